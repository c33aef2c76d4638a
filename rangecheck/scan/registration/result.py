"""What registration hands back: scans at their poses, and what may be relied on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.registration.evidence import Pair
from rangecheck.scan.registration.turntable import Turntable

Guess = Literal["poses", "turntable", "none"]
Verdict = Literal["aligned", "partial", "refused"]
#: residuals this many times what noise explains are remarked on
_REMARKABLE = 5.0


@dataclass(frozen=True)
class ScanState:
    """What became of one scan.

    aligned      False: refused, and the scan kept the pose it came with
    reason       why it was refused; for an aligned scan what is worth knowing, or nothing
    overlap      share of its points that at least one other aligned scan confirms (of a refused one: its best partner at the best pose tried)
    intruding    share of its points in space that another aligned scan saw to be empty
    residual_mm  RMS distance along the normal of its confirmed points from the other scans
    expected_mm  what noise alone would leave of it
    moved_mm, turned_deg  motion from the pose it came with: of the middle of its points, and its rotation
    undetermined motions that its overlap leaves free, in words
    pose_error_mm expected error of its pose relative to the scan that kept its own: RMS displacement of its points, one standard
                  deviation, from noise and the shape of the overlaps; what a scanner's calibration adds is not in it
    """

    name: str
    aligned: bool
    reason: str
    overlap: float
    intruding: float
    residual_mm: float
    expected_mm: float
    moved_mm: float
    turned_deg: float
    undetermined: tuple[str, ...] = ()
    pose_error_mm: float = math.nan


@dataclass(frozen=True, eq=False)
class Registration:
    """Scans at their poses, and what may be relied on.

    scans      all scans in the order they came, aligned ones moved, refused ones where they were
    states     one per scan
    pairs      every pair of aligned scans that share points, and the best pair that was tried for each refused scan
    verdict    "aligned": all are; "partial": the largest group is, the rest refused; "refused": no two scans hang together
    turntable  axis and step, if that was the guess and it held
    guess, seed, iterations  how it was done
    remarks    what else is worth knowing, in sentences
    """

    scans: list[RangeScan] = field(repr=False)
    states: tuple[ScanState, ...]
    pairs: tuple[Pair, ...] = field(repr=False)
    verdict: Verdict
    turntable: Turntable | None
    guess: Guess
    seed: int
    iterations: int
    remarks: tuple[str, ...] = ()

    @property
    def aligned(self) -> list[RangeScan]:
        """Only the scans whose poses hold."""
        return [scan for scan, state in zip(self.scans, self.states) if state.aligned]

    @property
    def residual_mm(self) -> float:
        """RMS over the overlapping pairs of aligned scans, weighted by the points they share; NaN without any."""
        good = [p for p in self.pairs if p.accepted]
        if not good:
            return math.nan
        weights = [p.points * (p.overlap_a + p.overlap_b) for p in good]
        return math.sqrt(float(np.average([p.residual_mm**2 for p in good], weights=weights)))

    @property
    def lines(self) -> list[str]:
        """What happened, in sentences."""
        n, kept = len(self.states), sum(s.aligned for s in self.states)
        if n == 1:
            return [f"{self.states[0].name}: one scan, nothing to align"]
        if self.verdict == "refused":
            lines = [f"refused: no two of {n} scans could be shown to belong together"]
        else:
            lines = [
                f"{self.verdict}: {kept} of {n} scans aligned, residual {self.residual_mm:.3f} mm over "
                f"{sum(p.accepted for p in self.pairs)} overlapping pairs"
            ]
        errors = [s.pose_error_mm for s in self.states if s.aligned and math.isfinite(s.pose_error_mm)]
        if len(errors) > 1:
            lines.append(
                f"poses are expected to err by {np.median(errors):.3f} mm in the median, {max(errors):.3f} at most (one standard deviation, from "
                "noise and overlaps)"
            )
        if self.turntable is not None:
            lines.append(self.turntable.line)
        for s in self.states:
            if not s.aligned:
                lines.append(f"{s.name} refused: {s.reason}")
            elif s.reason:
                lines.append(f"{s.name}: {s.reason}")
            if s.aligned and s.residual_mm > _REMARKABLE * s.expected_mm:
                lines.append(
                    f"{s.name}: residual {s.residual_mm:.3f} mm is {s.residual_mm / s.expected_mm:.1f} times what its noise explains "
                    f"({s.expected_mm:.3f} mm); suspect the scanner's calibration, or that the object moved"
                )
        return lines + list(self.remarks)
