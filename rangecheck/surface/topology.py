"""How faces hang together. Every predicate returns the culprits; empty means that all is well.

An edge is an unordered pair of vertices; faces that name a vertex twice have no place in the table of edges and are found by
`degenerate_faces`. Two faces that share an edge belong to one shell; meeting in a vertex alone does not join them. Around a vertex,
faces joined by edges form a fan; a vertex with two fans is where two sheets touch in a point.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.kernels import kernel
from rangecheck.surface.edges import EdgeTable, edge_table
from rangecheck.surface.surface import Surface

__all__ = [
    "EdgeTable",
    "boundary_edges",
    "boundary_loops",
    "degenerate_faces",
    "duplicate_faces",
    "edge_table",
    "euler_numbers",
    "faces_at_edges",
    "inconsistent_edges",
    "is_closed",
    "loop_lengths_mm",
    "non_manifold_edges",
    "non_manifold_vertices",
    "shells",
    "unreferenced_vertices",
]


def boundary_edges(surface: Surface | IntArray) -> IntArray:
    """(k, 2) edges with one face, in that face's direction."""
    table = edge_table(surface)
    half = table.halves[table.start[:-1][table.uses == 1]]
    face, side = half // 3, half % 3
    return np.stack([table.faces[face, side], table.faces[face, (side + 1) % 3]], axis=1).astype(np.int32)


