"""Patches that fill holes: triangles made well-shaped, made as fine as their rim, and bent smoothly between what surrounds them.

Turning diagonals until no two opposite angles exceed 180 degrees: Lawson, *Software for C1 surface interpolation*, 1977. Refining by
centroids until edges are as long as the rim's: Liepa, *Filling holes in meshes*, 2003. Smooth heights: the thin plate, as the least
squares of the cotangent Laplacian (Pinkall and Polthier 1993) over the patch and its rim, so that slopes continue.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.kernels import kernel
from rangecheck.surface.edges import grouped_half_edges, sorted_half_edges
from rangecheck.surface.predicates import side_of_line

#: a diagonal is turned when the sine of its two opposite angles' sum is below minus this: the rounding of a regular grid turns nothing
_COCIRCULAR = 1e-9


def neighbours_of(faces: IntArray, vertex_count: int) -> IntArray:
    """(m, 3) half-edge 3 face + side across each side ab, bc, ca; -1 at rims and where more than two faces meet."""
    faces = np.ascontiguousarray(faces, np.int32)
    halves, low, high = sorted_half_edges(faces, vertex_count)
    _, start, _, _ = grouped_half_edges(faces, halves, low, high)
    uses = np.diff(start)
    pair = start[:-1][uses == 2]
    across = np.full(3 * len(faces), -1, np.int32)
    across[halves[pair]], across[halves[pair + 1]] = halves[pair + 1], halves[pair]
    return across.reshape(-1, 3)


@kernel
def _far_cosine_sine(points, a, b, c):
    """Cosine and sine, times a common positive factor, of the angle at c of triangle a, b, c."""
    dot = uu = vv = 0.0
    for k in range(points.shape[1]):
        u, v = points[a, k] - points[c, k], points[b, k] - points[c, k]
        dot += u * v
        uu += u * u
        vv += v * v
    return dot, math.sqrt(max(uu * vv - dot * dot, 0.0))


@kernel
def turn_diagonals(points, faces, across, locked):
    """Turn diagonals in place until the triangulation is Delaunay; `points` (n, 2) or (n, 3), faces counter-clockwise in 2-D.
    Sides across which there is nothing, or whose face is locked, stay. Returns the number of turns."""
    waiting = [0]
    waiting.pop()
    queued = np.zeros(3 * len(faces), np.bool_)
    for h in range(3 * len(faces)):
        if across[h // 3, h % 3] > h:
            waiting.append(h)
            queued[h] = True
    turns = 0
    while len(waiting) > 0 and turns < 200 * len(faces):
        h = waiting.pop()
        queued[h] = False
        f, s = h // 3, h % 3
        opposite = across[f, s]
        if opposite < 0:
            continue
        g, o = opposite // 3, opposite % 3
        if locked[f] or locked[g]:
            continue
        a, b, c, d = faces[f, s], faces[f, (s + 1) % 3], faces[f, (s + 2) % 3], faces[g, (o + 2) % 3]
        if faces[g, o] != b or c == d:
            continue
        cos_c, sin_c = _far_cosine_sine(points, a, b, c)
        cos_d, sin_d = _far_cosine_sine(points, a, b, d)
        size = math.sqrt((cos_c * cos_c + sin_c * sin_c) * (cos_d * cos_d + sin_d * sin_d))
        if sin_c * cos_d + cos_c * sin_d >= -_COCIRCULAR * size:
            continue
        if points.shape[1] == 2:
            left = side_of_line(points[d, 0], points[d, 1], points[c, 0], points[c, 1], points[a, 0], points[a, 1])
            right = side_of_line(points[d, 0], points[d, 1], points[c, 0], points[c, 1], points[b, 0], points[b, 1])
            if not (left > 0 and right < 0):
                continue
        elif _would_fold(points, faces, across, f, s, c, d):
            continue
        beyond_bc, beyond_ca = across[f, (s + 1) % 3], across[f, (s + 2) % 3]
        beyond_ad, beyond_db = across[g, (o + 1) % 3], across[g, (o + 2) % 3]
        faces[f, 0], faces[f, 1], faces[f, 2] = a, d, c
        faces[g, 0], faces[g, 1], faces[g, 2] = d, b, c
        across[f, 0], across[f, 1], across[f, 2] = beyond_ad, 3 * g + 2, beyond_ca
        across[g, 0], across[g, 1], across[g, 2] = beyond_db, beyond_bc, 3 * f + 1
        for k in range(4):
            beyond = (beyond_ad, beyond_ca, beyond_db, beyond_bc)[k]
            mine = (3 * f, 3 * f + 2, 3 * g, 3 * g + 1)[k]
            if beyond >= 0:
                across[beyond // 3, beyond % 3] = mine
                if not queued[mine]:
                    waiting.append(mine)
                    queued[mine] = True
        turns += 1
    return turns


@kernel
def _would_fold(points, faces, across, f, s, c, d):
    """In space: whether edge c d exists already around c, or one of the two new faces would be turned against the old ones."""
    g = across[f, s] // 3
    h = 3 * f + (s + 2) % 3
    for _ in range(64):
        face, side = h // 3, h % 3
        if faces[face, (side + 1) % 3] == d:
            return True
        h = across[face, (side + 2) % 3]
        if h < 0 or h // 3 == f:
            break
    a, b = faces[f, s], faces[f, (s + 1) % 3]
    old, new_f, new_g = np.zeros(3), np.zeros(3), np.zeros(3)
    _add_normal(points, a, b, c, old)
    _add_normal(points, b, a, d, old)
    _add_normal(points, a, d, c, new_f)
    _add_normal(points, d, b, c, new_g)
    f_agrees = old[0] * new_f[0] + old[1] * new_f[1] + old[2] * new_f[2]
    g_agrees = old[0] * new_g[0] + old[1] * new_g[1] + old[2] * new_g[2]
    return g < 0 or f_agrees <= 0.0 or g_agrees <= 0.0


@kernel
def _add_normal(points, a, b, c, total):
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        total[k] += (points[b, i] - points[a, i]) * (points[c, j] - points[a, j]) - (points[b, j] - points[a, j]) * (
            points[c, i] - points[a, i]
        )


def refined(points: FloatArray, faces: IntArray, *, rounds: int = 40) -> tuple[FloatArray, IntArray]:
    """The patch `faces` over `points` (n, 2) or (n, 3) with points added inside until its edges are about as long as its rim's near
    by; the added points follow the given ones. The rim stays as it is."""
    faces = np.ascontiguousarray(faces, np.int32).copy()
    points = np.ascontiguousarray(points, np.float64)
    size = _rim_edge_lengths(points, faces)
    across = neighbours_of(faces, len(points))
    turn_diagonals(points, faces, across, np.zeros(len(faces), np.bool_))
    for _ in range(rounds):
        corners = points[faces]
        centre, centre_size = corners.mean(axis=1), size[faces].mean(axis=1)
        reach = math.sqrt(2.0) * np.linalg.norm(corners - centre[:, None], axis=2)
        split = np.flatnonzero(((reach > centre_size[:, None]) & (reach > size[faces])).all(axis=1))
        if not len(split):
            break
        new = np.arange(len(points), len(points) + len(split), dtype=np.int32)
        a, b, c = faces[split].T
        faces[split] = np.stack([a, b, new], axis=1)
        faces = np.concatenate([faces, np.stack([b, c, new], axis=1), np.stack([c, a, new], axis=1)])
        points, size = np.concatenate([points, centre[split]]), np.concatenate([size, centre_size[split]])
        across = neighbours_of(faces, len(points))
        turn_diagonals(points, faces, across, np.zeros(len(faces), np.bool_))
    return points, faces


def _rim_edge_lengths(points: FloatArray, faces: IntArray) -> FloatArray:
    """(n,) mean length of the rim edges at each vertex of the patch; elsewhere the mean of all."""
    face, side = np.nonzero(neighbours_of(faces, len(points)) < 0)
    a, b = faces[face, side], faces[face, (side + 1) % 3]
    length = np.linalg.norm(points[b] - points[a], axis=1)
    count = np.bincount(a, minlength=len(points)) + np.bincount(b, minlength=len(points))
    total = np.bincount(a, length, minlength=len(points)) + np.bincount(b, length, minlength=len(points))
    overall = float(length.mean()) if len(length) else 1.0
    return np.divide(total, count, out=np.full(len(points), overall), where=count > 0)


def smooth_values(points: FloatArray, values: FloatArray, free: BoolArray, faces: IntArray, *, plate: bool = True) -> FloatArray:
    """`values` (n, k) over a mesh of `points` (n, 2) or (n, 3), with those of the free vertices set so that they bend least (`plate`) or
    stretch least (membrane); all others stay. Free vertices must not lie on the mesh's own rim."""
    from scipy.sparse import csr_matrix, diags
    from scipy.sparse.linalg import splu

    if not free.any():
        return values
    ring = np.zeros(len(values), bool)
    ring[faces[free[faces].any(axis=1)].ravel()] = True
    around = faces[ring[faces].any(axis=1)]
    weights, area = _cotangents(points, around)
    a, b, c = around.T
    i, j = np.concatenate([b, c, c, a, a, b]), np.concatenate([c, b, a, c, b, a])
    shape = (len(values), len(values))
    bending: Any = csr_matrix((np.repeat(weights.T, 2, axis=0).ravel(), (i, j)), shape=shape)
    bending = bending - diags(np.asarray(bending.sum(axis=1)).ravel())
    unknown, known = np.flatnonzero(free), np.flatnonzero(~free)
    if plate:
        mass = np.bincount(around.ravel(), np.repeat(area / 3, 3), minlength=len(values))
        rows = np.flatnonzero(ring)
        root = diags(1 / np.sqrt(mass[rows])) @ bending[rows]
        inner = root[:, unknown]
        matrix, right = inner.T @ inner, -(inner.T @ (root[:, known] @ values[known]))
    else:
        matrix, right = -bending[unknown][:, unknown], bending[unknown][:, known] @ values[known]
    result = values.copy()
    result[unknown] = splu(matrix.tocsc()).solve(np.ascontiguousarray(right))
    return result


def _cotangents(points: FloatArray, faces: IntArray) -> tuple[FloatArray, FloatArray]:
    """(m, 3) half the cotangent of each corner's angle, which weighs the opposite edge, and (m,) areas."""
    corners = points[faces]
    u, v = np.roll(corners, -1, axis=1) - corners, np.roll(corners, -2, axis=1) - corners
    dot = (u * v).sum(axis=2)
    area2 = np.sqrt(np.maximum((u * u).sum(axis=2) * (v * v).sum(axis=2) - dot * dot, 0.0)).max(axis=1)
    # a sliver's cotangent is unbounded; past this it only spoils the condition of the system
    area2 = np.maximum(area2, 1e-4 * (u * u).sum(axis=2).max(axis=1))
    return 0.5 * dot / area2[:, None], 0.5 * area2
