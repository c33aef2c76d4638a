"""The fit: several starts on a few thousand pixels, then all pixels, with outliers weighed down, and what can be said of the result.

    1. a few thousand pixels, spread over place and brightness, are fitted by `scipy.optimize.least_squares` (trust region, Huber's loss) from
       every start; strengths of a start are the best for its lengths (non-negative least squares, they enter linearly);
    2. the best is polished on all pixels by reweighted Gauss-Newton steps (Huber 1964; pixels beyond OUTLIER noises are left out);
    3. the covariance is Huber's sandwich; combinations that the pictures do not fix are stated instead of numbers (identify.py).

A saturated pixel says only that the light was at least so much: it has no residual where the model says so too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.errors import SceneError
from rangecheck.recover.identify import Determination, determine
from rangecheck.recover.problem import LEAST_LOBE, LENGTHS, STRENGTHS, Guess, Parameter, Photograph, Problem

#: Huber's bend and the limit beyond which a pixel counts as an outlier, in standard deviations of its noise
BEND, OUTLIER = 2.5, 6.0
#: standard deviations on either side of a 95 % interval
TWO_SIDED_95 = 1.959963984540054
#: starts: widths of the lobes (rms slope of the rough limit) and roughness (2 pi sigma/lambda)^2
_START_WIDTHS, _START_ROUGHNESS = (0.03, 0.08, 0.2, 0.5), (0.03, 0.6, 10.0)
_POLISH, _SETTLED, _LITTLE = 25, 0.03, 0.01
#: how much more (minus log likelihood) an end on a few pixels may cost to be tried on all, and one on all to count as good as the best
_RIVAL, _AS_GOOD = 12.0, 2.0
#: pixels on which rivals are told apart before all are used
_SEVERAL = 16000


@dataclass(frozen=True, eq=False)
class Estimate:
    """One parameter: value in its own unit (lengths and strengths as such), its 95 % interval, or None where it is not determined."""

    name: str
    value: float
    low: float | None
    high: float | None
    at_bound: bool = False


@dataclass(frozen=True, eq=False)
class Fitted:
    """The outcome of a fit.

    problem     with its state at the best parameters;  theta (p,) those, as `Problem.parameters` of `started` counts them
    estimates   one for each parameter;  determination: covariance and what is not determined
    scale       residuals' robust standard deviation in units of the stated noise: 1 where the model explains the pictures
    rms         of the residuals that were kept, parts of full scale;  outliers: share of the pixels left out
    cost        robust minus log likelihood, up to a constant
    converged   whether the last step was small beside the intervals;  evaluations of the model on all pixels
    """

    started: Problem
    problem: Problem
    theta: FloatArray
    parameters: list[Parameter]
    estimates: list[Estimate]
    determination: Determination
    scale: float
    rms: float
    outliers: float
    cost: float
    converged: bool
    evaluations: int

    @property
    def statements(self) -> tuple[str, ...]:
        """What the pictures cannot determine."""
        return self.determination.statements

    def estimate(self, name: str) -> Estimate:
        """The estimate of one parameter by name. Raises SceneError where it was not fitted."""
        for estimate in self.estimates:
            if estimate.name == name:
                return estimate
        raise SceneError(f"{name} was not fitted; there are {', '.join(e.name for e in self.estimates)}")


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
    parameters = problem.parameters()
    count = sum(len(photo.sight) for photo in problem.photographs)
    if not parameters:
        raise SceneError("nothing is unknown; name at least one number to fit")
    if count < len(parameters):
        raise SceneError(f"{count} pixels cannot determine {len(parameters)} numbers; give larger pictures or fewer unknowns")
    few = _thin(problem, pixels)
    given = [few, *(replace(few, lights=s.lights, material=s.material) for s in starts or [])]
    begun = [_cheapest(family) for family in [given, *_families(few)]]
    found = sorted((_solve(start, parameters) for start in begun), key=lambda pair: pair[1])
    near = [state for state, cost in found if cost < found[0][1] + _RIVAL]
    if count > 4 * _SEVERAL:
        # with many pixels most rivals can be told apart by some of them
        thinned = _thin(problem, _SEVERAL)
        ends = [polish(_whole(thinned, state), known_noise=known_noise) for state in _distinct(near, finalists)]
        lowest = min(f.cost for f in ends)
        near = [f.problem for f in ends if f.cost < lowest + _RIVAL]
    ended = [polish(_whole(problem, state), known_noise=known_noise) for state in _distinct(near, finalists)]
    best = min(ended, key=lambda f: f.cost)
    others = [f for f in ended if f is not best and f.cost < best.cost + _AS_GOOD and _elsewhere(f, best)]
    return _with_rivals(best, others) if others else best


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


def _elsewhere(one: Fitted, other: Fitted) -> bool:
    """Whether two ends of fits are further apart than their intervals."""
    a, b = one.problem.material, other.problem.material
    return abs(math.log(a.sigma_um / b.sigma_um)) + abs(math.log(a.correlation_um / b.correlation_um)) > 0.2


def _in_short(fitted: Fitted) -> str:
    m = fitted.problem.material
    return f"sigma {m.sigma_um:.3g} um, T {m.correlation_um:.3g} um, K_lm {m.K_lm:.3g}, K_lobe {m.K_lobe:.3g}"


def _states_of(problem: Problem, state: Problem) -> tuple[Photograph, ...]:
    return tuple(
        replace(photo, exposure=s.exposure, ambient=s.ambient) for photo, s in zip(problem.photographs, state.photographs)
    )


def _distinct(begun: list[Problem], count: int) -> list[Problem]:
    """The best starts, no two with nearly the same material and lights."""
    chosen: list[Problem] = []
    for p in begun:
        key = (round(math.log(p.material.sigma_um), 1), round(math.log(p.material.correlation_um), 1))
        if all(key != (round(math.log(c.material.sigma_um), 1), round(math.log(c.material.correlation_um), 1)) for c in chosen):
            chosen.append(p)
        if len(chosen) == count:
            break
    return chosen


def _thin(problem: Problem, pixels: int) -> Problem:
    """The problem with about `pixels` pixels of all pictures together."""
    each = pixels // len(problem.photographs)
    return replace(problem, photographs=tuple(_thinned(photo, each) for photo in problem.photographs))


def _thinned(photo: Photograph, count: int) -> Photograph:
    """About `count` pixels: half spread over the picture, half over its brightest tenth, where highlights are.

    Bright is judged by the surroundings of a pixel without itself: chosen by their own noise, the bright would be too bright."""
    from scipy.ndimage import uniform_filter

    n = len(photo.sight)
    if n <= count:
        return photo
    every = np.arange(0, n, max(1, 2 * n // count))
    seen = photo.sight.spread(np.ones(n), 0.0)
    light = photo.sight.spread(photo.values, 0.0)
    ring = uniform_filter(light, 5) * 25.0 - light
    members = uniform_filter(seen, 5) * 25.0 - seen
    around = (ring / np.maximum(members, 0.5)).reshape(-1)[photo.sight.pixel]
    order = np.argsort(around, kind="stable")[-max(1, n // 10) :]
    bright = np.sort(order)[:: max(1, 2 * len(order) // count)]
    return photo.only(np.unique(np.concatenate([every, bright])))


def _families(problem: Problem) -> list[list[Problem]]:
    """Starts where lengths are unknown: smooth, intermediate and rough surfaces, of which pictures can often not tell one from another
    without having tried it; in each family the widths of the lobe differ."""
    guess, wave = problem.material, problem.material.wavelength_um
    names = set(LENGTHS) & set(problem.unknowns.material)
    families = []
    for roughness in _START_ROUGHNESS if names else ():
        family = []
        for width in _START_WIDTHS:
            # one order spreads by lambda/(2 pi T), and of about 4 roughness orders the rough limit's 2 sigma/T remains
            correlation = math.sqrt(max(1.0, 4.0 * roughness)) * wave / (2.0 * math.pi * width)
            lengths = {"sigma_um": math.sqrt(roughness) * wave / (2.0 * math.pi), "correlation_um": max(correlation, 0.6 * wave)}
            family.append(replace(problem, material=_with(guess, {n: v for n, v in lengths.items() if n in names})))
        families.append(family)
    return families


def _cheapest(family: list[Problem]) -> Problem:
    """The best of some starts, each with its best strengths."""
    ready = [with_best_strengths(p) for p in family]
    return min(ready, key=lambda p: _cost(p, p.start()))


def _with(guess: Guess, numbers: dict[str, float]) -> Guess:
    return replace(guess, **numbers)  # type: ignore[arg-type]


def with_best_strengths(problem: Problem) -> Problem:
    """The same state with those unknown strengths that fit the pictures best, all else held; they enter linearly."""
    from scipy.optimize import nnls

    names = [name for name in STRENGTHS if name in problem.unknowns.material]
    if not names:
        return problem
    alone = replace(problem, unknowns=replace(problem.unknowns, material=STRENGTHS, direction=False, irradiance=False, distance=False,
                                              radius=False, exposure=False, ambient=False, pose=False))  # fmt: skip
    columns, rest = [], []
    held = np.array([0.0 if name in names else getattr(problem.material, name) for name in STRENGTHS])
    for k, photo in enumerate(problem.photographs):
        slopes = alone.predict(alone.start(), k).slopes
        slopes[:, STRENGTHS.index("K_lobe")] /= max(problem.material.K_lobe, LEAST_LOBE)
        used = photo.values < photo.saturation
        columns.append((slopes[:, [STRENGTHS.index(name) for name in names]] / photo.noise[:, None])[used])
        rest.append(((photo.values - photo.ambient - slopes @ held) / photo.noise)[used])
    best, _ = nnls(np.concatenate(columns), np.concatenate(rest))
    return replace(problem, material=_with(problem.material, {n: max(float(b), LEAST_LOBE) for n, b in zip(names, best)}))


def residuals(problem: Problem, theta: FloatArray, which: int, *, slopes: bool = True) -> tuple[FloatArray, FloatArray]:
    """(predicted - measured) / noise of one picture, and its derivatives; both 0 where picture and model are saturated."""
    photo = problem.photographs[which]
    shown = problem.predict(theta, which, slopes=slopes)
    over = shown.values > photo.saturation
    residual = (np.minimum(shown.values, photo.saturation) - photo.values) / photo.noise
    jacobian = shown.slopes / photo.noise[:, None]
    jacobian[over] = 0.0
    residual[over & (photo.values >= photo.saturation)] = 0.0
    return residual, jacobian


def _cost(problem: Problem, theta: FloatArray) -> float:
    total = 0.0
    for k in range(len(problem.photographs)):
        r = np.abs(residuals(problem, theta, k, slopes=False)[0])
        total += float(np.where(r < BEND, 0.5 * r * r, BEND * r - 0.5 * BEND**2).sum())
    return total


def _solve(problem: Problem, parameters: list[Parameter]) -> tuple[Problem, float]:
    """The best state from one start, on the pixels that `problem` holds, and its cost."""
    from scipy.optimize import least_squares

    low, high = np.array([p.low for p in problem.parameters()]), np.array([p.high for p in problem.parameters()])
    start = np.clip(problem.start(), low + 1e-4, high - 1e-9)
    memory: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def both(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        key = theta.tobytes()
        if key not in memory:
            memory.clear()
            parts = [residuals(problem, theta, k) for k in range(len(problem.photographs))]
            memory[key] = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
        return memory[key]

    found = least_squares(
        lambda t: both(t)[0], start, lambda t: both(t)[1], bounds=(low, high), loss="huber", f_scale=BEND,
        x_scale=np.array([p.unit for p in parameters]), max_nfev=40, ftol=1e-6, xtol=1e-6, gtol=1e-6,
    )  # fmt: skip
    state, poses = problem.at(found.x)
    return moved_sights(state, poses), float(found.cost)


def moved_sights(state: Problem, poses: FloatArray) -> Problem:
    """The state with each picture's sight moved by its pose's small turn and shift (first order)."""
    photographs = []
    for photo, pose in zip(state.photographs, poses):
        if pose.any():
            sight = photo.sight
            moved = sight.by_pose @ pose
            normals, views = sight.normals + moved[:, 1], sight.views + moved[:, 2]
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            views /= np.linalg.norm(views, axis=1, keepdims=True)
            photo = replace(photo, sight=replace(sight, points=sight.points + moved[:, 0], normals=normals, views=views))
        photographs.append(photo)
    return replace(state, photographs=tuple(photographs))


def polish(problem: Problem, *, known_noise: bool = True) -> Fitted:
    """Reweighted Gauss-Newton steps on all pixels from the problem's state, and the statistics of where they end."""
    parameters = problem.parameters()
    low, high = np.array([p.low for p in parameters]), np.array([p.high for p in parameters])
    theta = np.clip(problem.start(), low, high)
    free = np.ones(len(parameters), bool)
    converged, damping = False, 0.0
    normal, score, meat, cost, facts = _accumulate(problem, theta)
    evaluations = 1
    for _ in range(_POLISH):
        free = ~(((theta <= low) & (score > 0.0)) | ((theta >= high) & (score < 0.0)))
        step, spread = _step(normal, score, free, parameters, damping)
        moved = np.clip(theta + step, low, high)
        trial = _accumulate(problem, moved)
        evaluations += 1
        if trial[3] > cost * (1.0 + 1e-12) + 1e-9:
            damping = max(10.0 * damping, 1e-3)
            if damping > 1e6:
                break
            continue
        # along what the pictures do not fix there is no end to walk to: little gained is the end too
        small = bool((np.abs(moved - theta)[free] < _SETTLED * spread[free]).all()) or cost - trial[3] < _LITTLE
        theta, damping = moved, 0.1 * damping if damping > 1e-6 else 0.0
        normal, score, meat, cost, facts = trial
        if small:
            converged = True
            break
    scale, rms, outliers = facts
    free = ~(((theta <= low) & (score > 0.0)) | ((theta >= high) & (score < 0.0)))
    widen = 1.0 if known_noise else max(1.0, scale) ** 2
    chosen = [p for p, f in zip(parameters, free) if f]
    determination = determine(normal[np.ix_(free, free)], meat[np.ix_(free, free)], chosen)
    covariance = np.zeros((len(parameters), len(parameters)))
    covariance[np.ix_(free, free)] = determination.covariance * widen
    known = np.zeros(len(parameters), bool)
    known[free] = determination.determined
    estimates = [_estimate(problem, p, float(t), float(c), bool(k), bool(f)) for p, t, c, k, f in zip(
        parameters, theta, np.sqrt(np.diag(covariance)), known, free)]  # fmt: skip
    state, poses = problem.at(theta)
    whole = determination._replace(covariance=covariance, determined=known)
    return Fitted(
        problem,
        moved_sights(state, poses),
        theta,
        parameters,
        estimates,
        whole,
        scale,
        rms,
        outliers,
        cost,
        converged,
        evaluations,
    )


