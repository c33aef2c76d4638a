"""Maps of a surface seen from any focal point: distance, depth, normals, incidence, which part and which face.

Camera frame as in optics.cameras; normals in the world frame. *Distance* is the length from the ray's origin to the hit, *depth*
its component along the optical axis: two maps, two names. Where nothing is hit, float maps hold NaN, part IDs 0, faces -1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import ArrayError, SceneError
from rangecheck.kernels import in_chunks, kernel
from rangecheck.maps.inside import require_outside
from rangecheck.optics import Camera
from rangecheck.raycast import EmbreeCaster, Hits
from rangecheck.rigid import checked, move_points
from rangecheck.surface import Surface

PIXELS_PER_CHUNK = 16384


class Caster(Protocol):
    """What traces first hits: Embree, or the brute-force oracle."""

    def closest(self, origins_mm: FloatArray, directions: FloatArray) -> Hits: ...


@dataclass(frozen=True, eq=False)
class Maps:
    """What every pixel of `camera` at `world_from_camera` sees at its centre.

    distance_mm   (h, w) float64, NaN where nothing is hit
    depth_mm      (h, w) float64, NaN where nothing is hit
    normals       (h, w, 3) float32 unit outward normals, world frame
    incidence_rad (h, w) float32, angle between the normal and the direction back to the camera; above pi/2 the back is seen
    part_id       (h, w) int32, part index + 1; 0 = none
    face          (h, w) int32, -1 = none
    part_names    names of parts 1, 2, ...
    """

    camera: Camera
    world_from_camera: FloatArray = field(repr=False)
    distance_mm: FloatArray = field(repr=False)
    depth_mm: FloatArray = field(repr=False)
    normals: FloatArray = field(repr=False)
    incidence_rad: FloatArray = field(repr=False)
    part_id: IntArray = field(repr=False)
    face: IntArray = field(repr=False)
    part_names: tuple[str, ...] = ()

    @property
    def hit(self) -> BoolArray:
        """(h, w) True where the surface is seen."""
        return self.face >= 0

    def points_mm(self) -> FloatArray:
        """(h, w, 3) float64 world points of the hits, back-projected from the distance; NaN where nothing is hit."""
        origins, directions = self.camera.pixel_rays()
        return move_points(self.world_from_camera, origins + self.distance_mm[..., None] * directions)


@kernel
def rays_to_world(world_from_camera, origins, directions, world_origins, world_directions):
    """Camera-frame rays in the world frame; one pass instead of numpy's many."""
    m = world_from_camera
    for i in range(origins.shape[0]):
        x, y, z = origins[i]
        dx, dy, dz = directions[i]
        for axis in range(3):
            world_origins[i, axis] = m[axis, 0] * x + m[axis, 1] * y + m[axis, 2] * z + m[axis, 3]
            world_directions[i, axis] = m[axis, 0] * dx + m[axis, 1] * dy + m[axis, 2] * dz


@kernel
def measure_hits(origins_mm, directions, vertices_mm, faces, face, distance_mm, normals, incidence_rad):
    """Distance (in place), normal and incidence of the faces that float32 rays hit, in float64.

    Where a ray meets its face's plane outside the face - the engine's rounding chose a neighbour across an edge, which matters on
    faces seen edge-on - the distance is that of the face's point nearest to the plane's hit, so that no point lies off the surface
    by more than the engine's sideways rounding."""
    for i in range(face.shape[0]):
        f = face[i]
        if f < 0:
            distance_mm[i], incidence_rad[i] = np.nan, np.nan
            normals[i, :] = np.nan
            continue
        ia, ib, ic = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = vertices_mm[ia, 0], vertices_mm[ia, 1], vertices_mm[ia, 2]
        e1x, e1y, e1z = vertices_mm[ib, 0] - ax, vertices_mm[ib, 1] - ay, vertices_mm[ib, 2] - az
        e2x, e2y, e2z = vertices_mm[ic, 0] - ax, vertices_mm[ic, 1] - ay, vertices_mm[ic, 2] - az
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        nx, ny, nz = e1y * e2z - e1z * e2y, e1z * e2x - e1x * e2z, e1x * e2y - e1y * e2x
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        normals[i, 0], normals[i, 1], normals[i, 2] = nx / length, ny / length, nz / length
        cx, cy, cz = ny * dz - nz * dy, nz * dx - nx * dz, nx * dy - ny * dx
        across = nx * dx + ny * dy + nz * dz
        incidence_rad[i] = math.atan2(math.sqrt(cx * cx + cy * cy + cz * cz), -across)
        if across == 0.0:
            continue
        sx, sy, sz = origins_mm[i, 0] - ax, origins_mm[i, 1] - ay, origins_mm[i, 2] - az
        qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
        # Moller & Trumbore's determinant is minus the component across the face
        u = -(sx * (dy * e2z - dz * e2y) + sy * (dz * e2x - dx * e2z) + sz * (dx * e2y - dy * e2x)) / across
        v = -(dx * qx + dy * qy + dz * qz) / across
        if u >= 0.0 and v >= 0.0 and u + v <= 1.0:
            distance_mm[i] = -(e2x * qx + e2y * qy + e2z * qz) / across
        else:
            u, v = max(u, 0.0), max(v, 0.0)
            if u + v > 1.0:
                u, v = u / (u + v), v / (u + v)
            x, y, z = u * e1x + v * e2x - sx, u * e1y + v * e2y - sy, u * e1z + v * e2z - sz
            distance_mm[i] = x * dx + y * dy + z * dz


