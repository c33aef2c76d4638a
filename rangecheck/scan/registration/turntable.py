"""Scans of an object on a turntable before a scanner that stays: one axis and one step instead of six numbers per scan.

With the first scan's pose P given, scan k lies at Rot(axis, k step) P, the axis being a line in the world. Five numbers (two of its
direction, two of its position, the step) are searched for and refined by the same equations as free poses, restricted to the
motions that a turntable can make. World frame, millimetres, radians.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, unit_vectors
from rangecheck.kernels import in_chunks
from rangecheck.scan.registration.coarse import levels_for
from rangecheck.scan.registration.evidence import AGREES, INTRUDES, Rules, compare, judge_pair
from rangecheck.scan.registration.joint import Level, align_jointly, frame_of
from rangecheck.scan.registration.matching import motion_numbers
from rangecheck.scan.registration.samples import Samples

#: places along the view, in radii of the object from the middle of what the scans show, at which the axis is looked for
_DEPTHS = np.linspace(-0.3, 1.5, 13)
#: places that are refined
_TRIED = 3
_GLANCE = 400


@dataclass(frozen=True, eq=False)
class Turntable:
    """The axis, as a point and a unit direction, and the angle of each scan in radians.

    step_deg     mean angle between scans, positive as the right hand turns about `direction`
    departure_mm RMS distance between where the free poses put the points and where the turntable does; NaN before it is known
    """

    point_mm: FloatArray
    direction: FloatArray
    angles_rad: FloatArray = field(repr=False)
    departure_mm: float = math.nan

    @property
    def step_deg(self) -> float:
        return math.degrees(float(np.diff(self.angles_rad).mean())) if len(self.angles_rad) > 1 else 0.0

    @property
    def line(self) -> str:
        """The turntable in a sentence."""
        return (
            f"turntable: steps of {self.step_deg:+.2f} degrees about ({', '.join(f'{x:z.3f}' for x in self.direction)}) through "
            f"({', '.join(f'{x:z.1f}' for x in self.point_mm)}) mm; the scans depart from it by {self.departure_mm:.3f} mm (RMS)"
        )

    def poses(self, world_from_first: FloatArray) -> list[FloatArray]:
        """world_from_scan of each scan."""
        return [self.turn(float(a - self.angles_rad[0])) @ world_from_first for a in self.angles_rad]

    def turn(self, angle_rad: float) -> FloatArray:
        """(4, 4) turn about the axis."""
        motion = rigid.about_axis(self.direction, angle_rad)
        motion[:3, 3] = self.point_mm - motion[:3, :3] @ self.point_mm
        return motion

    def nudged(self, numbers: FloatArray, length_mm: float) -> Turntable:
        """The turntable changed by five small numbers in mm: tilt and shift across two directions each, and the step's stretch."""
        across = np.linalg.svd(self.direction[None])[2][1:]
        direction = unit_vectors(self.direction + (numbers[:2] / length_mm) @ across)
        stretch = 1.0 + numbers[4] / (length_mm * max(float(np.abs(self.angles_rad - self.angles_rad[0]).max()), 1e-9))
        first = self.angles_rad[0]
        return replace(
            self, point_mm=self.point_mm + numbers[2:4] @ across, direction=direction,
            angles_rad=first + (self.angles_rad - first) * stretch,
        )  # fmt: skip


