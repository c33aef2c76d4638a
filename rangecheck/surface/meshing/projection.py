"""Cameras as numbers that compiled kernels understand, so that points are projected into every scan by a few operations.

Frame: x right, y down, z forward; u along columns, v along rows; the range of a point is its distance along its ray (for a
measured grid of rays: the z by which it lies beyond the plane the rays start on). Millimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import CameraError, ScanError
from rangecheck.kernels import inline_kernel
from rangecheck.optics import CylindricalCamera, OrthographicCamera, PinholeCamera, RayGrid
from rangecheck.optics.ray_law import RayLaw, least_squares
from rangecheck.scan import RangeScan

PINHOLE, QUADRATIC, ANGULAR, CYLINDER = 0, 1, 2, 3
#: numbers of a camera, after the 12 of the pose
NUMBERS = 25


@inline_kernel
def project(kind, n, x, y, z):
    """Pixel coordinates and range of a world point in the view with numbers `n`; the range is negative where it is not seen."""
    a = n[0] * x + n[1] * y + n[2] * z + n[9]
    b = n[3] * x + n[4] * y + n[5] * z + n[10]
    c = n[6] * x + n[7] * y + n[8] * z + n[11]
    u = v = 0.0
    r = -1.0
    if kind == PINHOLE:
        if c > 0.0:
            u, v = a / c, b / c
            if n[16] != 0.0:
                q = u * u + v * v
                k = (1.0 + q * (n[17] + q * (n[18] + q * n[21]))) / (1.0 + q * (n[22] + q * (n[23] + q * n[24])))
                u, v = (
                    u * k + 2.0 * n[19] * u * v + n[20] * (q + 2.0 * u * u),
                    v * k + n[19] * (q + 2.0 * v * v) + 2.0 * n[20] * u * v,
                )
            u, v = n[12] * u + n[14], n[13] * v + n[15]
            r = math.sqrt(a * a + b * b + c * c)
    elif kind == CYLINDER:
        turn = 2.0 * math.pi / abs(n[13])
        u = (math.atan2(a, c) - n[16]) / n[13] % turn
        if u > n[17] - 0.5:
            u -= turn
        v = b / n[14] + n[15]
        r = n[12] - math.sqrt(a * a + c * c)
    elif kind == ANGULAR:
        # optics.ray_law: azimuth = a0 + a1 u + a2 v, elevation likewise, solved for u and v
        a, b, c = a - n[24], b - n[25], c - n[26]
        det = n[13] * n[17] - n[14] * n[16]
        if det != 0.0:
            r = math.sqrt(a * a + b * b + c * c)
            a, b = math.atan2(a, c), math.atan2(b, math.sqrt(a * a + c * c))
            a += 2.0 * math.pi * math.floor((n[27] - a) / (2.0 * math.pi) + 0.5)
            a, b = a - n[12], b - n[15]
            u, v = (n[17] * a - n[14] * b) / det, (n[13] * b - n[16] * a) / det
    else:
        r = c - n[36]
        a, b, c = (a - n[32]) * n[35], (b - n[33]) * n[35], (c - n[34]) * n[35]
        u = n[12] + n[13] * a + n[14] * b + n[15] * c + a * (n[16] * a + n[17] * b + n[18] * c)
        u += b * (n[19] * b + n[20] * c) + n[21] * c * c
        v = n[22] + n[23] * a + n[24] * b + n[25] * c + a * (n[26] * a + n[27] * b + n[28] * c)
        v += b * (n[29] * b + n[30] * c) + n[31] * c * c
    return u, v, r


@dataclass(frozen=True)
class Projection:
    """How kernels project into one scan: `kind`, `numbers` (NUMBERS,), lateral pitch (2,): mm per pixel = pitch[0] * range + pitch[1];
    origins and directions (h, w, 3) of the cells' rays, without gaps; ranges (h, w) along them, NaN where nothing returned; and how
    far (h, w) in pixels the measured samples lie off their cells' centres, or None where they lie on them."""

    kind: int
    numbers: FloatArray
    pitch: FloatArray
    origins: FloatArray
    directions: FloatArray
    ranges: FloatArray
    off_u: FloatArray | None = None
    off_v: FloatArray | None = None


def projection_of(scan: RangeScan, rays: tuple[FloatArray, FloatArray] | None = None) -> Projection:
    """The scan's camera as numbers; `rays` are its pixel rays if they are known already.

    Raises ScanError for a camera whose projection has no closed form here."""
    camera, numbers = scan.camera, np.zeros(NUMBERS)
    if isinstance(camera, RayGrid):
        return _of_turning_rays(scan, camera) if _law_of(scan, camera).angular else _of_forward_rays(scan)
    origins, directions = rays or camera.pixel_rays()
    ranges = scan.range_mm.astype(np.float64)
    if isinstance(camera, PinholeCamera):
        numbers[:4] = camera.fx, camera.fy, camera.cx, camera.cy
        numbers[4] = float(any(camera.distortion))
        numbers[5 : 5 + len(camera.distortion)] = camera.distortion
        return Projection(PINHOLE, numbers, np.array([0.5 / camera.fx + 0.5 / camera.fy, 0.0]), origins, directions, ranges)
    if isinstance(camera, OrthographicCamera):
        p = camera.pixel_mm
        numbers[0], numbers[1], numbers[10], numbers[12], numbers[23] = camera.cx, 1 / p, camera.cy, 1 / p, 1.0
        return Projection(QUADRATIC, numbers, np.array([0.0, p]), origins, directions, ranges)
    if isinstance(camera, CylindricalCamera):
        numbers[:6] = camera.radius_mm, camera.step_rad, camera.row_mm, camera.cy, camera.first_rad, camera.width
        step = 0.5 * abs(camera.step_rad)
        pitch = np.array([-step, step * camera.radius_mm + 0.5 * camera.row_mm])
        return Projection(CYLINDER, numbers, pitch, origins, directions, ranges)
    raise ScanError(
        f"a {type(camera).__name__} cannot be projected into by the volumetric method; use poisson, which takes points"
    )


