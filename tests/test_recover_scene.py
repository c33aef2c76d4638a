"""Materials recovered from pictures of modelled scenes, and what they serve afterwards."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rangecheck_cli.main import exit_status
from test_recover_command import fitted, holds, save

from rangecheck.config import load_settings
from rangecheck.modeler import read_model
from rangecheck.pipeline.pictures import scene_of
from rangecheck.pipeline.subject import Subject
from rangecheck.recover.calm import calmed
from rangecheck.recover.looks import moved_by
from rangecheck.recover.sight import sphere_sight
from rangecheck.reflectance import Material, load_material, side_by_side
from rangecheck.transport import Settings, Tracer
from rangecheck.transport.settings import FULL

#: as `fit` writes it: one wavelength, intervals beside the numbers
FITTED = """
K_lm = 0.4
K_sl = 0.2
sigma_um = 0.15
correlation_um = 2.0
wavelengths_um = [0.555]
[uncertainty]
residual_in_noises = 1.0
not_determined = []
K_lm = [0.39, 0.41]
"""


def ball_and_block(folder, ball, block):
    """A scene of a ball before a block; `ball` and `block` are names or files of materials."""
    scene = folder / "scene.toml"
    scene.write_text(
        f"""
        tolerance_mm = 0.02
        camera = {{ width = 120, height = 90, field_of_view_deg = 16, eye_mm = [60, 160, 420], target_mm = [5, 22, 0] }}
        source = [{{ at_mm = [-150, 300, 300], radius_mm = 15, radiance = 300 }}]
        [[body]]
        name = "ball"
        shape = "sphere"
        radius_mm = 30
        at_mm = [-15, 30, 0]
        material = "{ball}"
        [[body]]
        name = "block"
        shape = "box"
        size_mm = [30, 40, 30]
        at_mm = [35, 20, 10]
        material = "{block}"
        """
    )
    return str(scene)


def test_surfaces_side_by_side_are_at_the_wavelengths_of_the_one_that_is_known_at_most():
    grey, red = Material("grey", K_lm=0.5, wavelengths_um=(0.555,)), Material("red", K_lm=(0.6, 0.2, 0.1))
    [one, other] = side_by_side([grey, red])
    assert other is red and one.wavelengths_um == red.wavelengths_um and one.K_lm == (0.5, 0.5, 0.5)
    [same, twin] = side_by_side([grey, replace(grey, name="twin")])
    assert same is grey and twin.wavelengths_um == grey.wavelengths_um


def test_a_fitted_material_of_one_wavelength_stands_beside_shipped_ones_of_three(tmp_path):
    material = tmp_path / "fitted.toml"
    material.write_text(FITTED)
    scene = ball_and_block(tmp_path, material, "brass")
    small = ["--size", "48x36", "-q"]
    assert exit_status(["render", scene, "-o", str(tmp_path / "seen.png"), *small]) == 0
    blue, _, red = np.moveaxis(cv2.imread(str(tmp_path / "seen.png")).astype(int), 2, 0)
    # brass is yellow; beside it the ball, of which one wavelength is known, is grey but for what it mirrors
    assert (red - blue).max() > 30 and np.median(np.abs(red - blue)[(red > 60) & (red < 200)]) < 30
    assert exit_status(["turntable", scene, "-o", str(tmp_path / "turn.mp4"), "--frames", "2", *small]) == 0
    film = ["turntable", "configs/scenes/ring_on_sheet.toml", "--material", str(material), "-o", str(tmp_path / "ring.mp4")]
    assert exit_status([*film, "--frames", "2", *small]) == 0
    # drawn for a data set beside the shipped ones, on a scene of coloured parts
    (tmp_path / "ranges.toml").write_text(f'[material]\nnames = ["{material}", "steel"]\n')
    made = ["dataset", scene, "-o", str(tmp_path / "set"), "--count", "4", "--ranges", str(tmp_path / "ranges.toml")]
    assert exit_status([*made, *small]) == 0
    rows = [json.loads(line) for line in (tmp_path / "set" / "index.jsonl").read_text().splitlines()]
    assert {json.dumps(row).count("fitted") > 0 for row in rows} == {True, False} and not any(row["wrong"] for row in rows)


SATIN = "K_lm = 0.4\nK_sl = 0.25\nsigma_um = 0.15\ncorrelation_um = 2.0\nwavelengths_um = [0.55]\n"
TRUTH = {"K_lm": 0.4, "K_lobe": 0.25, "sigma_um": 0.15, "correlation_um": 2.0}


def pictured(folder, scene, *, exposure=0.5, noise=0.004, settings=None, seed=3):
    """A noisy linear picture of a scene's file by its own camera, as the tracer shows it with chance of its own; its path."""
    model = read_model(scene)
    lit = scene_of(Subject("scene", model.surface, model=model), load_material("plaster")).at((0.55,))
    # what `light.model=direct` follows: lamps, shadows, one reflection in mirrors
    settings = settings or Settings(each=16, shadow_rays=0, diffuse=False, depth=2, backdrop=False)
    film = Tracer(lit).render(model.camera, model.world_from_camera, settings, seed=seed)
    return save(folder / "seen.png", exposure * np.nan_to_num(film.radiance[..., 0]), noise, seed)


