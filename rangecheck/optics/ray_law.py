"""Which cell of a measured grid of rays looks at a point: the law that the rays nearly follow, and the way from it to the rays.

Law, camera frame (x right, y down, z forward), z counted from the plane `start_mm` on which the rays begin:

    x = a[0] . (1, u, v) + z s[0] . (1, u, v)          y likewise with a[1], s[1]

At a given z this is linear in (u, v), so its inverse is a 2 x 2 solution. Parallel rays (s = 0), a linear stage with a fan of rows,
and a pinhole (a = 0) all follow it exactly; what a real scanner leaves over (interlacing, lens distortion) is kept per cell, and
`project` removes it by Newton's steps with the law's Jacobian, until the ray interpolated between the four cells around (u, v)
meets the point. Grids that see more than a half space from one point follow a law in azimuth and elevation instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.errors import CameraError
from rangecheck.kernels import in_chunks, kernel

#: rays flatter than this to the z axis are described by angles
FLATTEST_Z = 0.2
#: cells by which the last Newton step may move (u, v) for the search to count as ended
SETTLED = 5e-4
_STEPS = 12


@dataclass(frozen=True, eq=False)
class RayLaw:
    """The law of a grid of rays and what each cell leaves over.

    a, s      (2, 3) see above; mm and mm per mm, or radians and zero with `angular`
    start_mm  z of the plane z is counted from; `centre_mm` (3,) is where the rays meet if `angular`
    left_over (h, w, 5) float32: lateral remainder (2), slope remainder (2), z of the ray's origin above start_mm
    """

    a: FloatArray
    s: FloatArray
    start_mm: float
    angular: bool
    centre_mm: FloatArray
    left_over: FloatArray = field(repr=False)

    def project(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixel coordinates (..., 2) and range (...,) of camera-frame points (..., 3); NaN where no ray runs forward to the point.
        Outside the grid the law continues."""
        points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 3)
        uv, ranges = np.empty((len(points), 2)), np.empty(len(points))

        def some(i: int, j: int) -> None:
            _search(
                points[i:j], self.a, self.s, self.start_mm, self.angular, self.centre_mm, self.left_over, uv[i:j], ranges[i:j]
            )

        in_chunks(some, len(points), 32768)
        return uv.reshape(points_mm.shape[:-1] + (2,)), ranges.reshape(points_mm.shape[:-1])


def fit_law(origins_mm: FloatArray, directions: FloatArray) -> RayLaw:
    """The law of the rays (h, w, 3), NaN where a ray is not known. Raises CameraError for rays without one."""
    known: BoolArray = np.asarray(np.isfinite(origins_mm).all(axis=-1) & np.isfinite(directions).all(axis=-1))
    height, width = known.shape
    rows, columns = np.nonzero(known)
    if len(rows) < 3 or np.ptp(rows) == 0 or np.ptp(columns) == 0:
        raise CameraError(f"{len(rows)} rays are known, in one row or column; a grid needs three that span it", known=len(rows))
    origin, direction = origins_mm[known], directions[known]
    angular = bool(direction[:, 2].min() < FLATTEST_Z)
    centre: FloatArray = origin.mean(axis=0)
    slope: FloatArray
    start: FloatArray
    if angular:
        apart = float(np.abs(origin - centre).max())
        if apart > 1e-6 * (1 + np.abs(centre).max()):
            raise CameraError(
                f"its rays look to several sides and start {apart:.3g} mm apart; points can be projected into rays that start in one "
                "point, or that all run forward along z",
                apart_mm=apart,
            )
        lateral = _unwrapped(known, direction)
        slope, start = np.zeros_like(lateral), np.zeros(len(lateral))
        start_mm = 0.0
    else:
        start_mm = float(origin[:, 2].mean())
        slope = direction[:, :2] / direction[:, 2:]
        start = origin[:, 2] - start_mm
        lateral = origin[:, :2] - start[:, None] * slope
    design = np.stack([np.ones(len(rows)), columns, rows], axis=1).astype(np.float64)
    both = least_squares(design, np.concatenate([lateral, slope], axis=1))
    a, s = np.ascontiguousarray(both[:, :2].T), np.ascontiguousarray(both[:, 2:].T)
    s[np.abs(s).max(axis=1) * max(width, height) < 1e-12] = 0.0
    rest = np.zeros((height, width, 5))
    rest[known] = np.column_stack([lateral, slope, start])
    u, v = np.arange(width), np.arange(height)[:, None]
    for k, lawful in enumerate((a[0], a[1], s[0], s[1])):
        rest[..., k] -= lawful[0] + lawful[1] * u + lawful[2] * v
    return RayLaw(a, s, start_mm, angular, centre, fill_smoothly(rest, known).astype(np.float32))


def least_squares(design: FloatArray, target: FloatArray) -> FloatArray:
    """Solution of least norm of design x = target, for many rows and few columns, by its normal equations (columns scaled)."""
    scale = np.sqrt((design * design).sum(axis=0))
    scale[scale == 0.0] = 1.0
    scaled = design / scale
    found, *_ = np.linalg.lstsq(scaled.T @ scaled, scaled.T @ target, rcond=1e-12)
    return (found.T / scale).T


