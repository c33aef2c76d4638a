"""A scene as the compiled stages read it: everything in the caster's local frame (centred, scaled to the object), corner data
face by face so that one hit touches one place in memory."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import inline_kernel
from rangecheck.raycast import EmbreeCaster
from rangecheck.scene import Scene


class Geometry(NamedTuple):
    """corners, normals (m, 9) float32: three points, three unit normals; material (m,) int16; skin: how far a ray starts off
    the face that it leaves."""

    corners: FloatArray
    normals: FloatArray
    material: IntArray
    skin: float


class SourceArrays(NamedTuple):
    """centre (s, 3) local, radius (s,) local, radiance (s, c)."""

    centre: FloatArray
    radius: FloatArray
    radiance: FloatArray


def geometry_of(scene: Scene, caster: EmbreeCaster) -> Geometry:
    """The scene's faces in the local frame of `caster`."""
    faces = len(caster.faces)
    return Geometry(
        corners=np.take(caster.vertices.astype(np.float32), caster.faces, axis=0).reshape(faces, 9),
        normals=np.ascontiguousarray(scene.corner_normals.reshape(faces, 9)),
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
def place_hit(corners, normals, skin, face, u, v, dx, dy, dz, place, shading, facing, i):
    """Where ray (dx, dy, dz) met `face` at (u, v): row i of `place` (a skin off the face), `shading` and `facing` (its own)
    normal, both turned against the ray.

    With smooth normals the place is lifted to the rounded surface that they describe, so that a coarse mesh does not shade itself in
    facets where light grazes it (Hanika, *Hacking the shadow terminator*, 2021); on flat faces nothing is lifted."""
    w = 1.0 - u - v
    ax, ay, az = float(corners[face, 0]), float(corners[face, 1]), float(corners[face, 2])
    ex, ey, ez = corners[face, 3] - ax, corners[face, 4] - ay, corners[face, 5] - az
    fx, fy, fz = corners[face, 6] - ax, corners[face, 7] - ay, corners[face, 8] - az
    x, y, z = ax + u * ex + v * fx, ay + u * ey + v * fy, az + u * ez + v * fz
    gx, gy, gz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
    sx = w * normals[face, 0] + u * normals[face, 3] + v * normals[face, 6]
    sy = w * normals[face, 1] + u * normals[face, 4] + v * normals[face, 7]
    sz = w * normals[face, 2] + u * normals[face, 5] + v * normals[face, 8]
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
    for k in range(0, 9, 3):
        share = w if k == 0 else (u if k == 3 else v)
        nx, ny, nz = turn * normals[face, k], turn * normals[face, k + 1], turn * normals[face, k + 2]
        below = min(0.0, dot(x - corners[face, k], y - corners[face, k + 1], z - corners[face, k + 2], nx, ny, nz))
        lx, ly, lz = lx - share * below * nx, ly - share * below * ny, lz - share * below * nz
    place[i, 0], place[i, 1], place[i, 2] = x + lx + skin * gx, y + ly + skin * gy, z + lz + skin * gz
    shading[i, 0], shading[i, 1], shading[i, 2] = sx, sy, sz
    facing[i, 0], facing[i, 1], facing[i, 2] = gx, gy, gz
