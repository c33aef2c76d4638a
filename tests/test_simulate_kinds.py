"""Stripes, codes and flight times each err as their physics says, and the truth is kept beside them."""

import math

import numpy as np
import pytest

from rangecheck import rigid
from rangecheck.errors import SettingError
from rangecheck.optics import PinholeCamera
from rangecheck.raycast import EmbreeCaster
from rangecheck.scan.simulate import (
    FLYING,
    KINECT,
    MEASURED,
    NOTHING_THERE,
    SATURATED,
    TOO_DARK,
    Finish,
    Motion,
    RangeFinder,
    simulate_scan,
)
from rangecheck.scan.simulate_gray_code import Capture, gray_code_patterns, simulate_gray_code
from rangecheck.scan.simulate_noise import kinect_noise, photon_noise, speckle_noise

CAMERA = PinholeCamera(160, 120, 250.0, 250.0, 79.5, 59.5)
POSE = rigid.look_at([0.0, 0.0, 600.0], [0.0, 0.0, 0.0])
QUIET = {"noise_mm": 0.0, "step_mm": 0.0, "fade_deg": 90.0, "limit_deg": 90.0}


def plates(*places):
    """An embree caster of square plates (z, half size, centre x) that face +z."""
    corners, faces = [], []
    for z, size, x in places:
        faces += [[len(corners) + i for i in triangle] for triangle in ((0, 1, 2), (0, 2, 3))]
        corners += [[x - size, -size, z], [x + size, -size, z], [x + size, size, z], [x - size, size, z]]
    return EmbreeCaster(np.array(corners, float), np.array(faces, np.int32))


WALL = (0.0, 500.0, 0.0)


def depth(made):
    return made.scan.range_mm.astype(float) * CAMERA.pixel_rays()[1][..., 2]


def test_a_subject_that_comes_nearer_is_measured_where_it_was_when_the_sheet_passed():
    motion = Motion(velocity_mm_s=(0.0, 0.0, 20.0))
    made = simulate_scan(plates(WALL), CAMERA, POSE, RangeFinder(**QUIET), 1, motion=motion)
    np.testing.assert_allclose(depth(made), 600.0 - 20.0 * made.time_s, atol=2e-3)
    # the sheet sweeps 30 degrees a second about the source, 150 mm beside the camera
    points = made.scan.grid_points_mm - np.array([150.0, 0.0, 0.0])
    angle = np.degrees(np.arctan2(points[..., 0], points[..., 2]) - np.arctan2(-150.0, 600.0))
    np.testing.assert_allclose(made.time_s, angle / 30.0, atol=1e-4)
    np.testing.assert_allclose(made.true_range_mm * CAMERA.pixel_rays()[1][..., 2], 600.0, atol=1e-3)


def test_cells_that_never_settle_are_lost_not_guessed():
    # too fast for its sheet: where the edge of the plate runs away, cells meet now the plate, now the wall
    motion = Motion(velocity_mm_s=(900.0, 0.0, 0.0))
    made = simulate_scan(plates(WALL, (200.0, 60.0, 0.0)), CAMERA, POSE, RangeFinder(**QUIET), 1, motion=motion)
    measured = made.reason == MEASURED
    here = np.where(measured, depth(made), 400.0)
    assert (np.minimum(np.abs(here - 400.0), np.abs(here - 600.0)) < 2e-3).all()


def test_a_wall_that_slides_in_its_own_plane_looks_still():
    moved = simulate_scan(plates(WALL), CAMERA, POSE, RangeFinder(**QUIET), 1, motion=Motion(velocity_mm_s=(30.0, 5.0, 0.0)))
    np.testing.assert_allclose(depth(moved), 600.0, atol=1e-3)


def test_a_turning_subject_turns_about_its_axis():
    motion = Motion(turn_deg_s=10.0, axis=(0.0, 2.0, 0.0), centre_mm=(5.0, 0.0, -3.0))
    points = np.array([[15.0, 7.0, -3.0], [5.0, 1.0, -3.0]])
    there = motion.back(points, np.array([9.0, 9.0]))
    np.testing.assert_allclose(there, [[5.0, 7.0, 7.0], [5.0, 1.0, -3.0]], atol=1e-12)


