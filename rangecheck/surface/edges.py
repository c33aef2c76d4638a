"""The edges of a surface, its fans and its shells, found once and kept as long as the surface lives.

An edge is an unordered pair of vertices; faces that name a vertex twice have no place in the table. Two faces that share an edge belong
to one shell. Around a vertex, faces joined by edges form a fan.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from rangecheck.arrays import IntArray
from rangecheck.kernels import kernel
from rangecheck.surface.surface import Surface


@dataclass(frozen=True, eq=False)
class EdgeTable:
    """The edges of a surface, in ascending order of their vertices.

    ends      (e, 2) int32 vertices, the lower first
    start     (e + 1,) int32 where the half-edges of each edge begin in `halves`
    halves    (h,) int32 half-edges 3 face + side, side 0 = ab, 1 = bc, 2 = ca, those of one edge together, by face
    uses      (e,) int32 faces at each edge
    along     (e,) int32 of these, the ones that run from the lower vertex to the higher
    edge_of_half (3m,) int32 edge of each half-edge, -1 for faces that name a vertex twice
    fans      number of fans, and the fan of each corner (3m,) int32, -1 for faces that name a vertex twice
    shells    number of shells, and the shell of each face (m,) int32, numbered by their first face
    """

    faces: IntArray = field(repr=False)
    ends: IntArray = field(repr=False)
    start: IntArray = field(repr=False)
    halves: IntArray = field(repr=False)
    along: IntArray = field(repr=False)
    edge_of_half: IntArray = field(repr=False)

    @cached_property
    def uses(self) -> IntArray:
        return np.diff(self.start)

    @cached_property
    def fans(self) -> tuple[int, IntArray]:
        return joined_corners(self.faces, self.halves, self.start)

    @cached_property
    def shells(self) -> tuple[int, IntArray]:
        return joined_faces(len(self.faces), self.halves, self.start)


_tables: WeakKeyDictionary[Surface, EdgeTable] = WeakKeyDictionary()


def edge_table(surface: Surface | IntArray) -> EdgeTable:
    """The edges of a surface, found once and kept as long as it lives, or of bare faces (m, 3); linear in the number of faces."""
    if not isinstance(surface, Surface):
        faces = np.ascontiguousarray(surface, np.int32).reshape(-1, 3)
        return _found_edges(faces, int(faces.max(initial=-1)) + 1)
    table = _tables.get(surface)
    if table is None:
        table = _tables[surface] = _found_edges(surface.faces, len(surface.vertices))
    return table


def forget_edges(surface: Surface) -> None:
    """Keep the edges of a surface no longer: of a large mesh they are more than the mesh."""
    _tables.pop(surface, None)


def _found_edges(faces: IntArray, vertex_count: int) -> EdgeTable:
    halves, low, high = sorted_half_edges(faces, vertex_count)
    ends, start, along, edge_of_half = grouped_half_edges(faces, halves, low, high)
    return EdgeTable(faces, ends, start, halves, along, edge_of_half)


@kernel
def sorted_half_edges(faces, vertex_count):
    """Half-edges in ascending order of (lower vertex, higher vertex, face), by counting twice; and these vertices."""
    total = 0
    at = np.zeros(vertex_count + 1, np.int64)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if a != b and b != c and c != a:
            total += 3
            at[max(a, b) + 1] += 1
            at[max(b, c) + 1] += 1
            at[max(c, a) + 1] += 1
    for v in range(vertex_count):
        at[v + 1] += at[v]
    by_high = np.empty(total, np.int32)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if a != b and b != c and c != a:
            for side in range(3):
                p, q = faces[f, side], faces[f, (side + 1) % 3]
                v = max(p, q)
                by_high[at[v]] = 3 * f + side
                at[v] += 1
    at[:] = 0
    for i in range(total):
        f, side = by_high[i] // 3, by_high[i] % 3
        at[min(faces[f, side], faces[f, (side + 1) % 3]) + 1] += 1
    for v in range(vertex_count):
        at[v + 1] += at[v]
    halves, low, high = np.empty(total, np.int32), np.empty(total, np.int32), np.empty(total, np.int32)
    for i in range(total):
        f, side = by_high[i] // 3, by_high[i] % 3
        p, q = faces[f, side], faces[f, (side + 1) % 3]
        v = min(p, q)
        halves[at[v]], low[at[v]], high[at[v]] = by_high[i], v, max(p, q)
        at[v] += 1
    return halves, low, high


@kernel
def grouped_half_edges(faces, halves, low, high):
    """Ends, starts and direction counts of the edges whose sorted half-edges are given, and the edge of each half-edge."""
    count = 0
    for i in range(len(halves)):
        if i == 0 or low[i] != low[i - 1] or high[i] != high[i - 1]:
            count += 1
    ends, start, along = np.empty((count, 2), np.int32), np.empty(count + 1, np.int32), np.zeros(count, np.int32)
    edge_of_half = np.full(3 * len(faces), -1, np.int32)
    edge = -1
    for i in range(len(halves)):
        if i == 0 or low[i] != low[i - 1] or high[i] != high[i - 1]:
            edge += 1
            ends[edge, 0], ends[edge, 1], start[edge] = low[i], high[i], i
        edge_of_half[halves[i]] = edge
        if faces[halves[i] // 3, halves[i] % 3] == low[i]:
            along[edge] += 1
    start[count] = len(halves)
    return ends, start, along, edge_of_half


@kernel
def every_edge_passed_both_ways(faces, vertex_count):
    """Whether as many faces run along every edge one way as the other; without a table of the edges, which of a large mesh is much."""
    at = np.zeros(vertex_count + 1, np.int64)
    for f in range(len(faces)):
        for side in range(3):
            at[min(faces[f, side], faces[f, (side + 1) % 3]) + 1] += 1
    for v in range(vertex_count):
        at[v + 1] += at[v]
    # the other end, and in the last bit which way; those of one lower end together
    passes = np.empty(at[vertex_count], np.uint32)
    for f in range(len(faces)):
        for side in range(3):
            p, q = faces[f, side], faces[f, (side + 1) % 3]
            low = min(p, q)
            passes[at[low]] = 2 * max(p, q) + (1 if p < q else 0)
            at[low] += 1
    first = 0
    for v in range(vertex_count):
        own = passes[first : at[v]]
        first = at[v]
        own.sort()
        balance = 0
        for i in range(len(own)):
            balance += 1 if own[i] & 1 else -1
            if own[i] >> 1 != v and (i + 1 == len(own) or own[i + 1] >> 1 != own[i] >> 1):
                if balance != 0:
                    return False
            elif own[i] >> 1 == v:
                balance = 0
    return True


@kernel
def root_of(parent, i):
    """Root of the set that i belongs to, its lowest member; paths are halved on the way."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def join_sets(parent, i, j):
    """Makes one set of those of i and j."""
    i, j = root_of(parent, i), root_of(parent, j)
    parent[max(i, j)] = min(i, j)


