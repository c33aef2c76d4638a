"""Which shell lies inside which: the winding number of closed shells.

Van Oosterom and Strackee, *The solid angle of a plane triangle*, 1983. The winding number of a point is the sum over all faces of
their signed solid angles divided by 4 pi: 1 inside, 0 outside, -1 inside a shell that faces inwards.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import in_chunks, kernel
from rangecheck.surface.surface import Surface


@kernel
def solid_angle(corners, x, y, z):
    """Sum of the signed solid angles of triangles (m, 9) seen from a point, steradians, positive where their backs are seen."""
    total = 0.0
    for i in range(len(corners)):
        t = corners[i]
        ax, ay, az = t[0] - x, t[1] - y, t[2] - z
        bx, by, bz = t[3] - x, t[4] - y, t[5] - z
        cx, cy, cz = t[6] - x, t[7] - y, t[8] - z
        a = math.sqrt(ax * ax + ay * ay + az * az)
        b = math.sqrt(bx * bx + by * by + bz * bz)
        c = math.sqrt(cx * cx + cy * cy + cz * cz)
        triple = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        ab, bc, ca = ax * bx + ay * by + az * bz, bx * cx + by * cy + bz * cz, cx * ax + cy * ay + cz * az
        total += 2.0 * math.atan2(triple, a * b * c + ab * c + bc * a + ca * b)
    return total


def winding_numbers(surface: Surface, points_mm: FloatArray) -> FloatArray:
    """(n,) winding number of `surface` about each point (n, 3). Cost n times the number of faces."""
    corners = surface.triangles.reshape(-1, 9)

    def sums(first: int, last: int) -> FloatArray:
        return np.array([solid_angle(corners[first:last], p[0], p[1], p[2]) for p in points_mm])

    pieces = in_chunks(sums, len(corners), 1 << 16)
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
    order = np.argsort(shell, kind="stable")
    start = np.searchsorted(shell[order], np.arange(count + 1))
    pieces = [surface.triangles[order[a:b]].reshape(-1, 9) for a, b in pairwise(start)]
    low = np.array([p.reshape(-1, 3).min(axis=0) for p in pieces]).reshape(-1, 3)
    high = np.array([p.reshape(-1, 3).max(axis=0) for p in pieces]).reshape(-1, 3)
    depth = np.zeros(count, np.int64)
    for i in range(count):
        x, y, z = pieces[i][0, :3]
        # one that only runs into another is not inside it: a box within a box is the least that inside means
        around = np.flatnonzero(((low <= low[i]) & (high >= high[i])).all(axis=1))
        for j in around[around != i]:
            depth[i] += abs(round(solid_angle(pieces[j], x, y, z) / (4 * math.pi))) % 2
    return depth