def test_ambient_light_raises_the_noise_and_drowns_the_signal():
    dark, bright = (
        simulate_scan(plates(WALL), CAMERA, POSE, RangeFinder(ambient=ambient, least_contrast=0.1), 1) for ambient in (0.0, 3.0)
    )
    np.testing.assert_allclose(bright.noise_mm, dark.noise_mm * np.sqrt(1 + 3.0 / bright.signal), rtol=1e-12)
    drowned = simulate_scan(plates(WALL), CAMERA, POSE, RangeFinder(ambient=30.0, least_contrast=0.1), 1)
    assert (drowned.reason == TOO_DARK).all()


def test_polished_steel_returns_only_near_the_mirror_direction():
    finder = RangeFinder(**QUIET, least_signal=0.05, most_signal=20.0)
    steel = simulate_scan(plates(WALL), CAMERA, POSE, finder, 1, finish=Finish(diffuse=0.0, specular=0.6, rms_slope=0.08))
    # on the wall the mirror point lies half way between camera and source
    points = steel.true_range_mm[..., None] * CAMERA.pixel_rays()[1]
    to_source = np.array([150.0, 0.0, 0.0]) - points
    half = -points / np.linalg.norm(points, axis=-1, keepdims=True) + to_source / np.linalg.norm(
        to_source, axis=-1, keepdims=True
    )
    off_deg = np.degrees(np.arccos(-half[..., 2] / np.linalg.norm(half, axis=-1)))
    assert (steel.reason[off_deg > 12] == TOO_DARK).all()
    assert (steel.reason[off_deg < 4] != TOO_DARK).all()
    assert (steel.reason == SATURATED).any() == (steel.signal > 20).any()
    matt = simulate_scan(plates(WALL), CAMERA, POSE, finder, 1)
    assert (matt.reason == MEASURED).all()


def test_a_rougher_lobe_gives_the_same_light_over_more_directions():
    # directional albedo of the lobe at normal incidence, by quadrature over the hemisphere
    for slope, least in ((0.1, 0.99), (0.3, 0.97)):
        finish = Finish(diffuse=0.0, specular=1.0, rms_slope=slope)
        theta = (np.arange(4000) + 0.5) / 4000 * math.pi / 2
        to_camera = np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=1)
        up = np.broadcast_to([0.0, 0.0, 1.0], to_camera.shape)
        radiance = finish.response(up, up, to_camera) / math.pi
        albedo = (radiance * np.cos(theta) * np.sin(theta)).sum() * 2 * math.pi * (math.pi / 2 / 4000)
        assert least < albedo <= 1.0 + 1e-6


def test_time_of_flight_is_the_closed_form_on_a_wall():
    finder = RangeFinder(**QUIET, kind="time-of-flight", source_mm=(0.0, 0.0, 0.0), subrays=1)
    made = simulate_scan(plates(WALL), CAMERA, POSE, finder, 1)
    np.testing.assert_allclose(depth(made), 600.0, atol=2e-3)
    beside = simulate_scan(plates(WALL), CAMERA, POSE, RangeFinder(**QUIET, kind="time-of-flight", subrays=1), 1)
    np.testing.assert_allclose(depth(beside), 600.0, atol=2e-3)


def test_pixels_across_an_edge_fly_by_the_sum_of_phasors():
    # the plate ends within one column of pixels, at a share s of them
    edge_u, camera = 80.2, PinholeCamera(160, 7, 250.0, 250.0, 79.5, 3.0)
    x = (edge_u - camera.cx) / camera.fx * 500.0
    caster = plates((100.0, 300.0, x - 300.0), (-50.0, 600.0, 0.0))
    finder = RangeFinder(**QUIET, kind="time-of-flight", source_mm=(0.0, 0.0, 0.0), subrays=10, working_distance_mm=500.0)
    made = simulate_scan(caster, camera, POSE, finder, 1)
    assert (made.reason[:, 80] == FLYING).all()
    assert not (made.reason[:, :79] == FLYING).any() and not (made.reason[:, 82:] == FLYING).any()
    # in the middle row: 0.7 of the pixel at 500 mm, 0.3 at 650 mm with less light
    row, ray = 3, camera.pixel_rays()[1][3, 80]
    near, far = 500.0 / ray[2], 650.0 / ray[2]
    per_mm = 4 * math.pi * 60e6 / 299792458000.0
    total = 0.7 * ray[2] * (500 / near) ** 2 * np.exp(1j * per_mm * near) + 0.3 * ray[2] * (500 / far) ** 2 * np.exp(
        1j * per_mm * far
    )
    assert made.scan.range_mm[row, 80] == pytest.approx(np.angle(total) / per_mm, abs=1.0)


