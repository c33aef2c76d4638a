"""What `fit` finds through the command, in pictures whose truth is known: the camera's pose, lamps by a bust-like shape, and what else it is asked for."""

import json
import re

import cv2
import numpy as np
import pytest
from rangecheck_cli.main import exit_status
from test_recover import bumpy_ball

from rangecheck import rigid
from rangecheck.export.meshes import write_mesh
from rangecheck.optics import PinholeCamera
from rangecheck.recover.lights import ONE_NODE, Light
from rangecheck.recover.looks import facing
from rangecheck.recover.problem import Guess, Photograph, Problem, Unknowns
from rangecheck.recover.sight import sphere_sight
from rangecheck.reflectance import Material, load_material
from rangecheck.scene import Scene
from rangecheck.transport import DIRECT, Tracer

SPHERE = ["--sphere", "60,58,50"]
AHEAD, ASIDE = np.array([0.4, 0.3, 0.8]), np.array([-0.3, 0.3, 0.8])
SATIN = Guess(0.5, 0.0, 0.2, 0.15, 1.5)


def save(path, picture, noise, seed):
    grain = np.random.default_rng(seed).normal(0.0, noise, picture.shape)
    cv2.imwrite(str(path), np.clip((picture + grain) * 65535, 0, 65535).astype(np.uint16))
    return str(path)


def sphere_picture(path, guess, direction, irradiance, *, distance=1e6, radius=0.25, ambient=0.0, noise=0.01, seed=0):
    """A picture of a sphere as the model shows it; the lamp stands about the middle of what is seen, as the command takes it to."""
    sight = sphere_sight((60, 58), 50, (120, 121))
    n = len(sight)
    light = Light(direction, irradiance, facing(sight).points.mean(axis=0), distance, radius)
    photo = Photograph(sight, np.zeros(n), np.ones(n), np.ones((n, 1), bool), (0,), ambient=ambient)
    problem = Problem((photo,), (light,), guess, Unknowns(), ONE_NODE)
    return save(path, sight.spread(problem.predict(problem.start(), 0, slopes=False).values, 0.0), noise, seed)