def _step(
    normal: FloatArray, score: FloatArray, free: BoolArray, parameters: list[Parameter], damping: float
) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton step in the free parameters, kept within a unit each, and their standard deviations."""
    units = np.array([p.unit for p in parameters])
    scaled = (normal * units[:, None] * units[None, :])[np.ix_(free, free)]
    # a prior of ten units keeps combinations that nothing fixes where they are
    scaled = scaled + np.eye(len(scaled)) * 0.01 + np.diag(np.diag(scaled)) * damping
    step, spread = np.zeros(len(units)), np.full(len(units), np.inf)
    solved = np.linalg.solve(scaled, -(score * units)[free])
    step[free] = np.clip(solved, -1.0, 1.0) * units[free]
    spread[free] = np.sqrt(np.maximum(np.diag(np.linalg.inv(scaled)), 0.0)) * units[free]
    return step, spread


def _accumulate(
    problem: Problem, theta: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, float, tuple[float, float, float]]:
    """Information matrix, score, scatter of the score, cost, and (scale, rms, outliers) over all pictures at `theta`."""
    p = len(theta)
    normal, meat, score = np.zeros((p, p)), np.zeros((p, p)), np.zeros(p)
    cost, outliers, count, squares = 0.0, 0, 0, 0.0
    sizes = []
    for k, photo in enumerate(problem.photographs):
        r, jacobian = residuals(problem, theta, k)
        size = np.abs(r)
        inside, linear = size < OUTLIER, size < BEND
        psi = np.where(inside, np.clip(r, -BEND, BEND), 0.0)
        bent = jacobian * linear[:, None]
        normal += bent.T @ jacobian
        weighed = jacobian * psi[:, None]
        meat += weighed.T @ weighed
        score += jacobian.T @ psi
        capped = np.minimum(size, OUTLIER)
        cost += float(np.where(linear, 0.5 * r * r, BEND * capped - 0.5 * BEND**2).sum())
        outliers += int((~inside).sum())
        count += len(r)
        squares += float(((r * photo.noise)[inside] ** 2).sum())
        sizes.append(size)
    scale = float(np.median(np.concatenate(sizes)) / 0.6744897501960817)
    rms = math.sqrt(squares / max(1, count - outliers))
    return normal, score, meat, cost, (scale, rms, outliers / max(1, count))


def _estimate(problem: Problem, p: Parameter, theta: float, spread: float, known: bool, free: bool) -> Estimate:
    """A parameter in its own unit with its interval."""
    reach = TWO_SIDED_95 * spread
    if p.kind in ("length", "log strength", "irradiance", "distance", "radius", "exposure"):
        base = {
            "length": lambda: getattr(problem.material, p.name), "log strength": lambda: max(problem.material.K_lobe, LEAST_LOBE), "irradiance": lambda: problem.lights[p.owner].irradiance,
            "distance": lambda: problem.lights[p.owner].distance_mm, "radius": lambda: problem.lights[p.owner].angular_radius_deg,
            "exposure": lambda: problem.photographs[p.owner].exposure,
        }[p.kind]()  # fmt: skip
        value = base * math.exp(theta)
        interval = (value * math.exp(-reach), value * math.exp(reach))
    else:
        value, interval = theta, (theta - reach, theta + reach)
    if not known:
        return Estimate(p.name, value, None, None, not free)
    return Estimate(p.name, value, *interval, not free)
