"""What a fitted material and lamp show on a scan's grid, and how that changes with the normals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.recover.fit import Fitted
from rangecheck.recover.grid import ScanGrid, sight_of
from rangecheck.recover.problem import Photograph, Problem, Unknowns


@dataclass(frozen=True, eq=False)
class Shading:
    """m cells under a fitted lamp: seen (m,) their brightness; points, views (m, 3); `at` shades them for other normals."""

    problem: Problem
    seen: FloatArray
    saturation: float

    def at(self, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(m,) brightness and (m, 3) its derivative by the normal."""
        photo = self.problem.photographs[0]
        sight = replace(photo.sight, normals=normals, facing=normals)
        there = replace(self.problem, photographs=(replace(photo, sight=sight),))
        return there.by_normal(0)

    def only(self, keep: IntArray) -> Shading:
        """Of the cells `keep` (k,), among the m."""
        photo = self.problem.photographs[0].only(keep)
        return replace(self, problem=replace(self.problem, photographs=(photo,)), seen=self.seen[keep])

    def between(self, ends: IntArray) -> Shading:
        """Halfway between two neighbours, `ends` (k, 2) among the m: the mean of what is seen of both, in the place of the first."""
        return replace(self.only(ends[:, 0]), seen=self.seen[ends].mean(axis=1))


def shading_of(fitted: Fitted, grid: ScanGrid, cell: IntArray) -> Shading:
    """For cells (m,) of the flattened grid."""
    n = len(cell)
    sight = sight_of(grid, cell, -grid.rays.reshape(-1, 3)[cell])
    problem = fitted.problem
    taken = problem.photographs[0]
    lights = len(problem.lights)
    photo = Photograph(
        sight, np.zeros(n), np.ones(n), np.ones((n, lights), bool), tuple(range(lights)), saturation=taken.saturation, exposure=taken.exposure,
        ambient=taken.ambient,
    )  # fmt: skip
    there = Problem((photo,), problem.lights, problem.material, Unknowns((), direction=False), problem.nodes)
    return Shading(there, np.nan_to_num(grid.picture.reshape(-1)[cell]), taken.saturation)
