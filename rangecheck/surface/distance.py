"""How far points lie from a surface, and on which side.

The nearest point of a triangle after Ericson, *Real-Time Collision Detection*, 2005, 5.1.5; the side after Baerentzen and Aanaes,
*Signed distance computation using the angle weighted pseudonormal*, 2005: exact for closed, consistently wound surfaces.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import FloatArray, IntArray, require, unit_vectors
from rangecheck.kernels import in_chunks, inline_kernel, kernel
from rangecheck.surface.surface import Surface
from rangecheck.surface.tree import triangle_tree

#: points per task; fixed, so that any number of threads gives the same bytes
_CHUNK = 4096
#: where on its triangle a nearest point lies: inside, at corner a b c, on edge ab bc ca
_INSIDE, _CORNER, _EDGE = 0, 1, 4


class Nearest(NamedTuple):
    """Nearest points of a surface to n points.

    distance_mm (n,) float64, not negative
    face        (n,) int32 a face that holds the nearest point
    place_mm    (n, 3) float64 the nearest point
    feature     (n,) int8: 0 inside the face, 1..3 at its corner, 4..6 on its edge ab, bc, ca
    """

    distance_mm: FloatArray
    face: IntArray
    place_mm: FloatArray
    feature: IntArray


class SurfaceDistance:
    """Distances to the faces of one surface. Raises SurfaceError when it has none."""

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        self.tree = triangle_tree(surface)

    def nearest(self, points_mm: FloatArray) -> Nearest:
        """Nearest points of the surface to `points_mm` (n, 3), which must be finite."""
        points = require("points_mm", points_mm, (None, 3), finite=True) - self.tree.centre_mm
        n = len(points)
        found = Nearest(np.empty(n), np.empty(n, np.int32), np.empty((n, 3)), np.empty(n, np.int8))
        tree = self.tree
        # neighbours in space are asked together: each starts from the answer of the one before
        path = _along_curve(points) if n > 1 else np.zeros(n, np.int64)
        in_chunks(
            lambda first, last: nearest_faces(
                points,
                path,
                first,
                last,
                tree.corners,
                tree.boxes,
                tree.depth,
                found.distance_mm,
                found.face,
                found.place_mm,
                found.feature,
            ),
            n,
            _CHUNK,
        )
        return Nearest(found.distance_mm, tree.order[found.face], found.place_mm + tree.centre_mm, found.feature)

    def distance_mm(self, points_mm: FloatArray) -> tuple[FloatArray, IntArray]:
        """Distance (n,) and a nearest face (n,) of points (n, 3)."""
        found = self.nearest(points_mm)
        return found.distance_mm, found.face

    def signed_distance_mm(self, points_mm: FloatArray) -> tuple[FloatArray, IntArray]:
        """As `distance_mm`, negative on the inner side. On an open surface the sign means "behind the nearest face"."""
        signed, found = self.signed_nearest(points_mm)
        return signed, found.face

    def signed_nearest(self, points_mm: FloatArray) -> tuple[FloatArray, Nearest]:
        """As `signed_distance_mm`, with the nearest points."""
        found = self.nearest(points_mm)
        away = np.asarray(points_mm, dtype=np.float64) - found.place_mm
        side = np.einsum("ij,ij->i", away, self._pseudonormals(found))
        return np.where(side < 0, -found.distance_mm, found.distance_mm), found

    def _pseudonormals(self, found: Nearest) -> FloatArray:
        normals = self._face_normals[found.face]
        for corner in range(3):
            here = found.feature == _CORNER + corner
            normals[here] = self.surface.vertex_normals[self.surface.faces[found.face[here], corner]]
            here = found.feature == _EDGE + corner
            normals[here] = self._edge_normals[found.face[here], corner]
        return normals

    @cached_property
    def _face_normals(self) -> FloatArray:
        return np.nan_to_num(self.surface.face_normals)

    @cached_property
    def _edge_normals(self) -> FloatArray:
        """(m, 3, 3) sum of the unit normals of the faces at each edge ab, bc, ca."""
        faces = self.surface.faces
        ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
        key = ends.min(axis=1).astype(np.int64) * len(self.surface.vertices) + ends.max(axis=1)
        _, edge = np.unique(key, return_inverse=True)
        each = np.repeat(self._face_normals, 3, axis=0)
        total: FloatArray = np.stack([np.bincount(edge, each[:, axis]) for axis in range(3)], axis=1).astype(np.float64)
        return np.nan_to_num(unit_vectors(total))[edge].reshape(-1, 3, 3)


def _along_curve(points: FloatArray) -> IntArray:
    """(n,) order of points along a Morton curve with 2^10 cells a side."""
    low, high = points.min(axis=0), points.max(axis=0)
    width = float((high - low).max()) or 1.0
    cell = np.minimum((points - low) * (1024.0 / width), 1023.0).astype(np.uint32)
    code = np.zeros(len(points), np.uint32)
    for axis in range(3):
        spread = cell[:, axis]
        for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
            spread = (spread | (spread << np.uint32(shift))) & np.uint32(mask)
        code |= spread << np.uint32(axis)
    return np.argsort(code, kind="stable")


@inline_kernel
def _box_distance2(boxes, node, x, y, z):
    """Squared distance from a point to a node's box, 0 inside."""
    dx = max(boxes[node, 0] - x, 0.0, x - boxes[node, 3])
    dy = max(boxes[node, 1] - y, 0.0, y - boxes[node, 4])
    dz = max(boxes[node, 2] - z, 0.0, z - boxes[node, 5])
    return dx * dx + dy * dy + dz * dz


