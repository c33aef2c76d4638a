"""How thick the walls are: from samples of the surface straight inwards to the other side; and gaps straight outwards.

A ray that leaves at a slant measures more than the wall, so only opposite faces count: where the far side is turned by less than
`FACING` from the ray, there is no wall but a wedge, and the sample has no thickness. Every sharp edge, and the tip of every spike, is as thin
as one likes at the edge itself: where the other side is come to from a place over edges that all lie nearer to it than `edge_mm`, that is an
edge and not a wall.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import in_chunks, kernel
from rangecheck.raycast import EmbreeCaster
from rangecheck.surface.edges import edge_table
from rangecheck.surface.surface import Surface

#: least cosine between the ray and the far side's normal for the two sides to make a wall (60 degrees)
FACING = 0.5
_CHUNK = 1 << 14
#: faces around a place that are looked at for an edge
MOST_FACES = 1024


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
    is come to from the sample's own face over edges nearer than `edge_mm`."""
    return _reach(surface, samples, -1.0, edge_mm)


def gap_mm(surface: Surface, samples: Samples, *, edge_mm: float = 0.0) -> FloatArray:
    """(n,) distance straight outwards from each sample to another side that faces it; inf where there is none, or only the other side of
    a groove whose bottom is nearer than `edge_mm`."""
    return _reach(surface, samples, 1.0, edge_mm)


def _reach(surface: Surface, samples: Samples, way: float, edge_mm: float = 0.0) -> FloatArray:
    if not len(samples.face):
        return np.empty(0)
    caster = EmbreeCaster(surface.vertices, surface.faces)
    normals = np.nan_to_num(surface.face_normals)
    table = edge_table(surface)
    longest = (
        np.linalg.norm(surface.triangles - np.roll(surface.triangles, 1, axis=1), axis=2).max(axis=1)
        if edge_mm > 0
        else np.empty(0)
    )

    def cast(first: int, last: int) -> FloatArray:
        n = normals[samples.face[first:last]]
        # start off the face by the skin, so that it is not hit itself
        hits = caster.closest(samples.places_mm[first:last] + way * caster.skin_mm * n, way * n)
        far = normals[np.maximum(hits.face, 0)]
        # inwards the ray leaves through the far side, outwards it enters it: in both cases the two normals are opposite
        facing = np.einsum("ij,ij->i", n, far) <= -FACING
        facing &= hits.face >= 0
        if edge_mm > 0:
            # a far place is no farther beyond such an edge than the far face is long
            asked = np.flatnonzero(facing & (hits.distance_mm < edge_mm + longest[np.maximum(hits.face, 0)]))
            facing[asked] &= ~round_the_edge(
                samples.places_mm[first:last][asked], samples.face[first:last][asked], hits.face[asked], surface.vertices, surface.faces,
                table.edge_of_half, table.start, table.halves, edge_mm,
            )  # fmt: skip
        return np.where(facing, hits.distance_mm + caster.skin_mm, np.inf)

    return np.concatenate(in_chunks(cast, len(samples.face), _CHUNK))


@kernel
def round_the_edge(places, own, far, vertices, faces, edge_of_half, start, halves, edge_mm):
    """(n,) whether the way over the surface from each place on the face `own` to the face `far` crosses only edges nearer than `edge_mm` to the
    place; given up, with no, after MOST_FACES faces."""
    found = np.zeros(len(places), np.bool_)
    seen = np.empty(MOST_FACES, np.int32)
    for k in range(len(places)):
        seen[0] = own[k]
        count, at = 1, 0
        while at < count and not found[k]:
            f = seen[at]
            at += 1
            for side in range(3):
                edge = edge_of_half[3 * f + side]
                if (
                    edge < 0
                    or _off_segment2(places[k], vertices[faces[f, side]], vertices[faces[f, (side + 1) % 3]]) >= edge_mm**2
                ):
                    continue
                for h in range(start[edge], start[edge + 1]):
                    g = halves[h] // 3
                    if g == far[k]:
                        found[k] = True
                    known = False
                    for i in range(count):
                        known = known or seen[i] == g
                    if not known and count < MOST_FACES:
                        seen[count] = g
                        count += 1
    return found


@kernel
def _off_segment2(p, a, b):
    """Squared distance of p from the segment ab."""
    along2 = (b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2
    t = (p[0] - a[0]) * (b[0] - a[0]) + (p[1] - a[1]) * (b[1] - a[1]) + (p[2] - a[2]) * (b[2] - a[2])
    t = min(1.0, max(0.0, t / along2)) if along2 > 0.0 else 0.0
    return (
        (p[0] - a[0] - t * (b[0] - a[0])) ** 2 + (p[1] - a[1] - t * (b[1] - a[1])) ** 2 + (p[2] - a[2] - t * (b[2] - a[2])) ** 2
    )
