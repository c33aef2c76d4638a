"""How thick the walls are: from samples of the surface straight inwards to the other side; and gaps straight outwards.

A ray that leaves at a slant measures more than the wall, so only opposite faces count: where the far side is turned by less than
`FACING` from the ray, there is no wall but a wedge, and the sample has no thickness. Every sharp edge is as thin as one likes at the edge
itself: of two faces that share a corner, what lies nearer to it than `edge_mm` is an edge and not a wall.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.kernels import in_chunks
from rangecheck.raycast import EmbreeCaster
from rangecheck.surface.surface import Surface

#: least cosine between the ray and the far side's normal for the two sides to make a wall (60 degrees)
FACING = 0.5
_CHUNK = 1 << 14


class Samples(NamedTuple):
    """Points on faces, each standing for a piece of area: places_mm (n, 3), face (n,), area_mm2 (n,)."""

    places_mm: FloatArray
    face: IntArray
    area_mm2: FloatArray


def sample_surface(surface: Surface, spacing_mm: float) -> Samples:
    """At least one sample per face, and about one per spacing_mm^2, evenly laid in each face; no chance is involved."""
    split = np.clip(np.ceil(np.sqrt(2 * surface.face_areas) / spacing_mm), 1, 200).astype(np.int64)
    places, faces, areas = [], [], []
    for n in np.unique(split):
        mine = np.flatnonzero(split == n)
        weights = _middles_of_subdivision(int(n))
        places.append(np.einsum("kc,fcx->fkx", weights, surface.triangles[mine]).reshape(-1, 3))
        faces.append(np.repeat(mine, len(weights)))
        areas.append(np.repeat(surface.face_areas[mine] / len(weights), len(weights)))
    return Samples(np.concatenate(places), np.concatenate(faces), np.concatenate(areas))


def _middles_of_subdivision(n: int) -> FloatArray:
    """(n^2, 3) weights of the middles of the n^2 equal triangles that a triangle divides into."""
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(n) for j in range(n - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(n - 1) for j in range(n - 1 - i)]
    a = np.array(upright + turned) / n
    return np.column_stack([1 - a.sum(axis=1), a])


def wall_thickness_mm(surface: Surface, samples: Samples, *, edge_mm: float = 0.0) -> FloatArray:
    """(n,) distance straight inwards from each sample to the opposite side; inf where there is none that faces it, or only a side that
    meets the sample's own face in an edge or a corner nearer than `edge_mm`."""
    return _reach(surface, samples, -1.0, edge_mm)


def gap_mm(surface: Surface, samples: Samples) -> FloatArray:
    """(n,) distance straight outwards from each sample to another side that faces it; inf where there is none."""
    return _reach(surface, samples, 1.0)


def _reach(surface: Surface, samples: Samples, way: float, edge_mm: float = 0.0) -> FloatArray:
    if not len(samples.face):
        return np.empty(0)
    caster = EmbreeCaster(surface.vertices, surface.faces)
    normals = np.nan_to_num(surface.face_normals)

    def cast(first: int, last: int) -> FloatArray:
        n = normals[samples.face[first:last]]
        # start off the face by the skin, so that it is not hit itself
        hits = caster.closest(samples.places_mm[first:last] + way * caster.skin_mm * n, way * n)
        far = normals[np.maximum(hits.face, 0)]
        # inwards the ray leaves through the far side, outwards it enters it: in both cases the two normals are opposite
        facing = np.einsum("ij,ij->i", n, far) <= -FACING
        if edge_mm > 0:
            facing &= ~_at_common_edge(surface, samples.places_mm[first:last], samples.face[first:last], hits.face, edge_mm)
        return np.where((hits.face >= 0) & facing, hits.distance_mm + caster.skin_mm, np.inf)

    return np.concatenate(in_chunks(cast, len(samples.face), _CHUNK))


def _at_common_edge(surface: Surface, places_mm: FloatArray, face: IntArray, other: IntArray, edge_mm: float) -> BoolArray:
    """(n,) whether a place on `face` lies nearer than `edge_mm` to the corner or edge that face and `other` (-1: none) share."""
    own, far = surface.faces[face], surface.faces[np.maximum(other, 0)]
    shared = (own[:, :, None] == far[:, None, :]).any(axis=2) & (other >= 0)[:, None]
    corners = surface.vertices[own]
    away = np.where(shared, np.linalg.norm(corners - places_mm[:, None], axis=2), np.inf).min(axis=1)
    for i in range(3):
        j = (i + 1) % 3
        along = corners[:, j] - corners[:, i]
        share = np.einsum("ij,ij->i", places_mm - corners[:, i], along) / np.maximum(np.einsum("ij,ij->i", along, along), 1e-300)
        foot = corners[:, i] + np.clip(share, 0, 1)[:, None] * along
        beside = np.linalg.norm(places_mm - foot, axis=1)
        away = np.where(shared[:, i] & shared[:, j], np.minimum(away, beside), away)
    return np.asarray(away < edge_mm)