@pytest.mark.parametrize("kind", ["stripe", "gray-code", "time-of-flight"])
def test_nothing_comes_back_from_where_nothing_is(kind):
    finder = RangeFinder(kind=kind, ambient=0.5)
    made = simulate_scan(plates((0.0, 40.0, 0.0)), CAMERA, POSE, finder, 1, with_brightness=True)
    assert 1000 < made.scan.valid.sum() < 2000
    empty = np.isnan(made.true_range_mm) & ~(made.reason == FLYING)
    border = np.abs(CAMERA.pixel_rays()[1][..., :2] * 600).max(axis=-1) < 45
    assert (made.scan.brightness[empty & ~border] == 0).all() and not made.scan.valid[empty & ~border].any()
    away = simulate_scan(plates((0.0, 40.0, 5000.0)), CAMERA, POSE, finder, 1)
    assert not away.scan.valid.any() and (away.reason == NOTHING_THERE).all()


def test_flight_times_wrap():
    finder = RangeFinder(**QUIET, kind="time-of-flight", source_mm=(0.0, 0.0, 0.0), subrays=1, modulation_mhz=300.0)
    made = simulate_scan(plates(WALL), CAMERA, POSE, finder, 1)
    unambiguous = 299792458000.0 / 600e6
    true = np.remainder(made.true_range_mm, unambiguous)
    clear = np.minimum(true, unambiguous - true) > 0.01
    np.testing.assert_allclose(made.scan.range_mm[clear], true[clear], atol=2e-3)


def test_a_subject_that_moves_between_the_phase_samples_smears():
    finder = RangeFinder(**QUIET, kind="time-of-flight", source_mm=(0.0, 0.0, 0.0), subrays=1, sample_s=0.005)
    still, moved = (
        simulate_scan(plates(WALL), CAMERA, POSE, finder, 1, motion=m) for m in (None, Motion(velocity_mm_s=(0, 0, 400.0)))
    )
    shift = np.abs(depth(moved) - depth(still))
    # it moved 6 mm in all
    assert 0.05 < np.median(shift) < 6.0


def test_noise_models_give_the_published_numbers():
    assert kinect_noise(np.array(1000.0), np.array(0.0)) == pytest.approx(1.2 + 1.9 * 0.36)
    # a lens of 8 mm at 600 mm, red laser, 14 degrees
    expected = 0.66e-3 / (2 * math.pi * (4 / math.hypot(600, 4)) * math.sin(math.radians(14)))
    assert speckle_noise(0.66, 1.0, 8.0, np.array(600.0), np.radians(14.0)) == pytest.approx(expected)
    assert photon_noise(2.0, np.array(0.25), 0.0) == pytest.approx(4.0)
    assert photon_noise(2.0, np.array(1.0), 3.0) == pytest.approx(4.0)


@pytest.mark.parametrize("model", ["quadratic", "speckle", "photon", "kinect"])
def test_every_model_s_noise_is_what_is_drawn(model):
    finder = RangeFinder(noise_model=model, step_mm=0.0)
    made = simulate_scan(plates((0.0, 500.0, 0.0)), CAMERA, POSE, finder, 3)
    score = ((made.scan.range_mm - made.true_range_mm) / made.noise_mm)[made.scan.valid]
    n = len(score)
    assert n > 10000
    assert abs(score.mean()) < 5 / math.sqrt(n)
    assert abs(score.var() - 1) < 5 * math.sqrt(2 / n)


def test_the_kinect_s_depths_come_in_eighths_of_a_disparity():
    camera = PinholeCamera(160, 120, 145.0, 145.0, 79.5, 59.5)
    made = simulate_scan(plates((-900.0, 1500.0, 0.0)), camera, POSE, KINECT, 1)
    depth_mm = made.scan.grid_points_mm[..., 2][made.scan.valid]
    disparity = camera.fx * 75.0 / 0.125 / depth_mm
    # depth was rounded to 1 mm after its disparity
    assert np.abs(disparity - np.rint(disparity)).max() < 0.5 * disparity.max() / depth_mm.min() * 1.01


def test_coded_ranges_lie_on_the_planes_of_whole_columns():
    finder = RangeFinder(**QUIET, kind="gray-code", columns=200, column_noise=0.0)
    made = simulate_scan(plates(WALL), CAMERA, POSE, finder, 1)
    points = made.scan.grid_points_mm - np.array([150.0, 0.0, 0.0])
    tilt = math.atan2(150.0, 600.0)
    across = points[..., 0] * math.cos(tilt) + points[..., 2] * math.sin(tilt)
    along = points[..., 2] * math.cos(tilt) - points[..., 0] * math.sin(tilt)
    column = 200 / (160 / 250.0) * across / along
    assert np.abs(column - np.rint(column)).max() < 1e-3
    error = made.scan.range_mm - made.true_range_mm
    assert 0.8 < (error / made.noise_mm).std() < 1.2


