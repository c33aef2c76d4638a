"""What speaks for a pose and what against it: agreement where two scans see the same place, and free space that is not free.

A range scan says two things along each ray: there is surface at the distance measured, and there is none before it. Points of
another scan that lie well before that distance, in space the ray went through, contradict the pose whatever the points that do
agree (Huber & Hebert, *Fully automatic registration of multiple 3D data sets*, 2003, call it visibility consistency).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.kernels import kernel
from rangecheck.scan.registration.matching import Target
from rangecheck.scan.registration.samples import Samples

AGREES, DIFFERS, INTRUDES, SILENT = 0, 1, 2, 3
#: nats that a point which differs or intrudes counts against a pose: one in twenty may do so at the right one
_AGAINST = 3.0


def tolerance_mm(a: Samples, b: Samples) -> float:
    """How far apart two scans of one surface may lie: three standard deviations of what noise leaves in their smoothed points,
    and never less than half the sample spacing, because a coarser grid cannot tell a step from a slope."""
    return max(3 * math.hypot(a.smooth_mm, b.smooth_mm), 0.5 * max(a.spacing_mm, b.spacing_mm))


def gate_mm(target: Samples, agree_mm: float) -> float:
    """How far around a point surface is looked for: far enough that what differs by several tolerances is found and counts against."""
    return max(3 * target.spacing_mm, 4 * agree_mm)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Points of a moving scan judged by a target.

    verdict     (n,) AGREES, DIFFERS (a surface is near, facing the same way, but farther than the tolerance), INTRUDES (in space that
                the target saw to be empty) or SILENT (the target says nothing)
    residual_mm (n,) signed distance along the normal where AGREES or DIFFERS, else NaN
    """

    verdict: IntArray = field(repr=False)
    residual_mm: FloatArray = field(repr=False)

    def count(self, verdict: int) -> int:
        return int((self.verdict == verdict).sum())

    @property
    def agrees(self) -> BoolArray:
        return self.verdict == AGREES


def compare(
    points_mm: FloatArray,
    normals: FloatArray,
    world_from_moving: FloatArray,
    target: Samples,
    world_from_target: FloatArray,
    agree_mm: float,
) -> Comparison:
    """Judge points (n, 3) of the moving scan by `target`; `agree_mm` is the tolerance."""
    motion = rigid.inverse(world_from_target) @ world_from_moving
    there, turned = rigid.move_points(motion, points_mm), rigid.move_directions(motion, normals)
    cell = Target(target, 1).match(there, turned, gate_mm(target, agree_mm))
    hit = cell >= 0
    verdict = np.full(len(there), SILENT, np.int64)
    residual = np.full(len(there), np.nan)
    normal = target.normals.reshape(-1, 3)[cell[hit]] + turned[hit]
    normal /= np.sqrt((normal * normal).sum(axis=1, keepdims=True))
    residual[hit] = ((there[hit] - target.points_mm.reshape(-1, 3)[cell[hit]]) * normal).sum(axis=1)
    verdict[hit] = np.where(np.abs(residual[hit]) <= agree_mm, AGREES, DIFFERS)
    if target.projects:
        cells, ranges = target.camera.project(there)
        _intruders(cells / target.stride, ranges, target.range_mm, 3 * agree_mm + target.spacing_mm, verdict)
    return Comparison(verdict, residual)


@kernel
def _intruders(cells, ranges, range_mm, margin, verdict):
    """Points before all of the 3 x 3 readings around them by more than `margin`; one cell without a reading and nothing is said."""
    h, w = range_mm.shape
    for i in range(len(cells)):
        u, v = cells[i, 0], cells[i, 1]
        if verdict[i] != SILENT or not (u >= 1.0 and v >= 1.0 and u < w - 2.0 and v < h - 2.0):
            continue
        column, row = math.floor(u + 0.5), math.floor(v + 0.5)
        before = True
        for r in range(row - 1, row + 2):
            for c in range(column - 1, column + 2):
                if not ranges[i] < range_mm[r, c] - margin:
                    before = False
        if before:
            verdict[i] = INTRUDES


