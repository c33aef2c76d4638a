"""Lamps calibrated on photographed spheres, and the material file that a fit leaves."""

import math
import tomllib

import numpy as np
import pytest
from rangecheck_cli.main import exit_status

from rangecheck.errors import SceneError
from rangecheck.recover.matt import gains_under, lights_from_matt, prediction_errors, rough_matt
from rangecheck.recover.sight import sphere_sight
from rangecheck.recover.spheres import Outline, light_from_chrome, outline_of
from rangecheck.reflectance import load_material

SPHERE = Outline((60.0, 58.0), 50.0)


def degrees(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


def matt_picture(direction, gain=0.7, slope=0.0, noise=0.01, seed=0):
    sight = sphere_sight(SPHERE.centre_px, SPHERE.radius_px, (120, 121), 0.5)
    shown = gain * rough_matt(sight.normals, sight.views, direction, slope)
    return sight.spread(shown, 0.0) + np.random.default_rng(seed).normal(0, noise, (120, 121))


def test_a_lamp_is_found_on_a_matt_sphere_and_its_gain_with_it():
    lamps = np.array([[0.3, 0.2, 0.9], [-0.4, 0.3, 0.8], [0.1, -0.5, 0.7]])
    lamps /= np.linalg.norm(lamps, axis=1, keepdims=True)
    found = lights_from_matt([matt_picture(d, slope=0.3, seed=k) for k, d in enumerate(lamps)], SPHERE)
    assert degrees(found.directions, lamps).max() < 0.3
    assert np.abs(found.gains / 0.7 - 1).max() < 0.01
    assert found.slope == pytest.approx(0.3, abs=0.05)


def test_a_stain_does_not_pull_the_lamps_to_its_other_side():
    lamps = np.array([[0.3, 0.2, 0.9], [-0.4, 0.3, 0.8], [0.1, -0.5, 0.7], [-0.1, 0.5, 0.8]])
    lamps /= np.linalg.norm(lamps, axis=1, keepdims=True)
    rows, columns = np.indices((120, 121))
    stain = np.where(np.hypot(columns - 40, rows - 75) < 18, 0.8, 1.0)
    pictures = [stain * matt_picture(d, slope=0.3, seed=k) for k, d in enumerate(lamps)]
    found = lights_from_matt(pictures, SPHERE)
    assert degrees(found.directions, lamps).max() < 0.5
    assert found.paint[75, 40] == pytest.approx(0.8, abs=0.03) and found.paint[40, 75] == pytest.approx(1.0, abs=0.03)
    # two pictures are not enough to tell paint from light
    assert degrees(lights_from_matt(pictures[:2], SPHERE).directions, lamps[:2]).max() > 0.5


def test_a_beam_uneven_across_the_ball_is_not_taken_for_a_lamp_elsewhere():
    lamps = np.array([[0.3, 0.2, 0.9], [-0.4, 0.3, 0.8], [0.1, -0.5, 0.7], [-0.1, 0.5, 0.8]])
    lamps /= np.linalg.norm(lamps, axis=1, keepdims=True)
    beams = np.array([[0.15, 0.0], [-0.1, 0.15], [0.0, -0.15], [-0.05, 0.0]])
    rows, columns = np.indices((120, 121))
    x, y = (columns - 60) / 50, (58 - rows) / 50
    pictures = [
        (1 + b[0] * x + b[1] * y) * matt_picture(d, slope=0.2, noise=0.005, seed=k) for k, (d, b) in enumerate(zip(lamps, beams))
    ]
    found = lights_from_matt(pictures, SPHERE, same_strength=True)
    # as steep as 15 % over a radius: taken for even, such a beam turns its lamp by degrees
    assert degrees(found.directions, lamps).max() < 1.0
    assert np.abs(found.uneven - beams).max() < 0.03
    assert np.abs(found.gains / found.gains[0] - 1).max() == 0.0 and np.abs(found.apart).max() < 0.005


def test_a_highlight_s_place_on_a_mirror_ball_is_its_lamp_s_direction():
    sight = sphere_sight(SPHERE.centre_px, SPHERE.radius_px, (120, 121), 0.5)
    lamp = np.array([0.3, 0.5, 0.81])
    lamp /= np.linalg.norm(lamp)
    mirrored = 2 * sight.normals[:, 2:] * sight.normals - sight.views
    picture = sight.spread((degrees(mirrored, lamp) < 6.0).astype(float), 0.0)
    # a highlight 6 degrees in radius is 5 pixels wide: its middle is known to a tenth of a pixel, 0.2 degrees
    assert degrees(light_from_chrome(picture, SPHERE), lamp) < 0.3


def test_the_room_s_light_is_taken_from_the_shadows_of_the_other_pictures():
    lamps = np.array([[0.5, 0.2, 0.8], [-0.5, 0.3, 0.8], [0.1, -0.6, 0.7], [0.0, 0.6, 0.75]])
    lamps /= np.linalg.norm(lamps, axis=1, keepdims=True)
    inside = matt_picture(lamps[0], noise=0.0) != 0.0
    pictures = [matt_picture(d, slope=0.3, seed=k) + 0.7 * 0.05 * inside for k, d in enumerate(lamps)]
    # noise of the pictures is 1 % of full scale
    assert prediction_errors(pictures, SPHERE, lamps).max() < 0.014


def test_what_shows_no_lamp_or_no_disc_is_refused():
    with pytest.raises(SceneError, match="dark"):
        light_from_chrome(np.zeros((120, 121)), SPHERE)
    with pytest.raises(SceneError, match="no disc"):
        outline_of(np.ones((40, 90), bool))
    with pytest.raises(SceneError, match="12 pixels"):
        outline_of(np.eye(12))


@pytest.mark.real_data
def test_photographed_spheres_give_their_lamps_and_predict_each_other(real_data):
    import cv2

    folder = real_data / "spheres_photographed"

    def read(kind, name):
        return cv2.imread(str(folder / kind / f"{kind}.{name}.png"), cv2.IMREAD_GRAYSCALE) / 255.0

    listed = np.loadtxt(folder / "lights.txt", skiprows=1)
    listed /= np.linalg.norm(listed, axis=1, keepdims=True)
    mirror = outline_of(read("chrome", "mask") > 0.5)
    chrome = np.array([light_from_chrome(read("chrome", k), mirror) for k in range(12)])
    assert np.median(degrees(chrome, listed)) < 2.5
    outline = outline_of(read("gray", "mask") > 0.5)
    pictures = [read("gray", k) for k in range(12)]
    # taken to be of one strength, as under the list they are to 0.2 %; left free they come out 2 % apart either way
    matt = lights_from_matt(pictures, outline, same_strength=True)
    # an independent witness, the mirror's lamps, agrees; the list itself lies 2 degrees from them
    assert np.median(degrees(matt.directions, chrome)) < 0.8 and degrees(matt.directions, chrome).max() < 2.5
    assert np.median(degrees(matt.directions, listed)) < 2.5
    # its stains and uneven beams, once found, leave a third of what one albedo for all pixels under even light leaves
    assert 0.02 < matt.spread < 0.08 and matt.rms < 0.007
    # one albedo for all twelve: under its own lamps, beams held as fitted, and under the listed ones
    assert np.abs(matt.apart).max() < 0.003
    gains = gains_under(pictures, outline, listed)
    assert np.abs(gains / gains.mean() - 1.0).max() < 0.01
    # each picture is predicted by the others alone, under the mirror's lamps, of which the matt sphere has told nothing
    by_mirror = prediction_errors(pictures, outline, chrome)
    assert by_mirror.max() < 0.0392 and math.sqrt(float((by_mirror**2).mean())) < 0.018
    # and better where its own part told of its lamp and beam: under the matt sphere's own lamps, and under the list with their beams
    assert prediction_errors(pictures, outline, matt.directions, beams=matt.beams).max() < 0.01
    by_list = prediction_errors(pictures, outline, listed, beams=matt.beams)
    assert by_list.max() < 0.04 and math.sqrt(float((by_list**2).mean())) < 0.018


def test_the_command_writes_a_material_with_its_uncertainty_that_other_commands_take(tmp_path):
    import cv2

    lamp = np.array([0.4, 0.3, 0.8]) / np.linalg.norm([0.4, 0.3, 0.8])
    picture = np.clip(matt_picture(lamp, 0.6) * 65535, 0, 65535).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "ball.png"), picture)
    sphere = ["--sphere", "60,58,50"]
    assert exit_status(["fit", str(tmp_path / "ball.png"), *sphere, "-o", str(tmp_path / "ball.toml"), "-q"]) == 0
    material = load_material(tmp_path / "ball.toml")
    # irradiance 3, so that a white surface shows 3/pi
    assert material.K_lm == pytest.approx(0.6 * math.pi / 3, rel=0.01)
    # a picture in that material, which knows one wavelength, is grey
    shown = ["configs/scenes/ring_on_sheet.toml", "--size", "24x20", "--material", str(tmp_path / "ball.toml")]
    assert exit_status(["render", *shown, "-o", str(tmp_path / "ring.png"), "-q"]) == 0
    ring = cv2.imread(str(tmp_path / "ring.png"))
    assert ring.max() > 50 and np.array_equal(ring[..., 0], ring[..., 2])
    document = tomllib.loads((tmp_path / "ball.toml").read_text())
    low, high = document["uncertainty"]["K_lm"]
    assert low < material.K_lm < high
    assert document["uncertainty"]["not_determined"]
    assert (
        exit_status(["fit", str(tmp_path / "ball.png"), *sphere, "--calibrate", "matt", "-o", str(tmp_path / "l.txt"), "-q"]) == 0
    )
    assert degrees(np.loadtxt(tmp_path / "l.txt", skiprows=1), lamp) < 0.5
    assert exit_status(["fit", str(tmp_path / "ball.png"), "-o", str(tmp_path / "b.toml"), "-q"]) == 2


def test_the_command_finds_what_it_is_asked_to_beside_the_material(tmp_path, capsys):
    import json

    import cv2

    for k, exposure in enumerate((1.0, 0.8)):
        picture = exposure * matt_picture(
            np.array([0.4 - 0.6 * k, 0.3, 0.8]) / np.linalg.norm([0.4 - 0.6 * k, 0.3, 0.8]), 0.6, seed=k
        )
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.clip(picture * 65535, 0, 65535).astype(np.uint16))
    both = [str(tmp_path / "0.png"), str(tmp_path / "1.png"), "--sphere", "60,58,50"]
    assert exit_status(["fit", *both, "--find", "exposure", "-o", str(tmp_path / "m.toml"), "--json"]) == 0
    found = {e["name"]: e for e in json.loads(capsys.readouterr().out)["estimates"]}
    assert found["picture 1 exposure"]["value"] == pytest.approx(0.8, rel=0.01)
    assert exit_status(["fit", *both, "--find", "pose", "-o", str(tmp_path / "p.toml"), "-q"]) == 2
