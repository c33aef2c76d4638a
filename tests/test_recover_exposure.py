"""Pictures that hold no light, or more than their sensor counts, are refused in one line each; nothing is written of them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from rangecheck_cli.main import exit_status
from test_recover_command import AHEAD, SATIN, SPHERE, fitted, holds, save, sphere_picture

from rangecheck.errors import SceneError
from rangecheck.pipeline.fitting import _line
from rangecheck.recover.fit import Estimate
from rangecheck.recover.lights import Light
from rangecheck.recover.matt import lights_from_matt
from rangecheck.recover.outcome import as_far_as_known
from rangecheck.recover.polish import polish
from rangecheck.recover.problem import Guess, Photograph, Problem, Unknowns
from rangecheck.recover.sight import sphere_sight
from rangecheck.recover.spheres import Outline, light_from_chrome
from rangecheck.reflectance import load_material

BALL = Outline((60.0, 58.0), 50.0)


@pytest.fixture
def lamps(tmp_path):
    (tmp_path / "lamps.txt").write_text("0.4 0.3 0.8\n")
    return str(tmp_path / "lamps.txt")


@pytest.mark.parametrize(
    ("level", "said"), [(0.0, "is dark where the object is"), (1.0, "is saturated everywhere on the object")]
)
def test_a_picture_without_light_or_with_too_much_is_no_material(tmp_path, capsys, lamps, level, said):
    picture = save(tmp_path / "even.png", np.full((120, 121), level), 0.0, 0)
    assert exit_status(["fit", picture, *SPHERE, "--lights", lamps, "-o", str(tmp_path / "m.toml"), "-q"]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "m.toml").exists()


def test_a_picture_of_noise_alone_is_dark(tmp_path, capsys, lamps):
    picture = save(tmp_path / "noise.png", np.zeros((120, 121)), 0.01, 1)
    assert exit_status(["fit", picture, *SPHERE, "--lights", lamps, "-o", str(tmp_path / "m.toml"), "-q"]) == 2
    assert "is dark where the object is" in capsys.readouterr().err


def test_a_material_goes_into_a_file_that_materials_are_read_from(tmp_path, capsys, lamps):
    picture = sphere_picture(tmp_path / "ball.png", SATIN, AHEAD, 2.0)
    assert exit_status(["fit", picture, *SPHERE, "--lights", lamps, "-o", str(tmp_path / "m.png"), "-q"]) == 2
    assert "materials are read from .toml" in capsys.readouterr().err
    assert not (tmp_path / "m.png").exists()


@pytest.mark.parametrize("direction", ["nan 0.3 0.8", "0 0 0"])
def test_a_direction_that_is_none_is_told_by_its_file(tmp_path, capsys, direction):
    picture = sphere_picture(tmp_path / "ball.png", SATIN, AHEAD, 2.0)
    (tmp_path / "none.txt").write_text(direction)
    arguments = ["fit", picture, *SPHERE, "--lights", str(tmp_path / "none.txt"), "-o", str(tmp_path / "m.toml"), "-q"]
    assert exit_status(arguments) == 2
    assert "none.txt: holds" in capsys.readouterr().err


def test_an_overexposed_ball_shows_no_lamp():
    with pytest.raises(SceneError, match="saturated where it is lit"):
        lights_from_matt([np.ones((120, 121))], BALL)
    with pytest.raises(SceneError, match="a lamp mirrored in chrome is a small spot"):
        light_from_chrome(np.ones((120, 121)), BALL)


def test_a_number_at_the_end_of_what_is_looked_for_says_why_it_is_not_known():
    ended = Estimate("correlation_um", 0.2775, None, None, at_bound=True)
    assert _line(ended).endswith("not determined: the end of what is looked for")
    assert _line(replace(ended, at_bound=False)).endswith("not determined")
    assert _line(replace(ended, low=0.2, high=0.3)).endswith("0.2 to 0.3 (95 %)")


def test_a_material_given_for_a_scene_is_told_from_one(tmp_path, capsys):
    (tmp_path / "chalk.toml").write_text('description = "Chalk"\nK_lm = 0.8\n')
    assert exit_status(["render", str(tmp_path / "chalk.toml"), "-o", str(tmp_path / "x.png"), "-q"]) == 2
    assert "holds a material, no scene; give it as --material" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["chrome", "matt"])
def test_of_several_pictures_of_a_ball_the_one_that_shows_no_lamp_is_named(tmp_path, capsys, kind):
    lit = sphere_picture(tmp_path / "lit.png", SATIN if kind == "matt" else Guess(0.0, 0.9, 1e-4, 0.02, 2.0), AHEAD, 2.0)
    dark = save(tmp_path / "dark.png", np.zeros((120, 121)), 0.0, 0)
    assert exit_status(["fit", lit, dark, *SPHERE, "--calibrate", kind, "-q"]) == 2
    assert "dark.png: the sphere is dark" in capsys.readouterr().err


def test_a_strength_that_is_not_determined_is_told_as_it_is_taken(tmp_path, capsys):
    picture = sphere_picture(tmp_path / "0.png", Guess(0.4, 0.25, 1e-4, 0.02, 2.0), AHEAD, 2.0, radius=4.0)
    options = ["--irradiance", "2", "--spike", "--lamp-radius", "4"]
    _, found = fitted(capsys, picture, *SPHERE, *options, "-o", str(tmp_path / "m.toml"))
    material = load_material(tmp_path / "m.toml")
    assert found["K_spike"]["low"] is None and found["K_spike"]["value"] == pytest.approx(material.K_ss + material.K_s)


def test_a_picture_that_shows_something_else_than_the_shape_is_said_not_to_be_explained(tmp_path, capsys):
    path = sphere_picture(tmp_path / "ball.png", Guess(0.7, 0.0, 0.2, 0.15, 1.5), AHEAD, 1.2)
    picture = cv2.imread(path, -1)
    # a card stands before the left of the ball, brighter there than it
    picture[:, :55] = 60000
    cv2.imwrite(path, picture)
    assert exit_status(["fit", path, *SPHERE, "--irradiance", "6", "-o", str(tmp_path / "m.toml"), "-q"]) == 1
    assert "the pictures are not explained" in capsys.readouterr().out
    assert "the pictures are not explained" in (tmp_path / "m.toml").read_text()
    assert exit_status(["fit", path, *SPHERE, "--irradiance", "0.5", "-o", str(tmp_path / "n.toml"), "-q"]) == 2
    said = capsys.readouterr().err
    assert "the pictures are not explained" in said and "irradiance" not in said and not (tmp_path / "n.toml").exists()


def test_a_soft_reflection_on_a_ball_does_not_pull_its_material(tmp_path, capsys):
    path = sphere_picture(tmp_path / "spot.png", SATIN, AHEAD, 2.0)
    y, x = np.indices((120, 121))
    glow = 0.4 * np.exp(-((x - 45) ** 2 + (y - 78) ** 2) / (2 * 4.0**2))
    cv2.imwrite(path, np.clip(cv2.imread(path, -1) + 65535 * glow, 0, 65535).astype(np.uint16))
    document, found = fitted(capsys, path, *SPHERE, "--irradiance", "2", "-o", str(tmp_path / "m.toml"))
    assert holds(found["K_lm"], SATIN.K_lm) and holds(found["K_lobe"], SATIN.K_lobe)
    # the glow is seen within three of its widths, 5 % of the ball
    assert 0.04 < document["outliers"] < 0.1


def test_a_fit_that_did_not_settle_states_no_interval(tmp_path):
    sight = sphere_sight((20, 20), 18, (41, 41))
    lamp = Light(AHEAD, 2.0, np.zeros(3), 1e6, 0.25)
    photo = Photograph(sight, np.full(len(sight), 0.3), np.full(len(sight), 0.01), np.ones((len(sight), 1), bool), (0,))
    begun = polish(Problem((photo,), (lamp,), SATIN, Unknowns(("K_lm",), direction=False)), steps=0)
    assert not begun.converged and begun.estimate("K_lm").low is not None
    told = as_far_as_known(begun)
    assert told.estimate("K_lm").low is None and "did not settle" in told.statements[0]
