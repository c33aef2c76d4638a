"""A scan against a second photograph: paint carried by the scan's shape into another camera shows where the shape is wrong."""

from dataclasses import replace

import numpy as np
import pytest

from rangecheck import rigid
from rangecheck.errors import ScanError
from rangecheck.optics import PinholeCamera
from rangecheck.recover.carried import carried
from rangecheck.recover.dents import dents
from rangecheck.recover.second_view import jumps, second_view
from rangecheck.scan import RangeScan
from rangecheck.scan.decode import View
from rangecheck.studies.fit_alexander import dented, stepped

SIZE, AWAY_MM, BASE_MM = 240, 600.0, 300.0


def painted(x, y):
    """Paint of a plane: blots of a few millimetres."""
    waves = np.random.default_rng(4).normal(0.0, 1.2, (60, 2))
    phases = np.random.default_rng(5).uniform(0.0, 6.28, 60)
    return 0.4 * np.exp(0.04 * sum(np.cos(a * x + b * y + p) for (a, b), p in zip(waves, phases)))


@pytest.fixture(scope="module")
def pair():
    """A painted plane, its scan, and what a second camera, parallel to the first and BASE_MM aside, sees of it; 1 % of noise each."""
    rng = np.random.default_rng(1)
    camera = PinholeCamera.from_field_of_view(SIZE, SIZE, 8.0)
    _, rays = camera.pixel_rays()
    points = rays * (AWAY_MM / rays[..., 2:])
    # the second camera's picture is shifted so that both see the middle
    shift = BASE_MM * camera.fx / AWAY_MM
    other = replace(camera, cx=camera.cx + shift)
    aside = rigid.identity()
    aside[0, 3] = BASE_MM
    bright = painted(points[..., 0], points[..., 1])
    u, v = np.meshgrid(np.arange(SIZE), np.arange(SIZE))
    x, y = (u - other.cx) / other.fx * AWAY_MM + BASE_MM, (v - other.cy) / other.fy * AWAY_MM
    first, second = (b * (1.0 + rng.normal(0.0, 0.01, b.shape)) for b in (bright, painted(x, y)))
    ranges = np.linalg.norm(points, axis=-1) + rng.normal(0.0, 0.02, bright.shape)
    return RangeScan(ranges.astype(np.float32), camera, brightness=first.astype(np.float32)), second, View(other, aside)


def test_a_scan_that_is_right_agrees_with_the_second_view_everywhere(pair):
    found = second_view(*pair)
    assert found.regions == ()
    assert found.judged > 0.5
    # a pixel of 0.35 mm is 0.7 mm of range at this base: a hundredth of a pixel or so over a window
    assert abs(np.nanmedian(found.offset_mm)) < 0.05


def test_a_dent_is_named_at_its_place_and_nothing_else(pair):
    scan, picture, view = pair
    place = scan.grid_points_mm[100, 140]
    found = second_view(dented(scan, place, 1.0, 8.0), picture, view)
    assert found.regions
    assert all(np.linalg.norm(scan.grid_points_mm[r.cell] - place) < 13.0 for r in found.regions)
    assert {r.kind for r in found.regions} == {"shape"}


def test_a_narrow_dent_is_named_with_its_depth_at_its_middle(pair):
    scan, picture, view = pair
    place = scan.grid_points_mm[100, 140]
    found = second_view(dented(scan, place, 1.0, 4.0), picture, view)
    assert len(found.regions) == 1 and found.regions[0].kind == "shape"
    row, column = found.regions[0].cell
    # places are tried 1.5 mm apart
    assert np.linalg.norm(scan.grid_points_mm[row, column] - place) < 2.0
    # what has to be undone: the range is too long
    assert found.dents.amount_mm[row, column] == pytest.approx(-1.0, abs=0.2)


def test_dents_are_judged_where_paint_shows_and_not_where_there_is_none(pair):
    scan, picture, view = pair
    rng = np.random.default_rng(3)
    grey, bare = (0.4 * (1.0 + rng.normal(0.0, 0.01, (SIZE, SIZE))) for _ in range(2))
    of_paint = dents(carried(scan, picture, view, 1))
    of_none = dents(carried(replace(scan, brightness=bare.astype(np.float32)), grey, view, 1))
    assert min(of_paint.judged) > 0.6 and not of_paint.named.any()
    assert of_none.judged == (0.0, 0.0, 0.0) and not of_none.named.any()


def test_a_step_is_named_on_its_line_as_one_of_registration(pair):
    scan, picture, view = pair
    place = scan.grid_points_mm[120, 130]
    found = second_view(stepped(scan, place, 0.0, 0.5), picture, view)
    assert found.regions[0].kind == "registration"
    assert all(abs(scan.grid_points_mm[r.cell][0] - place[0]) < 7.0 for r in found.regions)


def test_the_jump_of_a_step_is_its_height_and_of_a_plane_nothing():
    step, even = np.zeros((40, 40)), np.ones((40, 40))
    step[:, 20:] = 0.7
    found, deviation = jumps(step, even, 6.0)
    assert np.nanmax(found) == pytest.approx(0.7) and found[20, 5] == pytest.approx(0.0, abs=1e-12)
    # means of two halves of variance 1
    assert np.nanmax(deviation) == pytest.approx(np.sqrt(2.0))
    assert np.isnan(jumps(np.full((40, 40), np.nan), even, 6.0)[0]).all()


def test_offsets_of_windows_that_hardly_agree_count_for_little_in_a_jump():
    wrong, variance = np.zeros((40, 40)), np.ones((40, 40))
    wrong[:, 20:24], variance[:, 20:24] = 0.7, 100.0
    trusted, _ = jumps(wrong, np.ones((40, 40)), 6.0)
    found, _ = jumps(wrong, variance, 6.0)
    assert np.nanmax(trusted) > 0.5 and np.nanmax(found[:, :19]) < 0.1 * 0.7


def test_pictures_that_show_nothing_alike_or_are_of_another_size_are_refused(pair):
    scan, picture, view = pair
    with pytest.raises(ScanError, match="agree nowhere"):
        second_view(scan, np.random.default_rng(0).uniform(0.2, 0.8, picture.shape), view)
    with pytest.raises(ScanError, match="give the camera"):
        second_view(scan, picture[1:], view)
