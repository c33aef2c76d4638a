"""Maps of a surface seen from any focal point: distance, depth, normals, incidence, which part and which face.

Camera frame as in optics.cameras; normals in the world frame. *Distance* is the length from the ray's origin to the hit, *depth*
its component along the optical axis: two maps, two names. Where nothing is hit, float maps hold NaN, part IDs 0, faces -1.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import SceneError
from rangecheck.kernels import in_chunks, kernel
from rangecheck.maps.inside import require_outside
from rangecheck.optics import Camera
from rangecheck.raycast import EmbreeCaster, Hits
from rangecheck.rigid import checked, move_directions, move_points
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
def refine_hits(origins_mm, directions, vertices_mm, faces, face, distance_mm):
    """Distances of float32 hits made again in float64, against the plane of the face that was hit (in place).

    Where the ray meets that plane outside the face - the engine's rounding chose a neighbour across an edge, which matters on
    faces seen edge-on - the distance is that of the face's point nearest to the plane's hit, so that no point lies off the surface
    by more than the engine's sideways rounding."""
    for i in range(face.shape[0]):
        f = face[i]
        if f < 0:
            distance_mm[i] = np.nan
            continue
        a, b, c = vertices_mm[faces[f, 0]], vertices_mm[faces[f, 1]], vertices_mm[faces[f, 2]]
        o, d = origins_mm[i], directions[i]
        e1x, e1y, e1z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        e2x, e2y, e2z = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        px, py, pz = d[1] * e2z - d[2] * e2y, d[2] * e2x - d[0] * e2z, d[0] * e2y - d[1] * e2x
        determinant = e1x * px + e1y * py + e1z * pz
        if determinant == 0.0:
            continue
        sx, sy, sz = o[0] - a[0], o[1] - a[1], o[2] - a[2]
        u = (sx * px + sy * py + sz * pz) / determinant
        qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
        v = (d[0] * qx + d[1] * qy + d[2] * qz) / determinant
        if u >= 0.0 and v >= 0.0 and u + v <= 1.0:
            distance_mm[i] = (e2x * qx + e2y * qy + e2z * qz) / determinant
        else:
            u, v = max(u, 0.0), max(v, 0.0)
            if u + v > 1.0:
                u, v = u / (u + v), v / (u + v)
            x, y, z = u * e1x + v * e2x - sx, u * e1y + v * e2y - sy, u * e1z + v * e2z - sz
            distance_mm[i] = x * d[0] + y * d[1] + z * d[2]


def first_hits(surface: Surface, caster: Caster, origins_mm: FloatArray, directions: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distance (n,) float64, NaN where missed, and face (n,) int32 of rays in the world frame; one chunk, no threads.

    Rays start for the engine where they enter the ball around the surface, so that a far camera costs no precision."""
    low, high = surface.bounds_mm
    centre = 0.5 * (low + high)
    radius = 0.5 * float(np.linalg.norm(high - low)) * (1 + 1e-6)
    local = origins_mm - centre
    along = -(local * directions).sum(axis=1)
    closest = local + along[:, None] * directions
    half_chord = np.sqrt(np.maximum(radius * radius - (closest * closest).sum(axis=1), 0.0))
    advance = np.maximum(along - half_chord, 0.0)
    hits = caster.closest(origins_mm + advance[:, None] * directions, directions)
    distance = hits.distance_mm + advance
    refine_hits(origins_mm, directions, surface.vertices, surface.faces, hits.face, distance)
    return distance, hits.face


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
    face_normals = surface.face_normals

    def chunk(start: int, stop: int) -> None:
        pixel = np.arange(start, stop)
        origins, directions = camera.rays((pixel % w).astype(float), (pixel // w).astype(float))
        axial = directions[:, 2]
        world_origins, world_directions = move_points(pose, origins), move_directions(pose, directions)
        t, f = first_hits(surface, engine, world_origins, world_directions)
        seen = f >= 0
        normal = np.where(seen[:, None], face_normals[f], np.nan)
        cosine = -(normal * world_directions).sum(axis=1)
        sine = np.sqrt((np.cross(normal, world_directions) ** 2).sum(axis=1))
        distance[start:stop], face[start:stop] = t, f
        depth[start:stop] = origins[:, 2] + t * axial
        normals[start:stop], incidence[start:stop] = normal, np.arctan2(sine, cosine)

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
