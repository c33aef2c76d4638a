"""Scans put together without a guess: pair by pair, and only as far as the pairs bear each other out.

Hypotheses of each pair are refined and judged. Groups of scans then grow by the best tie first; a tie is taken only if, with it,
no two scans of the grown group contradict each other, so that one wrong pair does not spoil the rest. Motions are a_from_b in scan
frames, millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray
from rangecheck.kernels import in_chunks
from rangecheck.scan.registration.evidence import Pair, Rules, judge_pair, objection_to
from rangecheck.scan.registration.features import features_of
from rangecheck.scan.registration.freedom import free_motions
from rangecheck.scan.registration.hypotheses import SAME, propose
from rangecheck.scan.registration.joint import Level, align_jointly
from rangecheck.scan.registration.samples import Samples

#: radii of the descriptions, in sizes of the object
_RADII = (0.2, 0.4)
FEATURES = 1000
TRIALS = 20_000
_KEEP = 5
#: a second, different motion that agrees on this share of what the first agrees on makes a pair ambiguous
RIVAL = 0.8
#: a motion supported by less than this share of what supports an accepted one is not tried
_HOPELESS = 0.4
#: consistency after the first level below which a motion is not refined further: wrong ones come to 0.05 to 0.3, right ones to 0.6 and more
_DOUBTFUL = 0.3
#: points per scan looked at when ties are judged: at first, and in the end
_GLANCE, _LOOK = 400, 1500
#: a pair shows how well the scanner's scans fit if they agree on this share; others may fit this many times worse
_CLEAR, _WORSE = 0.9, 2.0
#: pairs refined before groups are joined again; a fixed number, so that the result does not depend on the number of threads
_BATCH = 4


@dataclass(frozen=True, eq=False)
class Tie:
    """A motion that brings scan b onto scan a, and how it was judged.

    rival  a different motion's share of what this one agrees on; None when there was no other"""

    a: int
    b: int
    a_from_b: FloatArray = field(repr=False)
    pair: Pair
    rival: float | None = None

    @property
    def score(self) -> float:
        """How strongly the points speak for it."""
        return self.pair.evidence

    @property
    def ambiguous(self) -> bool:
        return self.rival is not None and self.rival >= RIVAL


@dataclass(frozen=True)
class Objection:
    """Why two scans whose pair was accepted were not joined; `free` are the motions left free, where that is why."""

    a: int
    b: int
    reason: str
    free: tuple[str, ...] = ()


@dataclass(eq=False)
class Groups:
    """Scans that hang together: `group[k]` is the group of scan k, `pose[k]` its pose in its group's frame."""

    group: list[int]
    pose: list[FloatArray]

    def members(self, group: int) -> list[int]:
        return [k for k, g in enumerate(self.group) if g == group]

    def largest(self) -> list[int]:
        """Members of the largest group, of equals the one with the first scan."""
        return max((self.members(g) for g in dict.fromkeys(self.group)), key=lambda m: (len(m), -m[0]))


def size_of(samples: Samples) -> float:
    """RMS distance of a scan's points from their mean, mm."""
    points = samples.spread(500)[0]
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def levels_for(samples: Sequence[Samples], reach_mm: float) -> tuple[Level, ...]:
    """Coarse to fine: the first level matches points up to about `reach_mm` apart, the last uses the whole grid."""
    spacing = float(np.median([s.spacing_mm for s in samples]))
    step = 1
    while 3 * step * spacing < reach_mm and step < 64:
        step *= 2
    levels: list[Level] = []
    count = 800
    while True:
        levels.append(Level(step, count, 30 if not levels else 15))
        if step == 1:
            return tuple(levels)
        step, count = step // 2, min(2 * count, 6000)


@dataclass(frozen=True, eq=False)
class Proposals:
    """Motions proposed for each unordered pair (a < b), with the number of alike points that support each, best first."""

    size_mm: float
    of_pair: dict[tuple[int, int], list[tuple[FloatArray, int]]] = field(repr=False)

    def by_support(self) -> list[tuple[int, int]]:
        """Pairs, the best supported first."""
        return sorted((p for p, found in self.of_pair.items() if found), key=lambda p: (-self.of_pair[p][0][1], p))


