"""One range scan as triangles between neighbouring cells, cut at depth jumps.

World frame, millimetres. Four neighbouring cells make two triangles. An edge is cut when it leans more than `max_angle_deg` from the
plane across its viewing ray (90 degrees = along the ray) and its ends differ in range by more than noise explains; a triangle with
a cut edge is left out. Faces look towards the camera.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, IntArray, unit_vectors
from rangecheck.errors import SettingError, SurfaceError
from rangecheck.kernels import kernel
from rangecheck.optics import PinholeCamera
from rangecheck.scan import RangeScan
from rangecheck.surface.meshing.local_fit import COSINE_CLASSES, noise_by_obliquity
from rangecheck.surface.surface import Surface

#: ranges of two neighbours on one surface differ by noise alone by less than this many standard deviations
NOISE_STEPS = 4.0 * math.sqrt(2.0)


@kernel
def _linked(points, rays, a, b, sine, noise_mm):
    """Whether the edge between cells a and b stays: its component along the mean ray is at most `sine` of it, or is noise."""
    ex, ey, ez = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    rx, ry, rz = rays[a, 0] + rays[b, 0], rays[a, 1] + rays[b, 1], rays[a, 2] + rays[b, 2]
    along = abs(ex * rx + ey * ry + ez * rz) / math.sqrt(rx * rx + ry * ry + rz * rz)
    return along <= noise_mm or along * along <= sine * sine * (ex * ex + ey * ey + ez * ez)


@kernel
def _square(points, a, b):
    return (points[a, 0] - points[b, 0]) ** 2 + (points[a, 1] - points[b, 1]) ** 2 + (points[a, 2] - points[b, 2]) ** 2


@kernel
def _triangles(points, rays, valid, height, width, sine, noise_mm, faces):
    """Write the triangles, turned towards the camera of a grid whose columns run right and rows down; returns how many."""
    n = 0
    for row in range(height - 1):
        for col in range(width - 1):
            a = row * width + col
            b, c, d = a + 1, a + width, a + width + 1
            va, vb, vc, vd = valid[a], valid[b], valid[c], valid[d]
            if va + vb + vc + vd < 3:
                continue
            ab = va and vb and _linked(points, rays, a, b, sine, noise_mm)
            ac = va and vc and _linked(points, rays, a, c, sine, noise_mm)
            bd = vb and vd and _linked(points, rays, b, d, sine, noise_mm)
            cd = vc and vd and _linked(points, rays, c, d, sine, noise_mm)
            ad = va and vd and _linked(points, rays, a, d, sine, noise_mm)
            bc = vb and vc and _linked(points, rays, b, c, sine, noise_mm)
            by_ad = (ad and ac and cd) + (ad and ab and bd)
            by_bc = (bc and ab and ac) + (bc and bd and cd)
            if by_ad > by_bc or (by_ad == by_bc and by_ad > 0 and _square(points, a, d) <= _square(points, b, c)):
                if ac and cd:
                    faces[n, 0], faces[n, 1], faces[n, 2] = a, c, d
                    n += 1
                if ab and bd:
                    faces[n, 0], faces[n, 1], faces[n, 2] = a, d, b
                    n += 1
            elif by_bc > 0:
                if ab and ac:
                    faces[n, 0], faces[n, 1], faces[n, 2] = a, c, b
                    n += 1
                if bd and cd:
                    faces[n, 0], faces[n, 1], faces[n, 2] = b, c, d
                    n += 1
    return n


@kernel
def _towards(points, rays, faces):
    """Sum over faces of -normal . ray: positive when they look towards the camera."""
    total = 0.0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        px, py, pz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        qx, qy, qz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
        total -= (py * qz - pz * qy) * rays[a, 0] + (pz * qx - px * qz) * rays[a, 1] + (px * qy - py * qx) * rays[a, 2]
    return total


@kernel
def _cosines(points, rays, faces, cosine):
    """|normal . ray| at each vertex, from the sum of its faces' area vectors."""
    normals = np.zeros_like(points)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        px, py, pz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        qx, qy, qz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
        nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        for k in range(3):
            v = faces[f, k]
            normals[v, 0] += nx
            normals[v, 1] += ny
            normals[v, 2] += nz
    for v in range(len(points)):
        length = math.sqrt(normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2)
        along = normals[v, 0] * rays[v, 0] + normals[v, 1] * rays[v, 1] + normals[v, 2] * rays[v, 2]
        cosine[v] = abs(along) / length if length > 0.0 else 0.0


