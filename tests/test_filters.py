"""Filters and noise on a ball before a slanted wall, whose every distance and slant is known."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from rangecheck.errors import ArrayError, ScanError
from rangecheck.optics import OrthographicCamera, PinholeCamera
from rangecheck.scan import RangeScan
from rangecheck.scan.filters import remove_flying_pixels, remove_isolated, remove_oblique, smooth_ranges
from rangecheck.scan.noise import estimate_noise, surface_cosines

CAMERA = PinholeCamera(240, 200, 300.0, 300.0, 119.5, 99.5)
BALL_MM, RADIUS_MM = np.array([0.0, 0.0, 600.0]), 110.0
WALL_NORMAL = np.array([0.7, 0.2, -1.0]) / np.sqrt(1.53)


def scene(camera=CAMERA):
    """Ranges, cosines of incidence, and which cells see the ball."""
    _, rays = camera.pixel_rays()
    b, c = -(rays @ BALL_MM), BALL_MM @ BALL_MM - RADIUS_MM**2
    with np.errstate(invalid="ignore"):
        near = -b - np.sqrt(b * b - c)
    ball = np.isfinite(near)
    ranges = np.where(ball, near, (WALL_NORMAL @ [0, 0, 900.0]) / (rays @ WALL_NORMAL))
    normals = np.where(ball[..., None], (ranges[..., None] * rays - BALL_MM) / RADIUS_MM, WALL_NORMAL)
    return ranges, np.abs((normals * rays).sum(axis=-1)), ball


RANGES, COSINES, BALL = scene()


def noisy(noise_mm, seed=0, power=2.0, slant=1.0):
    """A scan with noise_mm (r / 600)^power / cos^slant, and that standard deviation."""
    sigma = noise_mm * (RANGES / 600) ** power / np.maximum(COSINES, 0.05) ** slant
    return RangeScan(RANGES + sigma * np.random.default_rng(seed).normal(size=RANGES.shape), CAMERA), sigma


def near_edge(mask, cells):
    """Cells within `cells` of where `mask` changes."""
    from scipy.ndimage import binary_dilation

    edge = np.zeros(mask.shape, bool)
    edge[:, 1:] |= mask[:, 1:] != mask[:, :-1]
    edge[1:] |= mask[1:] != mask[:-1]
    return binary_dilation(edge, iterations=cells) if cells else edge


@pytest.mark.parametrize("noise_mm", [0.01, 0.2])
@pytest.mark.parametrize("power, slant", [(2.0, 1.0), (0.0, 0.0), (1.0, 2.0)])
def test_noise_is_told_from_the_scan_with_its_growth_by_distance_and_slant(noise_mm, power, slant):
    scan, sigma = noisy(noise_mm, power=power, slant=slant)
    found = estimate_noise(scan)
    counted = found.classes[:, 3].sum()
    # the median of n absolute normals errs by 1.17 / sqrt(n) of itself, 2 % in the smallest classes; at 0.01 mm the bend of the ball,
    # whose cells are 2 mm wide, is no longer small against the noise
    assert found.sigma_mm(RANGES, COSINES)[COSINES > 0.5] == pytest.approx(
        sigma[COSINES > 0.5], rel=0.05 if noise_mm > 0.1 else 0.15
    )
    assert abs(found.range_power - power) < 0.25 and abs(found.slant_power - slant) < 0.15
    assert counted > 0.8 * RANGES.size and abs(found.correlation) < 0.03


def test_noise_that_neighbours_share_is_reported_as_correlation():
    from scipy.ndimage import gaussian_filter

    shared = gaussian_filter(np.random.default_rng(0).normal(size=RANGES.shape), 2.0)
    found = estimate_noise(RangeScan(RANGES + 0.2 * shared / shared.std(), CAMERA))
    assert abs(found.correlation) > 0.1


def test_flat_scans_tell_no_power_and_tiny_ones_nothing():
    camera = OrthographicCamera(60, 50, 0.5, 30.0, 25.0)
    flat = RangeScan(300 + 0.1 * np.random.default_rng(0).normal(size=(50, 60)), camera)
    found = estimate_noise(flat)
    assert found.range_power == 0.0 and found.slant_power == 0.0 and found.normal_mm == pytest.approx(0.1, rel=0.1)
    assert estimate_noise(RangeScan(np.full((50, 60), 300.0), camera)).normal_mm == 0.0
    with pytest.raises(ScanError, match="200 are needed to tell noise"):
        estimate_noise(RangeScan(np.ones((5, 6)), OrthographicCamera(6, 5, 0.5, 3.0, 2.0)))


def test_slants_are_those_of_the_ball_and_the_wall():
    cosine = surface_cosines(RangeScan(RANGES, CAMERA), window=1)
    inside = ~near_edge(BALL, 3) & (COSINES > 0.3)
    inside[[0, -1]] = inside[:, [0, -1]] = False
    assert np.abs(cosine - COSINES)[inside].max() < 0.02


def test_smoothing_quietens_surfaces_and_keeps_edges():
    scan, sigma = noisy(0.2)
    for window, gain in ((2, 0.45), (3, 0.32), (5, 0.22)):
        quiet, report = smooth_ranges(scan, window=window, sigma_mm=sigma)
        error = (quiet.range_mm - RANGES) / sigma
        inside = (COSINES > 0.4) & ~near_edge(BALL, window)
        assert np.sqrt((error[inside] ** 2).mean()) < gain
        # a quadratic leaves the fourth power of the window over the cube of the radius, which counts at the widest only
        assert abs(error[inside & BALL].mean()) < (0.02 if window < 5 else 0.1), "a curved surface is not flattened"
        assert np.sqrt((error[near_edge(BALL, 1)] ** 2).mean()) < 1.0, "edges are no worse than they were"
        assert report.count == 0 and report.changed_mm < 2 * sigma.max() and f"{report.of} ranges" in report.said
    assert (np.isnan(quiet.range_mm) == np.isnan(scan.range_mm)).all()


def test_smoothing_leaves_a_plane_seen_aslant_where_it_is():
    plane = np.where(BALL, (WALL_NORMAL @ [0, 0, 900.0]) / (CAMERA.pixel_rays()[1] @ WALL_NORMAL), RANGES)
    quiet, _ = smooth_ranges(RangeScan(plane, CAMERA), window=3, sigma_mm=0.1)
    # what a quadratic leaves of a slanted plane's range, and float32
    assert np.abs(quiet.range_mm - plane).max() < 0.02


def test_flying_pixels_between_ball_and_wall_are_removed_and_hardly_others():
    scan, sigma = noisy(0.1)
    ranges = np.array(scan.range_mm)
    edge = near_edge(BALL, 0) & (np.random.default_rng(1).random(BALL.shape) < 0.5)
    wall = RANGES[BALL.shape[0] // 2, 0]
    ranges[edge] = np.random.default_rng(2).uniform(620, wall - 60, edge.sum())
    cleaned, report = remove_flying_pixels(RangeScan(ranges, CAMERA), sigma_mm=sigma)
    assert report.removed[edge].mean() > 0.9
    assert (report.removed & ~near_edge(BALL, 1)).sum() == 0
    assert report.removed[~edge].mean() < 2e-3
    assert (cleaned.valid == ~report.removed).all() and f"{report.count} of {report.of} cells" in report.said
    assert remove_flying_pixels(scan, sigma_mm=sigma)[1].count < 1e-3 * RANGES.size


def test_isolated_returns_are_removed_by_the_size_of_their_patch():
    ranges = np.full(RANGES.shape, np.nan)
    ranges[50:100, 50:100] = 500.0
    ranges[10, 10] = ranges[10, 11] = 400.0
    ranges[150:154, 150:155] = 700.0
    ranges[70, 70] = 300.0  # far before its neighbours
    scan = RangeScan(ranges, CAMERA)
    left, report = remove_isolated(scan, least_cells=20, sigma_mm=0.1)
    assert report.count == 3 and left.valid.sum() == scan.valid.sum() - 3
    assert remove_isolated(scan, least_cells=21, sigma_mm=0.1)[1].count == 23


def test_oblique_cells_are_removed_by_their_angle():
    scan = RangeScan(RANGES, CAMERA)
    _, report = remove_oblique(scan, max_angle_deg=60.0, sigma_mm=0.0)
    inside = ~near_edge(BALL, 2)
    inside[[0, -1]] = inside[:, [0, -1]] = False
    sure = np.abs(COSINES - 0.5) > 0.03
    assert (report.removed == (COSINES < 0.5))[inside & sure].all()


def test_filters_ask_the_scan_for_its_noise_and_refuse_nonsense():
    scan, _ = noisy(0.2)
    by_statement, _ = smooth_ranges(replace(scan, noise_mm=0.2))
    by_estimate, _ = smooth_ranges(scan)
    assert np.nanmedian(np.abs(by_statement.range_mm - by_estimate.range_mm)) < 0.5 * 0.2
    for call in (
        lambda: smooth_ranges(scan, window=1),
        lambda: smooth_ranges(scan, sigma_mm=-1.0),
        lambda: remove_flying_pixels(scan, grazing_deg=90.0),
        lambda: remove_isolated(scan, least_cells=0),
        lambda: remove_oblique(scan, max_angle_deg=0.0),
        lambda: smooth_ranges(scan, sigma_mm=np.nan),
    ):
        with pytest.raises(ArrayError):
            call()


@pytest.mark.parametrize("filtered", [remove_flying_pixels, remove_isolated, remove_oblique, smooth_ranges])
def test_empty_and_tiny_scans_pass_through(filtered):
    for ranges in (np.full((4, 5), np.nan), np.full((1, 1), 5.0), np.full((2, 2), 5.0)):
        scan = RangeScan(ranges, OrthographicCamera(ranges.shape[1], ranges.shape[0], 1.0, 0.0, 0.0))
        left, report = filtered(scan)
        assert left.range_mm.shape == ranges.shape and report.of == scan.valid.sum()


def test_threads_do_not_change_a_bit():
    from rangecheck.kernels import threads

    scan, sigma = noisy(0.2)
    with threads(1):
        alone = smooth_ranges(scan, sigma_mm=sigma)[0].range_mm.tobytes()
    with threads(3):
        assert smooth_ranges(scan, sigma_mm=sigma)[0].range_mm.tobytes() == alone


UNCOMPILED = """
import sys, numpy as np
from rangecheck.optics import PinholeCamera
from rangecheck.scan import RangeScan
from rangecheck.scan.decode.code import coordinates
from rangecheck.scan.decode.match import partners, smoothed
from rangecheck.scan.filters import remove_flying_pixels, remove_isolated, remove_oblique, smooth_ranges
from rangecheck.scan.noise import estimate_noise

