"""The study of recovery: its scenes are the same every time, and its truths are in the units of its estimates."""

from dataclasses import replace

import numpy as np

from rangecheck.recover.fit import fit
from rangecheck.studies.fit_scenes import random_scene, stated_deviation, truths


def test_a_random_scene_is_its_seed_s_and_its_truth_fits_its_pictures():
    put, at_truth = random_scene(5, 32)
    again, _ = random_scene(5, 32)
    assert np.array_equal(put.photographs[0].values, again.photographs[0].values)
    assert put.photographs[0].values.max() <= 1.0
    shown = at_truth.predict(at_truth.start(), 0, slopes=False).values
    r = (np.minimum(shown, 1.0) - at_truth.photographs[0].values)[shown < 0.95] / 0.01
    assert abs(r.std() - 1.0) < 4 / np.sqrt(2 * len(r))


def test_the_truth_lies_in_most_of_the_intervals_that_are_stated():
    stated = inside = 0
    for seed in range(3):
        put, at_truth = random_scene(seed, 48)
        found = fit(put, pixels=1500)
        known = truths(found, at_truth)
        for e in found.estimates:
            if e.low is not None:
                stated += 1
                inside += e.low <= known[e.name] <= e.high
    # of 18 numbers with 95 % each fewer than 14 lie inside once in a thousand times, if they were independent
    assert stated >= 10 and inside >= 0.75 * stated


def test_an_interval_over_two_answers_is_not_charted_as_a_standard_deviation():
    put, _ = random_scene(5, 32)
    found = fit(put, pixels=500)
    spread = [replace(e, low=e.value / 1.2, high=1.2 * e.value) for e in found.estimates]
    assert stated_deviation(replace(found, estimates=spread), "K_lm") > 0.0
    joined = [replace(e, low=e.value / 5.0, high=2.0 * e.value) for e in found.estimates]
    assert np.isnan(stated_deviation(replace(found, estimates=joined), "K_lm"))
