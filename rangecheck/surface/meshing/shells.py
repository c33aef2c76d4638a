"""Connected shells of a triangle mesh, and which of them to keep."""

from __future__ import annotations

import math

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import kernel


@kernel
def _join(faces, parent):
    for f in range(len(faces)):
        a = faces[f, 0]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        for corner in range(1, faces.shape[1]):
            b = faces[f, corner]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            if a < b:
                parent[b] = a
            elif b < a:
                parent[a] = b
                a = b
    # every parent is lower than its child, so one ascending pass numbers the roots and hands their numbers on
    count = 0
    for v in range(len(parent)):
        if parent[v] == v:
            parent[v] = count
            count += 1
        else:
            parent[v] = parent[parent[v]]


def shell_of_vertex(faces: IntArray, count: int) -> IntArray:
    """(n,) int32 number of the shell of each vertex, shells numbered by their lowest vertex; faces (m, 3) or (m, 4)."""
    parent = np.arange(count, dtype=np.int32)
    _join(faces, parent)
    return parent


@kernel
def areas(vertices, faces, first, last, area):
    """(m,) mm^2 of the triangles first..last."""
    for f in range(first, last):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        area[f] = 0.5 * math.sqrt(x * x + y * y + z * z)


def shells_to_keep(shell_of_face: IntArray, area_mm2: FloatArray, trusted: IntArray, least_share: float) -> IntArray:
    """Numbers of the shells whose trusted area (faces where `trusted`) is at least `least_share` of the largest shell's."""
    shells = int(shell_of_face.max()) + 1 if len(shell_of_face) else 0
    area = np.bincount(shell_of_face, area_mm2 * trusted, minlength=shells)
    if not area.any():
        area = np.bincount(shell_of_face, area_mm2, minlength=shells)
    return np.flatnonzero(area >= least_share * area.max(initial=0.0))