def fitted(capsys, *arguments):
    capsys.readouterr()
    assert exit_status(["fit", *arguments, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    return document, {e["name"]: e for e in document["estimates"]}


def holds(estimate, truth, widths=1.0):
    """Whether the truth lies inside the stated 95 % interval, made `widths` times as wide."""
    middle, half = 0.5 * (estimate["low"] + estimate["high"]), 0.5 * (estimate["high"] - estimate["low"])
    return abs(truth - middle) < widths * half


@pytest.mark.parametrize(
    ("find", "lamps", "options", "name", "truth"),
    [
        ("strength", [(AHEAD, 2.0, {}), (ASIDE, 1.6, {})], ["--irradiance", "2"], "light 1 irradiance", 1.6),
        ("ambient", [(AHEAD, 2.0, {"ambient": 0.05})], ["--irradiance", "2"], "picture 0 ambient", 0.05),
        ("distance", [(AHEAD, 1.5, {"distance": 300.0})], ["--irradiance", "1.5"], "light 0 distance", 300.0),
    ],
)
def test_what_the_command_is_asked_to_find_lies_in_its_interval(tmp_path, capsys, find, lamps, options, name, truth):
    pictures = [sphere_picture(tmp_path / f"{k}.png", SATIN, d, e, seed=k, **more) for k, (d, e, more) in enumerate(lamps)]
    document, found = fitted(capsys, *pictures, *SPHERE, *options, "--find", find, "-o", str(tmp_path / "m.toml"))
    # one truth in twenty lies outside of 95 %, one in ten thousand outside of twice that
    assert document["converged"] and holds(found[name], truth, 2.0) and holds(found["K_lm"], SATIN.K_lm, 2.0)
    width = found[name]["high"] - found[name]["low"]
    assert width < 0.05 * truth if find != "distance" else width < 0.2 * truth


def test_noise_that_is_cut_off_at_black_is_no_ambient_light(tmp_path, capsys):
    picture = sphere_picture(tmp_path / "0.png", SATIN, ASIDE, 2.0, distance=300.0)
    options = ["--irradiance", "2", "--find", "ambient", "--find", "distance", "--lamp-distance", "500"]
    _, found = fitted(capsys, picture, *SPHERE, *options, "-o", str(tmp_path / "m.toml"))
    # the dark side is on average 0.4 noises too bright
    assert holds(found["picture 0 ambient"], 0.0, 2.0) and holds(found["light 0 distance"], 300.0, 2.0)


def test_a_mirror_shows_how_large_its_lamp_is(tmp_path, capsys):
    mirror = Guess(0.4, 0.25, 1e-4, 0.02, 2.0)
    picture = sphere_picture(tmp_path / "0.png", mirror, AHEAD, 0.05, radius=4.0, noise=0.002)
    options = ["--irradiance", "0.05", "--noise", "0.002", "--spike", "--find", "radius", "--lamp-radius", "2"]
    _, found = fitted(capsys, picture, *SPHERE, *options, "-o", str(tmp_path / "m.toml"))
    assert holds(found["light 0 radius"], 4.0, 2.0) and found["light 0 radius"]["high"] < 4.1
    # where no lobe is seen the spike may have lost light to a roughness that nothing shows
    assert found["sigma_um"]["low"] is None and holds(found["K_spike"], 0.25)


def test_a_saturated_mirror_is_said_to_be_known_from_below_only(tmp_path, capsys):
    picture = sphere_picture(tmp_path / "0.png", Guess(0.4, 0.25, 1e-4, 0.02, 2.0), AHEAD, 2.0, radius=4.0)
    out = tmp_path / "m.toml"
    capsys.readouterr()
    options = ["--irradiance", "2", "--spike", "--lamp-radius", "4"]
    assert exit_status(["fit", picture, *SPHERE, *options, "-o", str(out), "-q"]) == 0
    said = capsys.readouterr().out
    assert "the most that a surface can mirror beside K_lm" in said
    material = load_material(out)
    assert material.K_lm == pytest.approx(0.4, rel=0.02) and material.K_lm + material.K_ss + material.K_s == pytest.approx(1.0)


def test_what_acts_only_together_is_said_not_to_be_told_apart(tmp_path, capsys):
    pictures = [sphere_picture(tmp_path / f"{k}.png", SATIN, d, 1.5, seed=k) for k, d in enumerate((AHEAD, ASIDE))]
    both = ["--irradiance", "1.5", "--find", "strength", "--find", "exposure", "-o", str(tmp_path / "m.toml")]
    document, found = fitted(capsys, *pictures, *SPHERE, *both)
    assert found["light 1 irradiance"]["low"] is None and found["picture 1 exposure"]["low"] is None
    [said] = document["not_determined"]
    assert re.search("only (light 1 irradiance x picture 1 exposure|picture 1 exposure x light 1 irradiance) acts", said)
    rough = sphere_picture(tmp_path / "rough.png", Guess(0.3, 0.0, 0.4, 3.0, 30.0), AHEAD, 2.0)
    document, found = fitted(capsys, rough, *SPHERE, "--irradiance", "2", "-o", str(tmp_path / "r.toml"))
    assert found["sigma_um"]["low"] is None and found["K_lm"]["low"] is not None
    assert any(
        "correlation_um / sigma_um acts" in said or "sigma_um / correlation_um acts" in said
        for said in document["not_determined"]
    )


@pytest.fixture(scope="module")
def on_the_ball(tmp_path_factory):
    """A bumpy ball as a mesh file, and a traced picture of it by a camera that is not quite where it is said to be; pose, lamp, folder."""
    folder = tmp_path_factory.mktemp("ball")
    surface = bumpy_ball()
    write_mesh(surface, folder / "ball.ply")
    middle = surface.bounds_mm.mean(axis=0)
    camera, pose = PinholeCamera.from_field_of_view(110, 110, 16.0), np.array(rigid.look_at((100, 80, 400.0), middle))
    turn = np.array([0.004, -0.003, 0.006])
    angle = np.linalg.norm(turn)
    pose[:3, :3] = rigid.about_axis(turn / angle, angle)[:3, :3] @ pose[:3, :3]
    pose[:3, 3] += [1.5, -2.0, 1.0]
    light = Light(np.array([-0.4, 0.5, 0.8]), 2.0, middle, 1e6, 0.25)
    satin = Material("satin", K_lm=0.3, K_sl=0.2, sigma_um=0.15, correlation_um=2.0, wavelengths_um=(0.555,))
    shown = Tracer(Scene(surface, (satin,), sources=(light.source(),), smooth=True)).render(camera, pose, DIRECT)
    save(folder / "seen.png", np.nan_to_num(shown.radiance[..., 0]), 0.005, 1)
    (folder / "lamp.txt").write_text("-0.3 0.45 0.8\n")
    return folder, pose, light


def test_a_camera_that_stood_elsewhere_is_found_within_its_interval_and_the_lamp_with_it(on_the_ball, capsys):
    folder, pose, light = on_the_ball
    known = ["--on", str(folder / "ball.ply"), "--unit", "mm", "--camera", "100,80,400", "--field", "16", "--irradiance", "2"]
    known += ["--noise", "0.005", "--lights", str(folder / "lamp.txt")]
    document, found = fitted(capsys, str(folder / "seen.png"), *known, "--find", "pose", "-o", str(folder / "m.toml"))
    seen = np.array(document["world_from_camera"])
    off, within = seen[:3, 3] - pose[:3, 3], np.array(document["camera_within_mm"])
    # from 2.7 mm and half a degree off
    assert document["converged"] and (np.abs(off) < 1.5 * within).all() and within.max() < 2.0
    turned = np.degrees(np.arccos(np.clip(0.5 * (np.trace(seen[:3, :3] @ pose[:3, :3].T) - 1.0), -1.0, 1.0)))
    assert turned < 1.5 * document["camera_turn_within_deg"] < 0.6
    assert document["residual_in_noises"] < 1.1 and holds(found["K_lm"], 0.3, 2.0)
    assert np.degrees(np.arccos(np.clip(document["lights"][0] @ light.direction, -1.0, 1.0))) < 0.5
    # where the camera is taken to be as it is said, the picture is not explained
    elsewhere, _ = fitted(capsys, str(folder / "seen.png"), *known, "-o", str(folder / "n.toml"))
    assert elsewhere["residual_in_noises"] > 1.2 * document["residual_in_noises"] and elsewhere["world_from_camera"] is None


def test_lamps_are_calibrated_on_the_bust_itself_and_the_list_serves_where_lamps_are_known(tmp_path, capsys):
    surface = bumpy_ball()
    write_mesh(surface, tmp_path / "ball.ply")
    middle = surface.bounds_mm.mean(axis=0)
    camera, pose = PinholeCamera.from_field_of_view(56, 56, 16.0), np.array(rigid.look_at((100, 80, 400.0), middle))
    satin = Material("satin", K_lm=0.3, K_sl=0.1, sigma_um=0.6, correlation_um=4.0, wavelengths_um=(0.555,))
    towards, strengths = np.array([[-0.4, 0.5, 0.8], [0.7, 0.3, 0.5]]), [2.0, 1.8]
    pictures = []
    for k, (d, e) in enumerate(zip(towards, strengths)):
        lamp = Light(d, e, middle, 1e6, 0.25).source()
        shown = Tracer(Scene(surface, (satin,), sources=(lamp,), smooth=True)).render(camera, pose, DIRECT)
        pictures.append(save(tmp_path / f"{k}.png", np.nan_to_num(shown.radiance[..., 0]), 0.005, k))
    seen = ["--on", str(tmp_path / "ball.ply"), "--unit", "mm", "--camera", "100,80,400", "--field", "16", "--noise", "0.005"]
    capsys.readouterr()
    assert exit_status(["fit", *pictures, *seen, "--calibrate", "bust", "-o", str(tmp_path / "lamps.txt"), "--json"]) == 0
    written = capsys.readouterr()
    assert "what the surface's parts throw on each other is followed only in a scene" in written.err
    found = json.loads(written.out)
    assert found["kind"] == "bust" and found["converged"] and found["residual_in_noises"] < 1.1
    truth = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    off = np.degrees(np.arccos(np.clip((np.array(found["directions"]) * truth).sum(1), -1.0, 1.0)))
    # two angles inside their intervals, made half again as wide
    assert (off < 1.5 * np.sqrt(2.0) * np.array(found["within_deg"])).all() and max(found["within_deg"]) < 0.4
    assert np.abs(np.array(found["strengths"]) / strengths * strengths[0] - 1.0).max() < 0.01
    lamps = np.loadtxt(tmp_path / "lamps.txt", skiprows=1)
    assert lamps == pytest.approx(np.array(found["directions"]), abs=1e-6)
    document, _ = fitted(
        capsys, *pictures, *seen, "--find", "strength", "--lights", str(tmp_path / "lamps.txt"), "-o", str(tmp_path / "m.toml")
    )
    assert document["residual_in_noises"] < 1.1
    for wrong, why in (
        (["--sphere", "45,45,40", "--calibrate", "bust"], "--on MESH"),
        (["--on", str(tmp_path / "ball.ply"), "--calibrate", "chrome"], "--sphere"),
        (["--sphere", "45,45,40", "--calibrate", "chrome", "--same-strength"], "no strengths"),
    ):
        assert exit_status(["fit", *pictures, *wrong, "-q"]) == 2 and why in capsys.readouterr().err


def test_a_chrome_sphere_s_highlights_are_listed_as_lamps(tmp_path, capsys):
    sight = sphere_sight((60, 58), 50, (120, 121), 0.5)
    lamps = np.array([[0.3, 0.5, 0.81], [-0.4, 0.1, 0.9]])
    lamps /= np.linalg.norm(lamps, axis=1, keepdims=True)
    mirrored = 2 * sight.normals[:, 2:] * sight.normals - sight.views
    names = [
        save(tmp_path / f"{k}.png", sight.spread((mirrored @ lamp > np.cos(np.radians(6.0))).astype(float), 0.0), 0.0, k)
        for k, lamp in enumerate(lamps)
    ]
    assert exit_status(["fit", *names, *SPHERE, "--calibrate", "chrome", "-o", str(tmp_path / "lamps.txt"), "--json"]) == 0
    found = np.array(json.loads(capsys.readouterr().out)["directions"])
    assert np.degrees(np.arccos((found * lamps).sum(1))).max() < 0.3
    assert np.loadtxt(tmp_path / "lamps.txt", skiprows=1) == pytest.approx(found, abs=1e-6)
