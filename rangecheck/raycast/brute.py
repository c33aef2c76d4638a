"""Every ray against every triangle in float64: slow and right. The oracle that the fast engine is tested against.

Moller & Trumbore, *Fast, minimum storage ray/triangle intersection*, 1997.
"""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.raycast.embree import Hits


class BruteCaster:
    """The same two methods as `EmbreeCaster`, without its approximations. Cost n rays x m faces."""

    skin_mm = 0.0

    def __init__(self, vertices_mm: FloatArray, faces: IntArray) -> None:
        self._a = vertices_mm[faces[:, 0]]
        self._ab = vertices_mm[faces[:, 1]] - self._a
        self._ac = vertices_mm[faces[:, 2]] - self._a

    def closest(self, origins_mm: FloatArray, directions: FloatArray) -> Hits:
        """First hit of each ray; origins and unit directions (n, 3)."""
        n = len(origins_mm)
        hits = Hits(np.full(n, np.inf), np.full(n, -1, np.int32), np.zeros(n, np.float32), np.zeros(n, np.float32))
        for i in range(n):
            with np.errstate(divide="ignore", invalid="ignore"):
                p = np.cross(directions[i], self._ac)
                determinant = (self._ab * p).sum(axis=1)
                s = origins_mm[i] - self._a
                u = (s * p).sum(axis=1) / determinant
                q = np.cross(s, self._ab)
                v = (q @ directions[i]) / determinant
                t = (self._ac * q).sum(axis=1) / determinant
                t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
            nearest = int(np.argmin(t))
            if np.isfinite(t[nearest]):
                hits.distance_mm[i], hits.face[i], hits.u[i], hits.v[i] = t[nearest], nearest, u[nearest], v[nearest]
        return hits

    def occluded(self, origins_mm: FloatArray, directions: FloatArray, reach_mm: FloatArray | float = np.inf) -> BoolArray:
        """Whether anything lies on each ray between its origin and `reach_mm`."""
        return self.closest(origins_mm, directions).distance_mm < reach_mm
