"""Whether the poses that scans came with can be right: every pair that sees the same place is asked whether it sees the same surface.

Scans that do not meet say nothing about each other's poses, and silence is no contradiction. World frame, millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rangecheck.kernels import in_chunks
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.registration.decide import judge_all
from rangecheck.scan.registration.evidence import AGREES, DIFFERS, INTRUDES, Pair, Rules
from rangecheck.scan.registration.samples import Samples, samples_of


@dataclass(frozen=True)
class GivenPoses:
    """What the pairs say about the poses given.

    agreeing     pairs whose common surface agrees within the rules
    contradicted pairs that say something about each other, and do not agree
    same         all scans came with one and the same pose: most likely nobody gave any
    """

    agreeing: tuple[Pair, ...] = field(repr=False)
    contradicted: tuple[Pair, ...] = field(repr=False)
    same: bool

    @property
    def missing(self) -> bool:
        """No poses were given, as far as can be told: one pose for all, at which the scans are not of one surface."""
        return self.same and (bool(self.contradicted) or not self.agreeing)

    @property
    def line(self) -> str:
        """What was found, in a clause."""
        if self.missing:
            return "all scans came with the same pose, at which they do not show one surface"
        if self.contradicted:
            worst = min(self.contradicted, key=lambda p: p.consistency)
            return (
                f"{len(self.contradicted)} of {len(self.contradicted) + len(self.agreeing)} overlapping pairs disagree at the poses given; "
                f"{worst.a} with {worst.b}: {worst.reason}"
            )
        if not self.agreeing:
            return "no two scans see the same place, so nothing speaks for or against their poses"
        worst = max(self.agreeing, key=lambda p: p.residual_mm)
        return f"{len(self.agreeing)} overlapping pairs agree at the poses given, to {worst.residual_mm:.3f} mm or better"


def check_poses(
    scans: Sequence[RangeScan], *, rules: Rules | None = None, samples: Sequence[Samples] | None = None
) -> GivenPoses:
    """Judge the poses of `scans`. `samples` are those of the scans, if they are at hand. Raises ScanError for a scan without a surface."""
    limits = rules or Rules()
    if samples is None:
        samples = in_chunks(lambda i, _: samples_of(scans[i]), len(scans), 1)
    poses = [scan.world_from_scan for scan in scans]
    agreeing, contradicted = [], []
    for pair, by_b, by_a in judge_all(samples, poses, limits).values():
        told = sum(c.count(k) for c in (by_a, by_b) for k in (AGREES, DIFFERS, INTRUDES))
        if pair.accepted:
            agreeing.append(pair)
        elif told >= limits.least_overlap * pair.points and _disagrees(pair, limits):
            contradicted.append(pair)
    same = len(scans) > 1 and all(np.array_equal(pose, poses[0]) for pose in poses)
    return GivenPoses(tuple(agreeing), tuple(contradicted), same)


def _disagrees(pair: Pair, rules: Rules) -> bool:
    """Whether a pair objects for another reason than that it shares too little."""
    return (
        pair.intruding > rules.most_intruding
        or pair.consistency < rules.least_consistency
        or (pair.residual_mm >= 0 and pair.excess > rules.most_excess)
    )