def test_neighbouring_codes_differ_in_one_bit():
    names, columns, rows = gray_code_patterns(1000, 50)
    bits = columns[[i for i, name in enumerate(names) if name.startswith("column") and not name.endswith("inverse")]]
    assert (np.abs(np.diff(bits, axis=1)).sum(axis=0) == 1).all()
    assert len(np.unique(bits, axis=1).T) == 1000
    assert len(names) == 2 + 2 * 6 + 2 * 10 and rows.shape == (len(names), 50)


def decode(shot, axis):
    """The plain decoder: pattern against inverse, Gray to binary."""
    bits = sorted({int(name.split("_")[1]) for name in shot.names if name.startswith(axis)}, reverse=True)
    value, last = np.zeros(shot.pictures.shape[1:], int), 0
    for bit in bits:
        on = shot.pictures[shot.names.index(f"{axis}_{bit}")] > shot.pictures[shot.names.index(f"{axis}_{bit}_inverse")]
        last = on.astype(int) ^ last
        value = 2 * value + last
    return value


@pytest.fixture(scope="module")
def rig():
    projector = PinholeCamera(128, 96, 210.0, 210.0, 63.5, 47.5)
    return projector, rigid.look_at([150.0, 0.0, 600.0], [0.0, 0.0, 0.0])


def test_pictures_decode_to_the_projector_pixel_that_lit_them(rig):
    projector, stands = rig
    shot = simulate_gray_code(plates(WALL, (80.0, 40.0, 0.0)), CAMERA, POSE, projector, stands, Capture(), 4)
    assert shot.pictures.shape == (2 + 14 + 14, 120, 160)
    lit = np.isfinite(shot.true_column)
    assert 0.3 < lit.mean() < 0.95
    for axis, true in (("column", shot.true_column), ("row", shot.true_row)):
        off = np.abs(decode(shot, axis)[lit] - np.rint(true[lit]))
        # a pixel wider than the border between two codes may land on either side of it, never farther; but for edges of the plate
        assert (off <= 1).mean() > 0.98
        inner = np.abs(true[lit] - np.rint(true[lit])) < 0.2
        assert (off[inner] == 0).mean() > 0.97
    white, black = shot.pictures[0].astype(int), shot.pictures[1].astype(int)
    assert np.median((white - black)[lit]) > 50 and np.abs((white - black)[~lit & np.isfinite(shot.true_range_mm)]).mean() < 12


def test_a_moving_subject_spoils_its_code(rig):
    projector, stands = rig
    capture = Capture(subrays=1)
    still = simulate_gray_code(plates(WALL), CAMERA, POSE, projector, stands, capture, 4)
    moved = simulate_gray_code(
        plates(WALL), CAMERA, POSE, projector, stands, capture, 4, motion=Motion(velocity_mm_s=(0, 0, 60.0))
    )
    lit = np.isfinite(still.true_column) & np.isfinite(moved.true_column)
    wrong = [(np.abs(decode(shot, "column") - np.rint(still.true_column))[lit] > 1).mean() for shot in (still, moved)]
    assert wrong[0] < 0.01 < 0.1 < wrong[1]


def test_pictures_are_decided_by_seed_camera_and_number(rig):
    projector, stands = rig
    shots = [
        simulate_gray_code(
            plates(WALL), CAMERA, POSE, projector, stands, Capture(subrays=1), seed, camera_index=index
        ).pictures.tobytes()
        for seed, index in ((1, 0), (1, 0), (1, 1), (2, 0))
    ]
    assert shots[0] == shots[1] and len(set(shots)) == 3


def test_what_cannot_be_is_refused():
    with pytest.raises(SettingError, match="kind"):
        RangeFinder(kind="sonar")
    with pytest.raises(SettingError, match="baseline"):
        RangeFinder(source_mm=(0.0, 0.0, 0.0))
    with pytest.raises(SettingError, match="finish"):
        Finish(diffuse=0.7, specular=0.6)
    with pytest.raises(SettingError, match="simulate_gray_code"):
        simulate_scan(plates(WALL), CAMERA, POSE, RangeFinder(kind="gray-code"), 1, motion=Motion())
    with pytest.raises(SettingError, match="bits"):
        Capture(bits=0)
