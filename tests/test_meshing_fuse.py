"""Several posed scans fused into one closed surface."""

from functools import cache

import numpy as np
import pytest

from rangecheck import kernels, rigid
from rangecheck.analytic.shapes import Box, Shape, Sphere, Torus
from rangecheck.errors import ScanError, SettingError
from rangecheck.optics import CylindricalCamera, OrthographicCamera, PinholeCamera, RayGrid
from rangecheck.scan import RangeScan
from rangecheck.surface import INTERPOLATED, INVENTED, MEASURED, Surface
from rangecheck.surface.meshing import fuse
from rangecheck.surface.meshing.fit_error import noise_of_blend
from rangecheck.surface.meshing.local_fit import quiet_ranges
from rangecheck.surface.meshing.samples import distance_to_samples, sample_grid
from rangecheck.surface.meshing.views import SMOOTHED, views_of
from rangecheck.surface.topology import (
    boundary_edges,
    euler_numbers,
    inconsistent_edges,
    non_manifold_edges,
    non_manifold_vertices,
)

CAMERA = PinholeCamera.from_field_of_view(96, 96, 24.0)
ROUND = ((0, 0), (90, 0), (180, 0), (270, 0), (0, 89), (0, -89))


def scan_of(shape: Shape, pose, camera=CAMERA, sigma: float = 0.0, seed: int = 0, **keywords) -> RangeScan:
    """What a perfect range finder at `pose` measures of `shape`, with Gaussian noise along the rays."""
    origins, directions = camera.pixel_rays()
    ranges = shape.first_hit(rigid.move_points(pose, origins), rigid.move_directions(pose, directions))
    noise = np.random.default_rng(seed).normal(0, sigma, ranges.shape)
    return RangeScan(np.where(np.isfinite(ranges), ranges + noise, np.nan), camera, pose, **keywords)


def scans_around(shape: Shape, places=ROUND, distance_mm: float = 300.0, **keywords) -> list[RangeScan]:
    """Scans from azimuth and elevation in degrees."""
    scans = []
    for k, (azimuth, elevation) in enumerate(np.radians(places)):
        way = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
        scans.append(scan_of(shape, rigid.look_at(distance_mm * way, (0.0, 0.0, 0.0)), seed=k, **keywords))
    return scans


@cache
def fused_sphere(sigma: float = 0.1) -> Surface:
    return fuse(scans_around(Sphere(50.0), sigma=sigma))


def assert_closed_manifold(surface: Surface) -> None:
    assert len(boundary_edges(surface)) == 0
    assert len(non_manifold_edges(surface)) == 0
    assert len(non_manifold_vertices(surface)) == 0
    assert len(inconsistent_edges(surface)) == 0
    assert surface.volume_mm3 > 0


def test_a_sphere_seen_from_all_sides_is_one_closed_shell_of_genus_zero():
    surface = fused_sphere()
    assert_closed_manifold(surface)
    assert euler_numbers(surface).tolist() == [2]
    assert surface.volume_mm3 == pytest.approx(4 / 3 * np.pi * 50**3, rel=2e-3)


def test_no_two_vertices_meet_when_an_stl_rounds_them_to_float32():
    rounded = fused_sphere().vertices.astype(np.float32)
    assert len(np.unique(rounded, axis=0)) == len(rounded)


def test_averaging_brings_the_surface_nearer_to_the_truth_than_the_samples_are():
    error = np.linalg.norm(fused_sphere().vertices, axis=1) - 50.0
    # a quadratic fit of width 1 pixel or more averages at least 5 samples
    assert np.sqrt((error**2).mean()) < 0.1 / np.sqrt(5)
    assert abs(error.mean()) < 0.02


def test_without_noise_the_vertices_lie_on_the_sphere_to_a_thousandth_of_the_grid():
    clean = fused_sphere(0.0)
    step = np.median(np.linalg.norm(np.diff(clean.triangles[:, :2], axis=1), axis=-1))
    error = np.abs(np.linalg.norm(clean.vertices, axis=1) - 50.0)
    assert np.median(error) < 1e-3 * step
    # at the rim of a view its one-sided fits see a curve of radius 40 steps end
    assert error.max() < 0.1 * step


def test_a_torus_keeps_its_hole():
    surface = fuse(
        scans_around(Torus(35.0, 14.0), ((0, 60), (90, 60), (180, 60), (270, 60), (0, -60), (120, -60), (240, -60)), sigma=0.05)
    )
    assert_closed_manifold(surface)
    assert euler_numbers(surface).tolist() == [0]


