"""The simulated range finder sees what camera and source both see, with the noise it states."""

import numpy as np
import pytest

from rangecheck import rigid
from rangecheck.errors import SettingError
from rangecheck.kernels import threads
from rangecheck.optics import PinholeCamera
from rangecheck.raycast import EmbreeCaster
from rangecheck.raycast.implicit import ImplicitCaster
from rangecheck.scan import sample
from rangecheck.scan.simulate import (
    IN_SHADOW,
    MEASURED,
    NOTHING_THERE,
    TOO_OBLIQUE,
    RangeFinder,
    ring_of_poses,
    simulate_scan,
)

RADIUS = 80.0
CAMERA = PinholeCamera(160, 120, 250.0, 250.0, 79.5, 59.5)
POSE = rigid.look_at([0.0, 0.0, 600.0], [0.0, 0.0, 0.0])
QUIET = RangeFinder(noise_mm=0.0, step_mm=0.0, fade_deg=90.0, limit_deg=90.0)


def sphere_hit(origins, directions, reach):
    b = (origins * directions).sum(axis=1)
    h2 = RADIUS**2 - ((origins - b[:, None] * directions) ** 2).sum(axis=1)
    near = -b - np.sqrt(np.where(h2 > 0, h2, np.nan))
    return np.where((near > 0) & (near <= reach), near, np.inf)


def sphere():
    return ImplicitCaster(sphere_hit, lambda points: points / RADIUS, 1e-6)


def plate(z, size, centre_x=0.0):
    """Corners and faces of a square plate in the plane z."""
    corners = np.array(
        [[centre_x - size, -size, z], [centre_x + size, -size, z], [centre_x + size, size, z], [centre_x - size, size, z]]
    )
    return corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def test_without_noise_the_range_is_the_closed_form():
    made = simulate_scan(sphere(), CAMERA, POSE, QUIET, 1)
    points = made.scan.points_mm()
    # range_mm is float32
    assert np.abs(np.linalg.norm(points, axis=1) - RADIUS).max() < np.spacing(np.float32(600.0))


def test_a_cell_is_measured_exactly_where_camera_and_source_see_the_sphere():
    made = simulate_scan(sphere(), CAMERA, POSE, QUIET, 1)
    source = rigid.move_points(POSE, np.array(QUIET.source_mm))
    normals = made.true_normal.reshape(-1, 3)
    lit = (normals * (source - RADIUS * normals)).sum(axis=1) > 0
    seen = np.isfinite(made.true_range_mm).ravel()
    reason = made.reason.ravel()
    assert (reason[~seen] == NOTHING_THERE).all()
    assert (reason[seen & lit] == MEASURED).all()
    assert (reason[seen & ~lit] == IN_SHADOW).all()
    assert (seen & ~lit).sum() > 20


def test_the_shadow_of_a_plate_on_a_wall_is_where_similar_triangles_put_it():
    # plate 100 mm before a wall; the source stands 150 mm to the side
    front, faces = plate(100.0, 40.0)
    wall, _ = plate(0.0, 400.0)
    caster = EmbreeCaster(np.concatenate([front, wall]), np.concatenate([faces, faces + 4]))
    made = simulate_scan(caster, CAMERA, POSE, QUIET, 1)
    points = rigid.move_points(POSE, made.true_range_mm[..., None] * CAMERA.pixel_rays()[1])
    source = rigid.move_points(POSE, np.array(QUIET.source_mm))
    on_wall = points[..., 2] < 1.0
    share = 100.0 / source[2]
    through_plate = points + share * (source - points)
    margin = np.abs(np.abs(through_plate[..., :2]).max(axis=-1) - 40.0)
    behind = on_wall & (np.abs(through_plate[..., :2]).max(axis=-1) < 40.0)
    clear = margin > 0.01
    assert ((made.reason == IN_SHADOW) == behind)[clear].all()
    assert behind.sum() > 100


def test_the_error_has_the_standard_deviation_that_is_stated():
    finder = RangeFinder(noise_mm=0.3, step_mm=0.0)
    made = simulate_scan(sphere(), CAMERA, POSE, finder, 7)
    score = ((made.scan.range_mm - made.true_range_mm) / made.noise_mm)[made.scan.valid]
    n = len(score)
    # mean and variance of n normal numbers, five standard errors wide
    assert abs(score.mean()) < 5 / np.sqrt(n)
    assert abs(score.var() - 1) < 5 * np.sqrt(2 / n)


def test_noise_grows_with_the_square_of_distance_and_with_obliquity():
    finder = RangeFinder(noise_mm=0.2, working_distance_mm=600.0)
    assert finder.noise_at(np.array(1200.0), np.array(1.0)) == pytest.approx(0.8)
    assert finder.noise_at(np.array(600.0), np.array(0.5)) == pytest.approx(0.4)