def find_turntable(
    samples: Sequence[Samples],
    world_from_first: FloatArray,
    angles_rad: FloatArray,
    rules: Rules,
    *,
    axis_direction: FloatArray | None = None,
    axis_point_mm: FloatArray | None = None,
) -> Turntable:
    """Axis and step that fit best, from angles known but for their sense.

    axis_direction  world; without it the upward direction of the first scan's picture
    axis_point_mm   world; without it looked for along the line of sight"""
    p = world_from_first
    direction = unit_vectors(np.asarray(axis_direction if axis_direction is not None else -p[:3, 1], dtype=float))
    everything = np.concatenate([rigid.move_points(p, s.spread(300)[0]) for s in samples])
    level = p[:3, 2] - (p[:3, 2] @ direction) * direction
    # who looks along the axis sees it in the middle of the picture, and any direction across it serves
    forward = unit_vectors(level if np.linalg.norm(level) > 0.1 else np.linalg.svd(direction[None])[2][1])
    sideways = np.cross(direction, forward)
    lateral = [rigid.move_points(p, s.points_mm[s.usable]) @ sideways for s in samples]
    # over a full turn the middle of the silhouette is on the axis in the mean
    middle = float(np.mean([0.5 * (np.percentile(x, 1) + np.percentile(x, 99)) for x in lateral]))
    radius = float(np.mean([0.5 * (np.percentile(x, 99) - np.percentile(x, 1)) for x in lateral]))
    centre = everything.mean(axis=0)
    centre = centre + (middle - centre @ sideways) * sideways
    points = (
        [centre + d * radius * forward for d in _DEPTHS] if axis_point_mm is None else [np.asarray(axis_point_mm, dtype=float)]
    )
    starts = [Turntable(point, direction, sense * angles_rad) for sense in (1.0, -1.0) for point in points]
    looks = [s.spread(_GLANCE) for s in samples]
    neighbours = [(k, (k + 1) % len(samples)) for k in range(len(samples) if len(samples) > 2 else 1)]

    def glance(first: int, last: int) -> float:
        poses = starts[first].poses(p)
        total = 0.0
        for i, j in neighbours:
            for a, b in ((i, j), (j, i)):
                seen = compare(*looks[a], poses[a], samples[b], poses[b], 0.08 * radius)
                total += seen.count(AGREES) - 2.0 * seen.count(INTRUDES)
        return total

    scores = in_chunks(glance, len(starts), 1)
    best = sorted(range(len(starts)), key=lambda k: -scores[k])[:_TRIED]
    levels = levels_for(samples, 0.3 * radius)
    coarse, fine = levels[: max(1, len(levels) - 2)], levels[max(1, len(levels) - 2) :]
    ordered = [pair for i, j in neighbours for pair in ((i, j), (j, i))]
    fitted = [refine_turntable(samples, p, starts[k], radius, coarse, ordered) for k in best]
    chosen = max(fitted, key=lambda t: _quality(samples, t.poses(p), neighbours, rules, looks))
    return refine_turntable(samples, p, chosen, radius, fine or coarse)


def _quality(samples, poses, neighbours, rules: Rules, looks) -> float:
    pairs = [judge_pair(samples[i], samples[j], poses[i], poses[j], rules, (looks[i], looks[j]))[0] for i, j in neighbours]
    return sum(pair.consistency * (pair.overlap_a + pair.overlap_b) for pair in pairs)


def refine_turntable(
    samples: Sequence[Samples],
    world_from_first: FloatArray,
    start: Turntable,
    radius_mm: float,
    levels: Sequence[Level],
    pairs: Sequence[tuple[int, int]] | None = None,
) -> Turntable:
    """The turntable nearest to `start` that fits the ordered `pairs` (without them, all) best."""
    current = start
    centre, length = frame_of(samples, start.poses(world_from_first))

    def restrict(a: FloatArray, g: FloatArray) -> FloatArray:
        nonlocal current
        now = current.poses(world_from_first)
        # how each pose answers each of the five numbers, by differences small against any tolerance
        jacobian = np.empty((len(g), 5))
        for c in range(5):
            numbers = np.zeros(5)
            numbers[c] = 1e-4
            after = current.nudged(numbers, length).poses(world_from_first)
            jacobian[:, c] = (
                np.concatenate([motion_numbers(q @ rigid.inverse(q0), centre, length) for q, q0 in zip(after, now)]) / 1e-4
            )
        system = jacobian.T @ a @ jacobian
        system += 1e-9 * np.trace(system) * np.eye(5)
        step = -np.linalg.solve(system, jacobian.T @ g) if np.trace(system) > 0 else np.zeros(5)
        current = current.nudged(np.clip(step, -0.3 * radius_mm, 0.3 * radius_mm), length)
        after = current.poses(world_from_first)
        return np.concatenate([motion_numbers(q @ rigid.inverse(q0), centre, length) for q, q0 in zip(after, now)])

    align_jointly(samples, start.poses(world_from_first), levels=levels, pairs=pairs, restrict=restrict)
    return current


def departure_mm(turntable: Turntable, samples: Sequence[Samples], poses: Sequence[FloatArray]) -> float:
    """RMS distance between where `poses` put the scans' points and where the turntable puts them."""
    squares = []
    for s, free, bound in zip(samples, poses, turntable.poses(poses[0])):
        points = s.spread(300)[0]
        squares.append(((rigid.move_points(free, points) - rigid.move_points(bound, points)) ** 2).sum(axis=1))
    return float(np.sqrt(np.concatenate(squares).mean()))