def faces_at_edges(surface: Surface, wanted: BoolArray) -> IntArray:
    """(k,) faces at the edges that a mask over the edge table selects."""
    table = edge_table(surface)
    return np.unique(table.halves[np.repeat(wanted, table.uses)] // 3)


def non_manifold_edges(surface: Surface | IntArray) -> IntArray:
    """(k, 2) edges with more than two faces."""
    table = edge_table(surface)
    return table.ends[table.uses > 2]


def inconsistent_edges(surface: Surface | IntArray) -> IntArray:
    """(k, 2) edges whose two faces run the same way along them: one of the two is turned over."""
    table = edge_table(surface)
    return table.ends[(table.uses == 2) & (table.along != 1)]


def unreferenced_vertices(surface: Surface) -> IntArray:
    """(k,) vertices that no face names."""
    used = np.zeros(len(surface.vertices), bool)
    used[surface.faces.ravel()] = True
    return np.flatnonzero(~used)


def degenerate_faces(surface: Surface) -> IntArray:
    """(k,) faces that name a vertex twice, or whose three corners are in line to the rounding of their coordinates."""
    return np.flatnonzero(faces_without_area(surface.vertices, surface.faces))


@kernel
def faces_without_area(vertices, faces):
    """(m,) whether twice a face's area is within rounding (2^-50 of its two sides' product) of 0."""
    without = np.empty(len(faces), np.bool_)
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        ux, uy, uz, vx, vy, vz = b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        bound = (ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz) * 2.0**-100
        without[f] = x * x + y * y + z * z <= bound
    return without


def duplicate_faces(surface: Surface) -> IntArray:
    """(k,) faces that name the same three vertices as an earlier face, whichever way round."""
    table = edge_table(surface)
    return np.flatnonzero(repeated_faces(surface.faces, table.halves, table.start))


@kernel
def repeated_faces(faces, halves, start):
    """(m,) whether a face has the same corners as an earlier one: then both lie at one edge with the same far corner."""
    repeated = np.zeros(len(faces), np.bool_)
    for edge in range(len(start) - 1):
        for i in range(start[edge] + 1, start[edge + 1]):
            far = faces[halves[i] // 3, (halves[i] % 3 + 2) % 3]
            for j in range(start[edge], i):
                if faces[halves[j] // 3, (halves[j] % 3 + 2) % 3] == far:
                    repeated[max(halves[i] // 3, halves[j] // 3)] = True
    return repeated


def non_manifold_vertices(surface: Surface) -> IntArray:
    """(k,) vertices whose faces form more than one fan: sheets that touch in a point."""
    return np.flatnonzero(_fans_of_vertices(surface) > 1)


def _fans_of_vertices(surface: Surface) -> IntArray:
    """(n,) number of fans at each vertex."""
    return fans_at_vertices(*edge_table(surface).fans, surface.faces, len(surface.vertices))


@kernel
def fans_at_vertices(fan_count, fan, faces, vertex_count):
    """(n,) number of fans at each vertex."""
    counted, fans = np.zeros(fan_count, np.bool_), np.zeros(vertex_count, np.int32)
    for corner in range(len(fan)):
        if fan[corner] >= 0 and not counted[fan[corner]]:
            counted[fan[corner]] = True
            fans[faces[corner // 3, corner % 3]] += 1
    return fans


def shells(surface: Surface) -> tuple[int, IntArray]:
    """Number of shells, and the shell of each face (m,) int32, numbered by their first face."""
    return edge_table(surface).shells


def euler_numbers(surface: Surface) -> IntArray:
    """(shells,) fans - edges + faces of each shell: 2 - 2 genus where it is closed, less one for each hole."""
    count, shell = shells(surface)
    table = edge_table(surface)
    return euler_of_shells(count, shell, *table.fans, table.halves, table.start)


@kernel
def euler_of_shells(count, shell, fan_count, fan, halves, start):
    """(count,) fans - edges + faces of each shell; faces without edges in the table do not count."""
    counted, euler = np.zeros(fan_count, np.bool_), np.zeros(count, np.int64)
    for corner in range(len(fan)):
        if fan[corner] < 0:
            continue
        if corner % 3 == 0:
            euler[shell[corner // 3]] += 1
        if not counted[fan[corner]]:
            counted[fan[corner]] = True
            euler[shell[corner // 3]] += 1
    for edge in range(len(start) - 1):
        euler[shell[halves[start[edge]] // 3]] -= 1
    return euler


def boundary_loops(surface: Surface) -> list[IntArray]:
    """Open borders as rings of vertices, each (k,) int32 in the direction of its faces, the one with most edges first.

    At a vertex where several borders meet, each continues around the fan it came along; a ring that comes back to a vertex is parted
    there, so that holes which touch in a point stay two. Where a border runs into an edge with more than two faces, pieces are joined
    at their ends as they come."""
    table = edge_table(surface)
    half = table.halves[table.start[:-1][table.uses == 1]]
    if not len(half):
        return []
    ring, start = chained_borders(surface.faces, table.halves, table.start, table.edge_of_half, half, len(surface.vertices))
    rings = [simple for a, b in pairwise(start) for simple in _simple_rings(ring[a:b])]
    return sorted(rings, key=lambda r: (-len(r), tuple(r[:3].tolist())))


def _simple_rings(ring: IntArray) -> list[IntArray]:
    """`ring` parted wherever it comes back to a vertex."""
    if len(np.unique(ring)) == len(ring):
        return [ring]
    rings: list[IntArray] = []
    path: list[int] = []
    place: dict[int, int] = {}
    for vertex in ring.tolist():
        if vertex in place:
            first = place[vertex]
            rings.append(np.array(path[first:], np.int32))
            for left in path[first:]:
                del place[left]
            del path[first:]
        place[vertex] = len(path)
        path.append(vertex)
    return [*rings, np.array(path, np.int32)]


@kernel
def _border_after(faces, halves, start, edge_of_half, half):
    """The border half-edge reached by turning around the end vertex of border half-edge `half`; -1 where the fan is not clean."""
    f, side = half // 3, half % 3
    pivot = faces[f, (side + 1) % 3]
    for _ in range(3 * len(faces)):
        # leave face f over its other edge at the pivot
        for turn in range(1, 3):
            other = (side + turn) % 3
            if faces[f, other] == pivot or faces[f, (other + 1) % 3] == pivot:
                break
        edge = edge_of_half[3 * f + other]
        uses = start[edge + 1] - start[edge]
        if uses == 1:
            return 3 * f + other
        if uses > 2:
            return -1
        across = halves[start[edge]] + halves[start[edge] + 1] - (3 * f + other)
        f, side = across // 3, across % 3
    return -1


@kernel
def chained_borders(faces, halves, start, edge_of_half, border, vertex_count):
    """Vertices of all border rings one after another, and where each begins. `border` are the half-edges with one face."""
    ring, starts = np.empty(len(border), np.int32), np.empty(len(border) + 1, np.int32)
    done = np.zeros(3 * len(faces), np.bool_)
    leaving = np.full(vertex_count, -1, np.int32)
    for h in border:
        leaving[faces[h // 3, h % 3]] = h
    count, rings = 0, 0
    starts[0] = 0
    for first in border:
        if done[first]:
            continue
        h = first
        while h >= 0 and not done[h]:
            done[h] = True
            ring[count] = faces[h // 3, h % 3]
            count += 1
            end = faces[h // 3, (h % 3 + 1) % 3]
            following = _border_after(faces, halves, start, edge_of_half, h)
            if following < 0 or faces[following // 3, following % 3] != end:
                following = leaving[end]
            h = following
        rings += 1
        starts[rings] = count
    return ring, starts[: rings + 1]


def loop_lengths_mm(surface: Surface, loops: list[IntArray]) -> FloatArray:
    """(len(loops),) length of each ring of vertices."""
    return np.array(
        [float(np.linalg.norm(surface.vertices[np.roll(r, -1)] - surface.vertices[r], axis=1).sum()) for r in loops], np.float64
    )


def is_closed(surface: Surface | IntArray) -> bool:
    """Whether every edge has exactly two faces, which run opposite ways along it, and no face names a vertex twice."""
    table = edge_table(surface)
    whole = len(table.faces) > 0 and len(table.halves) == 3 * len(table.faces)
    return whole and bool((table.uses == 2).all() and (table.along == 1).all())