def test_what_nobody_saw_is_closed_and_called_invented():
    surface = fuse(scans_around(Box(60.0, 60.0, 60.0), ((45, 20), (135, 20), (225, 20), (315, 20)), sigma=0.05))
    assert_closed_manifold(surface)
    below = surface.triangles.mean(axis=1)[:, 1] < -30.5
    assert surface.share_of_area(INVENTED) > 0.05
    centroid = surface.triangles.mean(axis=1)
    # the unseen underside: far from its rim everything is invented, and nothing is on the seen sides
    middle = (np.abs(centroid[:, [0, 2]]).max(axis=1) < 20) & (centroid[:, 1] < 0)
    assert middle.any() and (surface.origin_of_face[middle] == INVENTED).all()
    assert (surface.origin_of_face[~below & (centroid[:, 1] > -25)] != INVENTED).all()


def test_space_that_a_ray_crossed_is_never_filled():
    surface = fuse(scans_around(Box(60.0, 60.0, 60.0), ((45, 20), (135, 20), (225, 20), (315, 20)), sigma=0.05))
    for scan in scans_around(Box(60.0, 60.0, 60.0), ((45, 20), (225, 20))):
        uv, ranges = scan.camera.project(rigid.move_points(rigid.inverse(scan.world_from_scan), surface.vertices))
        column, row = np.rint(uv).astype(int).T
        inside = (column >= 1) & (column < 95) & (row >= 1) & (row < 95)
        seen = scan.range_mm[row[inside], column[inside]]
        before = ranges[inside] < seen - 3.0
        assert not before[np.isfinite(seen)].any()


@pytest.mark.parametrize("thresholds", [(2.0, 5.0), (4.0, 4.0), (3.0, 12.0)])
def test_labels_follow_the_stated_distance_to_the_nearest_sample_exactly(thresholds):
    from scipy.spatial import cKDTree

    scans = scans_around(Sphere(50.0), sigma=0.1)
    masked = scans[0].range_mm.copy()
    masked[30:60, 35:70] = np.nan
    scans = [RangeScan(masked, CAMERA, scans[0].world_from_scan), *scans[2:4]]
    measured_mm, interpolated_mm = thresholds
    surface = fuse(scans, measured_mm=measured_mm, interpolated_mm=interpolated_mm)
    distance, _ = cKDTree(np.concatenate([s.points_mm() for s in scans])).query(surface.triangles.mean(axis=1))
    expected = np.where(distance <= measured_mm, MEASURED, np.where(distance <= interpolated_mm, INTERPOLATED, INVENTED))
    clear = (np.abs(distance - measured_mm) > 1e-9) & (np.abs(distance - interpolated_mm) > 1e-9)
    assert (surface.origin_of_face[clear] == expected[clear]).all()
    assert (expected == INVENTED).any()


def test_the_expected_error_covers_the_true_one():
    surface = fused_sphere()
    error = np.abs(np.linalg.norm(surface.vertices, axis=1) - 50.0)
    assert np.isfinite(surface.vertex_error_mm).all()
    # without detail to smooth away it errs on the safe side
    assert (error < surface.vertex_error_mm).mean() > 0.68
    assert (error < 2 * surface.vertex_error_mm).mean() > 0.95
    assert np.median(surface.vertex_error_mm) < 0.1 / np.sqrt(5)


def test_noise_of_which_half_is_left_and_shared_by_neighbours_is_expected_where_it_is_stated():
    from scipy.ndimage import gaussian_filter

    smoothed = []
    for scan in scans_around(Sphere(50.0), sigma=0.0):
        noise = gaussian_filter(np.random.default_rng(len(smoothed)).normal(0.0, 1.0, scan.range_mm.shape), 2.0)
        smoothed.append(
            RangeScan(scan.range_mm + np.float32(0.05 / noise.std()) * noise, CAMERA, scan.world_from_scan, noise_mm=0.1)
        )
    surface = fuse(smoothed)
    error = np.abs(np.linalg.norm(surface.vertices, axis=1) - 50.0)
    assert (error < 2 * surface.vertex_error_mm).mean() > 0.95