@pytest.fixture(scope="module")
def satin_ball(tmp_path_factory):
    """A satin ball before a bright matt block: scene, picture."""
    folder = tmp_path_factory.mktemp("satin")
    (folder / "satin.toml").write_text(SATIN)
    (folder / "matt.toml").write_text("wavelengths_um = [0.55]\nK_lm = 0.9\n")
    scene = ball_and_block(folder, folder / "satin.toml", folder / "matt.toml")
    return folder, scene, pictured(folder, scene)


def inside(found, truth, widths=2.0):
    # one truth in twenty lies outside of 95 %, one in ten thousand outside of twice that
    return {name: holds(found[name], value, widths) for name, value in truth.items()}


def test_a_scene_s_part_gets_its_own_material_under_the_scene_s_lamp_and_surroundings(satin_ball, capsys):
    folder, scene, picture = satin_ball
    known = [picture, "--on", scene, "--noise", "0.004", "--set", "picture.exposure=0.5"]
    document, found = fitted(capsys, *known, "--part", "ball", "-o", str(folder / "m.toml"))
    assert document["converged"] and len(document["lights"]) == 1 and document["residual_in_noises"] < 1.1
    assert all(inside(found, TRUTH).values()), found
    assert all(found[name]["high"] - found[name]["low"] < 0.3 * value for name, value in TRUTH.items())
    assert exit_status(["fit", *known, "-o", str(folder / "n.toml")]) == 2
    assert "--part, of ball, block" in capsys.readouterr().err


def test_parts_of_known_material_tell_an_exposure_that_nobody_said(satin_ball, capsys):
    folder, scene, picture = satin_ball
    asked = [picture, "--on", scene, "--noise", "0.004", "--part", "ball", "--find", "exposure"]
    document, found = fitted(capsys, *asked, "-o", str(folder / "e.toml"))
    # the lamps are as bright as the scene says, so that what is found is the exposure itself
    assert document["converged"] and all(inside(found, TRUTH | {"picture 0 exposure": 0.5}).values()), found
    assert found["picture 0 exposure"]["high"] - found["picture 0 exposure"]["low"] < 0.01
    assert exit_status(["fit", *asked[:-2], "-o", str(folder / "f.toml")]) == 2
    assert "--find exposure" in capsys.readouterr().err


def test_a_scene_of_one_material_does_not_tell_exposure_and_albedo_apart(tmp_path, capsys):
    (tmp_path / "matt.toml").write_text("wavelengths_um = [0.55]\nK_lm = 0.5\n")
    scene = ball_and_block(tmp_path, tmp_path / "matt.toml", tmp_path / "matt.toml")
    asked = [pictured(tmp_path, scene), "--on", scene, "--noise", "0.004", "--find", "exposure", "-o", str(tmp_path / "m.toml")]
    document, found = fitted(capsys, *asked)
    assert found["picture 0 exposure"]["low"] is None and found["K_lm"]["low"] is None
    assert any("K_lm" in said and "picture 0 exposure" in said and "apart" in said for said in document["not_determined"])


def test_what_steel_mirrors_of_its_surroundings_tells_its_material(tmp_path, capsys):
    scene = ball_and_block(tmp_path, "steel", "plaster")
    known = [pictured(tmp_path, scene, exposure=2.0), "--on", scene, "--noise", "0.004", "--set", "picture.exposure=2"]
    out = tmp_path / "m.toml"
    document, found = fitted(capsys, *known, "--part", "ball", "--spike", "-o", str(out))
    steel = load_material("steel")
    truth = {"K_spike": 1.0, "K_lobe": 1.0, "sigma_um": steel.sigma_um}
    assert document["converged"] and all(inside(found, truth).values()), found
    # its metal is known, so that its file is of steel at every wavelength
    again = load_material(out)
    assert again.index_um == steel.index_um and again.K_s == pytest.approx(1.0, abs=0.03) and again.at((0.45, 0.65)).n


def test_light_that_bright_neighbours_throw_is_not_taken_for_the_part_s_own(satin_ball, capsys):
    folder, scene, _ = satin_ball
    everything = replace(FULL, passes=32, backdrop=False)
    picture = pictured(folder, scene, settings=everything, seed=5)
    known = [picture, "--on", scene, "--noise", "0.004", "--part", "ball", "--set", "picture.exposure=0.5"]
    document, found = fitted(capsys, *known, "--set", "light.model=plan", "-o", str(folder / "p.toml"))
    assert document["converged"] and all(inside(found, TRUTH).values()), found
    # without it the ball would send out more light than it receives, which is refused
    assert exit_status(["fit", *known, "-o", str(folder / "q.toml"), "-q"]) == 2
    assert "no surface reflects more than it receives" in capsys.readouterr().err


