"""Which shell lies inside which: the winding number of closed shells.

Van Oosterom and Strackee, *The solid angle of a plane triangle*, 1983. The winding number of a point is the sum over all faces of
their signed solid angles divided by 4 pi: 1 inside, 0 outside, -1 inside a shell that faces inwards.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import in_chunks, kernel
from rangecheck.surface.surface import Surface


@kernel
def solid_angle_of(vertices, faces, chosen, x, y, z):
    """Sum of the signed solid angles of some faces seen from a point, steradians, positive where their backs are seen."""
    total = 0.0
    for f in chosen:
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = vertices[i, 0] - x, vertices[i, 1] - y, vertices[i, 2] - z
        bx, by, bz = vertices[j, 0] - x, vertices[j, 1] - y, vertices[j, 2] - z
        cx, cy, cz = vertices[k, 0] - x, vertices[k, 1] - y, vertices[k, 2] - z
        a = math.sqrt(ax * ax + ay * ay + az * az)
        b = math.sqrt(bx * bx + by * by + bz * bz)
        c = math.sqrt(cx * cx + cy * cy + cz * cz)
        triple = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        ab, bc, ca = ax * bx + ay * by + az * bz, bx * cx + by * cy + bz * cz, cx * ax + cy * ay + cz * az
        total += 2.0 * math.atan2(triple, a * b * c + ab * c + bc * a + ca * b)
    return total


def winding_numbers(surface: Surface, points_mm: FloatArray) -> FloatArray:
    """(n,) winding number of `surface` about each point (n, 3). Cost n times the number of faces."""
    vertices, faces = surface.vertices, surface.faces

    def sums(first: int, last: int) -> FloatArray:
        chosen = np.arange(first, last, dtype=np.int32)
        return np.array([solid_angle_of(vertices, faces, chosen, p[0], p[1], p[2]) for p in points_mm])

    pieces = in_chunks(sums, len(faces), 1 << 16)
    return np.sum(pieces, axis=0) / (4 * np.pi) if pieces else np.zeros(len(points_mm))


def shell_volumes_mm3(surface: Surface, count: int, shell: IntArray) -> FloatArray:
    """(count,) signed volume of each shell, meaningful for closed shells."""
    return shell_sizes(surface.vertices, surface.faces, shell, count)[1]


@kernel
def shell_sizes(vertices, faces, shell, count):
    """Area and signed volume of each shell, (count,) each; volumes about the shell's own first vertex, so that far from the origin no
    digits are lost."""
    area, volume = np.zeros(count), np.zeros(count)
    about = np.full(count, -1, np.int32)
    for f in range(len(faces)):
        s = shell[f]
        if about[s] < 0:
            about[s] = faces[f, 0]
        o, a, b, c = vertices[about[s]], vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        area[s] += 0.5 * math.sqrt(x * x + y * y + z * z)
        volume[s] += ((a[0] - o[0]) * x + (a[1] - o[1]) * y + (a[2] - o[2]) * z) / 6.0
    return area, volume


def shell_depths(surface: Surface, count: int, shell: IntArray) -> IntArray:
    """(count,) in how many other shells each closed shell lies. A shell is asked about by one point that touches no other shell's box
    face exactly, its first vertex; only shells whose box holds its own are looked at."""
    if count < 2:
        return np.zeros(count, np.int64)
    boxes = boxes_of_shells(surface.vertices, surface.faces, shell, count)
    low, high = boxes[:, 0], boxes[:, 1]
    depth = np.zeros(count, np.int64)
    order = np.argsort(shell, kind="stable").astype(np.int32)
    start = np.searchsorted(shell, np.arange(count + 1), sorter=order)
    for i in range(count):
        x, y, z = surface.vertices[surface.faces[order[start[i]], 0]]
        # one that only runs into another is not inside it: a box within a box is the least that inside means
        around = np.flatnonzero(((low <= low[i]) & (high >= high[i])).all(axis=1))
        for j in around[around != i]:
            mine = order[start[j] : start[j + 1]]
            depth[i] += abs(round(solid_angle_of(surface.vertices, surface.faces, mine, x, y, z) / (4 * math.pi))) % 2
    return depth


@kernel
def boxes_of_shells(vertices, faces, shell, count):
    """(count, 2, 3) low and high corner of the box around each shell."""
    boxes = np.empty((count, 2, 3))
    boxes[:, 0], boxes[:, 1] = np.inf, -np.inf
    for f in range(len(faces)):
        for corner in range(3):
            for axis in range(3):
                value, s = vertices[faces[f, corner], axis], shell[f]
                boxes[s, 0, axis], boxes[s, 1, axis] = min(boxes[s, 0, axis], value), max(boxes[s, 1, axis], value)
    return boxes
