"""The fit: several starts on a few thousand pixels, then all pixels, with outliers weighed down, and what can be said of the result.

1. a few thousand pixels, spread over place and brightness, are fitted by `scipy.optimize.least_squares` (trust region, Huber's loss) from
   every start; strengths of a start are the best for its lengths (non-negative least squares, they enter linearly);
2. the best is polished on all pixels by reweighted Gauss-Newton steps (Huber 1964; pixels beyond OUTLIER noises are left out);
3. the covariance is Huber's sandwich; combinations that the pictures do not fix are stated instead of numbers (identify.py);
4. numbers whose trade is a curved valley get their intervals from their profiles (intervals.py), joined over ends that explain the pictures as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rangecheck.errors import SceneError
from rangecheck.recover.intervals import profiled
from rangecheck.recover.polish import TWO_SIDED_95, Estimate, Fitted, polish
from rangecheck.recover.problem import LENGTHS, Photograph, Problem
from rangecheck.recover.residuals import robust_cost, undarkened
from rangecheck.recover.spots import untold, without_spots
from rangecheck.recover.starts import cheapest, families, lamps, mirrors, solve, thin

__all__ = ["TWO_SIDED_95", "Estimate", "Fitted", "elsewhere", "explored", "fit", "followed", "joined", "settled"]

#: how much more (minus log likelihood) an end on a few pixels may cost to be tried on all, and one on all to count as good as the best
_RIVAL, _AS_GOOD = 12.0, 1.9208
#: starts under other lamps than those given
_OTHER_LAMPS = 4
#: how often spots are looked for: the first fit was pulled by them
_SPOTS = 3
#: pixels on which rivals are told apart before all are used
_SEVERAL = 16000


def fit(
    problem: Problem,
    *,
    starts: Sequence[Problem] | None = None,
    pixels: int = 2500,
    finalists: int = 4,
    known_noise: bool = True,
) -> Fitted:
    """Fit the problem's unknowns. `starts` are states to begin from beside those made here; `pixels` of all pictures serve the starts.

    With `known_noise` False the intervals are widened by the residuals' own scale. Raises SceneError without pixels or unknowns."""
    return settled(problem, explored(problem, starts=starts, pixels=pixels, finalists=finalists), known_noise=known_noise)


def explored(
    problem: Problem, *, starts: Sequence[Problem] | None = None, pixels: int = 2500, finalists: int = 4
) -> list[Problem]:
    """States on a few pixels where all starts end, the best first: those that could be the best on all."""
    parameters = problem.parameters()
    count = sum(len(photo.sight) for photo in problem.photographs)
    if not parameters:
        raise SceneError("nothing is unknown; name at least one number to fit")
    if count < len(parameters):
        raise SceneError(f"{count} pixels cannot determine {len(parameters)} numbers; give larger pictures or fewer unknowns")
    few = thin(problem, pixels)
    given = [few, *(replace(few, lights=s.lights, material=s.material) for s in starts or [])]
    every = [given, *families(few)]
    begun = [cheapest(family) for family in every]
    # and the most promising of the families' best under other lamps than those given
    others = [cheapest(list(alike)) for family in every for alike in list(zip(*(lamps(state) for state in family)))[1:]]
    for more in (others, mirrors(few)):
        begun += sorted(more, key=lambda state: robust_cost(state, state.start()))[:_OTHER_LAMPS]
    found = sorted((solve(start, parameters) for start in begun), key=lambda pair: pair[1])
    near = _distinct([state for state, cost in found if cost < found[0][1] + _RIVAL], finalists)
    if count > 4 * _SEVERAL:
        # with many pixels most rivals can be told apart by some of them
        near = [f.problem for f in followed(problem, near)]
    return near


def followed(problem: Problem, states: Sequence[Problem]) -> list[Fitted]:
    """Where some thousands of the problem's pixels lead from these states, the best first, without those that can no longer be the best."""
    some = undarkened(_whole(thin(problem, _SEVERAL), states[0]))
    ends = sorted((polish(_whole(some, state)) for state in states), key=lambda f: f.cost)
    return [f for f in ends if f.cost < ends[0].cost + _RIVAL]


