"""Small places where a surface runs through itself, smoothed out on a leash.

Folds of a fused or printed-small surface are a few faces wide: the vertices of the faces that cross are moved to the middle of their
neighbours until nothing crosses, none farther than the leash from where it was. What does not come loose stays as it was.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.surface.intersections import CROSSING, OVERLAP, self_intersections
from rangecheck.surface.surface import Surface
from rangecheck.surface.topology import edge_table

#: shares of the leash, and for each of them rings of neighbours that move with the culprits, tried in turn; steps of smoothing for each
SHARES, RINGS, STEPS = (0.1, 0.4, 1.0), (0, 1, 2, 3), 12


class Untangled(NamedTuple):
    """surface as far as it came loose; pairs of faces that met before and after; farthest move of a vertex in mm; vertices moved."""

    surface: Surface
    before: int
    after: int
    moved_mm: float
    vertices_moved: int


def untangle(surface: Surface, *, max_move_mm: float) -> Untangled:
    """`surface` with its vertices moved by at most `max_move_mm` so that faces neither cross nor overlap, as far as that goes."""
    culprits = self_intersections(surface).of_kind(CROSSING, OVERLAP)
    before = len(culprits)
    if not before:
        return Untangled(surface, 0, 0, 0.0, 0)
    table = edge_table(surface)
    vertices = surface.vertices.copy()
    for share, ring in product(SHARES, RINGS):
        mark = np.zeros(len(vertices), bool)
        mark[surface.faces[np.unique(culprits)].ravel()] = True
        for _ in range(ring):
            mark[table.ends[mark[table.ends].any(axis=1)].ravel()] = True
        moving = np.flatnonzero(mark)
        near = table.ends[mark[table.ends].any(axis=1)]
        for _ in range(STEPS):
            vertices[moving] = _held(
                surface.vertices[moving], _middles(vertices, near)[moving], vertices[moving], share * max_move_mm
            )
        region = _around(surface, vertices, np.unique(culprits), mark)
        culprits = region[self_intersections(Surface(vertices, surface.faces[region])).of_kind(CROSSING, OVERLAP)]
        if not len(culprits):
            break
    vertices = _give_back(surface, vertices, culprits)
    result = replace(surface, vertices=vertices)
    after = len(self_intersections(result).of_kind(CROSSING, OVERLAP))
    if after >= before:
        return Untangled(surface, before, before, 0.0, 0)
    move = np.linalg.norm(vertices - surface.vertices, axis=1)
    return Untangled(result, before, after, float(move.max()), int((move > 0).sum()))


def _middles(vertices: FloatArray, edges: IntArray) -> FloatArray:
    """(n, 3) mean of each vertex's neighbours over `edges`; the vertex itself where it has none."""
    i, j = np.concatenate([edges[:, 0], edges[:, 1]]), np.concatenate([edges[:, 1], edges[:, 0]])
    count = np.bincount(i, minlength=len(vertices))
    total = np.stack([np.bincount(i, vertices[j, axis], minlength=len(vertices)) for axis in range(3)], axis=1)
    return np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], vertices)


def _held(origin: FloatArray, wanted: FloatArray, current: FloatArray, leash_mm: float) -> FloatArray:
    """Halfway from `current` to `wanted`, but no farther than the leash from `origin`."""
    step = 0.5 * (current + wanted) - origin
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return origin + step * np.minimum(1.0, leash_mm / np.maximum(length, 1e-300))


def _around(surface: Surface, vertices: FloatArray, culprits: IntArray, moved: IntArray) -> IntArray:
    """Faces that could meet a face with moved vertices: the boxes of such two touch, so their middles are no farther apart than the
    longer sides of both."""
    from scipy.spatial import cKDTree

    mine = np.asarray(moved[surface.faces].any(axis=1))
    mine[culprits] = True
    corners = vertices[surface.faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    first, last = low[mine].min(axis=0), high[mine].max(axis=0)
    near = np.flatnonzero(((low <= last) & (high >= first)).all(axis=1))
    middle, size = 0.5 * (low + high), np.linalg.norm(high - low, axis=1)
    away, _ = cKDTree(middle[mine]).query(middle[near])
    return near[away <= 0.5 * (size[near] + size[mine].max())]


def _give_back(surface: Surface, vertices: FloatArray, culprits: IntArray) -> FloatArray:
    """Vertices with those put back that moved in vain: around faces that still meet."""
    if not len(culprits):
        return vertices
    mark = np.zeros(len(vertices), bool)
    mark[surface.faces[np.unique(culprits)].ravel()] = True
    ends = edge_table(surface).ends
    for _ in range(max(RINGS)):
        mark[ends[mark[ends].any(axis=1)].ravel()] = True
    return np.where(mark[:, None], surface.vertices, vertices)