def fill_smoothly(values: FloatArray, known: BoolArray) -> FloatArray:
    """`values` (h, w, k) with the cells that are not `known` filled from known ones around them, smoothly (pull-push:
    averages over ever larger blocks). Known cells stay as they are; without any, zero."""
    weight = known.astype(np.float64)
    total = np.where(known[..., None], values, 0.0)
    if known.all() or not known.any():
        return total
    height, width = known.shape
    pad = ((0, height % 2), (0, width % 2))
    blocks = np.pad(weight, pad), np.pad(total, (*pad, (0, 0)))
    coarse_weight, coarse_total = (b[::2, ::2] + b[1::2, ::2] + b[::2, 1::2] + b[1::2, 1::2] for b in blocks)
    held = coarse_weight > 0
    coarse = fill_smoothly(coarse_total / np.where(held, coarse_weight, 1.0)[..., None], held)
    return np.where(known[..., None], total, _doubled(coarse, height, width))


def _doubled(coarse: FloatArray, height: int, width: int) -> FloatArray:
    """`coarse` read linearly at the centres of cells half its size."""
    for axis, size in ((0, height), (1, width)):
        at = np.clip((np.arange(size) - 0.5) / 2, 0, coarse.shape[axis] - 1)
        low = np.minimum(at.astype(int), max(coarse.shape[axis] - 2, 0))
        high = np.minimum(low + 1, coarse.shape[axis] - 1)
        t = np.expand_dims(at - low, tuple(k for k in range(coarse.ndim) if k != axis))
        coarse = (1 - t) * coarse.take(low, axis) + t * coarse.take(high, axis)
    return coarse


def _unwrapped(known: BoolArray, direction: FloatArray) -> FloatArray:
    """Azimuth and elevation (n, 2) of the known rays, the azimuth continued over the turn along each column's mean."""
    azimuth = np.arctan2(direction[:, 0], direction[:, 2])
    _, columns = np.nonzero(known)
    width = known.shape[1]
    mean = np.zeros((2, width))
    np.add.at(mean[0], columns, np.sin(azimuth))
    np.add.at(mean[1], columns, np.cos(azimuth))
    used = np.hypot(*mean) > 0
    around = np.zeros(width)
    around[used] = np.unwrap(np.arctan2(mean[0], mean[1])[used])
    turn = 2 * math.pi
    azimuth += turn * np.round((around[columns] - azimuth) / turn)
    elevation = np.arctan2(direction[:, 1], np.hypot(direction[:, 0], direction[:, 2]))
    return np.stack([azimuth, elevation], axis=1)


@kernel
def _search(points, a, s, start, angular, centre, left_over, uv, ranges):
    height, width = left_over.shape[0], left_over.shape[1]
    turn = 2.0 * math.pi
    for i in range(len(points)):
        uv[i, 0] = uv[i, 1] = ranges[i] = math.nan
        x, y, z = points[i, 0], points[i, 1], points[i, 2] - start
        away = 0.0
        if angular:
            x, y, z = x - centre[0], y - centre[1], points[i, 2] - centre[2]
            away = math.sqrt(x * x + y * y + z * z)
            x, y, z = math.atan2(x, z), math.atan2(y, math.sqrt(x * x + z * z)), 0.0
            middle = a[0, 0] + 0.5 * (width - 1) * a[0, 1] + 0.5 * (height - 1) * a[0, 2]
            x += turn * math.floor((middle - x) / turn + 0.5)
        m00, m01 = a[0, 1] + z * s[0, 1], a[0, 2] + z * s[0, 2]
        m10, m11 = a[1, 1] + z * s[1, 1], a[1, 2] + z * s[1, 2]
        det = m00 * m11 - m01 * m10
        x0, y0 = x - a[0, 0] - z * s[0, 0], y - a[1, 0] - z * s[1, 0]
        u, v = (m11 * x0 - m01 * y0) / det, (m00 * y0 - m10 * x0) / det
        if not (math.isfinite(u) and math.isfinite(v)):
            continue
        lawful_u, lawful_v = u, v
        sx = sy = oz = 0.0
        settled = False
        for _ in range(_STEPS):
            uc, vc = min(max(u, 0.0), width - 1.0), min(max(v, 0.0), height - 1.0)
            c0, r0 = min(int(uc), max(width - 2, 0)), min(int(vc), max(height - 2, 0))
            c1, r1 = min(c0 + 1, width - 1), min(r0 + 1, height - 1)
            f, g = uc - c0, vc - r0
            w00, w01, w10, w11 = (1 - f) * (1 - g), f * (1 - g), (1 - f) * g, f * g
            n00, n01, n10, n11 = left_over[r0, c0], left_over[r0, c1], left_over[r1, c0], left_over[r1, c1]
            ex = w00 * n00[0] + w01 * n01[0] + w10 * n10[0] + w11 * n11[0]
            ey = w00 * n00[1] + w01 * n01[1] + w10 * n10[1] + w11 * n11[1]
            sx = w00 * n00[2] + w01 * n01[2] + w10 * n10[2] + w11 * n11[2]
            sy = w00 * n00[3] + w01 * n01[3] + w10 * n10[3] + w11 * n11[3]
            oz = w00 * n00[4] + w01 * n01[4] + w10 * n10[4] + w11 * n11[4]
            dx, dy = ex + z * sx, ey + z * sy
            next_u, next_v = lawful_u - (m11 * dx - m01 * dy) / det, lawful_v - (m00 * dy - m10 * dx) / det
            step = max(abs(next_u - u), abs(next_v - v))
            u, v = next_u, next_v
            if step < SETTLED:
                settled = True
                break
        if not settled:
            continue
        if angular:
            uv[i, 0], uv[i, 1], ranges[i] = u, v, away
            continue
        if z - oz > 0.0:
            sx += s[0, 0] + s[0, 1] * u + s[0, 2] * v
            sy += s[1, 0] + s[1, 1] * u + s[1, 2] * v
            uv[i, 0], uv[i, 1] = u, v
            ranges[i] = (z - oz) * math.sqrt(1.0 + sx * sx + sy * sy)