def test_nothing_returns_beyond_the_limit_angle_and_less_and_less_before_it():
    finder = RangeFinder(noise_mm=0.0, step_mm=0.0, fade_deg=40.0, limit_deg=70.0, source_mm=(1.0, 0.0, 0.0))
    made = simulate_scan(sphere(), CAMERA, POSE, finder, 3)
    rays = rigid.move_directions(POSE, CAMERA.pixel_rays()[1])
    angle = np.degrees(np.arccos(np.clip(-(made.true_normal * rays).sum(axis=-1), -1, 1)))
    seen = np.isfinite(made.true_range_mm)
    assert (made.reason[seen & (angle > 70.3)] != MEASURED).all()
    assert (made.reason[seen & (angle < 39.7)] == MEASURED).all()
    shares = [(made.reason[seen & (angle > a) & (angle < a + 7)] == TOO_OBLIQUE).mean() for a in (41, 48, 55, 62)]
    assert shares == sorted(shares) and shares[-1] > 0.7


def test_depth_comes_in_steps():
    made = simulate_scan(sphere(), CAMERA, POSE, RangeFinder(step_mm=0.5), 1)
    counts = made.scan.grid_points_mm[..., 2][made.scan.valid] / 0.5
    assert np.abs(counts - np.rint(counts)).max() < 2 * np.spacing(np.float32(600.0)) / 0.5


def test_the_seed_and_the_number_of_the_scan_decide_the_noise():
    finder = RangeFinder()
    scans = [
        simulate_scan(sphere(), CAMERA, POSE, finder, seed, scan_index=index).scan.range_mm.tobytes()
        for seed, index in ((1, 0), (1, 0), (2, 0), (1, 1))
    ]
    assert scans[0] == scans[1]
    assert len(set(scans)) == 3


def test_the_same_bytes_on_any_number_of_threads():
    vertices, faces = plate(0.0, 300.0)
    camera = PinholeCamera(320, 240, 300.0, 300.0, 159.5, 119.5)
    made = []
    for count in (1, 3):
        with threads(count):
            made.append(simulate_scan(EmbreeCaster(vertices, faces), camera, POSE, RangeFinder(), 1).scan.range_mm.tobytes())
    assert made[0] == made[1]


def test_brightness_is_lambert_under_the_source():
    made = simulate_scan(sphere(), CAMERA, POSE, QUIET, 1, with_brightness=True)
    source = rigid.move_points(POSE, np.array(QUIET.source_mm))
    to_source = source - RADIUS * made.true_normal
    distance = np.linalg.norm(to_source, axis=-1)
    expected = (made.true_normal * to_source).sum(axis=-1) / distance * (600.0 / distance) ** 2
    measured = made.scan.valid
    np.testing.assert_allclose(made.scan.brightness[measured], np.clip(expected[measured], 0, 1), atol=1e-6)
    assert (made.scan.brightness[made.reason == IN_SHADOW] == 0).all()


def test_a_ring_looks_at_its_target_from_every_side():
    poses = ring_of_poses(8, 500.0, target_mm=(1.0, 2.0, 3.0), elevations_deg=(-10.0, 30.0))
    for pose in poses:
        np.testing.assert_allclose(pose[:3, 3] + 500 * pose[:3, 2], [1.0, 2.0, 3.0], atol=1e-9)
    assert poses[0][2, 3] > 400 and poses[2][0, 3] > 400


@pytest.mark.parametrize("setting", [{"noise_mm": -1.0}, {"fade_deg": 80.0, "limit_deg": 60.0}, {"source_mm": (np.nan, 0, 0)}])
def test_an_impossible_instrument_is_refused(setting):
    with pytest.raises(SettingError):
        RangeFinder(**setting)


def test_the_shipped_scans_are_what_the_function_makes(sample_data):
    from rangecheck.scan.readers import read_scans

    shipped = read_scans(sample_data)
    assert len(shipped) == sample.VIEWS
    for scan, made in ((shipped[5], sample.sample_view(5)), (read_scans(sample_data / "frontal")[0], sample.sample_frontal())):
        np.testing.assert_array_equal(scan.range_mm, made.scan.range_mm)
        np.testing.assert_array_equal(scan.world_from_scan, made.scan.world_from_scan)
        assert scan.camera == made.scan.camera
        if made.scan.brightness is not None:
            np.testing.assert_array_equal(scan.brightness, made.scan.brightness)
    assert (sample_data / "README.md").read_text() == sample.README
    assert sum(path.stat().st_size for path in sample_data.rglob("*") if path.is_file()) < 8e6


def test_every_part_of_the_bust_that_can_be_seen_from_around_is_in_some_view(sample_data):
    from scipy.spatial import cKDTree

    from rangecheck.analytic.bust import bust_first_hit
    from rangecheck.scan.readers import read_scans

    # from twelve directions that are no view's, at heights from chin to crown
    ring = ring_of_poses(12, 600.0, target_mm=sample.TARGET_MM, elevations_deg=(0.0, 25.0, 60.0), first_deg=10.0)
    origins = np.repeat([pose[:3, 3] for pose in ring], 60, axis=0)
    targets = np.random.Generator(np.random.Philox(key=3)).uniform([-35, 165, -30], [35, 290, 35], (len(origins), 3))
    rays = (targets - origins) / np.linalg.norm(targets - origins, axis=1, keepdims=True)
    distance = bust_first_hit(origins, rays)
    points = (origins + distance[:, None] * rays)[np.isfinite(distance)]
    cloud = np.concatenate([scan.points_mm() for scan in read_scans(sample_data)])

    away, _ = cKDTree(cloud).query(points)
    assert (away < 2.0).mean() > 0.97
