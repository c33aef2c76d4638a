"""A cavity's ridges drawn out to where they belong.

The surface at a depth has ridges below every edge and curl of the outside that bends more sharply than the depth: there the nearest side
changes. A grid cuts them off by up to a third of its step, and the wall there is as much too thick. So every vertex is first moved to the
depth exactly, along the way to its nearest place of the outside. Then each edge whose ends lie below sides that are turned from each other
is parted where the two planes at depth, below these two sides, meet: as in extended marching cubes (Kobbelt, Botsch, Schwanecke and Seidel,
*Feature sensitive surface extraction from volume data*, 2001), but on the mesh's own edges, so that it stays closed and manifold as it was.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangecheck.arrays import FloatArray, IntArray, unit_vectors
from rangecheck.surface import topology as topo
from rangecheck.surface.distance import SurfaceDistance
from rangecheck.surface.intersections import CROSSING, OVERLAP, self_intersections
from rangecheck.surface.surface import Surface

#: least angle between the ways out of an edge's two ends for it to cross a ridge, in degrees
TURN_DEG = 12.0
#: times that edges are parted
ROUNDS = 2
#: edges shorter than this share of the first step, and moves longer than this many of them, are left alone
SHORTEST, FARTHEST = 0.15, 1.5
#: faces whose area is below about this share of their longest side's square count as turned over
FLAT = 1e-6
#: times that a move is halved before it is given up
HALVINGS = 4
#: rings of neighbours up to which vertices of faces that meet are put back
RINGS = 6


def with_ridges(inner: Surface, outside: SurfaceDistance, depth_mm: float, step_mm: float) -> Surface:
    """`inner`, a surface about `depth_mm` inside a closed surface made on a grid of `step_mm`, with its vertices at the depth and its ridges
    drawn out, as far as no face turns over or meets another by it."""
    far = FARTHEST * step_mm
    faces, given = inner.faces, inner.vertices
    way, _ = _ways_out(outside, given)
    vertices = _unfolded(given, _at_depth(outside, given, depth_mm, far), 0, faces, way)
    turned = np.cos(np.radians(TURN_DEG))
    for _ in range(ROUNDS):
        table = topo.edge_table(faces)
        a, b = table.ends.T
        length = np.linalg.norm(vertices[a] - vertices[b], axis=1)
        crossing = (np.einsum("ij,ij->i", way[a], way[b]) < turned) & (length > SHORTEST * step_mm)
        if not crossing.any():
            break
        a, b = a[crossing], b[crossing]
        ridge = _on_ridge(outside, vertices, way, a, b, depth_mm, far)
        number = np.full(len(crossing), -1)
        number[crossing] = len(vertices) + np.arange(len(a))
        faces = _parted(faces, number[table.edge_of_half].reshape(-1, 3), np.concatenate([vertices, ridge]))
        # a face at a ridge may look to either side of it, and no farther round
        way = np.concatenate([way, unit_vectors(way[a] + way[b])])
        middle = np.concatenate([vertices, 0.5 * (vertices[a] + vertices[b])])
        given = np.concatenate([given, 0.5 * (given[a] + given[b])])
        vertices = _unfolded(middle, np.concatenate([vertices, ridge]), len(vertices), faces, way)
        way[-len(a) :], _ = _ways_out(outside, vertices[-len(a) :])
    return replace(
        inner,
        vertices=_apart_again(given, vertices, faces),
        faces=faces,
        part_of_face=np.full(len(faces), inner.part_of_face[0]),
        origin_of_face=np.full(len(faces), inner.origin_of_face[0]),
    )


def _apart_again(given: FloatArray, vertices: FloatArray, faces: IntArray) -> FloatArray:
    """`vertices` with those at faces that cross or overlap put back where they lie on the given surface, with ever more rings around them."""
    ends = topo.edge_table(faces).ends
    places = vertices.copy()
    for rings in range(RINGS):
        culprits = self_intersections(Surface(places, faces)).of_kind(CROSSING, OVERLAP)
        if not len(culprits):
            return places
        mark = np.zeros(len(places), bool)
        mark[faces[np.unique(culprits)].ravel()] = True
        for _ in range(rings):
            mark[ends[mark[ends].any(axis=1)].ravel()] = True
        places[mark] = given[mark]
    return given


def _unfolded(before: FloatArray, wanted: FloatArray, first: int, faces: IntArray, way: FloatArray) -> FloatArray:
    """`wanted` places of vertices, those from `first` on drawn back towards `before` at faces that would look against their corners' ways
    out: by half again and again, at last wholly."""
    share = np.ones(len(wanted))
    for again in range(HALVINGS + 1):
        places = before + share[:, None] * (wanted - before)
        a, b, c = faces.T
        normal = np.cross(places[b] - places[a], places[c] - places[a])
        side2 = np.max([((places[i] - places[j]) ** 2).sum(axis=1) for i, j in ((a, b), (b, c), (c, a))], axis=0)
        folded = np.einsum("ij,ij->i", normal, way[a] + way[b] + way[c]) <= FLAT * side2
        culprits = np.unique(faces[folded])
        culprits = culprits[(culprits >= first) & (share[culprits] > 0)]
        if not len(culprits):
            break
        share[culprits] *= 0.5 if again < HALVINGS - 1 else 0.0
    return places


def _ways_out(outside: SurfaceDistance, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors (n, 3) from places inside to the nearest of the outside, and how deep they are (n,)."""
    signed, found = outside.signed_nearest(places)
    way = found.place_mm - places
    return way / np.maximum(np.abs(signed), 1e-300)[:, None], -signed


