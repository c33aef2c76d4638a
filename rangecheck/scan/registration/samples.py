"""What registration takes from a range scan: smoothed points with normals, on the scan's own grid.

Around each cell a quadric is fitted to the neighbours that hang together with it. Range noise lies along the ray, so the fit is an
ordinary least squares of the distance along the ray over the position across it, which stays unbiased where the surface is oblique.
A plane would not do: it moves points of a convex surface inwards, the more the more obliquely they are seen, and all scans of a ring
would lean alike. Scan frame, millimetres; normals point to the sensor's side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, unit_vectors
from rangecheck.basis import frame_around
from rangecheck.equations import cholesky, substituted
from rangecheck.errors import CameraError, ScanError
from rangecheck.kernels import in_chunks, kernel
from rangecheck.optics import Camera
from rangecheck.scan.range_scan import RangeScan

#: a chord between neighbouring cells that is closer than this to the line of sight crosses a depth jump
JUMP_DEG = 82.0
#: cells from a depth jump or from the end of the data within which a point serves no other scan as a target
BORDER_CELLS = 2
#: normals this uncertain (radians) or worse make the window grow
_NORMAL_NOISE = 0.03
_WINDOWS = (1, 2, 3, 4, 5, 7)
#: narrowest window that scans are compared through, cells to each side: coarse search and verdicts want quiet points
_QUIET_WINDOW = 2
#: what normals may err by in the end: by cos 0.1 they make a distance smaller by half a percent. Smoothing takes off more: what windows
#: smooth away differs from view to view, and poses lean on it
FINE_NORMAL_NOISE = 0.1
#: points of one scan beyond which its grid is thinned: a pose needs no more
ENOUGH_POINTS = 60_000
_LEAST_POINTS = 50


@dataclass(frozen=True, eq=False)
class Samples:
    """One scan made ready for registration, every `stride`-th row and column of its grid.

    points_mm  (h, w, 3) float64 points moved onto their fitted quadrics, NaN where there is none
    normals    (h, w, 3) float64 unit, towards the sensor
    usable     (h, w) True where point and normal are known
    inner      (h, w) True where usable and not at a border
    range_mm   (h, w) float32 as measured
    spacing_mm median distance between neighbours of this grid
    noise_mm   standard deviation of one reading along its ray, from the quadrics' residuals
    smooth_mm  expected standard deviation of `points_mm` across the surface
    normal_noise expected standard deviation of a normal, radians
    projects   False when the camera cannot say where a point lies in its grid
    """

    name: str
    camera: Camera = field(repr=False)
    stride: int
    points_mm: FloatArray = field(repr=False)
    normals: FloatArray = field(repr=False)
    usable: BoolArray = field(repr=False)
    inner: BoolArray = field(repr=False)
    range_mm: FloatArray = field(repr=False)
    spacing_mm: float
    noise_mm: float
    smooth_mm: float
    normal_noise: float
    projects: bool

    def spread(self, count: int) -> tuple[FloatArray, FloatArray]:
        """About `count` inner points and their normals, (n, 3) each, spread evenly over the grid; all when there are fewer."""
        chosen = np.flatnonzero(self.inner.ravel())
        step = math.sqrt(len(chosen) / max(count, 1))
        if step > 1:
            rows, columns = np.divmod(chosen, self.inner.shape[1])
            # one point in each block of step x step cells, the first in reading order
            block = (rows / step).astype(np.int64) * self.inner.shape[1] + (columns / step).astype(np.int64)
            chosen = chosen[np.unique(block, return_index=True)[1]]
        return self.points_mm.reshape(-1, 3)[chosen], self.normals.reshape(-1, 3)[chosen]


def samples_of(scan: RangeScan, *, enough: int = ENOUGH_POINTS, fine: bool = False) -> Samples:
    """`scan` made ready; `fine`: smoothed as little as its normals allow, for the last step of an alignment. Raises ScanError when fewer than 50 of its cells lie on a surface."""
    scan.need_points(_LEAST_POINTS)
    stride = max(1, math.isqrt(int(scan.valid.sum() / enough)))
    points = np.ascontiguousarray(scan.grid_points_mm)
    rays = np.ascontiguousarray(scan.camera.pixel_rays()[1], dtype=np.float64)
    step = _spacing(points, rays)
    if not step > 0:
        raise ScanError(
            f"{scan.name}: no two neighbouring cells lie on one surface, so it has no normals; decode or filter it again",
            name=scan.name,
        )
    most = FINE_NORMAL_NOISE if fine else _NORMAL_NOISE
    for window in _WINDOWS if fine else [w for w in _WINDOWS if w >= _QUIET_WINDOW]:
        fits = _quadrics(points, rays, window, stride, step)
        usable = fits.usable
        found = int(usable.sum())
        if found == 0:
            continue
        noise = float(np.sqrt(np.median(fits.variance[usable])))
        smooth, tilt = (noise * math.sqrt(float(np.median(v[usable]))) for v in (fits.spread, fits.tilt))
        if tilt <= most and found >= 0.5 * int(scan.valid[::stride, ::stride].sum()):
            break
    if int(usable.sum()) < _LEAST_POINTS:
        raise ScanError(
            f"{scan.name}: {int(usable.sum())} cells lie on a surface that can be fitted; at least {_LEAST_POINTS} "
            "are needed; filter its noise first or use a denser scan",
            name=scan.name,
            usable=int(usable.sum()),
        )
    inner = usable & ~fits.border
    if inner.sum() < _LEAST_POINTS:
        inner = usable
    thinned = points[::stride, ::stride] + fits.offset[..., None] * rays[::stride, ::stride]
    return Samples(
        scan.name, scan.camera, stride, np.ascontiguousarray(np.where(usable[..., None], thinned, np.nan)), fits.normals, usable, inner,
        np.ascontiguousarray(scan.range_mm[::stride, ::stride]), step * stride, noise, smooth, tilt,
        _projects(scan.camera, thinned[usable][0]),
    )  # fmt: skip


def _projects(camera: Camera, point_mm: FloatArray) -> bool:
    try:
        camera.project(point_mm[None])
    except CameraError:
        return False
    return True


def _spacing(points: FloatArray, rays: FloatArray) -> float:
    """Median distance of connected neighbours: the geometric mean of rows and columns, so that both directions count."""
    slope = math.tan(math.radians(JUMP_DEG))
    lengths = []
    for a, b, ray in (
        (points[:, :-1], points[:, 1:], rays[:, :-1]),
        (points[:-1], points[1:], rays[:-1]),
    ):
        chord = b - a
        with np.errstate(invalid="ignore"):
            along = np.abs((chord * ray).sum(axis=-1))
            length = np.sqrt((chord * chord).sum(axis=-1))
            across = np.sqrt(np.maximum(length**2 - along**2, 0))
            connected = along <= slope * across
        if connected.any():
            lengths.append(float(np.median(length[connected])))
    return float(np.exp(np.mean(np.log(lengths)))) if lengths else math.nan


@dataclass(frozen=True, eq=False)
class _Fits:
    """Quadrics fitted on the thinned grid: see `_fit_quadrics`."""

    normals: FloatArray
    offset: FloatArray
    variance: FloatArray
    spread: FloatArray
    tilt: FloatArray
    border: BoolArray

    @property
    def usable(self) -> BoolArray:
        return ~np.isnan(self.offset)


def _quadrics(points: FloatArray, rays: FloatArray, window: int, stride: int, step_mm: float) -> _Fits:
    shape = tuple(len(range(0, n, stride)) for n in points.shape[:2])
    offset, variance, spread, tilt = (np.full(shape, np.nan) for _ in range(4))
    fits = _Fits(np.full((*shape, 3), np.nan), offset, variance, spread, tilt, np.ones(shape, np.bool_))
    slope = math.tan(math.radians(JUMP_DEG))
    in_chunks(
        lambda first, last: _fit_quadrics(
            points, rays, window, stride, slope, window * step_mm, BORDER_CELLS, first, last,
            fits.normals, fits.offset, fits.variance, fits.spread, fits.tilt, fits.border,
        ),
        shape[0],
        16,
    )  # fmt: skip
    return fits


@kernel
def _fit_quadrics(
    points, rays, window, stride, slope, unit, border_cells, first, last, normals, offset, variance, spread, tilt, border
):
    """d = c + a x + b y + e x^2 + f x y + g y^2 over the window, d along the centre's ray, (x, y) across it in units of `unit`; rows
    `first` to `last` of the thinned grid. `spread` and `tilt` are the variances of c and of the slopes per variance of a reading."""
    h, w = points.shape[0], points.shape[1]
    f, system, right, answer = np.empty(6), np.empty((6, 6)), np.empty(6), np.empty(6)
    for row in range(first, last):
        for column in range(normals.shape[1]):
            i, j = row * stride, column * stride
            if not np.isfinite(points[i, j, 0]):
                continue
            dx, dy, dz = rays[i, j, 0], rays[i, j, 1], rays[i, j, 2]
            e1x, e1y, e1z, e2x, e2y, e2z = frame_around(dx, dy, dz)
            n = 0
            total = 0.0
            edge = False
            system[:, :] = 0.0
            right[:] = 0.0
            for p in range(i - window, i + window + 1):
                for q in range(j - window, j + window + 1):
                    near = abs(p - i) <= border_cells and abs(q - j) <= border_cells
                    if p < 0 or q < 0 or p >= h or q >= w or not np.isfinite(points[p, q, 0]):
                        edge = edge or near
                        continue
                    cx, cy, cz = (
                        points[p, q, 0] - points[i, j, 0],
                        points[p, q, 1] - points[i, j, 1],
                        points[p, q, 2] - points[i, j, 2],
                    )
                    x = (cx * e1x + cy * e1y + cz * e1z) / unit
                    y = (cx * e2x + cy * e2y + cz * e2z) / unit
                    d = cx * dx + cy * dy + cz * dz
                    if abs(d) > slope * unit * math.sqrt(x * x + y * y):
                        edge = edge or near
                        continue
                    n += 1
                    total += d * d
                    f[0], f[1], f[2], f[3], f[4], f[5] = 1.0, x, y, x * x, x * y, y * y
                    for k in range(6):
                        right[k] += f[k] * d
                        for m in range(k + 1):
                            system[k, m] += f[k] * f[m]
            border[row, column] = edge
            # six numbers from at least nine readings
            if n < 9 or not cholesky(system, 6, 1e-4, 0.0):
                continue
            substituted(system, 6, right, answer)
            residual = total
            for k in range(6):
                residual -= answer[k] * right[k]
            offset[row, column] = answer[0]
            variance[row, column] = max(residual, 0.0) / (n - 6)
            ga, gb = answer[1] / unit, answer[2] / unit
            length = math.sqrt(1.0 + ga * ga + gb * gb)
            normals[row, column, 0] = (ga * e1x + gb * e2x - dx) / length
            normals[row, column, 1] = (ga * e1y + gb * e2y - dy) / length
            normals[row, column, 2] = (ga * e1z + gb * e2z - dz) / length
            for k in range(3):
                f[:] = 0.0
                f[k] = 1.0
                substituted(system, 6, f, answer)
                if k == 0:
                    spread[row, column] = answer[0]
                    tilt[row, column] = 0.0
                else:
                    tilt[row, column] += 0.5 * answer[k] / (unit * unit)


def facing(samples: Samples) -> FloatArray:
    """(h, w) cosine between normal and line of sight, NaN where there is no normal."""
    _, rays = samples.camera.pixel_rays()
    toward = -unit_vectors(np.asarray(rays[:: samples.stride, :: samples.stride], dtype=np.float64))
    return (samples.normals * toward).sum(axis=-1)