def propose_all(
    samples: Sequence[Samples], pairs: Sequence[tuple[int, int]], *, seed: int, trials: int = TRIALS, features: int = FEATURES
) -> Proposals:
    """Hypotheses for `pairs`; the same seed gives the same ones whatever else is asked for."""
    size = float(np.median([size_of(s) for s in samples]))
    radii = tuple(r * size for r in _RADII)
    described = in_chunks(lambda i, _: features_of(samples[i], features, radii), len(samples), 1)

    def one(first: int, last: int) -> list[tuple[FloatArray, int]]:
        i, j = pairs[first]
        return propose(described[i], described[j], size, seed=seed + 7919 * i + 104729 * j, trials=trials, keep=_KEEP)

    return Proposals(size, dict(zip(pairs, in_chunks(one, len(pairs), 1))))


def refine_ties(
    samples: Sequence[Samples], proposals: Proposals, pairs: Sequence[tuple[int, int]], rules: Rules
) -> list[list[Tie]]:
    """For each of `pairs` the distinct motions that were refined and judged, best first."""
    levels = levels_for(samples, 0.3 * proposals.size_mm)[:-1] or levels_for(samples, 0.0)
    first_look, look = [s.spread(_GLANCE) for s in samples], [s.spread(_LOOK) for s in samples]

    def one(first: int, last: int) -> list[Tie]:
        i, j = pairs[first]
        two = (samples[i], samples[j])
        ties: list[Tie] = []
        for motion, support in proposals.of_pair[i, j]:
            if ties and ties[0].pair.accepted and support < _HOPELESS * proposals.of_pair[i, j][0][1]:
                break
            rough = align_jointly(two, (np.eye(4), motion), levels=levels[:1])
            glance, *_ = judge_pair(*two, rough.poses[0], rough.poses[1], rules, (first_look[i], first_look[j]))
            if glance.consistency < _DOUBTFUL:
                ties.append(Tie(i, j, rigid.inverse(rough.poses[0]) @ rough.poses[1], glance))
                continue
            fine = align_jointly(two, rough.poses, levels=levels[1:] or levels)
            pair, *_ = judge_pair(*two, fine.poses[0], fine.poses[1], rules, (look[i], look[j]))
            ties.append(Tie(i, j, rigid.inverse(fine.poses[0]) @ fine.poses[1], pair))
        return _distinct(ties, look[j][0][:: max(1, len(look[j][0]) // 30)], proposals.size_mm)

    return in_chunks(one, len(pairs), 1)


def join_without_guess(
    samples: Sequence[Samples], start: Groups, rules: Rules, *, seed: int, trials: int = TRIALS, features: int = FEATURES
) -> tuple[Groups, list[Tie], list[Objection]]:
    """Join the groups of `start` by pairs that lie in different ones, the best supported pairs first, until all are one or no
    pair is left; with the best tie of each pair that was looked at, and why good ones were refused."""
    n = len(samples)
    across = [(i, j) for i in range(n) for j in range(i + 1, n) if start.group[i] != start.group[j]]
    proposals = propose_all(samples, across, seed=seed, trials=trials, features=features)
    groups = start
    objections: list[Objection] = []
    waiting = proposals.by_support()
    known: list[list[Tie]] = []
    while waiting:
        batch, waiting = waiting[:_BATCH], waiting[_BATCH:]
        known += refine_ties(samples, proposals, batch, rules)
        # from the start each time: a pair seen later may show that an earlier one was not as good as it looked
        limited = replace(rules, most_excess=excess_limit([found[0].pair for found in known if found], rules))
        groups, objections = grow(samples, known, limited, start)
        waiting = [(i, j) for i, j in waiting if groups.group[i] != groups.group[j]]
    return groups, [found[0] for found in known if found], objections


def excess_limit(pairs: Sequence[Pair], rules: Rules) -> float:
    """How many times what noise explains a residual may be, learnt from the best pairs: scans of one scanner err alike, so a pair that
    fits twice as badly as the best is a smooth surface at a wrong place."""
    best = [p.excess for p in pairs if p.accepted and p.consistency >= _CLEAR]
    return min(rules.most_excess, max(_WORSE * min(best), _WORSE)) if best else rules.most_excess


def _distinct(ties: list[Tie], probe: FloatArray, size_mm: float) -> list[Tie]:
    """Best first, motions that ended in the same place once; the first knows its strongest rival."""
    ordered = sorted(ties, key=lambda t: -t.score)
    kept: list[Tie] = []
    for tie in ordered:
        place = rigid.move_points(tie.a_from_b, probe)
        others = (rigid.move_points(k.a_from_b, probe) for k in kept)
        if all(np.sqrt(((place - o) ** 2).sum(axis=1).mean()) > 0.5 * SAME * size_mm for o in others):
            kept.append(tie)
    if len(kept) > 1 and kept[0].score > 0:
        best, rivals = kept[0], [t.score for t in kept[1:] if t.pair.intruding <= 2 * max(kept[0].pair.intruding, 0.01)]
        if rivals:
            kept[0] = Tie(best.a, best.b, best.a_from_b, best.pair, max(rivals) / best.score)
    return kept


def grow(
    samples: Sequence[Samples], ties: Sequence[Sequence[Tie]], rules: Rules, start: Groups
) -> tuple[Groups, list[Objection]]:
    """Join groups by the best ties, and say of those accepted but not taken why.

    A tie must be accepted by the rules, have no rival, leave no motion free, and bring no two scans into contradiction."""
    groups = Groups(list(start.group), [p.copy() for p in start.pose])
    looks = [s.spread(_LOOK) for s in samples]
    objections: list[Objection] = []
    for tie in sorted((t[0] for t in ties if t), key=lambda t: -t.score):
        if objection_to(tie.pair, rules) or groups.group[tie.a] == groups.group[tie.b]:
            continue
        if tie.ambiguous:
            reason = (
                f"two different motions agree about equally well (the second with {100 * (tie.rival or 0):.0f} % of the first)"
            )
            objections.append(Objection(tie.a, tie.b, reason))
            continue
        left = groups.group[tie.a]
        mine, theirs = groups.members(left), groups.members(groups.group[tie.b])
        # the motion that takes b's whole group into a's
        carry = groups.pose[tie.a] @ tie.a_from_b @ rigid.inverse(groups.pose[tie.b])
        moved = {k: carry @ groups.pose[k] for k in theirs}
        objection = _contradiction(samples, looks, groups.pose, moved, mine, rules, tie)
        if objection is not None:
            objections.append(objection)
            continue
        for k, pose in moved.items():
            groups.group[k], groups.pose[k] = left, rigid.checked(pose)
    return groups, [o for o in objections if groups.group[o.a] != groups.group[o.b]]


def _contradiction(samples, looks, poses, moved, mine, rules, tie) -> Objection | None:
    """Why two groups cannot stand like this: an intrusion between any two of their scans, or an overlap that leaves motions free."""
    points, normals, noise = [], [], 0.0
    for i in mine:
        for j, pose in moved.items():
            pair, of_i, _ = judge_pair(samples[i], samples[j], poses[i], pose, rules, (looks[i], looks[j]))
            if pair.intruding > rules.most_intruding:
                return Objection(tie.a, tie.b, f"then {pair.a} and {pair.b} would contradict each other: {pair.reason}")
            if pair.accepted:
                points.append(rigid.move_points(poses[i], looks[i][0][of_i.agrees]))
                normals.append(rigid.move_directions(poses[i], looks[i][1][of_i.agrees]))
                noise = max(noise, samples[i].normal_noise, samples[j].normal_noise)
    if not points:
        return Objection(tie.a, tie.b, "their overlap did not hold when looked at again")
    free = free_motions(np.concatenate(points), np.concatenate(normals), noise)
    return Objection(tie.a, tie.b, f"the overlap leaves free: {'; '.join(free)}", free) if free else None
