"""Reweighted Gauss-Newton on all pixels (Huber 1964), and the statistics of where it ends.

The scatter of the score is that of the residuals as they are, each over one minus its pixel's leverage (HC3 of MacKinnon & White 1985): where a few
pixels hold a highlight the fit follows their noise, and their residuals are smaller than it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.errors import SceneError
from rangecheck.recover.identify import Determination, determine
from rangecheck.recover.problem import LEAST_LOBE, Parameter, Problem
from rangecheck.recover.residuals import BEND, OUTLIER, UNTOLD, moved_sights, residuals

#: standard deviations on either side of a 95 % interval
TWO_SIDED_95 = 1.959963984540054
_POLISH, _SETTLED, _LITTLE = 25, 0.03, 0.01
#: what is known of a combination that nothing fixes: it lies within ten units
HOLD = 0.01
#: an interval of what nothing determines ends nowhere, but numbers do
_LARGEST_LOG = 300.0
#: the least of one minus a pixel's leverage
_LEAST_LEFT = 1e-3


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


def polish(problem: Problem, *, known_noise: bool = True, steps: int = _POLISH) -> Fitted:
    """At most `steps` reweighted Gauss-Newton steps on all pixels from the problem's state, and the statistics of where they end."""
    parameters = problem.parameters()
    low, high = np.array([p.low for p in parameters]), np.array([p.high for p in parameters])
    theta = np.clip(problem.start(), low, high)
    free = np.ones(len(parameters), bool)
    converged, damping = False, 0.0
    normal, score, meat, cost, facts = accumulate(problem, theta)
    evaluations, taken = 1, 0
    for _ in range(_POLISH):
        if taken == steps:
            break
        free = ~(((theta <= low) & (score > 0.0)) | ((theta >= high) & (score < 0.0)))
        step, spread = _step(normal, score, free, parameters, damping)
        moved = np.clip(theta + step, low, high)
        trial = accumulate(problem, moved, normal)
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
        taken += 1
        if small:
            converged = True
            break
    if not taken:
        normal, score, meat, cost, facts = accumulate(problem, theta, normal)
        evaluations += 1
    scale, rms, outliers = facts
    free = ~(((theta <= low) & (score > 0.0)) | ((theta >= high) & (score < 0.0)))
    widen = 1.0 if known_noise else max(1.0, scale) ** 2
    chosen = [p for p, f in zip(parameters, free) if f]
    determination = determine(normal[np.ix_(free, free)], meat[np.ix_(free, free)], chosen)
    covariance = np.zeros((len(parameters), len(parameters)))
    covariance[np.ix_(free, free)] = determination.covariance * widen
    known = np.zeros(len(parameters), bool)
    known[free] = determination.determined
    unlobed = _without_lobe(problem, theta, normal, free)
    estimates = [estimate_of(problem, p, float(t), float(c), bool(k), bool(f), float(u)) for p, t, c, k, f, u in zip(
        parameters, theta, np.sqrt(np.diag(covariance)), known, free, unlobed)]  # fmt: skip
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
    # keeps combinations that nothing fixes where they are
    scaled = scaled + np.eye(len(scaled)) * HOLD + np.diag(np.diag(scaled)) * damping
    step, spread = np.zeros(len(units)), np.full(len(units), np.inf)
    solved = np.linalg.solve(scaled, -(score * units)[free])
    step[free] = solved / max(1.0, float(np.abs(solved).max(initial=0.0))) * units[free]
    spread[free] = np.sqrt(np.maximum(np.diag(np.linalg.inv(scaled)), 0.0)) * units[free]
    return step, spread


def accumulate(
    problem: Problem, theta: FloatArray, information: FloatArray | None = None
) -> tuple[FloatArray, FloatArray, FloatArray, float, tuple[float, float, float]]:
    """Information matrix, score, scatter of the score, cost, and (scale, rms, outliers) over all pictures at `theta`.

    information: the matrix at or near `theta`, by which pixels have leverage; without it none has."""
    p = len(theta)
    follow = None if information is None else _inverse(information, np.array([q.unit for q in problem.parameters()]))
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
        left = psi
        if follow is not None:
            leverage = np.where(linear, ((jacobian @ follow) * jacobian).sum(1), 0.0)
            left = psi / np.maximum(1.0 - leverage, _LEAST_LEFT)
        weighed = jacobian * left[:, None]
        meat += weighed.T @ weighed
        score += jacobian.T @ psi
        capped = np.minimum(size, OUTLIER)
        cost += float(np.where(linear, 0.5 * r * r, BEND * capped - 0.5 * BEND**2).sum())
        # what tells nothing, as at a terminator, says nothing of how well the others are explained either
        told = photo.noise < UNTOLD
        outliers += int((~inside & told).sum())
        count += int(told.sum())
        squares += float(((r * photo.noise)[inside & told] ** 2).sum())
        sizes.append(size[told])
    scale = float(np.median(np.concatenate(sizes)) / 0.6744897501960817) if count else 0.0
    rms = math.sqrt(squares / max(1, count - outliers))
    return normal, score, meat, cost, (scale, rms, outliers / max(1, count))


def _inverse(information: FloatArray, units: FloatArray) -> FloatArray:
    """(p, p) of the information beside what is known before."""
    held = np.linalg.inv(information * units[:, None] * units[None, :] + np.eye(len(units)) * HOLD)
    return np.asarray(held * units[:, None] * units[None, :])


def _without_lobe(problem: Problem, theta: FloatArray, normal: FloatArray, free: BoolArray) -> FloatArray:
    """(p,) how far the free parameters would move if a lobe that ended at the weakest that is looked for were none at all."""
    moved = np.zeros(len(theta))
    parameters = problem.parameters()
    for k, p in enumerate(parameters):
        if p.kind == "log strength" and not free[k] and in_own_unit(problem, p, float(theta[k])) <= LEAST_LOBE * (1.0 + 1e-9):
            # light is linear in the lobe's strength: without it there is less by once its slope by the logarithm
            units = np.array([q.unit for q in parameters])[free]
            moved[free] = _inverse(normal[np.ix_(free, free)], units) @ normal[free, k]
    return moved


def in_own_unit(problem: Problem, p: Parameter, theta: float) -> float:
    """A parameter as what it stands for: lengths, strengths, distances themselves instead of their logarithms."""
    match p.kind:
        case "length":
            base = getattr(problem.material, p.name)
        case "log strength":
            base = max(problem.material.K_lobe, LEAST_LOBE)
        case "irradiance":
            base = problem.lights[p.owner].irradiance
        case "distance":
            base = problem.lights[p.owner].distance_mm
        case "radius":
            base = problem.lights[p.owner].angular_radius_deg
        case "exposure":
            base = problem.photographs[p.owner].exposure
        case _:
            return theta
    return float(base * math.exp(min(theta, _LARGEST_LOG)))


def estimate_of(
    problem: Problem, p: Parameter, theta: float, spread: float, known: bool, free: bool, elsewhere: float = 0.0
) -> Estimate:
    """A parameter in its own unit with its interval, which holds that around `theta + elsewhere` too."""
    reach = TWO_SIDED_95 * spread
    value, low, high = (
        in_own_unit(problem, p, theta + t) for t in (0.0, min(elsewhere, 0.0) - reach, max(elsewhere, 0.0) + reach)
    )
    return Estimate(p.name, value, low if known else None, high if known else None, not free)
