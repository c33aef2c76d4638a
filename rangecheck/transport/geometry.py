"""A scene as the compiled stages read it: everything in the caster's local frame (centred, scaled to the object). Corners are read by
vertex: of a mesh of 20 million faces copies face by face would be more than all else."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import inline_kernel
from rangecheck.raycast import EmbreeCaster
from rangecheck.scene import Scene


class Geometry(NamedTuple):
    """vertices (n, 3) float32; faces (m, 3) int32; normals (k, 3) float32 and of which of these each corner has one, rows (m, 3) int32;
    material (m,) int16; skin: how far a ray starts off the face that it leaves."""

    vertices: FloatArray
    faces: IntArray
    normals: FloatArray
    rows: IntArray
    material: IntArray
    skin: float

    def corners(self, face: IntArray | slice) -> FloatArray:
        """(k, 3, 3) float32 corners of some faces."""
        return self.vertices[self.faces[face]]

    def corner_normals(self, face: IntArray | slice) -> FloatArray:
        """(k, 3, 3) float32 normals at the corners of some faces."""
        return self.normals[self.rows[face]]


class SourceArrays(NamedTuple):
    """centre (s, 3) local, radius (s,) local, radiance (s, c)."""

    centre: FloatArray
    radius: FloatArray
    radiance: FloatArray


def geometry_of(scene: Scene, caster: EmbreeCaster) -> Geometry:
    """The scene's faces in the local frame of `caster`."""
    normals, rows = scene.shading_normals
    return Geometry(
        vertices=caster.local,
        faces=caster.faces,
        normals=normals,
        rows=rows,
        material=np.ascontiguousarray(scene.material_of_face),
        skin=caster.skin,
    )


def sources_of(scene: Scene, caster: EmbreeCaster, channels: int) -> SourceArrays:
    """The scene's sources in the local frame of `caster`, for `channels` wavelengths."""
    count = len(scene.sources)
    centre, radius, radiance = np.empty((count, 3)), np.empty(count), np.empty((count, channels))
    for k, source in enumerate(scene.sources):
        centre[k] = (source.centre_mm - caster.centre_mm) / caster.scale_mm
        radius[k] = source.radius_mm / caster.scale_mm
        radiance[k] = source.radiance
    return SourceArrays(centre, radius, radiance)


@inline_kernel
def dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@inline_kernel
def place_hit(vertices, faces, normals, rows, skin, face, u, v, dx, dy, dz, place, shading, facing, i):
    """Where ray (dx, dy, dz) met `face` at (u, v): row i of `place` (a skin off the face), `shading` and `facing` (its own)
    normal, both turned against the ray.

    With smooth normals the place is lifted to the rounded surface that they describe, so that a coarse mesh does not shade itself in
    facets where light grazes it (Hanika, *Hacking the shadow terminator*, 2021); on flat faces nothing is lifted."""
    w = 1.0 - u - v
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    ax, ay, az = float(vertices[a, 0]), float(vertices[a, 1]), float(vertices[a, 2])
    ex, ey, ez = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
    fx, fy, fz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
    x, y, z = ax + u * ex + v * fx, ay + u * ey + v * fy, az + u * ez + v * fz
    gx, gy, gz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
    p, q, r = rows[face, 0], rows[face, 1], rows[face, 2]
    sx = w * normals[p, 0] + u * normals[q, 0] + v * normals[r, 0]
    sy = w * normals[p, 1] + u * normals[q, 1] + v * normals[r, 1]
    sz = w * normals[p, 2] + u * normals[q, 2] + v * normals[r, 2]
    # the face's own normal agrees with its corners' on which side is out
    turn = 1.0 if dot(gx, gy, gz, dx, dy, dz) < 0.0 else -1.0
    size = turn / math.sqrt(dot(gx, gy, gz, gx, gy, gz))
    gx, gy, gz = gx * size, gy * size, gz * size
    turn = 1.0 if dot(sx, sy, sz, gx, gy, gz) > 0.0 else -1.0
    size = turn / math.sqrt(max(dot(sx, sy, sz, sx, sy, sz), 1e-30))
    sx, sy, sz = sx * size, sy * size, sz * size
    seen = -dot(sx, sy, sz, dx, dy, dz)
    if seen < 1e-4:
        # a rounded normal that looks away from the eye is bent back to where it just sees it
        sx, sy, sz = sx - (1e-4 - seen) * dx, sy - (1e-4 - seen) * dy, sz - (1e-4 - seen) * dz
        size = 1.0 / math.sqrt(dot(sx, sy, sz, sx, sy, sz))
        sx, sy, sz = sx * size, sy * size, sz * size
    lx = ly = lz = 0.0
    for k in range(3):
        share, at, row = w if k == 0 else (u if k == 1 else v), faces[face, k], rows[face, k]
        nx, ny, nz = turn * normals[row, 0], turn * normals[row, 1], turn * normals[row, 2]
        below = min(0.0, dot(x - vertices[at, 0], y - vertices[at, 1], z - vertices[at, 2], nx, ny, nz))
        lx, ly, lz = lx - share * below * nx, ly - share * below * ny, lz - share * below * nz
    place[i, 0], place[i, 1], place[i, 2] = x + lx + skin * gx, y + ly + skin * gy, z + lz + skin * gz
    shading[i, 0], shading[i, 1], shading[i, 2] = sx, sy, sz
    facing[i, 0], facing[i, 1], facing[i, 2] = gx, gy, gz
