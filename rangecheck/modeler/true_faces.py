"""The true surface behind a model's facets: one analytic face - plane, sphere, cylinder, cone, torus - per numbered face.

A face knows its own frame (`world_from_face`): planes are y = 0, round faces have their axis along y. Normals are exact; whether they
point into or out of the matter depends on the solid, so callers turn them to the facet's side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, unit_vectors

KINDS = ("plane", "sphere", "cylinder", "cone", "torus", "mesh")


@dataclass(frozen=True, eq=False)
class TrueFace:
    """One untrimmed analytic surface.

    kind  plane: y = 0. sphere: radius a about the origin. cylinder: radius a about y. cone: apex at the origin, radius grows by a
          per mm of -y. torus: tube of radius b about the circle of radius a in y = 0 (a may be less than b, or negative, for the
          inner part of a spindle). mesh: the facets are the surface.
    """

    kind: str
    a: float = 0.0
    b: float = 0.0
    world_from_face: FloatArray = field(default_factory=rigid.identity, repr=False)

    def moved(self, motion: FloatArray) -> TrueFace:
        """The same face after a rigid motion."""
        return TrueFace(self.kind, self.a, self.b, motion @ self.world_from_face)

    @property
    def is_curved(self) -> bool:
        """Whether the face can have a silhouette inside it."""
        return self.kind != "plane"

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """(n, 3) unit normals of the face through (or nearest to) points (n, 3), world frame; NaN for a mesh."""
        p = rigid.move_points(rigid.inverse(self.world_from_face), points_mm)
        if self.kind == "plane":
            local = np.tile([0.0, 1.0, 0.0], (len(p), 1))
        elif self.kind == "sphere":
            local = p
        elif self.kind == "cylinder":
            local = p * [1.0, 0.0, 1.0]
        elif self.kind == "cone":
            local = unit_vectors(p * [1.0, 0.0, 1.0]) + [0.0, self.a, 0.0]
        elif self.kind == "torus":
            local = p - self.a * unit_vectors(p * [1.0, 0.0, 1.0])
        else:
            return np.full_like(points_mm, np.nan)
        return rigid.move_directions(self.world_from_face, unit_vectors(local))

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """(n,) signed distance of points (n, 3) to the untrimmed face; 0 for a mesh."""
        p = rigid.move_points(rigid.inverse(self.world_from_face), points_mm)
        rho, y = np.hypot(p[:, 0], p[:, 2]), p[:, 1]
        if self.kind == "plane":
            return y
        if self.kind == "sphere":
            return np.sqrt((p * p).sum(axis=1)) - self.a
        if self.kind == "cylinder":
            return rho - self.a
        if self.kind == "cone":
            return (rho + self.a * y) / math.hypot(1.0, self.a)
        if self.kind == "torus":
            return np.hypot(rho - self.a, y) - self.b
        return np.zeros(len(p))
