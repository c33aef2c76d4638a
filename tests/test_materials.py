"""Materials: what ships is sourced and keeps its energy; what cannot be is refused with the value and the next step."""

import math

import numpy as np
import pytest

from rangecheck.errors import ArrayError, InputError, SceneError
from rangecheck.kernels import kernel
from rangecheck.reflectance import (
    GREY_UM,
    Material,
    directional_albedo,
    energy_table,
    load_material,
    lobe_brdf,
    material_names,
    polar_chart,
    stack_tables,
)
from rangecheck.reflectance.charts import polar_components
from rangecheck.reflectance.energy import visibility_of
from rangecheck.reflectance.fast import FAST_ERROR
from rangecheck.reflectance.fresnel import conductor_fresnel
from rangecheck.reflectance.lobe import SMITH
from rangecheck.reflectance.tables import FRESNEL, VISIBILITY, fresnel_at, lambert_value, lobe_value, spike_value, visibility_at

SHIPPED = material_names()


def test_the_materials_of_the_report_and_of_the_workshop_ship():
    assert {"plaster", "steel", "steel_satin", "steel_ground", "chrome", "brass"} <= set(SHIPPED)
    assert {"figure_8", "figure_10", "figure_11"} <= set(SHIPPED)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_material_is_sourced_and_gives_out_no_more_than_it_receives(name):
    material = load_material(name)
    assert material.source and material.description
    assert material.bounded and material.strengths().sum(axis=0).max() <= 1
    grazing = np.radians(np.concatenate([np.linspace(0, 80, 9), 90 - np.geomspace(10, 0.1, 30)]))
    k_lm, k_ss, k_sl, k_s = material.strengths()
    for w, wavelength in enumerate(material.wavelengths_um):
        if not (k_ss[w] + k_sl[w] + k_s[w]) or material.concerns():
            continue
        albedo = directional_albedo(
            grazing,
            sigma_um=material.sigma_um,
            correlation_um=material.correlation_um,
            wavelength_um=wavelength,
            masking=material.masking,
        )
        assert (k_lm[w] + (k_ss[w] + k_sl[w] + k_s[w]) * albedo).max() <= 1 + 1e-6


def test_brass_is_yellow_because_it_swallows_blue():
    brass = load_material("brass")
    red, green, blue = (conductor_fresnel(1.0, *brass.index_at(w)) for w in brass.wavelengths_um)
    assert red > green > 0.75 and blue < 0.5 < 0.9 * red


def test_only_figure_10_is_outside_the_theorys_assumptions_and_says_so():
    assert [name for name in SHIPPED if load_material(name).concerns()] == ["figure_10"]
    assert "below the wavelength" in load_material("figure_10").concerns()[0]


@kernel
def _read(surfaces, series, material, wave, c_i, c_r, sxy2, out):
    for n in range(c_i.size):
        out[n, 0] = lobe_value(surfaces, series, material, wave, c_i[n], c_r[n], sxy2[n])
        out[n, 1] = spike_value(surfaces, material, wave, c_i[n])
        out[n, 2] = fresnel_at(surfaces, material, wave, c_i[n])
        out[n, 3] = visibility_at(surfaces, material, wave, c_i[n])
        out[n, 4] = lambert_value(surfaces, material, wave)