def _law_of(scan: RangeScan, camera: RayGrid) -> RayLaw:
    try:
        return camera.law
    except CameraError as error:
        raise ScanError(f"{scan.name}: {error}; use poisson or pivot, which take points", name=scan.name) from None


def _of_turning_rays(scan: RangeScan, camera: RayGrid) -> Projection:
    """Rays from one point to all sides, by the law of their angles; what a cell leaves over is kept as `off_u`, `off_v`."""
    law = _law_of(scan, camera)
    height, width = scan.range_mm.shape
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    azimuth, elevation = (row[0] + row[1] * u + row[2] * v for row in law.a)
    flat = np.cos(elevation)
    directions = np.stack([flat * np.sin(azimuth), np.sin(elevation), flat * np.cos(azimuth)], axis=-1)
    numbers = np.zeros(NUMBERS)
    numbers[:6], numbers[12:15] = law.a.ravel(), law.centre_mm
    numbers[15] = law.a[0] @ [1.0, 0.5 * (width - 1), 0.5 * (height - 1)]
    off = law.left_over[..., :2] @ np.linalg.inv(law.a[:, 1:]).T
    pitch = np.array([0.5 * (np.linalg.norm(law.a[:, 1]) + np.linalg.norm(law.a[:, 2])), 0.0])
    origins = np.broadcast_to(law.centre_mm, directions.shape)
    return Projection(ANGULAR, numbers, pitch, origins, directions, scan.range_mm.astype(np.float64), off[..., 0], off[..., 1])


def _of_forward_rays(scan: RangeScan) -> Projection:
    """Measured rays that run forward along z, by two least-squares laws through the scan's own samples: u, v quadratic in x, y, z;
    and x, y along each ray linear in z. Stripe scanners follow them to a tenth of a cell; the rest is kept as `off_u`, `off_v`.

    Raises ScanError when the samples leave the laws by more than two cells."""
    valid = scan.valid
    height, width = valid.shape
    rows, columns = np.nonzero(valid)
    points = scan.grid_points_mm[valid]
    centre = points.mean(axis=0)
    scale = 1.0 / max(float(np.ptp(points, axis=0).max()), 1e-9)
    a, b, c = (points - centre).T * scale
    terms = np.stack([np.ones_like(a), a, b, c, a * a, a * b, a * c, b * b, b * c, c * c], axis=1)
    cell = np.stack([columns, rows], axis=1).astype(float)
    forward = least_squares(terms, cell)
    off = np.zeros((height, width, 2))
    off[valid] = terms @ forward - cell
    worst = float(np.quantile(np.abs(off[valid]), 0.99))
    if not worst < 2.0:
        raise ScanError(
            f"{scan.name}: its grid of rays leaves a smooth law by {worst:.1f} cells (2 are allowed), so points cannot be projected "
            "into it; use poisson or pivot, which take points",
            name=scan.name,
        )
    u, v = columns / width - 0.5, rows / height - 0.5
    law = least_squares(np.stack([np.ones_like(u), u, v, u * v, u * u, v * v, c, c * u, c * v], axis=1), points[:, :2])
    u, v = np.arange(width) / width - 0.5, np.arange(height)[:, None] / height - 0.5
    at_centre = [k[0] + k[1] * u + k[2] * v + k[3] * (u * v) + k[4] * (u * u) + k[5] * (v * v) for k in law.T]
    directions = np.stack([scale * (k[6] + k[7] * u + k[8] * v) for k in law.T] + [np.ones((height, width))], axis=-1)
    # ranges count from a plane as far before the samples as they are deep, so that all are positive
    start = float(points[:, 2].min()) - 1.0 / scale
    origins = np.stack([*at_centre, np.full((height, width), centre[2])], axis=-1) - (centre[2] - start) * directions
    numbers = np.concatenate([forward[:, 0], forward[:, 1], centre, [scale, start]])
    steps = [np.hypot(*(np.diff(x, axis=axis) for x in at_centre)).mean() for axis in (0, 1)]
    pitch = np.array([0.0, 0.5 * float(sum(steps))])
    ranges = scan.grid_points_mm[..., 2] - start
    return Projection(QUADRATIC, numbers, pitch, origins, directions, ranges, off[..., 0], off[..., 1])
