"""Values that a surface carries, at any point of its faces."""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.surface.surface import Surface


def barycentric(surface: Surface, points_mm: FloatArray, face: IntArray) -> FloatArray:
    """(n, 3) weights of each point (n, 3) among the corners of its face, clipped to the face; a face without area weighs evenly."""
    a, b, c = (surface.vertices[surface.faces[face, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area2 = np.einsum("ij,ij->i", normal, normal)
    known = area2 > 0
    safe = np.where(known, area2, 1.0)
    wb = np.einsum("ij,ij->i", np.cross(points_mm - a, c - a), normal) / safe
    wc = np.einsum("ij,ij->i", np.cross(b - a, points_mm - a), normal) / safe
    weights = np.clip(np.stack([1 - wb - wc, wb, wc], axis=1), 0.0, 1.0)
    weights /= weights.sum(axis=1, keepdims=True)
    return np.where(known[:, None], weights, 1 / 3)