def _at_depth(outside: SurfaceDistance, places: FloatArray, depth_mm: float, farthest_mm: float) -> FloatArray:
    """Places moved to the depth: too deep ones along the way out, which ends at the depth exactly; others away from it, as far as it helps."""
    way, deep = _ways_out(outside, places)
    moved = places + np.clip(deep - depth_mm, -farthest_mm, farthest_mm)[:, None] * way
    shallow = np.flatnonzero(deep < depth_mm)
    if len(shallow):
        now = -outside.signed_distance_mm(moved[shallow])[0]
        worse = np.abs(now - depth_mm) > np.abs(deep[shallow] - depth_mm)
        moved[shallow[worse]] = places[shallow[worse]]
    return moved


def _on_ridge(
    outside: SurfaceDistance, vertices: FloatArray, way: FloatArray, a: IntArray, b: IntArray, depth_mm: float, farthest_mm: float
) -> FloatArray:
    """A place (n, 3) on the ridge between vertices a and b: where the planes through them, square to their ways out, meet, nearest to the
    middle of the edge; the middle, moved to the depth, where another side is nearer than that."""
    middle = 0.5 * (vertices[a] + vertices[b])
    along = 0.5 * (vertices[b] - vertices[a])
    # the middle lies below the first plane by p and below the second by q
    p, q = np.einsum("ij,ij->i", way[a], -along), np.einsum("ij,ij->i", way[b], along)
    c = np.einsum("ij,ij->i", way[a], way[b])
    square = np.maximum(1 - c * c, 1e-12)
    move = ((p - c * q) / square)[:, None] * way[a] + ((q - c * p) / square)[:, None] * way[b]
    far = np.linalg.norm(move, axis=1)
    ridge = middle + move * np.minimum(1.0, farthest_mm / np.maximum(far, 1e-300))[:, None]
    fallback = _at_depth(outside, middle, depth_mm, farthest_mm)
    deep = -outside.signed_distance_mm(ridge)[0]
    # shallower than asked: some third side is nearer
    return np.where((deep < depth_mm * (1 - 1e-3))[:, None], fallback, _at_depth(outside, ridge, depth_mm, farthest_mm))


def _parted(faces: IntArray, new: IntArray, vertices: FloatArray) -> IntArray:
    """Faces parted at the vertices `new` (m, 3) on their sides ab, bc, ca; -1 where a side stays whole."""
    count = (new >= 0).sum(axis=1)
    result = [faces[count == 0]]
    for side in range(3):
        turn = [side, (side + 1) % 3, (side + 2) % 3]
        one = (count == 1) & (new[:, side] >= 0)
        (a, b, c), m = faces[one][:, turn].T, new[one, side]
        result += [np.stack([a, m, c], axis=1), np.stack([m, b, c], axis=1)]
        two = (count == 2) & (new[:, turn[2]] < 0)
        (a, b, c), m, n = faces[two][:, turn].T, new[two, turn[0]], new[two, turn[1]]
        short = _length(vertices, a, n) <= _length(vertices, m, c)
        result.append(np.stack([m, b, n], axis=1))
        result.append(np.where(short[:, None], np.stack([a, m, n], axis=1), np.stack([a, m, c], axis=1)))
        result.append(np.where(short[:, None], np.stack([a, n, c], axis=1), np.stack([m, n, c], axis=1)))
    three = count == 3
    (a, b, c), (m, n, p) = faces[three].T, new[three].T
    result += [np.stack(t, axis=1) for t in ((a, m, p), (m, b, n), (p, n, c), (m, n, p))]
    return np.concatenate(result).astype(faces.dtype)


def _length(vertices: FloatArray, i: IntArray, j: IntArray) -> FloatArray:
    return np.asarray(np.linalg.norm(vertices[i] - vertices[j], axis=1))
