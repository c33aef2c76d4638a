"""A measured grid of rays: projecting a point is the inverse of running along a ray."""

import numpy as np
import pytest

from rangecheck.errors import CameraError
from rangecheck.optics import OrthographicCamera, PinholeCamera, RayGrid
from rangecheck.optics.ray_law import fill_smoothly


def grid_of(camera):
    origins, directions = camera.pixel_rays()
    return RayGrid(camera.width, camera.height, np.array(origins), np.array(directions))


def turning(width, height, first_rad, step_rad):
    """Rays of a scanner that turns about its vertical axis, from one point."""
    azimuth = first_rad + step_rad * np.arange(width)[None, :]
    elevation = np.linspace(-0.8, 0.5, height)[:, None]
    directions = np.stack(
        np.broadcast_arrays(np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)), -1
    )
    return RayGrid(width, height, np.broadcast_to([5.0, -3.0, 2.0], directions.shape), directions)


@pytest.mark.parametrize(
    "camera",
    [
        PinholeCamera(31, 23, 60.0, 66.0, 14.0, 12.5),
        PinholeCamera(31, 23, 40.0, 41.0, 14.0, 12.5, (-0.2, 0.05, 1e-3, -2e-3)),
        OrthographicCamera(31, 23, 0.3, 15.0, 11.0),
    ],
    ids=["pinhole", "distorted", "parallel"],
)
def test_the_law_of_a_camera_with_a_formula_is_that_formula(camera):
    random = np.random.default_rng(0)
    u, v = random.uniform(1, 29, 500), random.uniform(1, 21, 500)
    origins, directions = camera.rays(u, v)
    points = origins + random.uniform(50, 500, 500)[:, None] * directions
    uv, ranges = grid_of(camera).project(points)
    formula_uv, formula_ranges = camera.project(points)
    # rays are interpolated linearly between cells: the curvature of the distortion over one cell remains
    assert np.abs(uv - formula_uv).max() < (2e-3 if getattr(camera, "distortion", ()) else 5e-4)
    assert np.allclose(ranges, formula_ranges, rtol=1e-5)


@pytest.mark.parametrize("first, step", [(-3.0, 0.05), (3.0, -0.05), (0.5, 2 * np.pi / 100)], ids=["right", "left", "full turn"])
def test_a_turning_scanner_is_inverted_through_its_seam(first, step):
    grid = turning(100, 30, first, step)
    random = np.random.default_rng(1)
    u, v = random.uniform(0, 99, 300), random.uniform(0, 29, 300)
    origins, directions = grid.rays(u, v)
    away = random.uniform(10, 1000, 300)
    uv, ranges = grid.project(origins + away[:, None] * directions)
    # the direction between two cells is their normalised mean, not the mean angle: a third power of the step
    assert np.abs(uv - np.stack([u, v], axis=1)).max() < 2e-2
    assert np.allclose(ranges, away)


def test_points_behind_or_unknown_are_not_seen():
    grid = grid_of(PinholeCamera(31, 23, 60.0, 66.0, 14.0, 12.5))
    uv, ranges = grid.project(np.array([[0, 0, -5.0], [np.nan, 0, 1], [0, 0, 5.0]]))
    assert np.isnan(uv[:2]).all() and np.isnan(ranges[:2]).all() and np.isfinite(uv[2]).all()


def test_cells_without_a_ray_take_the_law_of_the_others():
    camera = OrthographicCamera(31, 23, 0.3, 15.0, 11.0)
    grid = grid_of(camera)
    grid.origins_mm[5:9, 4:20] = np.nan
    uv, _ = RayGrid(31, 23, grid.origins_mm, grid.directions).project(np.array([[-2.0, -1.2, 7.0]]))
    assert np.allclose(uv, camera.project(np.array([[-2.0, -1.2, 7.0]]))[0], atol=1e-4)


def test_rays_without_a_law_are_refused():
    random = np.random.default_rng(2)
    directions = random.normal(size=(5, 6, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    with pytest.raises(CameraError, match=r"start .* mm apart"):
        RayGrid(6, 5, random.normal(size=(5, 6, 3)), directions).project(np.ones((1, 3)))
    with pytest.raises(CameraError, match="0 rays are known"):
        RayGrid(6, 5, np.full((5, 6, 3), np.nan), directions).project(np.ones((1, 3)))


def test_filling_keeps_what_is_known_and_stays_within_its_bounds():
    random = np.random.default_rng(3)
    values, known = random.uniform(2, 3, (37, 22, 2)), random.random((37, 22)) < 0.02
    filled = fill_smoothly(values, known)
    assert (filled[known] == values[known]).all()
    assert filled.min() >= values[known].min() and filled.max() <= values[known].max()
