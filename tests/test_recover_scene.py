"""Materials recovered from pictures of modelled scenes, and what they serve afterwards."""

import json
from dataclasses import replace

import cv2
import numpy as np
from rangecheck_cli.main import exit_status

from rangecheck.reflectance import Material, side_by_side

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
