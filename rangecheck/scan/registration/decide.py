"""Which scans hang together, decided from the evidence of every pair at the final poses; and why the others do not.

Scans are one rigid group when accepted pairs tie them together without leaving a motion free and no two of them contradict each
other. What is in no group with others has no pose that could be defended, and is said to be refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray
from rangecheck.kernels import in_chunks
from rangecheck.scan.registration.evidence import AGREES, INTRUDES, Comparison, Pair, Rules, judge_pair, objection_to
from rangecheck.scan.registration.freedom import free_motions
from rangecheck.scan.registration.result import ScanState
from rangecheck.scan.registration.samples import Samples

#: points per scan that the final verdict looks at
LOOK = 4000
#: times the usual excess of its residual over noise that a pair may show
_WORSE = 2.5

Judged = dict[tuple[int, int], tuple[Pair, Comparison, Comparison]]


@dataclass(frozen=True, eq=False)
class Decision:
    """Every pair judged, and the group of each scan.

    judged  (i, j) with i < j -> the pair, i's points judged by j, j's points judged by i
    group   number of each scan's group: the index of one of its members
    free    motions that keep two groups apart although pairs between them are accepted
    """

    judged: Judged = field(repr=False)
    group: list[int]
    free: dict[tuple[int, int], tuple[str, ...]]

    def largest(self) -> list[int]:
        """Members of the largest group, of equals the one with the first scan."""
        groups = ([k for k, g in enumerate(self.group) if g == name] for name in dict.fromkeys(self.group))
        return max(groups, key=lambda m: (len(m), -m[0]))


def judge_all(samples: Sequence[Samples], poses: Sequence[FloatArray], rules: Rules, look: int = LOOK) -> Judged:
    """Every unordered pair (i < j) judged."""
    moving = [s.spread(look) for s in samples]
    pairs = [(i, j) for i in range(len(samples)) for j in range(i + 1, len(samples))]

    def one(first: int, last: int) -> tuple[Pair, Comparison, Comparison]:
        i, j = pairs[first]
        return judge_pair(samples[i], samples[j], poses[i], poses[j], rules, (moving[i], moving[j]))

    return dict(zip(pairs, in_chunks(one, len(pairs), 1)))


def decide(
    samples: Sequence[Samples], poses: Sequence[FloatArray], rules: Rules, *, held: bool = False, look: int = LOOK
) -> Decision:
    """Judge every pair at `poses` and find the rigid groups, the best pairs first.

    held  the poses come from a model that determines them, such as a turntable: what overlaps leave free does not matter

    Scans of one scanner err alike: a pair whose residual is far above that of the others is not accepted."""
    judged = judge_all(samples, poses, rules, look)
    usual = [pair.excess for pair, *_ in judged.values() if pair.accepted]
    if usual:
        limit = replace(rules, most_excess=min(rules.most_excess, _WORSE * max(float(np.median(usual)), 1.0)))
        for p, (pair, of_i, of_j) in judged.items():
            if pair.accepted and (reason := objection_to(pair, limit)):
                judged[p] = (replace(pair, accepted=False, reason=reason), of_i, of_j)
    group = list(range(len(samples)))
    ranked = sorted((p for p, (pair, *_) in judged.items() if pair.accepted), key=lambda p: (-judged[p][0].evidence, p))
    free: dict[tuple[int, int], tuple[str, ...]] = {}
    changed = True
    while changed:
        changed = False
        for i, j in ranked:
            if group[i] == group[j]:
                continue
            left, right = ([k for k, g in enumerate(group) if g == group[m]] for m in (i, j))
            across = [(min(a, b), max(a, b)) for a in left for b in right]
            if any(judged[p][0].intruding > rules.most_intruding for p in across):
                continue
            # ties between the same two groups hold together: what one leaves free another may fix
            joining = [p for p in across if judged[p][0].accepted]
            left_free = () if held else _left_free(samples, poses, judged, joining, look)
            if left_free:
                free[min(i, j), max(i, j)] = left_free
                continue
            group = [group[i] if g == group[j] else g for g in group]
            changed = True
    return Decision(judged, group, {p: f for p, f in free.items() if group[p[0]] != group[p[1]]})


def _left_free(samples, poses, judged: Judged, pairs, look: int) -> tuple[str, ...]:
    points, normals, noise = [], [], 0.0
    for i, j in pairs:
        agrees = judged[i, j][1].agrees
        where, across = samples[i].spread(look)
        points.append(rigid.move_points(poses[i], where[agrees]))
        normals.append(rigid.move_directions(poses[i], across[agrees]))
        noise = max(noise, samples[i].normal_noise, samples[j].normal_noise)
    return free_motions(np.concatenate(points), np.concatenate(normals), noise)


def aligned_state(
    k: int, samples: Sequence[Samples], decision: Decision, before: FloatArray, after: FloatArray, note: str, error_mm: float
) -> ScanState:
    """The state of member k of a group, all of which were judged in `decision`; its pose was `before` and is `after`."""
    views = [(pair, of_i if i == k else of_j) for (i, j), (pair, of_i, of_j) in decision.judged.items() if k in (i, j)]
    confirmed = [view.agrees for _, view in views]
    count = sum(int(c.sum()) for c in confirmed)
    residual = math.sqrt(sum(float(np.square(v.residual_mm[v.agrees]).sum()) for _, v in views) / max(count, 1))
    expected = math.sqrt(sum(v.count(AGREES) * p.expected_mm**2 for p, v in views) / max(count, 1))
    return ScanState(
        samples[k].name, True, note, float(np.any(confirmed, axis=0).mean()),
        float(np.any([v.verdict == INTRUDES for _, v in views], axis=0).mean()), residual, expected, *_motion(samples[k], before, after),
        (), error_mm,
    )  # fmt: skip


def refused_state(name: str, best: Pair | None, objection: str, free: tuple[str, ...]) -> ScanState:
    """The state of a scan that is in no group.

    best       the best pair that was tried for it
    objection  why an accepted pair did not tie it to others, with the partner's name; empty if no pair was accepted
    free       motions that were left free, if that is why"""
    if best is None:
        reason = objection or "nothing in it looks like anything in the other scans"
        return ScanState(name, False, reason, 0.0, 0.0, math.nan, math.nan, 0.0, 0.0, free)
    partner, overlap = (best.b, best.overlap_a) if best.a == name else (best.a, best.overlap_b)
    reason = (
        objection
        or f"with {partner}, its best partner, {best.reason or 'it fits, but nothing joins the two to the largest group'}"
    )
    return ScanState(name, False, reason, overlap, best.intruding, best.residual_mm, best.expected_mm, 0.0, 0.0, free)


def _motion(samples: Samples, before: FloatArray, after: FloatArray) -> tuple[float, float]:
    middle = samples.points_mm[samples.usable].mean(axis=0)
    moved = float(np.linalg.norm(rigid.move_points(after, middle) - rigid.move_points(before, middle)))
    return moved, math.degrees(rigid.angle_rad(after @ rigid.inverse(before)))
