"""Sheets parted and turned: edges with more than two faces, vertices with several fans, neighbours wound against each other."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, IntArray, float32_spacing_mm
from rangecheck.kernels import kernel
from rangecheck.solid.containment import shell_depths, shell_volumes_mm3
from rangecheck.surface import topology as topo
from rangecheck.surface.surface import Surface

#: parted sheets are drawn apart by this many float32 steps, so that STL does not weld them again
STEPS_APART = 64


class Parted(NamedTuple):
    """surface with parted sheets; vertices that were doubled, and how far their copies moved in mm."""

    surface: Surface
    doubled: int
    moved_mm: float


def part_sheets(surface: Surface, *, max_move_mm: float) -> Parted:
    """Each sheet at a vertex with several fans, or at an edge with several pairs of faces, gets vertices of its own, drawn into it by a few
    float32 steps. Faces at an edge are paired so that the material between them is bounded. Nothing changes when the step exceeds the leash."""
    step = STEPS_APART * float32_spacing_mm(float(np.abs(surface.bounds_mm).max()))
    if step > max_move_mm or not (len(topo.non_manifold_edges(surface)) or len(topo.non_manifold_vertices(surface))):
        return Parted(surface, 0, 0.0)
    fan = _fans_with_pairs(surface)
    corner_vertex = surface.faces.ravel()
    first_fan = np.full(len(surface.vertices), -1)
    fans, first_corner = np.unique(fan, return_index=True)
    owner = corner_vertex[first_corner]
    extra = np.zeros(int(fans.max()) + 1, bool)
    for f, v in zip(fans.tolist(), owner.tolist()):
        if first_fan[v] < 0:
            first_fan[v] = f
        else:
            extra[f] = True
    several = np.unique(owner[extra[fans]])
    target = np.full(int(fans.max()) + 1, -1)
    target[fans] = owner
    new = np.flatnonzero(extra)
    target[new] = np.arange(len(surface.vertices), len(surface.vertices) + len(new))
    faces = target[fan].reshape(-1, 3)
    vertices = np.concatenate([surface.vertices, surface.vertices[corner_vertex[first_corner[np.searchsorted(fans, new)]]]])
    moving = np.concatenate([several, np.arange(len(surface.vertices), len(vertices))])
    inward = _towards_own_faces(vertices, faces, moving)
    vertices[moving] += step * inward
    error = surface.vertex_error_mm
    if error is not None:
        error = np.concatenate([error, error[corner_vertex[first_corner[np.searchsorted(fans, new)]]]])
    return Parted(replace(surface, vertices=vertices, faces=faces, vertex_error_mm=error), len(new), step)


def _towards_own_faces(vertices: FloatArray, faces: IntArray, moving: IntArray) -> FloatArray:
    middles = vertices[faces].mean(axis=1)
    total = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(total, faces[:, corner], middles - vertices[faces[:, corner]])
    length = np.linalg.norm(total[moving], axis=1, keepdims=True)
    return total[moving] / np.maximum(length, 1e-300)


def _fans_with_pairs(surface: Surface) -> IntArray:
    """(3m,) fan of each corner when faces at edges with four or more uses are joined in pairs only."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    table = topo.edge_table(surface)
    one, two = [], []
    two_faced = np.flatnonzero(table.uses == 2)
    first = table.start[two_faced]
    one.append(table.halves[first])
    two.append(table.halves[first + 1])
    for edge in np.flatnonzero(table.uses > 2).tolist():
        for pair in _pairs_at(surface, table, edge):
            one.append(np.array(pair[:1]))
            two.append(np.array(pair[1:]))
    g, h = np.concatenate(one), np.concatenate(two)
    next_g, next_h = g - g % 3 + (g % 3 + 1) % 3, h - h % 3 + (h % 3 + 1) % 3
    same = surface.faces.ravel()[g] == surface.faces.ravel()[h]
    start_h, end_h = np.where(same, h, next_h), np.where(same, next_h, h)
    i, j = np.concatenate([g, next_g]), np.concatenate([start_h, end_h])
    n = 3 * len(surface.faces)
    _, label = connected_components(coo_matrix((np.ones(len(i), np.int8), (i, j)), shape=(n, n)), False)
    return label


