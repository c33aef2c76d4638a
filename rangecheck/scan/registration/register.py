"""`register`: scans brought onto each other, and a verdict on every one of them.

The way: poses from a guess (given, a turntable's, or none), all pairs together by point-to-plane, every pair judged, and what
cannot be defended refused, with the reason, at the pose it came with. Numbers that rule the verdict are arguments, so that a study
can move them. World frame, millimetres. One scan keeps its pose, and the others are moved to it: the first of those whose given
poses held together, or the first of all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rangecheck import rigid
from rangecheck.arrays import FloatArray, require
from rangecheck.errors import ScanError, SettingError
from rangecheck.kernels import in_chunks
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.registration.coarse import FEATURES, TRIALS, Groups, Objection, join_without_guess, levels_for, size_of
from rangecheck.scan.registration.decide import Decision, aligned_state, decide, refused_state
from rangecheck.scan.registration.evidence import Pair, Rules
from rangecheck.scan.registration.joint import FINE_WINDOW_CELLS, LEVELS, align_jointly, pose_errors_mm
from rangecheck.scan.registration.result import Guess, Registration, ScanState
from rangecheck.scan.registration.samples import ENOUGH_POINTS, Samples, samples_of
from rangecheck.scan.registration.turntable import Turntable, departure_mm, find_turntable

#: pull of a turntable on its scans, as a share of their weight: below what a well-shaped overlap says, above what noise says
_HOLD = 2e-3
#: what a pair found without a guess must show, having been picked from many: overlap, consistency, excess over noise
_OVERLAP_WITHOUT_GUESS, _CONSISTENCY_WITHOUT_GUESS, _EXCESS_WITHOUT_GUESS = 0.2, 0.85, 5.0


def register(
    scans: Sequence[RangeScan],
    *,
    guess: Guess = "poses",
    seed: int = 0,
    reach_mm: float | None = None,
    rescue: bool = True,
    angles_deg: npt.ArrayLike | None = None,
    axis_direction: npt.ArrayLike | None = None,
    axis_point_mm: npt.ArrayLike | None = None,
    least_overlap: float = 0.08,
    least_consistency: float = 0.7,
    most_intruding: float = 0.03,
    agree_mm: float | None = None,
    most_excess: float = 8.0,
    most_pose_error_mm: float | None = None,
    enough_points: int = ENOUGH_POINTS,
    features: int = FEATURES,
    trials: int = TRIALS,
) -> Registration:
    """Bring `scans` onto each other and say of each whether its pose can be relied on.

    guess       "poses": the scans' own poses are nearly right; "turntable": they were taken in order around one axis by a scanner that
                stayed, at the first scan's pose; "none": nothing is known
    seed        of the trials without a guess; the same seed gives the same bytes on any number of threads
    reach_mm    how far points may be from where they belong under the poses given; without it a quarter of the object's size
    rescue      look for scans whose guess was wrong as if there were none
    angles_deg  turntable: angle of each scan (n,), without it equal steps of a full turn; their sense is found
    axis_direction, axis_point_mm  turntable: in the world, without them the picture's upward direction, and searched for
    least_overlap, least_consistency, most_intruding, agree_mm, most_excess  see `Rules`; without a guess overlap must be at least 0.2, consistency 0.85, and excess at most 5
    most_pose_error_mm  expected error beyond which a pose is refused; without it a quarter of the scan's sample spacing, or three times
                what noise leaves in its smoothed points if that is more; a turntable's own poses are not held to it
    enough_points  points per scan beyond which its grid is thinned
    features, trials  of the search without a guess: points described per scan, motions tried per pair

    Raises ScanError when there is no scan or one has no surface; SettingError for a setting out of its range. A pose that
    cannot be defended is no error but a state: see `Registration.states`."""
    rules = Rules(least_overlap, least_consistency, most_intruding, agree_mm, most_excess)
    _check(scans, guess, rules, reach_mm, features, trials, enough_points, most_pose_error_mm)
    n = len(scans)
    samples: list[Samples] = in_chunks(lambda i, _: samples_of(scans[i], enough=enough_points), n, 1)
    given = [np.array(s.world_from_scan, dtype=float) for s in scans]
    if n == 1:
        alone = ScanState(scans[0].name, True, "", 0.0, 0.0, math.nan, math.nan, 0.0, 0.0)
        return Registration(list(scans), (alone,), (), "aligned", None, guess, seed, 0)

    size = float(np.median([size_of(s) for s in samples]))
    table: Turntable | None = None
    tried: list[Pair] = []
    remarks: list[str] = []
    objections: list[Objection] = []
    iterations, hold = 0, 0.0
    if guess == "none":
        groups = Groups(list(range(n)), [np.eye(4) for _ in range(n)])
    else:
        start, reach = given, reach_mm if reach_mm is not None else 0.25 * size
        if guess == "turntable":
            table = _turntable(samples, given[0], rules, angles_deg, axis_direction, axis_point_mm)
            start, reach = table.poses(given[0]), 0.1 * size
        hold = _HOLD if guess == "turntable" else 0.0
        levels = levels_for(samples, reach)
        result = align_jointly(samples, start, levels=levels, hold=hold)
        iterations = result.iterations
        decision = decide(samples, result.poses, rules, held=hold > 0)
        if len(decision.largest()) < n:
            # a scan at a wrong place pulls others with it: once more without the pairs that contradict each other
            peaceful = [
                q for p, (pair, *_) in decision.judged.items() if pair.intruding <= rules.most_intruding for q in (p, p[::-1])
            ]
            again = align_jointly(samples, start, levels=levels, hold=hold, pairs=peaceful)
            iterations += again.iterations
            second = decide(samples, again.poses, rules, held=hold > 0)
            if len(second.largest()) > len(decision.largest()):
                result, decision = again, second
        groups = Groups(decision.group, result.poses)
        tried = [pair for pair, *_ in decision.judged.values()]
        objections = [Objection(i, j, f"the overlap leaves free: {'; '.join(m)}", m) for (i, j), m in decision.free.items()]
    held = groups.largest()
    anchor = held[0] if len(held) > 1 else None
    if len(held) < n and (guess == "none" or rescue):
        strict = replace(
            rules,
            least_overlap=max(rules.least_overlap, _OVERLAP_WITHOUT_GUESS),
            least_consistency=max(rules.least_consistency, _CONSISTENCY_WITHOUT_GUESS),
            most_excess=min(rules.most_excess, _EXCESS_WITHOUT_GUESS),
        )
        groups, ties, more_objections = join_without_guess(samples, groups, strict, seed=seed, trials=trials, features=features)
        tried += [tie.pair for tie in ties]
        objections += more_objections
    settled = decision if guess != "none" and len(held) == n else None
    # a turntable's poses that held to the last scan need no other support; those found without it do
    hold = hold if len(held) == n else 0.0
    unsure: dict[int, str] = {}
    while True:
        main, poses, decided, more = _settle(samples, groups, rules, hold, settled)
        iterations += more
        errors = dict.fromkeys(main, math.nan)
        if decided is None or hold > 0:
            break
        kept = anchor if anchor in main else main[0]
        local = [samples[k] for k in main]
        errors = dict(zip(main, pose_errors_mm(local, [poses[k] for k in main], main.index(kept))))
        limits = {k: _allowed_error(samples[k], most_pose_error_mm) for k in main}
        loose = [k for k in main if errors[k] > limits[k]]
        if not loose:
            break
        for k in loose:
            unsure[k] = (
                f"its overlaps determine its pose only to {errors[k]:.2f} mm (one standard deviation; at most {limits[k]:.2f})"
            )
        groups = Groups(
            [n + k if k in loose else g for k, g in enumerate(groups.group)], [poses.get(k, p) for k, p in enumerate(groups.pose)]
        )
        settled = None
    anchor = anchor if anchor in main else main[0]
    if decided is not None:
        finer = _polished(scans, samples, main, poses, rules, hold, enough_points)
        if finer is not None:
            fine, poses, decided, more = finer
            iterations += more
            if hold == 0:
                known = pose_errors_mm(fine, [poses[k] for k in main], main.index(anchor), window_cells=FINE_WINDOW_CELLS)
                errors = dict(zip(main, known))
    back = given[anchor] @ rigid.inverse(poses[anchor])
    poses = {k: rigid.checked(back @ pose) for k, pose in poses.items()}

    states = []
    for k in range(n):
        if decided is not None and k in main:
            note = "" if guess == "none" or k in held else "its guess did not hold; its pose was found without one"
            states.append(aligned_state(main.index(k), [samples[m] for m in main], decided, given[k], poses[k], note, errors[k]))
        else:
            text = unsure.get(k, "")
            motions: tuple[str, ...] = ()
            for o in objections:
                if k in (o.a, o.b) and not text:
                    text, motions = f"with {scans[o.b if o.a == k else o.a].name}, {o.reason}", o.free
                    break
            states.append(refused_state(scans[k].name, _best_of(scans[k].name, tried), text, motions))
    if table is not None and decided is not None and len(main) == n:
        table = replace(table, departure_mm=departure_mm(table, samples, [poses[k] for k in range(n)]))
    elif table is not None:
        remarks.append("turntable: not all scans hang together, so its axis and step are not reported")
        table = None
    pairs = [pair for pair, *_ in decided.judged.values() if pair.overlap > 0] if decided is not None else []
    for s in states:
        if not s.aligned and (best := _best_of(s.name, tried)) is not None:
            pairs.append(replace(best, accepted=False, reason=best.reason or s.reason))
    verdict = "refused" if decided is None else "aligned" if len(main) == n else "partial"
    moved = [scan.moved(poses[k]) if states[k].aligned else scan for k, scan in enumerate(scans)]
    return Registration(moved, tuple(states), tuple(pairs), verdict, table, guess, seed, iterations, tuple(remarks))  # type: ignore[arg-type]


def _settle(
    samples: Sequence[Samples], groups: Groups, rules: Rules, hold: float, settled: Decision | None
) -> tuple[list[int], dict[int, FloatArray], Decision | None, int]:
    """The largest group aligned once more without the others, which may have pulled at it, and judged again, until it stays whole.

    settled  the decision on all scans, if they hang together already and nothing pulled at them

    Members, their poses, the decision on them (None when no two scans hang together), iterations."""
    main, poses = groups.largest(), dict(enumerate(groups.pose))
    if settled is not None:
        return main, poses, settled, 0
    total = 0
    while len(main) > 1:
        local = [samples[k] for k in main]
        spacing = float(np.median([s.spacing_mm for s in local]))
        result = align_jointly(local, [poses[k] for k in main], levels=levels_for(local, 6 * spacing), hold=hold)
        total += result.iterations
        poses = dict(zip(main, result.poses))
        decision = decide(local, result.poses, rules, held=hold > 0)
        whole = [main[k] for k in decision.largest()]
        if len(whole) == len(main):
            return main, poses, decision, total
        main = whole
    return main, {main[0]: groups.pose[main[0]]}, None, total


def _polished(
    scans: Sequence[RangeScan], samples: Sequence[Samples], main: list[int], poses: dict[int, FloatArray],
    rules: Rules, hold: float, enough: int,
) -> tuple[list[Samples], dict[int, FloatArray], Decision, int] | None:  # fmt: skip
    """The members `main` aligned once more by points smoothed as little as their noise allows: those points, poses, the decision on them,
    iterations; None where they do not stay whole.

    What a wide window smooths away is another thing in every view, as each sees other sides of ridges: on finely modelled surfaces poses lean
    on it by a quarter of the sample spacing, all around a ring."""
    fine: list[Samples] = in_chunks(lambda i, _: samples_of(scans[main[i]], enough=enough, fine=True), len(main), 1)
    result = align_jointly(fine, [poses[k] for k in main], levels=(LEVELS[-1],), hold=hold)
    second = decide([samples[k] for k in main], result.poses, rules, held=hold > 0)
    if len(second.largest()) < len(main):
        return None
    return fine, poses | dict(zip(main, result.poses)), second, result.iterations


def _allowed_error(samples: Samples, most_mm: float | None) -> float:
    return most_mm if most_mm is not None else max(0.25 * samples.spacing_mm, 3 * samples.smooth_mm)


def _best_of(name: str, tried: Sequence[Pair]) -> Pair | None:
    """The pair of a scan that comes nearest to being accepted."""
    mine = [p for p in tried if name in (p.a, p.b)]
    return max(mine, key=lambda p: (p.accepted, p.evidence), default=None)


def _turntable(samples, world_from_first, rules, angles_deg, axis_direction, axis_point_mm) -> Turntable:
    n = len(samples)
    angles = np.arange(n) * (360.0 / n) if angles_deg is None else require("angles_deg", angles_deg, (n,), finite=True)
    direction = None if axis_direction is None else require("axis_direction", axis_direction, (3,), finite=True)
    if direction is not None and not np.linalg.norm(direction) > 0:
        raise SettingError("axis_direction has length 0; a turntable turns about a direction", key="axis_direction")
    point = None if axis_point_mm is None else require("axis_point_mm", axis_point_mm, (3,), finite=True)
    return find_turntable(
        samples, world_from_first, np.radians(angles - angles[0]), rules, axis_direction=direction, axis_point_mm=point
    )


def _check(scans, guess, rules: Rules, reach_mm, features, trials, enough_points, most_pose_error_mm) -> None:
    if not scans:
        raise ScanError("there are no scans to register; give at least one")
    names = [s.name for s in scans]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ScanError(f"{len(twice)} names are given to several scans, the first is {twice[0]!r}; name each scan differently")
    if guess not in ("poses", "turntable", "none"):
        raise SettingError(f"guess is {guess!r}; it must be poses, turntable or none", key="guess")
    for key, value, low, high in (
        ("least_overlap", rules.least_overlap, 0.0, 1.0),
        ("least_consistency", rules.least_consistency, 0.0, 1.0),
        ("most_intruding", rules.most_intruding, 0.0, 1.0),
        ("most_excess", rules.most_excess, 0.0, math.inf),
        ("agree_mm", rules.agree_mm, 0.0, math.inf),
        ("most_pose_error_mm", most_pose_error_mm, 0.0, math.inf),
        ("reach_mm", reach_mm, 0.0, math.inf),
        ("features", features, 50, 20_000),
        ("trials", trials, 1, 10_000_000),
        ("enough_points", enough_points, 500, math.inf),
    ):
        if value is not None and not low <= value <= high:
            raise SettingError(f"{key} is {value}; it must lie between {low:g} and {high:g}", key=key, value=value)