def test_what_a_tracer_reads_is_the_public_model_times_strength_and_fresnel():
    steel, plaster = load_material("steel_satin"), load_material("plaster")
    surfaces, series = stack_tables([plaster, steel])
    rng = np.random.default_rng(21)
    i, r, phi = rng.uniform(0, 1.5, 500), rng.uniform(0, 1.5, 500), rng.uniform(-0.3, 0.3, 500)
    sxy2 = np.sin(i) ** 2 + np.sin(r) ** 2 - 2 * np.sin(i) * np.sin(r) * np.cos(phi)
    out = np.empty((500, 5))
    for wave, wavelength in enumerate(steel.wavelengths_um):
        _read(surfaces, series, 1, wave, np.cos(i), np.cos(r), sxy2, out)
        n, k = steel.index_at(wavelength)
        facet = np.sqrt(np.maximum(0, (np.cos(i) + np.cos(r)) ** 2 + sxy2)) / 2
        share = np.array([conductor_fresnel(min(c, 1.0), n, k) for c in facet])
        model = lobe_brdf(i, r, phi, sigma_um=0.1, correlation_um=3.0, wavelength_um=wavelength, masking="smith", bounded=True)
        bright = model > 1e-100
        # the table of F is linear between nodes: 2e-4
        np.testing.assert_allclose(out[bright, 0], (model * share)[bright], rtol=FAST_ERROR + 3e-4)
        own = np.array([conductor_fresnel(c, n, k) for c in np.cos(i)])
        np.testing.assert_allclose(out[:, 2], own, atol=2e-4)
        g = (4 * np.pi * 0.1 / wavelength * np.cos(i)) ** 2
        np.testing.assert_allclose(out[:, 1], out[:, 2] * np.exp(-g), rtol=1e-12)
        np.testing.assert_allclose(out[:, 3], visibility_of(surfaces[1, wave, VISIBILITY:FRESNEL], np.cos(i)), rtol=1e-12)
        assert (out[:, 4] == 0).all()
    _read(surfaces, series, 0, 0, np.cos(i), np.cos(r), sxy2, out)
    assert (out[:, 0] == 0).all() and (out[:, 1] == 0).all() and out[0, 4] == pytest.approx(0.9 / math.pi)


def test_unmasked_and_unbounded_a_tracer_reads_the_published_form():
    published = Material(
        "published", K_s=1.0, sigma_um=0.1, correlation_um=3.0, wavelengths_um=GREY_UM, masking="none", bounded=False
    )
    surfaces, series = published.tables()
    i, r = np.radians([10.0, 60.0, 85.0, 89.9]), np.radians([12.0, 58.0, 84.0, 89.0])
    sxy2 = (np.sin(i) - np.sin(r)) ** 2
    out = np.empty((4, 5))
    _read(surfaces, series, 0, 0, np.cos(i), np.cos(r), sxy2, out)
    np.testing.assert_allclose(
        out[:, 0], lobe_brdf(i, r, 0.0, sigma_um=0.1, correlation_um=3.0, wavelength_um=0.555), rtol=FAST_ERROR
    )


def test_v_groove_masking_reaches_the_tracer():
    grooved = Material("grooved", K_s=1.0, sigma_um=0.2, correlation_um=3.0, wavelengths_um=GREY_UM, masking="v-groove")
    surfaces, series = grooved.tables()
    i, r = np.radians([10.0, 60.0, 80.0]), np.radians([50.0, 40.0, 70.0])
    out = np.empty((3, 5))
    _read(surfaces, series, 0, 0, np.cos(i), np.cos(r), (np.sin(i) - np.sin(r)) ** 2, out)
    model = lobe_brdf(i, r, 0.0, sigma_um=0.2, correlation_um=3.0, wavelength_um=0.555, masking="v-groove", bounded=True)
    np.testing.assert_allclose(out[:, 0], model, rtol=FAST_ERROR)
    assert surfaces[0, 0, 5] != SMITH


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"K_lm": 0.5, "K_ss": 0.4, "K_sl": 0.4}, "is 1.3; more than 1 makes light from nothing"),
        ({"K_lm": 0.5, "K_s": 0.6}, "is 1.1; more than 1"),
        ({"K_lm": -0.1}, "strengths K must be 0 or more"),
        ({"K_lm": math.nan}, "strengths K must be 0 or more"),
        ({"K_lm": (0.1, 0.2)}, "K_lm has 2 values for 3 wavelengths"),
        ({"sigma_um": -1.0}, "sigma_um is -1.0"),
        ({"correlation_um": 0.0}, "correlation_um 0.0"),
        ({"wavelengths_um": ()}, "wavelengths_um is"),
        ({"masking": "phong"}, "masking is 'phong'"),
        ({"index_um": (0.5, 0.6), "n": (1.0, 2.0), "k": (1.0, 2.0)}, r"known from 0.5 to 0.6 um, not at 0.65 um"),
        ({"index_um": (0.4, 0.7), "n": (1.0,), "k": (1.0, 2.0)}, "equally long"),
        ({"index_um": (0.4, 0.7), "n": (1.0, 0.0), "k": (1.0, 2.0)}, "needs n > 0"),
    ],
)
def test_what_no_material_can_be_is_refused(values, words):
    with pytest.raises(SceneError, match=words):
        Material("wrong", **values)