def test_a_camera_that_two_smooth_bodies_do_not_tell_is_said_not_to_be_known_and_the_material_holds(satin_ball, capsys):
    folder, scene, _ = satin_ball
    picture = pictured(folder, scene)
    asked = [picture, "--on", scene, "--noise", "0.004", "--part", "ball", "--set", "picture.exposure=0.5", "--find", "pose"]
    model = read_model(scene)
    middle = model.surface.bounds_mm.mean(axis=0)
    off = moved_by(model.world_from_camera, middle, np.array([0.004, -0.006, 0.003, 0.8, -0.6, 2.0]))
    text = Path(scene).read_text()
    eye, ahead = off[:3, 3], off[:3, 3] + 400 * off[:3, 2]
    moved = text.replace(
        "eye_mm = [60, 160, 420], target_mm = [5, 22, 0]", f"eye_mm = {eye.tolist()}, target_mm = {ahead.tolist()}"
    )
    assert moved != text
    (folder / "moved.toml").write_text(moved)
    asked[2] = str(folder / "moved.toml")
    document, found = fitted(capsys, *asked, "-o", str(folder / "c.toml"))
    seen = np.array(document["world_from_camera"])
    stated = {name: truth for name, truth in TRUTH.items() if found[name]["low"] is not None}
    assert document["converged"] and "K_lm" in stated and all(inside(found, stated).values()), found
    off = np.linalg.norm(seen[:3, 3] - model.world_from_camera[:3, 3])
    within = document["camera_within_mm"]
    assert within is None or off <= max(within), (off, within)


def test_chance_in_smooth_light_is_shared_and_detail_is_kept():
    rng = np.random.default_rng(4)
    sight = sphere_sight((50, 50), 45, (101, 101))
    row, column = np.divmod(sight.pixel, 101)
    smooth, detail = 0.5 + 0.002 * row, np.where((row // 4 + column // 4) % 2, 1.0, 0.2)
    label = np.zeros(len(sight), int)
    # of a hundred paths one meets the lamp: rare, bright, and of the right mean
    rare = 0.3 * (rng.random((16, len(sight))) < 0.01) / 0.01
    observed = smooth + rare
    calm, variance = calmed(sight, observed.mean(axis=0), observed.var(axis=0, ddof=1) / 16, label, 1)
    truth = smooth + 0.3
    assert np.abs(calm - truth).std() < 0.3 * observed.mean(axis=0).std()
    assert abs((calm - truth).mean()) < 3.0 * np.sqrt(variance.mean() / len(calm))
    # weights by the variance do not lean towards pixels that no path lit
    assert abs(np.average(calm - truth, weights=1.0 / (variance + 1e-4))) < 5.0 * np.sqrt(variance.mean() / len(calm))
    sharp, _ = calmed(sight, detail, np.full(len(sight), 1e-6), label, 1)
    assert np.abs(sharp - detail).max() < 1e-3


def test_a_fitted_material_says_how_well_it_is_known_wherever_it_is_taken(tmp_path, capsys):
    material, small = tmp_path / "fitted.toml", ["--size", "32x24"]
    material.write_text(FITTED.replace("[]", '["the pictures do not determine sigma_um"]') + "sigma_um = []\n")
    scene = ball_and_block(tmp_path, material, "brass")
    known = "K_lm 0.4 (0.39 to 0.41), sigma_um 0.15 (not determined)"
    for command in (
        ["materials", str(material)],
        ["render", scene, "-o", str(tmp_path / "seen.png"), *small],
        ["turntable", scene, "-o", str(tmp_path / "turn.mp4"), "--frames", "2", *small],
    ):
        capsys.readouterr()
        assert exit_status([*command, "-q"]) == 0
        said = capsys.readouterr().out
        assert known in said and "not determined: the pictures do not determine sigma_um" in said
        assert ("fitted: fitted to pictures" in said) == (command[0] != "materials")
    material.write_text(FITTED.replace("[0.39, 0.41]", '"about 0.4"'))
    assert exit_status(["materials", str(material), "-q"]) == 2
    assert "its uncertainty cannot be read" in capsys.readouterr().err


def test_a_job_s_file_finds_its_material_beside_itself(tmp_path):
    (tmp_path / "satin.toml").write_text(SATIN)
    (tmp_path / "job.toml").write_text('[light]\nmaterials = ["satin.toml", "steel", "nowhere.toml"]\n')
    assert load_settings(tmp_path / "job.toml").light.materials == (str(tmp_path / "satin.toml"), "steel", "nowhere.toml")


def test_a_scene_s_file_finds_its_material_beside_itself(tmp_path):
    (tmp_path / "satin.toml").write_text(SATIN)
    scene = ball_and_block(tmp_path, "satin.toml", "brass")
    assert exit_status(["render", scene, "-o", str(tmp_path / "seen.png"), "--size", "32x24", "-q"]) == 0