def require_same(surface: Surface, face: IntArray) -> None:
    """Raises ArrayError when faces (any shape) are named that the surface does not have: they are of another surface."""
    if face.size and face.max() >= len(surface.faces):
        raise ArrayError(
            f"face {face.max()} is named, and the surface has {len(surface.faces)}; maps, caster and surface must belong together",
            name="face",
        )


def closest_of_picture(caster: Caster, origins_mm: FloatArray, directions: FloatArray) -> Hits:
    """First hits of rays that lie side by side in a picture."""
    if isinstance(caster, EmbreeCaster):
        return caster.closest(origins_mm, directions, coherent=True)
    return caster.closest(origins_mm, directions)


def trace_maps(
    surface: Surface,
    camera: Camera,
    world_from_camera: FloatArray,
    caster: Caster | None = None,
    *,
    allow_inside: bool = False,
) -> Maps:
    """Maps of `surface` from `camera`; `caster` is built when not given. Same bytes on any number of threads.

    Raises SceneError when the surface is empty or the focal point lies inside the solid (unless `allow_inside`)."""
    if not len(surface.faces):
        raise SceneError("the surface has no faces; there is nothing to see")
    pose = checked(world_from_camera, "world_from_camera")
    if not allow_inside:
        require_outside(surface, camera, pose)
    engine = caster if caster is not None else EmbreeCaster(surface.vertices, surface.faces)
    h, w = camera.height, camera.width
    n = h * w
    distance, depth = np.empty(n), np.empty(n)
    normals, incidence = np.empty((n, 3), np.float32), np.empty(n, np.float32)
    face = np.empty(n, np.int32)

    def chunk(start: int, stop: int) -> None:
        here = slice(start, stop)
        pixel = np.arange(start, stop)
        origins, directions = camera.rays((pixel % w).astype(float), (pixel // w).astype(float))
        world_origins, world_directions = np.empty((stop - start, 3)), np.empty((stop - start, 3))
        rays_to_world(pose, origins, directions, world_origins, world_directions)
        hits = closest_of_picture(engine, world_origins, world_directions)
        require_same(surface, hits.face)
        distance[here], face[here] = hits.distance_mm, hits.face
        measure_hits(
            world_origins,
            world_directions,
            surface.vertices,
            surface.faces,
            face[here],
            distance[here],
            normals[here],
            incidence[here],
        )
        depth[here] = origins[:, 2] + distance[here] * directions[:, 2]

    in_chunks(chunk, n, PIXELS_PER_CHUNK)
    part = np.where(face >= 0, surface.part_of_face[face] + 1, 0).astype(np.int32)
    return Maps(
        camera=camera,
        world_from_camera=pose,
        distance_mm=distance.reshape(h, w),
        depth_mm=depth.reshape(h, w),
        normals=normals.reshape(h, w, 3),
        incidence_rad=incidence.reshape(h, w),
        part_id=part.reshape(h, w),
        face=face.reshape(h, w),
        part_names=surface.part_names,
    )
