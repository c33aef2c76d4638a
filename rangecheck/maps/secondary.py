"""Which surface does each pixel see in the mirror of the surface it sees? Secondary IDs, and the whole chain of reflections.

Exact integers: each pixel's centre ray is reflected by the mirror law, met again, reflected again, and the IDs of what it meets
are kept; 0 = the ray left the scene. Never filtered, never blended.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import ArrayError
from rangecheck.kernels import in_chunks, kernel
from rangecheck.maps.trace import PIXELS_PER_CHUNK, Caster, Maps, measure_hits, require_same
from rangecheck.raycast import EmbreeCaster
from rangecheck.rigid import move_points
from rangecheck.surface import Surface
from rangecheck.surface.attributes import barycentric

#: unit normals (n, 3) at points (n, 3) on faces (n,)
NormalsAt = Callable[[FloatArray, IntArray], FloatArray]
#: a ray that leaves a surface starts this share of the surface's extent off it: 64 float32 steps, as Embree's skin
SKIN = 64 * 2.0**-23


@dataclass(frozen=True, eq=False)
class Chain:
    """What each pixel's mirror ray meets, reflection after reflection.

    part_ids (bounces, h, w) int32, part index + 1; 0 = left the scene (and from then on)
    faces    (bounces, h, w) int32, -1 = left the scene
    """

    part_ids: IntArray = field(repr=False)
    faces: IntArray = field(repr=False)
    part_names: tuple[str, ...] = ()

    @property
    def secondary_id(self) -> IntArray:
        """(h, w) the surface met after the first reflection: the report's secondary face ID."""
        return self.part_ids[0]

    def pairs(self, maps: Maps) -> list[tuple[str, str, int]]:
        """Which surface reflects which: (primary, secondary, pixels), most pixels first; "nothing" where the ray leaves."""
        seen = maps.part_id > 0
        names = ("nothing", *self.part_names)
        both, counts = np.unique(np.stack([maps.part_id[seen], self.secondary_id[seen]]), axis=1, return_counts=True)
        rows = [(names[a], names[b], int(n)) for (a, b), n in zip(both.T, counts)]
        return sorted(rows, key=lambda row: (-row[2], row[0], row[1]))


@kernel
def reflect(directions, facet_normals, normals, points, skin_mm, origins):
    """Mirror directions (in place) about the normals turned towards where the ray came from, and start them off the facet.

    A normal that would send the ray below its own facet gives way to the facet's: no light goes there."""
    for i in range(directions.shape[0]):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        fx, fy, fz = facet_normals[i, 0], facet_normals[i, 1], facet_normals[i, 2]
        if dx * fx + dy * fy + dz * fz > 0.0:
            fx, fy, fz = -fx, -fy, -fz
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        if nx * fx + ny * fy + nz * fz < 0.0:
            nx, ny, nz = -nx, -ny, -nz
        along = dx * nx + dy * ny + dz * nz
        rx, ry, rz = dx - 2.0 * along * nx, dy - 2.0 * along * ny, dz - 2.0 * along * nz
        if along >= 0.0 or rx * fx + ry * fy + rz * fz <= 0.0:
            along = dx * fx + dy * fy + dz * fz
            rx, ry, rz = dx - 2.0 * along * fx, dy - 2.0 * along * fy, dz - 2.0 * along * fz
        length = (rx * rx + ry * ry + rz * rz) ** 0.5
        directions[i, 0], directions[i, 1], directions[i, 2] = rx / length, ry / length, rz / length
        origins[i, 0], origins[i, 1], origins[i, 2] = (
            points[i, 0] + skin_mm * fx,
            points[i, 1] + skin_mm * fy,
            points[i, 2] + skin_mm * fz,
        )


def smooth_normals(surface: Surface) -> NormalsAt:
    """Normals interpolated between the vertices, for meshes without a true surface to ask."""
    vertex_normals = surface.vertex_normals

    def at(points_mm: FloatArray, face: IntArray) -> FloatArray:
        weights = barycentric(surface, points_mm, face)
        normals = np.einsum("nk,nkj->nj", weights, vertex_normals[surface.faces[face]])
        length = np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None]
        return np.where(length > 0, normals / np.where(length > 0, length, 1.0), surface.face_normals[face])

    return at


def trace_chain(
    surface: Surface, maps: Maps, caster: Caster | None = None, *, bounces: int = 1, normals: NormalsAt | None = None
) -> Chain:
    """Follow every pixel's mirror ray through `bounces` reflections. Same result on any number of threads.

    `normals` gives the mirror's normals - a model's exact ones, or `smooth_normals(surface)`; without it the facets are the
    mirrors. Raises ArrayError when `maps` are not of this surface."""
    if bounces < 1:
        raise ArrayError(f"bounces is {bounces}; at least one reflection is needed for a secondary ID", name="bounces")
    require_same(surface, maps.face)
    engine = caster if caster is not None else EmbreeCaster(surface.vertices, surface.faces)
    pixels = np.flatnonzero(maps.hit)
    faces = np.full((bounces, maps.face.size), -1, np.int32)
    w = maps.camera.width
    distance_mm = maps.distance_mm.ravel()
    skin_mm = SKIN * surface.extent_mm
    rotation = maps.world_from_camera[:3, :3]

    def chunk(start: int, stop: int) -> None:
        live = pixels[start:stop]
        face = maps.face.ravel()[live]
        starts, rays = maps.camera.rays((live % w).astype(float), (live // w).astype(float))
        point = move_points(maps.world_from_camera, starts + distance_mm[live, None] * rays)
        directions = np.ascontiguousarray(rays @ rotation.T)
        for bounce in range(bounces):
            facet = np.nan_to_num(surface.normals_of(face))
            normal = facet if normals is None else normals(point, face)
            origins = np.empty_like(point)
            reflect(directions, facet, normal, point, skin_mm, origins)
            hits = engine.closest(origins, directions)
            require_same(surface, hits.face)
            distance = hits.distance_mm.copy()
            measure_hits(
                origins, directions, surface.vertices, surface.faces, hits.face, distance,
                np.empty((len(live), 3), np.float32), np.empty(len(live), np.float32),
            )  # fmt: skip
            met = hits.face >= 0
            live, face, directions = live[met], hits.face[met], directions[met]
            point = origins[met] + distance[met, None] * directions
            faces[bounce, live] = face
            if not len(live):
                return

    in_chunks(chunk, len(pixels), PIXELS_PER_CHUNK)
    parts = np.where(faces >= 0, surface.part_of_face[faces] + 1, 0).astype(np.int32)
    shape = (bounces, *maps.face.shape)
    return Chain(parts.reshape(shape), faces.reshape(shape), surface.part_names)
