"""Laws of the lobe and the spike: reciprocity, limits, energy, and the known table of what the published model gives out."""

import numpy as np
import pytest

from rangecheck.errors import ArrayError
from rangecheck.reflectance import KirchhoffWarning, directional_albedo, lobe_brdf, spike_reflectance
from rangecheck.reflectance.energy import visibility_table
from rangecheck.reflectance.fast import FAST_ERROR
from rangecheck.reflectance.fresnel import conductor_fresnel

GREEN = 0.555
FIGURE_8 = {"sigma_um": 0.1, "correlation_um": 3.0, "wavelength_um": GREEN}


def directions(count, seed):
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 0.5 * np.pi, count), rng.uniform(0, 0.5 * np.pi, count), rng.uniform(-np.pi, np.pi, count)


@pytest.mark.parametrize("masking", ["none", "smith", "v-groove"])
@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("form", ["series", "fast", "smooth", "rough"])
def test_light_may_run_backwards(form, masking, bounded):
    i, r, phi = directions(500, 3)
    there = lobe_brdf(i, r, phi, form=form, masking=masking, bounded=bounded, **FIGURE_8)
    back = lobe_brdf(r, i, -phi, form=form, masking=masking, bounded=bounded, **FIGURE_8)
    assert (there >= 0).all() and np.isfinite(there).all()
    np.testing.assert_allclose(there, back, rtol=1e-12, atol=0)


def test_the_rough_limit_is_the_microfacet_model_of_beckmann():
    """D F G / (4 c_i c_r) with F = G = 1, slopes of rms alpha = 2 sigma/T, from the half vector itself."""
    i, r, phi = directions(5000, 4)
    i, r = 0.98 * i, 0.98 * r
    sigma, correlation = 2.0, 20.0
    ours = lobe_brdf(i, r, phi, sigma_um=sigma, correlation_um=correlation, wavelength_um=0.5, form="rough")
    light = np.stack([-np.sin(i), np.zeros_like(i), np.cos(i)], axis=-1)
    viewer = np.stack([np.sin(r) * np.cos(phi), np.sin(r) * np.sin(phi), np.cos(r)], axis=-1)
    half = light + viewer
    tan2 = (half[:, 0] ** 2 + half[:, 1] ** 2) / half[:, 2] ** 2
    alpha2 = (2 * sigma / correlation) ** 2
    density = np.exp(-tan2 / alpha2) * (1 + tan2) ** 2 / (np.pi * alpha2)
    microfacet = density / (4 * np.cos(i) * np.cos(r))
    # the exponent itself, up to 700, is known to a few units in its last place
    bright = tan2 / alpha2 < 100
    assert bright.sum() > 1000
    np.testing.assert_allclose(ours[bright], microfacet[bright], rtol=1e-12)


def test_the_general_form_meets_the_rough_one_where_the_surface_is_rough():
    i, r = np.radians(30.0), np.radians(np.linspace(10, 50, 9))
    rough = {"sigma_um": 2.0, "correlation_um": 20.0, "wavelength_um": 0.5}
    np.testing.assert_allclose(lobe_brdf(i, r, 0.1, **rough), lobe_brdf(i, r, 0.1, form="rough", **rough), rtol=2e-3)


def test_the_tracers_form_is_the_general_one_within_its_stated_error():
    i, r, phi = directions(20_000, 5)
    for sigma, correlation in ((0.005, 3.0), (0.1, 3.0), (1.0, 10.0), (5.0, 200.0)):
        surface = {"sigma_um": sigma, "correlation_um": correlation, "wavelength_um": GREEN}
        exact, fast = lobe_brdf(i, r, phi, **surface), lobe_brdf(i, r, phi, form="fast", **surface)
        seen = exact > 1e-280
        assert seen.sum() > 100
        assert np.abs(fast[seen] / exact[seen] - 1).max() < FAST_ERROR


@pytest.mark.parametrize(
    ("sigma", "correlation", "albedos"),
    [
        (0.02, 3.0, (1.000, 1.000, 1.000, 1.003, 1.010)),
        (0.1, 3.0, (1.000, 1.000, 0.990, 1.079, 1.245)),
        (0.2, 3.0, (1.000, 0.995, 0.967, 1.293, 2.014)),
        (1.0, 10.0, (1.000, 0.985, 0.960, 1.255, 4.396)),
        (2.0, 6.0, (0.894, 0.961, 1.269, 2.675, 11.8)),
    ],
)
def test_the_published_model_gives_out_what_is_known_of_it(sigma, correlation, albedos):
    """Computed independently with 40-digit arithmetic; past about 75 degrees it makes energy."""
    angles = np.radians([0, 60, 75, 85, 89])
    ours = directional_albedo(
        angles, sigma_um=sigma, correlation_um=correlation, wavelength_um=GREEN, masking="none", bounded=False
    )
    half_a_digit = np.where(np.array(albedos) > 10, 0.05, 0.0005)
    assert (np.abs(ours - albedos) <= half_a_digit + 1e-6).all()


