"""Plane outlines of straight lines and arcs, cut into chords within a stated error.

A point is [x, y] or [x, y, bulge]: with a bulge, the line from it to the next point is an arc of included angle 4 atan(bulge),
positive to the left of the chord's direction turning counter-clockwise (the convention of DXF). Millimetres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import SceneError

MOST_CHORDS = 200_000


@dataclass(frozen=True)
class Segment:
    """A straight line from p to q, or, with a radius, an arc about `centre`."""

    p: tuple[float, float]
    q: tuple[float, float]
    centre: tuple[float, float] = (0.0, 0.0)
    radius: float = 0.0
    start_rad: float = 0.0
    sweep_rad: float = 0.0

    def chords(self, error_mm: float) -> FloatArray:
        """(k, 2) points from p on, without q, whose chords leave the segment by at most `error_mm`."""
        if not self.radius:
            return np.array([self.p])
        count = arc_chords(self.radius, abs(self.sweep_rad), error_mm)
        if count > MOST_CHORDS:
            raise SceneError(f"a tolerance of {error_mm:g} mm cuts an arc into {count} chords; at most {MOST_CHORDS} are made")
        angle = self.start_rad + self.sweep_rad * np.arange(count) / count
        points = np.stack([self.centre[0] + self.radius * np.cos(angle), self.centre[1] + self.radius * np.sin(angle)], axis=1)
        points[0] = self.p
        return points


def arc_chords(radius_mm: float, sweep_rad: float, error_mm: float) -> int:
    """Number of equal chords over `sweep_rad` that stay within `error_mm` of the circle: r (1 - cos(half step)) <= error."""
    # 1 - cos(h) = 2 sin(h / 2)^2, which does not vanish for errors below the rounding of 1
    half = max(2 * math.asin(math.sqrt(min(error_mm / radius_mm / 2, 1.0))), math.ulp(0.0))
    # never coarser than an eighth of a turn: a face must keep its shape however loose the tolerance
    return max(1, math.ceil(min(sweep_rad / min(2 * half, math.pi / 4), 1e12) - 1e-9))


def segments(points: Sequence[Sequence[float]], name: str) -> list[Segment]:
    """The segments of a closed outline, counter-clockwise whatever way it was given. Raises SceneError."""
    rows = [tuple(float(x) for x in row) for row in points]
    if len(rows) < 2 or any(len(row) not in (2, 3) or not all(map(math.isfinite, row)) for row in rows):
        raise SceneError(
            f"{name}: an outline needs at least 2 points [x, y] or [x, y, bulge] of finite numbers; it has {len(rows)}"
        )
    found = [_segment(rows[k], rows[(k + 1) % len(rows)], name, k) for k in range(len(rows))]
    # area under chords and arcs alike, from fine chords
    outline = np.concatenate([s.chords(max(s.radius, 1.0) * 1e-3) for s in found])
    x, y = outline.T
    area = 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
    span = float(np.ptp(outline, axis=0).max())
    if abs(area) <= 1e-9 * span * span:
        raise SceneError(f"{name}: the outline encloses no area; give its points in order around it")
    return found if area > 0 else [_turned(s) for s in reversed(found)]


def _segment(row: tuple[float, ...], following: tuple[float, ...], name: str, k: int) -> Segment:
    p, q = (row[0], row[1]), (following[0], following[1])
    chord = math.dist(p, q)
    if chord == 0.0:
        raise SceneError(f"{name}: points {k + 1} and {k + 2} of the outline are the same; remove one")
    bulge = row[2] if len(row) == 3 else 0.0
    if bulge == 0.0:
        return Segment(p, q)
    if abs(bulge) > 100.0:
        raise SceneError(f"{name}: bulge {bulge:g} at point {k + 1} is nearly a whole turn; cut the arc in two")
    sweep = 4 * math.atan(bulge)
    # the centre lies on the chord's perpendicular, (1 - b^2) / (4 b) chord lengths to its left
    offset = (1 - bulge * bulge) / (4 * bulge)
    centre = (0.5 * (p[0] + q[0]) - offset * (q[1] - p[1]), 0.5 * (p[1] + q[1]) + offset * (q[0] - p[0]))
    return Segment(p, q, centre, math.dist(centre, p), math.atan2(p[1] - centre[1], p[0] - centre[0]), sweep)


def _turned(s: Segment) -> Segment:
    return Segment(s.q, s.p, s.centre, s.radius, s.start_rad + s.sweep_rad, -s.sweep_rad)
