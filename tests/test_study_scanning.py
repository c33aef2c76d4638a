"""Studies of meshing and registration: what they measure is what they say, on cases whose answer is known."""

import math
import os
import signal
from functools import partial
from importlib import import_module

import numpy as np
import pytest

from rangecheck.errors import DependencyMissing, InputError
from rangecheck.scan.registration import register
from rangecheck.studies import study_named
from rangecheck.studies.bust_scans import bust_ring, bust_views, near_samples, real_data
from rangecheck.studies.meshing_busts import errors_of
from rangecheck.studies.meshing_edges import _with_outliers
from rangecheck.studies.meshing_methods import Apart
from rangecheck.studies.registration import shaken, strays_mm
from rangecheck.study import Candidate, measure
from rangecheck.surface.distance import SurfaceDistance
from rangecheck.surface.surface import Surface


@pytest.fixture(scope="module")
def views():
    return bust_views((0.0, 30.0), width=96)


def test_scans_where_the_truth_puts_them_stray_nowhere(views):
    alone = register(views[:1])
    assert strays_mm(alone, views[:1]).tolist() == [0.0]
    moved = shaken(views, 5.0, 0.0, seed=2)
    apart = np.linalg.norm(moved[1].points_mm() - views[1].points_mm(), axis=1)
    assert np.allclose(apart, 5.0) and moved[0] is views[0]


def test_false_readings_are_as_many_as_asked_for(views):
    spoiled = _with_outliers(views[0], 0.1, seed=3)
    changed = (spoiled.range_mm != views[0].range_mm) & views[0].valid
    count = int(views[0].valid.sum())
    # a binomial law's standard deviation, five times
    assert abs(changed.sum() - 0.1 * count) < 5 * math.sqrt(0.09 * count)
    assert (spoiled.valid == views[0].valid).all()


def test_errors_and_their_shares_are_those_of_a_shifted_plane():
    square = np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    truth = SurfaceDistance(Surface(square, faces))
    heights = np.array([0.05, 0.15, 0.15, 0.25])
    lifted = Surface(square + heights[:, None] * [0, 0, 1], faces, vertex_error_mm=np.full(4, 0.1))
    found = errors_of(lifted, truth)
    assert found["within_one"] == 0.25 and found["within_two"] == 0.75
    assert found["rms_mm"] == pytest.approx(math.sqrt(np.mean(heights**2)))


def test_a_vertex_counts_where_a_sample_is_near(views):
    points = views[0].points_mm()[::50]
    assert near_samples(points, views, 1.0).all()
    assert not near_samples(points + [0, 0, 500.0], views, 1.0).any()


def test_real_data_is_asked_for_by_name_where_it_is_missing(monkeypatch):
    monkeypatch.delenv("RANGECHECK_DATA", raising=False)
    with pytest.raises(InputError, match="RANGECHECK_DATA"):
        real_data("busts")
    found = study_named("meshing", "busts")(quick=True)
    assert any("not measured" in said for said in found.findings)


def test_a_ring_sees_the_bust_from_as_many_sides_as_asked():
    ring = bust_ring(3, width=48)
    eyes = np.array([scan.world_from_scan[:3, 3] for scan in ring])
    assert len({tuple(np.round(eye, 3)) for eye in eyes}) == 3
    assert all(scan.valid.mean() > 0.1 for scan in ring)


def test_the_study_of_scans_times_reading():
    found = study_named("scans", "reading")(quick=True)
    assert found.tables["reading"][0]["what"] == "depth PNG of 512 x 512" and found.tables["reading"][0]["seconds"] > 0


def _crashes(scans):
    os.kill(os.getpid(), signal.SIGSEGV)


def _face(scans):
    return Surface(scans[0].points_mm()[:3], np.array([[0, 1, 2]], np.int32))


def test_a_method_whose_engine_is_not_installed_names_what_mends_it(views):
    with Apart(views) as apart, pytest.raises(DependencyMissing, match=r"no_such_engine .*pip install 'rangecheck\[engines\]'"):
        apart.run(partial(import_module, "no_such_engine"))


def test_a_method_that_crashes_is_told_and_the_others_go_on(views):
    with Apart(views) as apart:
        runs = {"sound": partial(apart.run, _face), "crash": partial(apart.run, _crashes)}
        found = {
            m.method: m
            for m in measure(
                [Candidate(name, "", run) for name, run in runs.items()],
                lambda surface: math.nan if surface is None else float(np.abs(surface.vertices - views[0].points_mm()[:3]).max()),
                rounds=2,
                warmups=0,
            )
        }
    assert found["sound"].error == 0.0 and found["sound"].seconds > 0.0
    assert math.isnan(found["crash"].error) and math.isnan(found["crash"].seconds)