@kernel
def _roughness(ranges, out):
    """Immerkaer's mask |4 c - 2 cross + corners| / 6 of whole 3 x 3 neighbourhoods, else NaN."""
    height, width = ranges.shape
    out[:] = np.nan
    for row in range(1, height - 1):
        for col in range(1, width - 1):
            cross = ranges[row - 1, col] + ranges[row + 1, col] + ranges[row, col - 1] + ranges[row, col + 1]
            corners = ranges[row - 1, col - 1] + ranges[row - 1, col + 1] + ranges[row + 1, col - 1] + ranges[row + 1, col + 1]
            out[row, col] = abs(4.0 * ranges[row, col] - 2.0 * cross + corners) / 6.0


def grid_mesh(scan: RangeScan, *, max_angle_deg: float = 80.0, noise_mm: float | None = None) -> Surface:
    """The scan's own samples as an open surface, every face measured.

    max_angle_deg  an edge leaning more than this from the plane across its ray is a depth jump (0 to 90)
    noise_mm       standard deviation of range; by default the scan's own, else nothing is put down to noise

    vertex_error_mm is the noise along the normal: the stated `noise_mm` (along the normal a triangulating range finder's noise hardly
    depends on obliquity), or, where none is stated, an estimate from the scan by class of obliquity, times the cosine.
    Raises SettingError for an angle out of range, ScanError for a scan with under 3 samples, SurfaceError when no face remains."""
    if not 0 < max_angle_deg < 90:
        raise SettingError(f"max_angle_deg is {max_angle_deg}; it must lie between 0 and 90 degrees", key="max_angle_deg")
    scan.need_points()
    noise = scan.noise_mm if noise_mm is None else noise_mm
    height, width = scan.range_mm.shape
    points = scan.grid_points_mm.reshape(-1, 3)
    # where all rays start in the origin, points lie along them; only directions count
    rays = points if isinstance(scan.camera, PinholeCamera) else np.ascontiguousarray(scan.camera.pixel_rays()[1]).reshape(-1, 3)
    valid = scan.valid.ravel()
    # the lowest corner of a triangle's square, or the cell to its right, is valid
    faces = np.empty((4 * int(valid.sum()), 3), np.int32)
    count = _triangles(
        points, rays, valid, height, width, math.sin(math.radians(max_angle_deg)), NOISE_STEPS * (noise or 0.0), faces
    )
    faces = faces[:count]
    if count == 0:
        raise SurfaceError(
            f"{scan.name}: no three neighbouring samples span a face within {max_angle_deg:g} degrees; "
            "raise max_angle_deg, or use poisson or pivot",
            name=scan.name,
        )
    if _towards(points, rays, faces) < 0:
        faces = faces[:, ::-1]
    used = np.zeros(len(points), bool)
    used[faces] = True
    number = np.cumsum(used, dtype=np.int32) - 1
    faces = number[faces]
    error = _errors(scan, points[used], rays[used], faces, used, noise)
    return Surface(rigid.move_points(scan.world_from_scan, points[used]), faces, vertex_error_mm=error)


def estimated_noise_mm(scan: RangeScan) -> float | None:
    """Standard deviation of range that the scan itself shows, over all obliquities; None when under 20 cells tell."""
    rough = np.empty(scan.range_mm.shape)
    _roughness(scan.range_mm.astype(np.float64), rough)
    values = rough[np.isfinite(rough)]
    return float(np.median(values)) / 0.6745 if len(values) >= 20 else None


def _errors(
    scan: RangeScan, points: FloatArray, rays: FloatArray, faces: IntArray, used: FloatArray, noise: float | None
) -> FloatArray | None:
    """(n,) standard error of the vertices along their normals, or None when nothing tells it."""
    if noise is not None:
        return np.full(len(points), float(noise))
    cosine = np.empty(len(points))
    _cosines(points, unit_vectors(rays), faces, cosine)
    rough = np.empty(scan.range_mm.shape)
    _roughness(scan.range_mm.astype(np.float64), rough)
    classes = noise_by_obliquity(rough.ravel()[used], cosine, None)
    if not classes.any():
        return None
    return np.interp(cosine, 0.5 * (COSINE_CLASSES[1:] + COSINE_CLASSES[:-1]), classes) * cosine
