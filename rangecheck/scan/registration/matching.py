"""Which point of another scan belongs to a point, and what the pair of them says about the poses.

A point is projected into the other scan's grid and the nearest usable cell around there is taken (Blais & Levine, *Registering
multiview range data to create 3D computer objects*, 1995); where the camera cannot project, a k-d tree answers instead.
The residual of a pair is its distance along the mean of both normals, which vanishes to second order on curved surfaces too
(Rusinkiewicz, *A symmetric objective function for ICP*, 2019).

Motions of scan i are `world_from_i`. A small motion is (turn, shift) about `centre_mm`; turns are counted in units of
1 / `length_mm`, so that all six numbers are millimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import kernel
from rangecheck.scan.registration.samples import Samples

#: cells searched on each side of where a point falls
_REACH = 3
#: normals of two matching points may differ by this much (cosine)
SAME_SIDE = 0.5


@dataclass(frozen=True, eq=False)
class Target:
    """A scan that points are matched to, seen through every `step`-th cell of its samples."""

    samples: Samples = field(repr=False)
    step: int

    @property
    def gate_mm(self) -> float:
        """How far apart matched points may be."""
        return _REACH * self.step * self.samples.spacing_mm

    @cached_property
    def _tree(self) -> tuple[Any, IntArray]:
        from scipy.spatial import cKDTree

        cells = np.zeros(self.samples.inner.shape, np.bool_)
        cells[:: self.step, :: self.step] = self.samples.inner[:: self.step, :: self.step]
        index = np.flatnonzero(cells.ravel())
        return cKDTree(self.samples.points_mm.reshape(-1, 3)[index]), index

    def match(self, points_mm: FloatArray, normals: FloatArray, gate_mm: float) -> IntArray:
        """(n,) flat cell of each point (target's scan frame) within `gate_mm` and on the same side of the surface, else -1."""
        found = np.full(len(points_mm), -1, np.int64)
        if self.samples.projects:
            cells = self.samples.camera.project(points_mm)[0] / (self.samples.stride * self.step)
            _nearest_cells(
                points_mm, normals, cells, self.samples.points_mm, self.samples.normals, self.samples.inner,
                self.step, _REACH, gate_mm, SAME_SIDE, found,
            )  # fmt: skip
            return found
        tree, index = self._tree
        if len(index):
            distance, nearest = tree.query(points_mm, distance_upper_bound=gate_mm)
            found = np.where(np.isfinite(distance), index[np.minimum(nearest, len(index) - 1)], -1)
            facing = (self.samples.normals.reshape(-1, 3)[found] * normals).sum(axis=1)
            found[~(facing >= SAME_SIDE)] = -1
        return found


@kernel
def _nearest_cells(points, normals, cells, grid_points, grid_normals, inner, step, reach, gate, same_side, found):
    """For each point the nearest inner cell within `reach` steps of where it projects to."""
    h, w = (inner.shape[0] + step - 1) // step, (inner.shape[1] + step - 1) // step
    for i in range(len(points)):
        u, v = cells[i, 0], cells[i, 1]
        if not (u > -reach - 1.0 and v > -reach - 1.0 and u < w + reach and v < h + reach):
            continue
        column, row = math.floor(u + 0.5), math.floor(v + 0.5)
        best = gate * gate
        for r in range(max(row - reach, 0), min(row + reach + 1, h)):
            for c in range(max(column - reach, 0), min(column + reach + 1, w)):
                p, q = r * step, c * step
                if not inner[p, q]:
                    continue
                x = grid_points[p, q, 0] - points[i, 0]
                y = grid_points[p, q, 1] - points[i, 1]
                z = grid_points[p, q, 2] - points[i, 2]
                square = x * x + y * y + z * z
                if square >= best:
                    continue
                facing = (
                    grid_normals[p, q, 0] * normals[i, 0]
                    + grid_normals[p, q, 1] * normals[i, 1]
                    + grid_normals[p, q, 2] * normals[i, 2]
                )
                if facing >= same_side:
                    best = square
                    found[i] = p * inner.shape[1] + q


@dataclass(frozen=True, eq=False)
class Equations:
    """What the matches of one scan's points on another say.

    normal   (6, 6) weighted sum of J J^T, J the motion of the residual per small motion of the moving scan
    gradient (6,) weighted sum of r J
    weight   sum of the weights
    matches  points that found a partner
    scale_mm robust standard deviation of the residuals
    rms_mm   weighted root mean square of the residuals
    """

    normal: FloatArray
    gradient: FloatArray
    weight: float
    matches: int
    scale_mm: float
    rms_mm: float


def equations(
    points_mm: FloatArray,
    normals: FloatArray,
    world_from_moving: FloatArray,
    target: Target,
    world_from_target: FloatArray,
    *,
    centre_mm: FloatArray,
    length_mm: float,
    gate_mm: float,
    least_scale_mm: float,
) -> Equations:
    """Match points (n, 3) of the moving scan and add up what they say; weights by Tukey's biweight at 4.7 robust deviations,
    of which none is taken as less than `least_scale_mm`."""
    motion = rigid.inverse(world_from_target) @ world_from_moving
    there = rigid.move_points(motion, points_mm)
    turned = rigid.move_directions(motion, normals)
    cell = target.match(there, turned, gate_mm)
    hit = cell >= 0
    matches = int(hit.sum())
    if matches == 0:
        return Equations(np.zeros((6, 6)), np.zeros(6), 0.0, 0, math.nan, math.nan)
    normal = target.samples.normals.reshape(-1, 3)[cell[hit]] + turned[hit]
    normal /= np.sqrt((normal * normal).sum(axis=1, keepdims=True))
    partner = target.samples.points_mm.reshape(-1, 3)[cell[hit]]
    residual = ((there[hit] - partner) * normal).sum(axis=1)
    scale = max(1.4826 * float(np.median(np.abs(residual))), least_scale_mm)
    across = rigid.move_directions(world_from_target, normal)
    middle = rigid.move_points(world_from_target, 0.5 * (there[hit] + partner)) - centre_mm
    a, g, sums = np.zeros((6, 6)), np.zeros(6), np.zeros(2)
    _add_up(middle, across, residual, 4.685 * scale, length_mm, a, g, sums)
    rms = math.sqrt(sums[1] / sums[0]) if sums[0] > 0 else math.nan
    return Equations(a, g, float(sums[0]), matches, scale, rms)


@kernel
def _add_up(points, normals, residuals, cut, length, a, g, sums):
    """A += w J J^T, g += w r J with J = ((p x n) / length, n)."""
    j = np.empty(6)
    for i in range(len(points)):
        r = residuals[i]
        if abs(r) >= cut:
            continue
        w = (1.0 - (r / cut) ** 2) ** 2
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        j[0], j[1], j[2] = (py * nz - pz * ny) / length, (pz * nx - px * nz) / length, (px * ny - py * nx) / length
        j[3], j[4], j[5] = nx, ny, nz
        for p in range(6):
            g[p] += w * r * j[p]
            for q in range(6):
                a[p, q] += w * j[p] * j[q]
        sums[0] += w
        sums[1] += w * r * r


def small_motion(step: FloatArray, centre_mm: FloatArray, length_mm: float) -> FloatArray:
    """(4, 4) motion of the six numbers (turn in mm at `length_mm`, shift in mm) about `centre_mm`."""
    turn = step[:3] / length_mm
    angle = float(np.linalg.norm(turn))
    motion = rigid.about_axis(turn, angle) if angle > 0 else np.eye(4)
    motion[:3, 3] = centre_mm + step[3:] - motion[:3, :3] @ centre_mm
    return motion


def motion_numbers(motion: FloatArray, centre_mm: FloatArray, length_mm: float) -> FloatArray:
    """The six numbers (6,) of which `small_motion` makes `motion`, for turns of less than half a revolution."""
    r = motion[:3, :3]
    skew = 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    sine = float(np.linalg.norm(skew))
    turn = skew * (rigid.angle_rad(motion) / sine if sine > 0 else 1.0)
    return np.concatenate([turn * length_mm, motion[:3, 3] - centre_mm + r @ centre_mm])
