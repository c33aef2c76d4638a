"""Rays against an exact surface, with the same two methods as against triangles. World frame, millimetres."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rangecheck.analytic.bust import bust_first_hit, bust_normals
from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.raycast.embree import Hits


class ImplicitCaster:
    """First hits and occlusion against a surface given by two functions.

    first_hit(origins (n, 3), unit directions (n, 3), reach (n,) or scalar) -> (n,) mm, inf where missed
    normals(points (n, 3) on the surface) -> (n, 3) outward unit normals
    skin_mm is how far off the surface a ray must start that leaves it.
    """

    def __init__(
        self,
        first_hit: Callable[[FloatArray, FloatArray, FloatArray | float], FloatArray],
        normals: Callable[[FloatArray], FloatArray],
        skin_mm: float,
    ) -> None:
        self._first_hit, self.normals, self.skin_mm = first_hit, normals, skin_mm

    @classmethod
    def of_bust(cls) -> ImplicitCaster:
        """The sample bust itself, without a mesh in between."""
        return cls(bust_first_hit, bust_normals, 1e-3)

    def closest(self, origins_mm: FloatArray, directions: FloatArray, *, coherent: bool = False) -> Hits:
        """First hit of each ray; face is 0 where something was hit, -1 elsewhere. `coherent` makes no difference here."""
        distance = self._first_hit(origins_mm, directions, np.inf)
        none = np.zeros(len(distance), np.float32)
        return Hits(distance, np.where(np.isfinite(distance), 0, -1).astype(np.int32), none, none)

    def occluded(
        self, origins_mm: FloatArray, directions: FloatArray, reach_mm: FloatArray | float = np.inf, *, coherent: bool = False
    ) -> BoolArray:
        """Whether the surface lies on each ray between its origin and `reach_mm` (scalar or (n,))."""
        return self._first_hit(origins_mm, directions, reach_mm) < reach_mm
