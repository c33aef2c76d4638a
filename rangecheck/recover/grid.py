"""A scan's own grid as what a camera sees: places, normals at a stated scale, and sums over places that hold something.

The brightness image of a scan lies on the scan's own pixels, so nothing has to be cast. Scan frame = camera frame, millimetres. Normals are
those of the range image smoothed by a Gaussian, as only neighbours on the same side of a depth jump can smooth it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from rangecheck.errors import ScanError
from rangecheck.recover.sight import Sight
from rangecheck.scan import RangeScan

#: neighbours further apart in range than this many pixel sizes lie on two sides of a depth jump
JUMP = 4.0


@dataclass(frozen=True, eq=False)
class ScanGrid:
    """The scan on its grid, every `step`-th row and column of it averaged to one.

    points (h, w, 3) scan frame, NaN where nothing returned;  valid (h, w);  picture (h, w) brightness, NaN where not valid;  rays (h, w, 3)
    unit;  spacing_mm between neighbouring cells, across the view, median;  step"""

    points: FloatArray
    valid: BoolArray
    picture: FloatArray
    rays: FloatArray
    spacing_mm: float
    step: int


def scan_grid(scan: RangeScan, step: int = 1) -> ScanGrid:
    """The scan with its brightness, `step` x `step` cells averaged to one where at least half of them returned.

    Raises ScanError where the scan has no brightness or nothing is left."""
    if scan.brightness is None:
        raise ScanError(f"{scan.name}: the scan has no brightness image; nothing can be compared with it", name=scan.name)
    origins, rays = scan.camera.pixel_rays()
    if not np.allclose(origins, origins[0, 0], atol=1e-6, equal_nan=True):
        raise ScanError(f"{scan.name}: its rays do not start in one point; pictures of such scanners are not compared")
    found = np.where(scan.valid, scan.range_mm, np.nan).astype(np.float64)
    seen = np.where(scan.valid, scan.brightness, np.nan).astype(np.float64)
    h, w = (n // step for n in found.shape)
    if min(h, w) < 3:
        raise ScanError(f"{scan.name}: {found.shape[1]} x {found.shape[0]} cells in steps of {step} leave no grid")

    def mean(values: FloatArray) -> FloatArray:
        blocks = values[: h * step, : w * step].reshape(h, step, w, step)
        filled = np.isfinite(blocks)
        count = filled.sum(axis=(1, 3))
        total = np.where(filled, blocks, 0.0).sum(axis=(1, 3))
        return np.where(2 * count >= step * step, total / np.maximum(count, 1), np.nan)

    ranges, bright = mean(found), mean(seen)
    middle = unit_vectors(np.stack([mean(rays[..., k]) for k in range(3)], axis=-1))
    valid = np.isfinite(ranges)
    if not valid.any():
        raise ScanError(f"{scan.name}: no cell holds a distance; nothing can be compared with the picture")
    apart = np.linalg.norm(np.diff(middle, axis=1), axis=-1)
    spacing = float(np.nanmedian(apart) * np.nanmedian(ranges))
    points = origins[0, 0] + ranges[..., None] * middle
    return ScanGrid(points, valid, np.where(valid, bright, np.nan), middle, spacing, step)


def masked_gauss(values: FloatArray, weight: FloatArray, sigma: float) -> FloatArray:
    """Gaussian mean of values (h, w) by weight; NaN where no weight is near. `sigma` in cells."""
    from scipy.ndimage import gaussian_filter

    total = gaussian_filter(np.where(weight > 0, values, 0.0) * weight, sigma, truncate=3.0, mode="constant")
    norm = gaussian_filter(weight.astype(np.float64), sigma, truncate=3.0, mode="constant")
    return np.where(norm > 1e-3, total / np.maximum(norm, 1e-12), np.nan)


def normals_at(grid: ScanGrid, scale_mm: float) -> FloatArray:
    """(h, w, 3) unit normals, towards the camera, of the range image smoothed at `scale_mm`; NaN where a neighbour is missing."""
    return turned_normals(grid, scale_mm)[0]


def turned_normals(grid: ScanGrid, scale_mm: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(h, w, 3) unit normals, towards the camera, of the range image smoothed at `scale_mm`, NaN where a neighbour is missing; and how they turn with the
    slopes of ln range per cell along columns and along rows.

    Smoothing acts on the logarithm of range after a plane's own slope, so that slanted planes keep their normals up to rims."""
    ranges = np.linalg.norm(grid.points, axis=-1)
    sigma = max(scale_mm / grid.spacing_mm, 0.5)
    level, across, down = _local_planes(np.log(np.where(grid.valid, ranges, 1.0)), grid.valid, sigma)
    by_u = _ray_slopes(grid.rays, 1) + across[..., None] * grid.rays
    by_v = _ray_slopes(grid.rays, 0) + down[..., None] * grid.rays
    crossed = np.cross(by_u, by_v)
    crossed[(crossed * grid.rays).sum(-1) > 0] *= -1.0
    length = np.maximum(np.linalg.norm(crossed, axis=-1, keepdims=True), 1e-300)
    normals = crossed / length
    normals[~grid.valid | ~np.isfinite(level)] = np.nan
    # v x u looks back to the camera, as columns run right and rows down
    turns = [np.cross(by_v, grid.rays), np.cross(grid.rays, by_u)]
    a, b = ((turn - (turn * normals).sum(-1, keepdims=True) * normals) / length for turn in turns)
    return normals, a, b