def test_a_stack_needs_one_set_of_wavelengths():
    plaster, figure = load_material("plaster"), load_material("figure_8")
    with pytest.raises(SceneError, match=r"evaluate them at the same wavelengths with Material\.at"):
        stack_tables([plaster, figure])
    assert stack_tables([plaster.at(GREY_UM), figure]).surfaces.shape[:2] == (2, 1)
    with pytest.raises(SceneError, match="at least one material"):
        stack_tables([])


def test_strengths_between_wavelengths_are_interpolated():
    painted = Material("painted", K_lm=(0.8, 0.4, 0.2))
    assert painted.at((0.65, 0.60, 0.40)).K_lm == pytest.approx((0.8, 0.6, 0.2))


def test_a_material_file_says_what_is_wrong_with_it(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("K_lm = 0.5\nshine = 3\n")
    with pytest.raises(InputError, match=r"mine\.toml: unknown key shine; a material has K_lm"):
        load_material(path)
    path.write_text("K_lm = 0.8\nK_s = 0.5\n")
    with pytest.raises(InputError, match=r"mine\.toml: mine: K_lm \+ K_ss \+ K_sl \+ K_s is 1.3"):
        load_material(path)
    path.write_text("K_lm = ")
    with pytest.raises(InputError, match="is not valid TOML"):
        load_material(path)
    path.write_text("K_lm = 'much'\n")
    with pytest.raises(InputError, match="mine"):
        load_material(path)
    path.write_text("K_lm = 0.5\n[index]\nn = [1.0]\n")
    with pytest.raises(InputError, match="does not describe a material"):
        load_material(path)
    with pytest.raises(InputError, match="is no shipped material; choose one of"):
        load_material("marble")
    with pytest.raises(InputError, match="does not exist"):
        load_material(tmp_path / "absent.toml")
    path.write_text("K_lm = 0.5\n")
    assert load_material(path).name == "mine" and load_material(str(path)).K_lm == 0.5


def test_the_energy_table_adds_up_and_shows_what_the_published_form_makes_of_nothing():
    figure = load_material("figure_8")
    rows = {row["degrees"]: row for row in energy_table(figure, (0.0, 60.0, 89.0))}
    assert rows[89.0]["total"] <= 1 + 1e-6 < rows[89.0]["published"] == pytest.approx(1.245, abs=0.0005)
    assert rows[60.0]["spike"] == pytest.approx(0.278, abs=0.0005) and rows[60.0]["lobe"] == pytest.approx(0.722, abs=0.003)
    for row in rows.values():
        assert row["diffuse"] + row["spike"] + row["lobe"] == pytest.approx(row["total"])
    # Fresnel at normal incidence, on average over facets that all face nearly the same way
    steel = energy_table(load_material("steel"), (0.0,))
    assert [row["total"] for row in steel] == pytest.approx([0.667, 0.641, 0.603], abs=0.002)
    assert [row["wavelength_um"] for row in steel] == [0.65, 0.55, 0.45]
    assert {row["total"] for row in energy_table(load_material("plaster"), (0.0, 80.0))} == {0.9}


def test_the_polar_plot_points_where_mirrors_do():
    parts = polar_components(load_material("figure_8"), 45.0, 0.555)
    assert parts["degrees"][np.argmax(parts["lobe"])] == pytest.approx(45, abs=2)
    assert parts["spike"] == pytest.approx(math.exp(-((4 * math.pi * 0.1 / 0.555) ** 2) / 2), rel=1e-6)
    assert (parts["diffuse"] == 0).all()
    first, second = (polar_chart(load_material("steel_satin"), (45.0,)) for _ in range(2))
    assert first == second and first.startswith(b"<?xml") and first.rstrip().endswith(b"</svg>")
    with pytest.raises(ArrayError, match="view_degrees is 95"):
        polar_chart(load_material("plaster"), (95.0,))