def _pairs_at(surface: Surface, table: topo.EdgeTable, edge: int) -> list[tuple[int, int]]:
    """Half-edges at an edge, paired around it so that each pair encloses material; empty when as many do not run each way."""
    halves = table.halves[table.start[edge] : table.start[edge + 1]]
    low, high = table.ends[edge]
    origin, axis = surface.vertices[low], surface.vertices[high] - surface.vertices[low]
    axis = axis / np.linalg.norm(axis)
    u, v = rigid.across(axis)
    far = surface.vertices[surface.faces[halves // 3, (halves % 3 + 2) % 3]] - origin
    angle = np.arctan2(far @ v, far @ u)
    along = surface.faces[halves // 3, halves % 3] == low
    if along.sum() * 2 != len(halves):
        return []
    order = np.argsort(angle, kind="stable")
    pairs = []
    for k, here in enumerate(order.tolist()):
        # turning counter-clockwise about the edge, a face that runs along it has its material behind it, before it in the turn
        before = int(order[k - 1])
        if along[here] and not along[before]:
            pairs.append((int(halves[here]), int(halves[before])))
    return pairs if 2 * len(pairs) == len(halves) else []


class Turned(NamedTuple):
    """surface with faces turned; faces turned so that neighbours agree, shells turned over so that they face outwards."""

    surface: Surface
    faces: int
    shells: int


def turn_faces(surface: Surface) -> Turned:
    """The fewest faces of each shell turned so that neighbours agree; then closed shells turned so that bodies face outwards and cavities
    inwards. A shell that cannot agree with itself (a one-sided strip) is left as it was."""
    table = topo.edge_table(surface)
    count, shell = table.shells
    turn = disagreeing(len(surface.faces), table.halves, table.start, surface.faces)
    one_sided = np.zeros(count, bool)
    one_sided[shell[turn < 0]] = True
    share = np.bincount(shell, turn > 0, minlength=count) / np.maximum(np.bincount(shell, minlength=count), 1)
    flip = ((turn > 0) ^ (share > 0.5)[shell]) & ~one_sided[shell]
    faces = surface.faces.copy()
    faces[flip] = faces[flip][:, ::-1]
    agreed = replace(surface, faces=faces) if flip.any() else surface
    over = 0
    if topo.is_closed(agreed):
        count, shell = topo.shells(agreed)
        volumes, depth = shell_volumes_mm3(agreed, count, shell), shell_depths(agreed, count, shell)
        wrong = (volumes < 0) == (depth % 2 == 0)
        over = int(wrong.sum())
        if over:
            faces = agreed.faces.copy()
            faces[wrong[shell]] = faces[wrong[shell]][:, ::-1]
            agreed = replace(agreed, faces=faces)
    return Turned(agreed, int(flip.sum()), over)


@kernel
def disagreeing(face_count, halves, start, faces):
    """(m,) 1 for faces to be turned so that each agrees with its shell's first face, 0 for the others, -1 where both would be wrong."""
    edge_of = np.full(3 * face_count, -1, np.int32)
    for edge in range(len(start) - 1):
        for i in range(start[edge], start[edge + 1]):
            edge_of[halves[i]] = edge
    turn = np.full(face_count, -2, np.int8)
    waiting = np.empty(face_count, np.int32)
    for seed in range(face_count):
        if turn[seed] != -2:
            continue
        turn[seed] = 0
        waiting[0] = seed
        top = 1
        conflict = False
        while top > 0:
            top -= 1
            f = waiting[top]
            for side in range(3):
                edge = edge_of[3 * f + side]
                if edge < 0 or start[edge + 1] - start[edge] != 2:
                    continue
                h = halves[start[edge]] + halves[start[edge] + 1] - (3 * f + side)
                g = h // 3
                same_way = faces[g, h % 3] == faces[f, side]
                wanted = (1 - turn[f]) if same_way else turn[f]
                if turn[g] == -2:
                    turn[g] = wanted
                    waiting[top] = g
                    top += 1
                elif turn[g] != wanted:
                    conflict = True
        if conflict:
            turn[seed] = -1
    return turn