@dataclass(frozen=True)
class Pair:
    """Two scans at their poses.

    overlap       smaller of both shares of points that the other scan confirms
    overlap_a, overlap_b  share of a's points that b confirms, and of b's that a does
    consistency   of the points that the other scan says something about, the share it confirms
    intruding     share of all points that lie in space the other saw to be empty
    residual_mm   RMS distance of confirmed points along the normal
    expected_mm   what noise alone would leave of it
    bias_mm       median signed distance: how far the two surfaces lie apart on the whole
    points        number of points judged
    evidence      how strongly the points speak for the pose: the mean over all points of the logarithm of how much better a point
                  fits than one that lies anywhere within the search gate; what differs or intrudes counts against it
    accepted      whether this pair ties its scans together; `reason` says why not
    """

    a: str
    b: str
    overlap: float
    overlap_a: float
    overlap_b: float
    consistency: float
    intruding: float
    residual_mm: float
    expected_mm: float
    bias_mm: float
    points: int
    evidence: float
    accepted: bool
    reason: str

    @property
    def excess(self) -> float:
        """Residual over what noise explains; infinite where nothing agrees."""
        return self.residual_mm / self.expected_mm if self.residual_mm >= 0 and self.expected_mm > 0 else math.inf


@dataclass(frozen=True)
class Rules:
    """What a pair must show before it ties its scans together.

    least_overlap     share of the smaller scan's points that the other confirms
    least_consistency of the points that the other scan says something about, the share it must confirm
    most_intruding    share of points that may lie in space the other saw to be empty
    agree_mm          tolerance of agreement; None: from noise and sample spacing (`tolerance_mm`)
    most_excess       times what noise explains that the residual may be. Scanners whose errors hang together over many cells come to
                      4 or 5 at the right pose; smooth surfaces at a wrong one to 3 and more
    """

    least_overlap: float = 0.08
    least_consistency: float = 0.7
    most_intruding: float = 0.03
    agree_mm: float | None = None
    most_excess: float = 8.0


def judge_pair(
    a: Samples,
    b: Samples,
    world_from_a: FloatArray,
    world_from_b: FloatArray,
    rules: Rules,
    moving: tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]] | None = None,
) -> tuple[Pair, Comparison, Comparison]:
    """The pair's figures and verdict, with the comparison of a's points by b and of b's by a."""
    tolerance = rules.agree_mm if rules.agree_mm is not None else tolerance_mm(a, b)
    of_a, of_b = moving if moving is not None else (a.spread(4000), b.spread(4000))
    by_b = compare(*of_a, world_from_a, b, world_from_b, tolerance)
    by_a = compare(*of_b, world_from_b, a, world_from_a, tolerance)
    agree, differ, intrude = (by_a.count(k) + by_b.count(k) for k in (AGREES, DIFFERS, INTRUDES))
    points = len(by_a.verdict) + len(by_b.verdict)
    overlap_a, overlap_b = by_b.count(AGREES) / len(by_b.verdict), by_a.count(AGREES) / len(by_a.verdict)
    # b's view of a counts distances the other way round
    residual = np.concatenate([by_b.residual_mm[by_b.agrees], -by_a.residual_mm[by_a.agrees]])
    rms = float(np.sqrt(np.mean(residual**2))) if len(residual) else math.nan
    bias = float(np.median(residual)) if len(residual) else math.nan
    expected = math.hypot(a.smooth_mm, b.smooth_mm)
    # a normal law of the pair's own width against an even one over the gate, nats per point
    gain = math.log(2 * gate_mm(b, tolerance) / (math.sqrt(2 * math.pi) * max(rms, expected))) - 0.5 if agree else 0.0
    evidence = (agree * max(gain, 0.0) - _AGAINST * (differ + intrude)) / points
    pair = Pair(
        a.name, b.name, min(overlap_a, overlap_b), overlap_a, overlap_b, agree / max(agree + differ + intrude, 1),
        intrude / points, rms, expected, bias, points, evidence, True, "",
    )  # fmt: skip
    reason = objection_to(pair, rules, tolerance)
    return replace(pair, accepted=not reason, reason=reason), by_b, by_a


def objection_to(pair: Pair, rules: Rules, tolerance: float | None = None) -> str:
    """Why the rules do not accept a pair, in words; empty when they do."""
    if pair.intruding > rules.most_intruding:
        return f"{100 * pair.intruding:.1f} % of the points lie in space the other scan saw to be empty (at most {100 * rules.most_intruding:.1f} %)"
    if max(pair.overlap_a, pair.overlap_b) < rules.least_overlap:
        return f"they share {100 * max(pair.overlap_a, pair.overlap_b):.1f} % of their points (at least {100 * rules.least_overlap:.1f} %)"
    if pair.consistency < rules.least_consistency:
        within = f" within {tolerance:.2f} mm" if tolerance is not None else ""
        return (
            f"where both see the object only {100 * pair.consistency:.0f} % of the points agree{within} "
            f"(at least {100 * rules.least_consistency:.0f} %)"
        )
    if pair.excess > rules.most_excess:
        return (
            f"they lie {pair.residual_mm:.3f} mm apart, {pair.excess:.1f} times what noise explains (at most {rules.most_excess:.1f} times); "
            "a wrong pose on a smooth surface looks like this"
        )
    return ""
