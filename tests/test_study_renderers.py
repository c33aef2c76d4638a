"""The study of what pictures cost finds the error that is there, and the effort that meets a goal."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rangecheck.studies.renderers import Racer, crossed, run_to, study


def test_the_error_of_a_picture_is_found_whatever_the_noise_of_its_reference():
    chance = np.random.default_rng(3)
    truth = np.full((64, 64), 2.0)
    picture = truth + 0.1 * np.where(chance.random(truth.shape) < 0.5, 1, -1)
    halves = tuple(truth + chance.normal(0, 0.2, truth.shape) for _ in range(2))
    found = crossed(picture, halves, np.ones(truth.shape, bool))
    # each product of two differences has a standard deviation below (0.1 + 0.2)^2, over 4096 pixels, of twice the error
    assert found * 2.0 == pytest.approx(0.1, abs=4 * 0.3**2 / 64 / (2 * 0.1))


def test_the_effort_that_meets_a_goal_lies_between_two_that_were_measured():
    truth = np.ones((4, 4))
    efforts = [2.0**k for k in range(12)]
    racer = Racer("one", lambda samples, seed: truth + 1 / math.sqrt(samples), efforts, (truth, truth), 0.0, "samples")
    everywhere = np.ones((4, 4), bool)
    found = run_to(racer, everywhere, 0.03)
    assert found.effort == pytest.approx(1 / 0.03**2) and found.more == 1
    assert found.rows[-1]["error"] <= 0.03 < found.rows[-2]["error"]
    tired = replace(racer, efforts=efforts[:4])
    assert math.isnan(run_to(tired, everywhere, 0.03).more)
    # what lies beyond its efforts follows from how its error falls
    beyond = run_to(replace(tired, extends=True), everywhere, 0.03)
    assert beyond.effort == 8 and beyond.effort * beyond.more == pytest.approx(1 / 0.03**2)


def test_pictures_are_timed_beside_their_cast():
    made = study(quick=True, part="cast")
    # the bust fills about a fifth of the picture; rays beside it need not be cast
    assert [row["ratio"] > 0 and row["rays"] > 64 * 64 / 5 for row in made.tables["cast_ratios"]] == [True] * 4
    assert len(made.findings) == 4


def test_mitsuba_is_raced_where_it_is_installed():
    pytest.importorskip("mitsuba", reason="the outside renderer is not installed: pip install 'rangecheck[compare]'")
    made = study(quick=True, part="steel")
    names = {row["renderer"] for row in made.tables["race_steel"]}
    assert "rangecheck, evenly" in names and any(name.startswith("mitsuba") for name in names)
    assert made.findings[-1].startswith("steel, one interreflection: Mitsuba's best setting takes")