def settled(problem: Problem, states: Sequence[Problem], *, known_noise: bool = True) -> Fitted:
    """The best end on all pixels from these states, with the intervals of all that explain the pictures as well; without spots that nothing explains."""
    problem, states = undarkened(_whole(problem, states[0])), _distinct(states, len(states))
    ended = [polish(_whole(problem, state), known_noise=known_noise) for state in states]
    silent, pixels = untold(problem), sum(len(photo.sight) for photo in problem.photographs)
    for _ in range(_SPOTS):
        spotless = without_spots(problem, min(ended, key=lambda f: f.cost))
        if spotless is None:
            break
        problem = spotless
        ended = [polish(_whole(problem, f.problem), known_noise=known_noise) for f in ended]
    found = joined(ended)
    told, spots = pixels - silent, untold(problem) - silent
    return replace(found, outliers=found.outliers * (told - spots) / max(1, told) + spots / max(1, told)) if spots else found


def joined(ended: Sequence[Fitted]) -> Fitted:
    """The best of some ends on the same pixels, with the intervals of all that explain the pictures as well."""
    best = min(ended, key=lambda f: f.cost)
    others = [f for f in ended if f is not best and f.cost < best.cost + _AS_GOOD and elsewhere(f, best)]
    known = profiled(best)
    if not others:
        return known
    return _with_rivals(known, [profiled(f, 1.0 - (f.cost - best.cost) / _AS_GOOD) for f in others])


def _with_rivals(best: Fitted, others: list[Fitted]) -> Fitted:
    """The best end, its intervals wide enough to hold those of ends elsewhere that explain the pictures as well."""
    said = f"{1 + len(others)} different answers explain the pictures equally well: " + "; ".join(
        _in_short(f) for f in [best, *others]
    )
    joined = []
    for k, estimate in enumerate(best.estimates):
        rivals = [other.estimates[k] for other in others]
        if estimate.low is not None and estimate.high is not None:
            known = [(r.low, r.high) for r in rivals if r.low is not None and r.high is not None]
            estimate = (
                replace(
                    estimate, low=min([estimate.low, *(r[0] for r in known)]), high=max([estimate.high, *(r[1] for r in known)])
                )
                if len(known) == len(rivals)
                else replace(estimate, low=None, high=None)
            )
        joined.append(estimate)
    statements = (*best.statements, said)
    return replace(best, estimates=joined, determination=best.determination._replace(statements=statements))


def _whole(problem: Problem, state: Problem) -> Problem:
    """All pixels of `problem` at the state found with a few; poses stay those of the problem, whose sights are exact."""
    return replace(problem, lights=state.lights, material=state.material, photographs=_states_of(problem, state))


def elsewhere(one: Fitted, other: Fitted) -> bool:
    """Whether two ends of fits are further apart than their intervals; numbers that neither knows, as lengths of a lobe too weak to be seen, are no
    difference."""
    open_ones = {e.name for e in one.estimates if e.low is None} & {e.name for e in other.estimates if e.low is None}
    there, here = _sizes_of(one.problem), _sizes_of(other.problem)
    if any(abs(there[name] - here[name]) > 0.1 for name in there if name not in open_ones):
        return True
    return set(LENGTHS) <= open_ones and any(_apart(a, b) for a, b in zip(one.estimates, other.estimates))


def _sizes_of(state: Problem) -> dict[str, float]:
    """Logarithms by which states count as different, by their parameters' names: of the lengths, and of the lamps' radii."""
    sizes = {name: getattr(state.material, name) for name in LENGTHS}
    sizes |= {f"light {k} radius": light.angular_radius_deg for k, light in enumerate(state.lights)}
    return {name: math.log(size) for name, size in sizes.items()}


def _apart(one: Estimate, other: Estimate) -> bool:
    """Whether neither of two stated intervals holds the other's value."""
    if one.low is None or one.high is None or other.low is None or other.high is None:
        return False
    return not (one.low <= other.value <= one.high or other.low <= one.value <= other.high)


def _in_short(fitted: Fitted) -> str:
    m = fitted.problem.material
    said = f"sigma {m.sigma_um:.3g} um, T {m.correlation_um:.3g} um, K_lm {m.K_lm:.3g}, K_lobe {m.K_lobe:.3g}"
    if not fitted.problem.unknowns.radius:
        return said
    return f"{said}, lamps of {', '.join(f'{light.angular_radius_deg:.3g}' for light in fitted.problem.lights)} degrees"


def _states_of(problem: Problem, state: Problem) -> tuple[Photograph, ...]:
    return tuple(
        replace(photo, exposure=s.exposure, ambient=s.ambient) for photo, s in zip(problem.photographs, state.photographs)
    )


def _distinct(begun: Sequence[Problem], count: int) -> list[Problem]:
    """The best starts, no two with nearly the same material and lights."""
    chosen: dict[tuple[float, ...], Problem] = {}
    for state in begun:
        chosen.setdefault(tuple(np.round(list(_sizes_of(state).values()), 1)), state)
    return list(chosen.values())[:count]
