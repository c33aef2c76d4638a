"""Where the irradiance of a surface is kept: nodes, fine enough to be interpolated between, each with its own normal.

A face that is small beside the spacing has its three corners for nodes, which it shares with its neighbours where they are smooth
together. A larger face carries a triangular lattice of nodes of its own. Places are local (see `geometry`), float32.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import inline_kernel, stage_kernel
from rangecheck.transport.geometry import Geometry

#: corners with a normal of their own, at most about so many
_MOST_APART = 400_000
#: degrees that a corner's normal may depart from its vertex's to share a node with it; the first that keeps nodes few enough
_SHARING_DEG = (5.0, 15.0, 40.0)
#: nodes of a face stand so much of a cell inside it, where rays are clear of the walls that meet at its edges
_INSIDE = 0.05
#: faces or nodes that are looked at together
_AT_ONCE = 1 << 20


@dataclass(frozen=True, eq=False)
class Nodes:
    """place, normal (n, 3) float32; node_of_face (m, 3) int32: the corners' nodes, or the lattice's first in column 0; steps (m,) int32:
    cells along an edge, 1 for faces with corner nodes; spacing: about how far apart nodes are where faces are large."""

    place: FloatArray
    normal: FloatArray
    node_of_face: IntArray
    steps: IntArray
    spacing: float


def nodes_of(geometry: Geometry, most: int) -> Nodes:
    """Nodes of the faces, at most `most` of them on lattices."""
    faces = geometry.faces
    edges, area = (np.empty(len(faces), np.float32) for _ in range(2))
    for some in pieces(len(faces)):
        corners = geometry.corners(some)
        edges[some] = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
        area[some] = areas(corners)
    spacing = max(math.sqrt(float(area.sum(dtype=np.float64)) / (0.25 * most)), 1e-6)
    del area
    while True:
        steps = np.maximum(1, np.ceil(edges / spacing)).astype(np.int32)
        chosen = np.flatnonzero(steps > 1)
        sizes = (steps[chosen].astype(np.int64) + 1) * (steps[chosen].astype(np.int64) + 2) // 2
        if int(sizes.sum()) <= most:
            break
        spacing *= 1.5
    del edges
    shared = _vertex_normals(geometry)
    places, facing, node_of_face = [geometry.vertices], [shared], faces
    count = len(geometry.vertices)
    face, corner = _apart(geometry, shared, steps)
    if len(face) or len(chosen):
        node_of_face = faces.copy()
    if len(face):
        own = geometry.vertices[faces[face, corner]]
        places.append(own + np.float32(_INSIDE) * (geometry.corners(face).mean(axis=1) - own))
        facing.append(geometry.normals[geometry.rows[face, corner]])
        node_of_face[face, corner] = count + np.arange(len(face), dtype=np.int32)
        count += len(face)
    if len(chosen):
        starts = np.concatenate([[0], np.cumsum(sizes)])
        place, normal = np.empty((starts[-1], 3), np.float32), np.empty((starts[-1], 3), np.float32)
        _fill_lattices(geometry.corners(chosen), geometry.corner_normals(chosen), steps[chosen], starts, place, normal)
        places.append(place)
        facing.append(normal)
        node_of_face[chosen, 0] = count + starts[:-1]
    node_of_face = node_of_face.view()
    node_of_face.flags.writeable = False
    return Nodes(joined(places), joined(facing), node_of_face, steps, spacing)


def pieces(count: int) -> Iterator[slice]:
    """All rows of `count`, so many at a time that what is made of them on the way stays small."""
    return (slice(first, first + _AT_ONCE) for first in range(0, count, _AT_ONCE))


def joined(parts: list[FloatArray]) -> FloatArray:
    """The parts one after another; a single one as it is, for it may be large."""
    return np.concatenate(parts) if parts[1:] else parts[0]


def areas(corners: FloatArray) -> FloatArray:
    """(k,) of triangles (k, 3, 3)."""
    return np.asarray(0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1))


def _vertex_normals(geometry: Geometry) -> FloatArray:
    """(n, 3) float32: the mean of the normals of all corners at each vertex; +z where there is none."""
    total = np.zeros((len(geometry.vertices), 3))
    _add_corner_normals(geometry.faces, geometry.normals, geometry.rows, total)
    mean = np.empty(total.shape, np.float32)
    for some in pieces(len(total)):
        size = np.linalg.norm(total[some], axis=1, keepdims=True)
        mean[some] = np.where(size > 0, total[some] / np.maximum(size, 1e-30), (0.0, 0.0, 1.0))
    return mean


@stage_kernel
def _add_corner_normals(faces, normals, rows, total):
    for face in range(len(faces)):
        for corner in range(3):
            for axis in range(3):
                total[faces[face, corner], axis] += normals[rows[face, corner], axis]


def _apart(geometry: Geometry, shared: FloatArray, steps: IntArray) -> tuple[IntArray, IntArray]:
    """Faces of one step, and corners of them, whose normal is too far from their vertex's."""
    for degrees in _SHARING_DEG:
        found = []
        for some in pieces(len(steps)):
            small = some.start + np.flatnonzero(steps[some] == 1)
            cosine = np.einsum("ijk,ijk->ij", geometry.corner_normals(small), shared[geometry.faces[small]])
            face, corner = np.nonzero(cosine < math.cos(math.radians(degrees)))
            found.append((small[face], corner))
        if sum(len(face) for face, _ in found) <= _MOST_APART:
            break
    return np.concatenate([face for face, _ in found]), np.concatenate([corner for _, corner in found])


@stage_kernel
def _fill_lattices(corners, normals, steps, starts, place, normal):
    """Nodes (i, j), i + j <= steps, of every large face, row by row of j."""
    for face in range(len(steps)):
        k, at = steps[face], starts[face]
        pull = _INSIDE / k
        for j in range(k + 1):
            for i in range(k + 1 - j):
                u, v = i / k, j / k
                u, v = u + pull * (1.0 / 3.0 - u), v + pull * (1.0 / 3.0 - v)
                w = 1.0 - u - v
                size = 0.0
                for axis in range(3):
                    place[at, axis] = w * corners[face, 0, axis] + u * corners[face, 1, axis] + v * corners[face, 2, axis]
                    normal[at, axis] = w * normals[face, 0, axis] + u * normals[face, 1, axis] + v * normals[face, 2, axis]
                    size += normal[at, axis] * normal[at, axis]
                size = math.sqrt(max(size, 1e-30))
                for axis in range(3):
                    normal[at, axis] /= size
                at += 1


@inline_kernel
def nodes_around(node_of_face, steps, face, u, v):
    """Three nodes around the place (u, v) of a face, and their weights."""
    k = np.int64(steps[face])
    if k == 1:
        return (
            np.int64(node_of_face[face, 0]), np.int64(node_of_face[face, 1]), np.int64(node_of_face[face, 2]), 1.0 - u - v, u, v,
        )  # fmt: skip
    first = np.int64(node_of_face[face, 0])
    a, b = max(0.0, min(u, 1.0)) * k, max(0.0, min(v, 1.0)) * k
    j = min(np.int64(b), k - 1)
    i = min(np.int64(a), k - 1 - j)
    p, q = min(a - i, 1.0), min(b - j, 1.0)
    row = first + j * (k + 1) - j * (j - 1) // 2
    above = row + (k + 1 - j)
    if p + q <= 1.0 or i + j == k - 1:
        return row + i, row + i + 1, above + i, 1.0 - p - q, p, q
    return above + i + 1, above + i, row + i + 1, p + q - 1.0, 1.0 - p, 1.0 - q
