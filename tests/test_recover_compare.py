"""A scan against its own brightness image: what is planted in the scan and not in the picture is named at its place, and nothing else."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rangecheck_cli.main import exit_status

from rangecheck.analytic.shapes import Sphere
from rangecheck.errors import ScanError
from rangecheck.optics import PinholeCamera
from rangecheck.pipeline.explained import _judged_line
from rangecheck.recover.compare import compare
from rangecheck.recover.grid import normals_at, scan_grid
from rangecheck.recover.lights import Light
from rangecheck.scan import RangeScan
from rangecheck.studies.fit_alexander import dented

SIZE, RADIUS_MM, AWAY_MM = 200, 80.0, 600.0
LAMP = np.array([0.5, -0.4, -0.77]) / np.linalg.norm([0.5, -0.4, -0.77])


def ball_scan(range_noise_mm=0.02, picture_noise=0.01, paint=0.0, seed=0):
    """A matt ball seen by a pinhole camera from which a far lamp stands up and to the right; 1 mm to a pixel or so."""
    rng = np.random.default_rng(seed)
    camera = PinholeCamera.from_field_of_view(SIZE, SIZE, 16.0)
    _, rays = camera.pixel_rays()
    centre = np.array([0.0, 0.0, AWAY_MM])
    sphere = Sphere(RADIUS_MM)
    distance = sphere.first_hit(-centre, rays)
    points = np.where(np.isfinite(distance), distance, AWAY_MM)[..., None] * rays
    normals = sphere.normal(points - centre)
    seen = np.isfinite(distance) & (-(normals * rays).sum(-1) > 0.25)
    albedo = 0.7 * (1.0 + paint * (np.sin(points[..., 0] / 3.0) * np.sin(points[..., 1] / 4.0) > 0.3))
    bright = albedo * np.maximum((normals * LAMP).sum(-1), 0.0) + rng.normal(0, picture_noise, (SIZE, SIZE))
    ranges = np.where(seen, distance + rng.normal(0, range_noise_mm, (SIZE, SIZE)), np.nan)
    return RangeScan(
        ranges.astype(np.float32), camera, brightness=np.clip(bright, 0, 1).astype(np.float32), noise_mm=range_noise_mm
    )


@pytest.fixture(scope="module")
def clean():
    scan = ball_scan()
    return scan, compare(scan, scale_mm=2.5)


def test_normals_of_a_scanned_ball_are_those_of_the_ball():
    scan = ball_scan(range_noise_mm=0.0)
    grid = scan_grid(scan)
    truth = (grid.points - [0, 0, AWAY_MM]) / RADIUS_MM
    well = -(truth * grid.rays).sum(-1) > 0.5
    away = np.degrees(np.arccos(np.clip((normals_at(grid, 2.5) * truth).sum(-1), -1, 1)))
    assert np.nanmedian(away[well]) < 0.2 and np.nanquantile(away[well], 0.99) < 1.0


def test_the_lamp_of_a_scan_s_picture_is_found_on_its_own_surface(clean):
    light: Light = clean[1].fitted.problem.lights[0]
    centre = np.array([0.0, 0.0, AWAY_MM])
    towards = light.centre_mm - centre
    assert np.degrees(np.arccos(towards @ LAMP / np.linalg.norm(towards))) < 3.0


def test_nothing_is_named_where_scan_and_picture_are_of_the_same_thing(clean):
    assert clean[1].regions == ()
    assert clean[1].judged > 0.5


def test_a_dent_that_the_picture_does_not_show_is_named_at_its_place_with_its_depth(clean):
    scan, found = clean
    dent = compare(dented(scan, scan.grid_points_mm[110, 90], depth_mm=1.0, radius_mm=10.0), scale_mm=2.5, fitted=found.fitted)
    assert len(dent.regions) >= 1
    assert all(np.linalg.norm(np.subtract(r.middle_mm, scan.grid_points_mm[110, 90])) < 12.0 for r in dent.regions)
    worst = dent.regions[0]
    assert worst.kind == "shape" and dent.amount_mm[worst.cell] == pytest.approx(1.0, abs=0.35)


def test_the_picture_of_what_is_left_is_red_where_the_scan_lies_too_deep_and_blue_where_it_stands_too_high(clean):
    from rangecheck.pipeline.explained import residual_picture, told

    scan, found = clean
    for depth, more, less in ((1.0, 0, 2), (-1.0, 2, 0)):
        dent = compare(
            dented(scan, scan.grid_points_mm[110, 90], depth_mm=depth, radius_mm=10.0), scale_mm=2.5, fitted=found.fitted
        )
        said = "\n".join(told(scan, dent))
        assert f"mm too {'deep' if depth > 0.0 else 'high'} at" in said and f"named from {dent.level:.1f}" in said
        side = np.sign(dent.z[dent.regions[0].cell])
        assert side == np.sign(depth)
        assert np.sign(dent.hollow[dent.regions[0].cell]) == side
        wholly = replace(dent, hollow=np.where(np.isfinite(dent.z), 1.5 * side * dent.level, np.nan), regions=())
        # without the scale at the right
        shown = residual_picture(wholly, "ball").astype(int)[:, :700]
        assert (shown[..., more] - shown[..., less] > 60).mean() > 0.2
        assert not (shown[..., less] - shown[..., more] > 60).any()
    ringed, plain = (residual_picture(replace(dent, regions=regions), "ball") for regions in (dent.regions, ()))
    assert 100 < (ringed != plain).any(axis=2).sum() < 0.02 * plain[..., 0].size
    # the ring is about the place's middle, wherever in it the worst cell is, and says what is wrong
    [place] = dent.regions
    beside = replace(place, cell=(place.cell[0] + 6, place.cell[1] - 6))
    assert (residual_picture(replace(dent, regions=(beside,)), "ball") == ringed).all()
    assert (residual_picture(replace(dent, regions=(replace(place, kind="albedo"),)), "ball") != ringed).any()


def test_a_step_between_two_halves_of_a_scan_is_named_on_its_line(clean):
    scan, found = clean
    ranges = scan.range_mm.copy()
    ranges[:, 120:] += 0.3
    step = compare(replace(scan, range_mm=ranges), scale_mm=0.8, fitted=found.fitted)
    assert step.regions
    assert all(abs(scan.grid_points_mm[r.cell][0] - scan.grid_points_mm[100, 120, 0]) < 6.0 for r in step.regions)


def test_a_spot_of_paint_is_no_fault_of_the_shape(clean):
    scan, found = clean
    points = scan.grid_points_mm
    spot = np.where(np.linalg.norm(points - points[110, 90], axis=-1) < 6.0, 0.8, 1.0)
    named = compare(replace(scan, brightness=(spot * scan.brightness).astype(np.float32)), scale_mm=2.5, fitted=found.fitted)
    assert named.regions and {r.kind for r in named.regions} == {"albedo"}


@pytest.mark.parametrize("kind", ["registration", "shadow edge", "highlight"])
def test_what_is_wrong_alone_is_named_as_what_it_is_where_it_is(kind):
    from rangecheck.studies.fit_classes import named

    assert named(kind, 3) == (kind, [])


@pytest.mark.parametrize("kind, seed", [("shape", 702), ("registration", 1310), ("shadow edge", 1309), ("albedo", 1309)])
def test_where_the_lamp_is_mirrored_a_fault_keeps_its_name(kind, seed):
    from rangecheck.studies.fit_classes import named

    assert named(kind, seed) == (kind, [])


def test_where_it_is_too_dark_to_compare_a_dent_is_not_judged_rather_than_missed():
    from rangecheck.studies.fit_classes import named

    assert named("shape", 704) == ("not judged", [])


def test_the_shadow_that_a_scan_s_own_ridge_casts_lies_behind_it_as_far_as_the_lamp_is_low():
    from types import SimpleNamespace

    from rangecheck.recover.causes import cast_by_scan

    camera = PinholeCamera.from_field_of_view(SIZE, SIZE, 16.0)
    _, rays = camera.pixel_rays()
    away = AWAY_MM / rays[..., 2]
    x = (away[..., None] * rays)[..., 0]
    height, low = 6.0, np.radians(30.0)
    # a ramp that ends in a cliff, the lamp 30 degrees above the plane behind it: the shadow is height / tan 30 long
    ramp = np.where((x > -20.0) & (x < 0.0), height * (1.0 + x / 20.0), 0.0)
    scan = RangeScan(
        ((AWAY_MM - ramp) / rays[..., 2]).astype(np.float32), camera, brightness=np.full((SIZE, SIZE), 0.5, np.float32)
    )
    light = Light(np.array([-np.cos(low), 0.0, -np.sin(low)]), np.pi, np.array([0.0, 0.0, AWAY_MM]), 1e5, 0.1)
    grid = scan_grid(scan)
    lit = SimpleNamespace(problem=SimpleNamespace(lights=[light]))
    hidden = cast_by_scan(grid, lit, grid.valid)
    long = height / np.tan(low)
    row = hidden[SIZE // 2]
    across = grid.points[SIZE // 2, :, 0]
    assert row[(across > 2.0) & (across < long - 2.0)].all()
    assert not row[(across > long + 2.0) | (across < -2.0)].any()


def test_on_strong_paint_nothing_is_judged_and_nothing_named():
    found = compare(ball_scan(paint=0.5), scale_mm=2.5)
    assert found.judged == 0.0 and found.regions == ()
    # and it says what it would have seen
    assert np.nanmedian(found.least_mm) > 1.0


def test_check_names_the_place_in_mm_and_explains_it(tmp_path, clean, capsys):
    import json

    from rangecheck.scan.readers import write_scans

    scan = clean[0]
    for name, made in (("clean", scan), ("dented", dented(scan, scan.grid_points_mm[110, 90], depth_mm=1.0, radius_mm=10.0))):
        write_scans(tmp_path / name, [replace(made, name=name, brightness=np.nan_to_num(made.brightness))], step_mm=0.01)
        capsys.readouterr()
        exit_status(["check", str(tmp_path / name), "--json"])
        row = json.loads(capsys.readouterr().out)["files"][0]
        assert row["pictures"][0]["by"] == "shading" and row["pictures"][0]["judged"] > 0.3
        if name == "clean":
            assert row["findings"] == []
            continue
        [region] = row["pictures"][0]["regions"]
        assert region["amount_mm"] == pytest.approx(1.0, abs=0.35) and abs(region["z"]) > region["asked"]
        [found] = row["findings"]
        assert found["code"] == "scan-contradicts-picture" and found["severity"] == "warning"
        assert np.linalg.norm(np.array(found["places_mm"]) - scan.grid_points_mm[110, 90], axis=1).max() < 12.0
    assert exit_status(["explain", "scan-contradicts-picture"]) == 0


def test_a_scan_without_a_picture_or_without_distances_is_refused():
    scan = ball_scan()
    with pytest.raises(ScanError, match="no brightness"):
        compare(replace(scan, brightness=None))
    with pytest.raises(ScanError, match="no cell holds"):
        compare(replace(scan, range_mm=np.full((SIZE, SIZE), np.nan, np.float32)))


def test_what_could_be_compared_is_told_apart_from_what_was_judged():
    least = np.full((10, 10), np.nan)
    least[:4] = 1.2
    least[0] = 0.8
    excluded = {"saturated in the picture": 0.2, "in shadow": 0.0, "within 10 mm of those": 0.4}
    grid = SimpleNamespace(valid=np.ones((10, 10), bool))
    found = SimpleNamespace(least_mm=least, judged=0.1, excluded=excluded, paint=0.02, grid=grid)
    said = _judged_line("view", found)
    assert "10 % of it judged by its brightness to 1 mm, of 40 % that could be compared, where dents of 1.20 mm (median)" in said
    assert said.endswith("; not compared: 20 % saturated in the picture, 40 % within 10 mm of those")


def test_every_cell_is_compared_or_its_reason_is_told():
    scan = ball_scan()
    bright = scan.brightness.copy()
    # a saturated stripe down the lit side
    bright[:, 80:90] = 1.0
    found = compare(replace(scan, brightness=bright))
    compared = np.isfinite(found.least_mm).sum() / found.grid.valid.sum()
    assert compared + sum(found.excluded.values()) == pytest.approx(1.0)
    inside = found.grid.valid[:, 80:90].sum() / found.grid.valid.sum()
    assert found.excluded["saturated in the picture"] == pytest.approx(inside, rel=0.3)