def test_the_spike_is_what_the_lobe_leaves_of_a_smooth_surface():
    angles = np.radians([0.0, 30.0, 60.0])
    spike = spike_reflectance(angles, sigma_um=0.02, wavelength_um=GREEN)
    np.testing.assert_allclose(spike, np.exp(-((4 * np.pi * 0.02 / GREEN * np.cos(angles)) ** 2)), rtol=1e-14)
    np.testing.assert_allclose(spike, [0.815, 0.857, 0.950], atol=0.0005)
    assert (spike_reflectance(angles, sigma_um=0.0, wavelength_um=GREEN) == 1).all()


GRAZING = np.concatenate([np.linspace(0, 80, 5), 90 - np.geomspace(10, 0.1, 25)])


@pytest.mark.parametrize("masking", ["smith", "v-groove"])
@pytest.mark.parametrize("waves_high", [0.003, 0.05, 0.4, 3.0])
@pytest.mark.parametrize("waves_long", [1.0, 8.0, 100.0])
def test_masked_and_bounded_no_angle_gives_out_more_than_it_receives(masking, waves_high, waves_long):
    albedo = directional_albedo(
        np.radians(GRAZING), sigma_um=waves_high, correlation_um=waves_long, wavelength_um=1.0, masking=masking, bounded=True
    )
    assert albedo.max() <= 1 + 1e-6


def test_the_bound_takes_nothing_where_the_model_keeps_its_energy():
    roughness, reach = (2 * np.pi * 0.1 / GREEN) ** 2, (np.pi * 3 / GREEN) ** 2
    bounded = visibility_table(roughness, reach, 1, True)
    masked = visibility_table(roughness, reach, 1, False)
    assert (bounded <= masked).all()
    from rangecheck.reflectance.energy import ENERGY_MARGIN, VISIBILITY_OCTAVES
    from rangecheck.reflectance.octaves import nodes

    steep = nodes(VISIBILITY_OCTAVES) > np.cos(np.radians(72))
    np.testing.assert_allclose(bounded[steep], masked[steep], atol=2 * ENERGY_MARGIN)


def test_fresnel_of_steel_is_the_measured_normal_reflectance_and_1_at_grazing():
    # n, k interpolated from Karlsson & Ribbing 1982; their normal reflectances
    for n, k, share in ((1.6777, 3.1170, 0.603), (2.0440, 3.6732, 0.641), (2.4401, 4.1820, 0.667)):
        assert conductor_fresnel(1.0, n, k) == pytest.approx(share, abs=0.0005)
        assert conductor_fresnel(1.0, n, k) == pytest.approx(((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2), rel=1e-14)
        assert conductor_fresnel(0.0, n, k) == 1.0


def test_a_correlation_length_below_the_wavelength_is_warned_of():
    with pytest.warns(KirchhoffWarning, match="0.01 is below the wavelength 0.555"):
        lobe_brdf(0.1, 0.1, 0.0, sigma_um=0.001, correlation_um=0.01, wavelength_um=GREEN)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sigma_um": -0.1}, "sigma_um is -0.1"),
        ({"correlation_um": 0.0}, "correlation_um is 0; it must be above 0"),
        ({"wavelength_um": [0.5, -1.0]}, "wavelength_um is -1"),
        ({"sigma_um": np.nan}, "sigma_um has 1 values that are not finite"),
        ({"form": "phong"}, "form is 'phong'; it must be one of series, smooth, rough, fast"),
        ({"masking": "some"}, "masking is 'some'"),
    ],
)
def test_what_no_surface_can_have_is_refused_by_name(change, words):
    with pytest.raises(ArrayError, match=words):
        lobe_brdf(0.1, 0.2, 0.0, **{**FIGURE_8, **change})
    with pytest.raises(ArrayError, match=r"theta_i spans 0 to 1\.6; polar angles"):
        lobe_brdf([0.0, 1.6], 0.2, 0.0, **FIGURE_8)


def test_everything_broadcasts_and_nothing_is_an_answer():
    value = lobe_brdf(
        np.zeros((4, 1)), 0.1, np.zeros(3), sigma_um=0.1, correlation_um=np.full((2, 1, 1), 3.0), wavelength_um=GREEN
    )
    assert value.shape == (2, 4, 3) and (value == value[0, 0, 0]).all()
    assert lobe_brdf([], 0.1, 0.0, **FIGURE_8).shape == (0,)
    assert lobe_brdf(0.1, 0.1, 0.0, bounded=True, **FIGURE_8).shape == ()
    assert lobe_brdf(0.1, 0.1, 0.0, sigma_um=0.0, correlation_um=3.0, wavelength_um=GREEN) == 0.0
    several = lobe_brdf(0.1, 0.1, 0.0, bounded=True, sigma_um=[0.1, 0.2, 0.1], correlation_um=3.0, wavelength_um=GREEN)
    assert several[0] == several[2] == lobe_brdf(0.1, 0.1, 0.0, bounded=True, **FIGURE_8) != several[1]


def test_the_horizon_itself_is_finite_when_masked_and_bounded():
    edge = 0.5 * np.pi
    for masking in ("smith", "v-groove"):
        value = lobe_brdf([edge, 0.3], edge, 0.0, masking=masking, bounded=True, **FIGURE_8)
        assert np.isfinite(value).all() and (value < 1e-3).all()