ranges = np.random.default_rng(0).normal(500, 0.2, (24, 30))
ranges[5:8, 5:9] = np.nan
ranges[16:, 20:] += 100
scan = RangeScan(ranges, PinholeCamera(30, 24, 50.0, 50.0, 14.5, 11.5))
noise = estimate_noise(scan)
results = [np.array([noise.normal_mm, noise.slant_power])]
results += [f(scan, sigma_mm=0.2)[0].range_mm for f in (remove_flying_pixels, remove_isolated, remove_oblique, smooth_ranges)]
cell = np.linspace(1, 15, 60).astype(int)
bits = [np.where(((cell ^ cell >> 1) >> k) & 1, 1.0, -1.0) for k in (3, 2, 1, 0)]
column, _ = coordinates(np.repeat(np.array(bits, np.float32)[:, None], 10, 1), np.ones((10, 60), bool), 0)
seen = smoothed(column, np.repeat(np.linspace(1, 3, 10, dtype=np.float32)[:, None], 60, 1))
np.savez(sys.argv[1], *results, column, seen.value, partners(seen, seen)[0])
"""


def test_kernels_mean_the_same_without_the_compiler(tmp_path):
    for name, off in (("compiled", "0"), ("plain", "1")):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": off}
        subprocess.run(
            [sys.executable, "-W", "error", "-c", UNCOMPILED, str(tmp_path / f"{name}.npz")], env=environment, check=True
        )
    compiled, plain = np.load(tmp_path / "compiled.npz"), np.load(tmp_path / "plain.npz")
    for key in compiled.files:
        # sums in another order differ in the last digits of float32
        assert np.allclose(compiled[key], plain[key], rtol=1e-5, atol=1e-5, equal_nan=True), key


@pytest.mark.real_data
def test_the_bunnys_noise_is_a_plausible_scanners(real_data):
    from rangecheck.scan.readers import read_scans

    found = estimate_noise(read_scans(real_data / "stanford_bunny" / "bun000.ply", "m")[0])
    # a Cyberware 3030MS of 1994: steps of some hundredths of a millimetre
    assert 0.005 < found.normal_mm < 0.2