def _ray_slopes(rays: FloatArray, axis: int) -> FloatArray:
    return np.gradient(rays, axis=axis)


def _local_planes(values: FloatArray, valid: BoolArray, sigma: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Level and slopes (per cell along columns, rows) of the planes fitted to values around each cell, weighted by a Gaussian (moving least
    squares by convolution)."""
    from scipy.ndimage import correlate1d

    reach = max(1, math.ceil(2.5 * sigma))
    t = np.arange(-reach, reach + 1, dtype=np.float64)
    bell = np.exp(-0.5 * (t / sigma) ** 2)

    def moment(field: FloatArray, i: int, j: int) -> FloatArray:
        half = correlate1d(field, bell * t**i, axis=1, mode="constant")
        return np.asarray(correlate1d(half, bell * t**j, axis=0, mode="constant"))

    weight = valid.astype(np.float64)
    base = float(values[valid].mean())
    lifted = np.where(valid, values - base, 0.0)
    m = {(i, j): moment(weight, i, j) for i, j in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))}
    r = {(i, j): moment(lifted, i, j) for i, j in ((0, 0), (1, 0), (0, 1))}
    matrix = np.empty((*values.shape, 3, 3))
    for row, a in enumerate(((0, 0), (1, 0), (0, 1))):
        for column, b in enumerate(((0, 0), (1, 0), (0, 1))):
            matrix[..., row, column] = m[a[0] + b[0], a[1] + b[1]]
    right = np.stack([r[0, 0], r[1, 0], r[0, 1]], axis=-1)
    good = valid & (np.linalg.det(matrix) > 1e-3 * (bell.sum() ** 2) ** 3)
    solved = np.full((*values.shape, 3), np.nan)
    solved[good] = np.linalg.solve(matrix[good], right[good][..., None])[..., 0]
    return solved[..., 0] + base, solved[..., 1], solved[..., 2]


def grid_sight(grid: ScanGrid, normals: FloatArray, keep: BoolArray) -> Sight:
    """The kept cells as a sight: the camera's own pixels, whose pose is not moved."""
    cell = np.flatnonzero(keep & np.isfinite(normals).all(axis=-1))
    return sight_of(grid, cell, normals.reshape(-1, 3)[cell])


def sight_of(grid: ScanGrid, cell: IntArray, normals: FloatArray) -> Sight:
    """Cells (m,) of the flattened grid with normals (m, 3) as what the scan's own camera sees; its pose is not moved."""
    n = len(cell)
    return Sight(
        cell, np.zeros(n, np.int32), grid.points.reshape(-1, 3)[cell], normals, normals, -grid.rays.reshape(-1, 3)[cell], np.zeros(n),
        np.full(n, grid.spacing_mm), np.zeros((n, 3, 3, 0)), np.zeros((n, 0)), (grid.valid.shape[0], grid.valid.shape[1]),
    )  # fmt: skip