@kernel
def _numbered(parent):
    """Number of sets, and the set of each member; a set's root is its lowest member, so it is numbered before the others."""
    number, count = np.empty(len(parent), np.int32), 0
    for i in range(len(parent)):
        if parent[i] < 0:
            number[i] = -1
        elif parent[i] == i:
            number[i] = count
            count += 1
        else:
            number[i] = number[root_of(parent, i)]
    return count, number


@kernel
def joined_corners(faces, halves, start):
    """Number of fans and the fan of each corner (3m,), numbered by their first corner; -1 for faces without edges in the table."""
    parent = np.full(3 * len(faces), -1, np.int32)
    for i in range(len(halves)):
        parent[halves[i]] = halves[i]
    for edge in range(len(start) - 1):
        first = halves[start[edge]]
        f, side = first // 3, first % 3
        for i in range(start[edge] + 1, start[edge + 1]):
            g, other = halves[i] // 3, halves[i] % 3
            here, there = 3 * g + other, 3 * g + (other + 1) % 3
            if faces[g, other] != faces[f, side]:
                here, there = there, here
            join_sets(parent, 3 * f + side, here)
            join_sets(parent, 3 * f + (side + 1) % 3, there)
    return _numbered(parent)


@kernel
def joined_faces(face_count, halves, start):
    """Number of shells and the shell of each face (m,), numbered by their first face."""
    parent = np.arange(face_count).astype(np.int32)
    for edge in range(len(start) - 1):
        for i in range(start[edge] + 1, start[edge + 1]):
            join_sets(parent, halves[start[edge]] // 3, halves[i] // 3)
    return _numbered(parent)