def _fitted(truth: np.ndarray, sigma: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of the local fits of noisy ranges `truth` seen by parallel rays 1 mm apart, their borders cut off: errors, standard errors of the fits
    alone and of what is read between cells, and mean squares of what they smooth away."""
    noisy = truth + np.random.default_rng(seed).normal(0.0, sigma, truth.shape)
    fits = quiet_ranges(noisy, np.array([0.0, 1.0]), sigma)
    alone = fits.values[..., 3]
    inside = (slice(8, -8), slice(8, -8))
    found = (fits.values[..., 0] - truth, alone, alone * fits.factors[fits.chosen], fits.clues[..., 0])
    return tuple(values[inside] for values in found)


def test_on_a_plane_the_local_fits_err_by_what_they_say_and_smooth_nothing_away():
    v, u = np.mgrid[0:160, 0:160].astype(float)
    error, _, between, lost = _fitted(500.0 + 0.2 * u - 0.1 * v, 0.1, seed=3)
    stated = between / noise_of_blend()[-1]
    # an RMS over cells of which some 25 share their samples
    few = np.sqrt(25 / error.size)
    assert abs(np.sqrt(np.mean(error**2) / np.mean(stated**2)) - 1.0) < 4 * few
    assert abs(np.mean(lost)) < 0.2 * np.mean(stated**2)


@pytest.mark.parametrize("period", [10.0, 14.0])
def test_ripples_that_the_local_fits_smooth_away_are_told_from_the_scan(period):
    v, u = np.mgrid[0:160, 0:160].astype(float)
    truth = 500.0 + 0.05 * np.sin(2 * np.pi * u / period) * np.sin(2 * np.pi * v / period)
    error, alone, between, lost = _fitted(truth, 0.02, seed=4)
    total = np.mean(between**2 + lost)
    assert np.mean(error**2) > 1.5 * np.mean(alone**2)  # noise alone does not explain it
    # the fourth-power law is the first term of a series in (width / period)^2
    assert 0.7 < np.sqrt(np.mean(error**2) / total) < 1.4


@pytest.mark.parametrize("enough", [0.0, 3.0])
def test_the_nearest_sample_is_found_however_far_it_lies(enough):
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(2)
    # a sheet, and a few samples far beside it: most cells of the box are empty
    samples = np.concatenate([rng.uniform(0, 40, (4000, 3)) * (1, 1, 0.02), rng.uniform(90, 130, (5, 3))])
    asked = rng.uniform(-60, 160, (3000, 3))
    true = cKDTree(samples).query(asked)[0]
    found = distance_to_samples(sample_grid(samples, 1.5), asked, 70.0, enough)
    assert (np.isinf(found) == (true > 70.0)).all()
    exact = np.isfinite(found) & (true > enough)
    np.testing.assert_allclose(found[exact], true[exact], rtol=1e-12)
    assert (found[true <= enough] <= max(enough, 1e-12)).all()


@pytest.mark.parametrize("grain_mm", [0.0, 0.06, 0.2])
def test_grain_finer_than_the_cells_is_told_from_noise_of_the_same_size_by_what_two_scans_share(grain_mm):
    sigma, side = 0.1, 160
    camera = OrthographicCamera(side, side, 1.0, 79.5, 79.5)
    grain = grain_mm * np.random.default_rng(5).normal(size=(side, side))
    noises = (sigma * np.random.default_rng(seed).normal(size=(side, side)) for seed in (6, 7))
    views = views_of([RangeScan((500.0 + grain + noise).astype(np.float32), camera) for noise in noises])
    inside = np.zeros((2, side, side), bool)
    inside[:, 12:-12, 12:-12] = True
    lost = float(views.cells[inside.ravel(), SMOOTHED].mean())
    # products of left-out residuals, of some 1.3 standard deviations each, which neighbours in a window share
    few = np.sqrt(25 / side**2) * (1.3 * np.hypot(sigma, grain_mm)) ** 2
    assert abs(lost - grain_mm**2) < 4 * few + 0.1 * grain_mm**2


def test_the_same_scans_give_the_same_bytes_on_any_number_of_threads():
    scans = scans_around(Sphere(50.0), ROUND[:3], sigma=0.1)
    with kernels.threads(1):
        one = fuse(scans)
    with kernels.threads(3):
        three = fuse(scans)
    assert one.vertices.tobytes() == three.vertices.tobytes()
    assert one.faces.tobytes() == three.faces.tobytes()
    assert one.vertex_error_mm.tobytes() == three.vertex_error_mm.tobytes()


def test_far_from_the_origin_nothing_changes():
    far = np.array([4.5e8, -2.0e8, 5.0e8])
    scans = scans_around(Sphere(50.0), sigma=0.1)
    moved = []
    for scan in scans:
        pose = scan.world_from_scan.copy()
        pose[:3, 3] += far
        moved.append(scan.moved(pose))
    surface, there = fused_sphere(), fuse(moved)
    assert_closed_manifold(there)
    assert there.volume_mm3 == pytest.approx(surface.volume_mm3, rel=1e-4)


def pose_from(azimuth_deg: float):
    a = np.radians(azimuth_deg)
    return rigid.look_at((300 * np.sin(a), 0.0, 300 * np.cos(a)), (0.0, 0.0, 0.0))


def raygrid_of(camera) -> RayGrid:
    origins, directions = camera.pixel_rays()
    return RayGrid(camera.width, camera.height, np.ascontiguousarray(origins), np.ascontiguousarray(directions))


@pytest.mark.parametrize("kind", ["orthographic", "raygrid", "fan of rays", "lens", "cylindrical"])
def test_every_camera_that_can_be_projected_into_gives_the_same_sphere(kind):
    parallel = OrthographicCamera(110, 110, 1.1, 54.5, 54.5)
    cameras = {
        "orthographic": parallel,
        "raygrid": raygrid_of(parallel),
        "fan of rays": raygrid_of(CAMERA),
        "lens": PinholeCamera(96, 96, 226.0, 226.0, 47.5, 47.5, (-0.2, 0.05, 1e-3, -1e-3)),
    }
    if kind == "cylindrical":
        camera = CylindricalCamera(360, 110, 150.0, 2 * np.pi / 360, 1.1, 54.5)
        surface = fuse([scan_of(Sphere(50.0), rigid.identity(), camera, sigma=0.05)])
    else:
        surface = fuse([scan_of(Sphere(50.0), pose_from(a), cameras[kind], sigma=0.05, seed=a) for a in (0, 90, 180, 270)])
    assert_closed_manifold(surface)
    measured = np.unique(surface.faces[surface.origin_of_face == MEASURED])
    error = np.linalg.norm(surface.vertices[measured], axis=1) - 50.0
    assert np.median(np.abs(error)) < 0.05
    assert surface.share_of_area(MEASURED) > 0.85


def test_floating_bits_are_removed_by_the_stated_share():
    scans = scans_around(Sphere(50.0), ROUND[:4])
    ranges = scans[0].range_mm.copy()
    ranges[2:8, 2:8] = 300.0
    with_bit = [RangeScan(ranges, CAMERA, scans[0].world_from_scan), *scans[1:]]
    assert len(euler_numbers(fuse(with_bit))) == 1
    assert len(euler_numbers(fuse(with_bit, least_shell=0.0))) > 1


def test_half_closed_leaves_only_the_holes_wider_than_stated_open():
    scans = scans_around(Box(60.0, 60.0, 60.0), ((45, 20), (135, 20), (225, 20), (315, 20)), sigma=0.05)
    opened = fuse(scans, closing="open")
    assert (opened.origin_of_face != INVENTED).all()
    assert len(boundary_edges(opened)) > 0 and len(non_manifold_vertices(opened)) == 0
    assert len(boundary_edges(fuse(scans, closing="half", largest_hole_mm=40.0))) > 0
    assert_closed_manifold(fuse(scans, closing="half", largest_hole_mm=400.0))


def test_what_cannot_be_fused_is_refused_with_the_reason():
    scans = scans_around(Sphere(50.0), ROUND[:2])
    with pytest.raises(ScanError, match="no scans"):
        fuse([])
    with pytest.raises(SettingError, match="positive number"):
        fuse(scans, voxel_mm=-1.0)
    with pytest.raises(SettingError, match="in this order"):
        fuse(scans, measured_mm=5.0, interpolated_mm=1.0)
    with pytest.raises(SettingError, match="open, half, closed"):
        fuse(scans, closing="ajar")
    empty = RangeScan(np.full((96, 96), np.nan), CAMERA, name="dark")
    with pytest.raises(ScanError, match="dark: 0 of 9216"):
        fuse([*scans, empty])
    lonely = np.full((96, 96), np.nan)
    lonely[::6, ::6] = 300.0
    with pytest.raises(ScanError, match="too far apart"):
        fuse([RangeScan(lonely, CAMERA)])
    with pytest.raises(SettingError, match="blocks"):
        fuse(scans, voxel_mm=1e-5)