@kernel
def nearest_on_triangle(t, x, y, z):
    """Nearest point of triangle t (9,) to (x, y, z): its coordinates and the feature it lies on (see `Nearest`)."""
    abx, aby, abz = t[3] - t[0], t[4] - t[1], t[5] - t[2]
    acx, acy, acz = t[6] - t[0], t[7] - t[1], t[8] - t[2]
    apx, apy, apz = x - t[0], y - t[1], z - t[2]
    d1 = abx * apx + aby * apy + abz * apz
    d2 = acx * apx + acy * apy + acz * apz
    if d1 <= 0.0 and d2 <= 0.0:
        return t[0], t[1], t[2], 1
    bpx, bpy, bpz = x - t[3], y - t[4], z - t[5]
    d3 = abx * bpx + aby * bpy + abz * bpz
    d4 = acx * bpx + acy * bpy + acz * bpz
    if d3 >= 0.0 and d4 <= d3:
        return t[3], t[4], t[5], 2
    cpx, cpy, cpz = x - t[6], y - t[7], z - t[8]
    d5 = abx * cpx + aby * cpy + abz * cpz
    d6 = acx * cpx + acy * cpy + acz * cpz
    if d6 >= 0.0 and d5 <= d6:
        return t[6], t[7], t[8], 3
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        s = d1 / (d1 - d3)
        return t[0] + s * abx, t[1] + s * aby, t[2] + s * abz, 4
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        s = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return t[3] + s * (t[6] - t[3]), t[4] + s * (t[7] - t[4]), t[5] + s * (t[8] - t[5]), 5
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        s = d2 / (d2 - d6)
        return t[0] + s * acx, t[1] + s * acy, t[2] + s * acz, 6
    v, w = vb / (va + vb + vc), vc / (va + vb + vc)
    return t[0] + v * abx + w * acx, t[1] + v * aby + w * acy, t[2] + v * abz + w * acz, 0


@kernel
def nearest_faces(points, path, first, last, corners, boxes, depth, distance, place_of, nearest, feature_of):
    """Nearest faces, as places in the tree's order, of the points path[first:last]; the nearer child is always opened first."""
    n = len(corners)
    leaf_level = (1 << depth) - 1
    waiting = np.empty(2 * depth + 2, np.int64)
    waiting_distance2 = np.empty(2 * depth + 2)
    start = np.int64(0)
    for k in range(first, last):
        p = path[k]
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        best = start
        bx, by, bz, feature = nearest_on_triangle(corners[best], x, y, z)
        best2 = (bx - x) ** 2 + (by - y) ** 2 + (bz - z) ** 2
        waiting[0], waiting_distance2[0] = 0, _box_distance2(boxes, 0, x, y, z)
        top = 1
        while top > 0:
            top -= 1
            node = waiting[top]
            if waiting_distance2[top] >= best2:
                continue
            while node < leaf_level:
                near, far = 2 * node + 1, 2 * node + 2
                near2, far2 = _box_distance2(boxes, near, x, y, z), _box_distance2(boxes, far, x, y, z)
                if far2 < near2:
                    near, far, near2, far2 = far, near, far2, near2
                if far2 < best2:
                    waiting[top], waiting_distance2[top] = far, far2
                    top += 1
                node = near
                if near2 >= best2:
                    break
            if node < leaf_level:
                continue
            leaf = node - leaf_level
            for i in range((leaf * n) >> depth, ((leaf + 1) * n) >> depth):
                qx, qy, qz, kind = nearest_on_triangle(corners[i], x, y, z)
                d2 = (qx - x) ** 2 + (qy - y) ** 2 + (qz - z) ** 2
                if d2 < best2:
                    best2, best, feature, bx, by, bz = d2, np.int64(i), kind, qx, qy, qz
        start = best
        distance[p], place_of[p], feature_of[p] = np.sqrt(best2), best, feature
        nearest[p, 0], nearest[p, 1], nearest[p, 2] = bx, by, bz
