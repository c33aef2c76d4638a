"""Where the irradiance of a surface is kept: nodes, fine enough to be interpolated between, each with its own normal.

A face that is small beside the spacing has its three corners for nodes, which it shares with its neighbours where they are smooth
together. A larger face carries a triangular lattice of nodes of its own. Places are local (see `geometry`), float32.
"""

from __future__ import annotations

import math
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


@dataclass(frozen=True, eq=False)
class Nodes:
    """place, normal (n, 3) float32; node_of_face (m, 3) int32: the corners' nodes, or the lattice's first in column 0; steps (m,) int32:
    cells along an edge, 1 for faces with corner nodes; spacing: about how far apart nodes are where faces are large."""

    place: FloatArray
    normal: FloatArray
    node_of_face: IntArray
    steps: IntArray
    spacing: float


def nodes_of(geometry: Geometry, vertices: FloatArray, faces: IntArray, most: int) -> Nodes:
    """Nodes of the faces (m, 3) over local vertices (n, 3), at most `most` of them on lattices."""
    corners = geometry.corners.reshape(-1, 3, 3)
    normals = geometry.normals.reshape(-1, 3, 3)
    edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    spacing = max(math.sqrt(float(area.sum(dtype=np.float64)) / (0.25 * most)), 1e-6)
    while True:
        steps = np.maximum(1, np.ceil(edges / spacing)).astype(np.int64)
        large = steps > 1
        if int(((steps[large] + 1) * (steps[large] + 2) // 2).sum()) <= most:
            break
        spacing *= 1.5
    small = np.flatnonzero(~large)
    places, facing, node_of_face = [vertices.astype(np.float32)], [_vertex_normals(normals, faces, len(vertices))], faces.copy()
    count = len(vertices)
    apart = _apart(normals[small], facing[0][faces[small]])
    if apart.any():
        face, corner = small[np.nonzero(apart)[0]], np.nonzero(apart)[1]
        own = corners[face, corner]
        places.append(own + np.float32(_INSIDE) * (corners[face].mean(axis=1) - own))
        facing.append(normals[face, corner])
        node_of_face[face, corner] = count + np.arange(len(face), dtype=np.int32)
        count += len(face)
    chosen = np.flatnonzero(large)
    if len(chosen):
        sizes = (steps[chosen] + 1) * (steps[chosen] + 2) // 2
        starts = np.concatenate([[0], np.cumsum(sizes)])
        place, normal = np.empty((starts[-1], 3), np.float32), np.empty((starts[-1], 3), np.float32)
        _fill_lattices(corners, normals, chosen, steps, starts, place, normal)
        places.append(place)
        facing.append(normal)
        node_of_face[chosen, 0] = count + starts[:-1]
    return Nodes(
        np.ascontiguousarray(np.concatenate(places)),
        np.ascontiguousarray(np.concatenate(facing)),
        np.ascontiguousarray(node_of_face, np.int32),
        steps.astype(np.int32),
        spacing,
    )


def _vertex_normals(normals: FloatArray, faces: IntArray, vertices: int) -> FloatArray:
    """(vertices, 3) float32: the mean of the normals of all corners at each vertex; +z where there is none."""
    total = np.stack([np.bincount(faces.ravel(), normals[..., axis].ravel(), vertices) for axis in range(3)], axis=1)
    size = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(size > 0, total / np.maximum(size, 1e-30), (0.0, 0.0, 1.0)).astype(np.float32)


def _apart(normals: FloatArray, shared: FloatArray) -> FloatArray:
    """(k, 3) bool: corners whose normal is too far from their vertex's."""
    cosine = np.einsum("ijk,ijk->ij", normals, shared)
    for degrees in _SHARING_DEG:
        apart = cosine < math.cos(math.radians(degrees))
        if int(apart.sum()) <= _MOST_APART:
            break
    return np.asarray(apart)


@stage_kernel
def _fill_lattices(corners, normals, chosen, steps, starts, place, normal):
    """Nodes (i, j), i + j <= steps, of every large face, row by row of j."""
    for n in range(len(chosen)):
        face = chosen[n]
        k, at = steps[face], starts[n]
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
