"""Intervals of numbers on which light depends far from linearly: the lengths and the lobe's strength, whose trade is a curved valley.

The profile of a number is what the others' best cost rises by when it is held elsewhere; its 95 % interval ends where that is 1.92 (half of 1.96
squared: Wilks 1938, Venzon & Moolgavkar 1988). It is followed on some thousand pixels, weighed so that they stand for all, of the model's own
picture without noise, and then taken relative to the straight valley's on the same pixels: what is wanted is how the valley bends.

A combination that the pictures do not determine is followed too, either way as far as they allow: where it bends, numbers have a part in it farther on that
have none where the fit ended, as a spike's strength in that of its roughness, which takes nothing from it while the surface is smooth.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.recover.identify import VAGUE
from rangecheck.recover.polish import HOLD, TWO_SIDED_95, Estimate, Fitted, in_own_unit
from rangecheck.recover.problem import Problem
from rangecheck.recover.starts import standing_for_all

BENT = ("length", "log strength")
_PIXELS, _SECANTS, _STEPS = 3000, 3, 3
#: nothing is followed farther than this many times the straight valley's reach
_FARTHEST = 4.0
#: what is open is followed in steps of so many units, at most so many, on so many pixels, and each rest brought to its best in so many turns
_STRIDE, _STRIDES, _OPEN_PIXELS, _OPEN_TURNS = 0.5, 16, 1000, 3


def profiled(fitted: Fitted, spare: float = 1.0) -> Fitted:
    """The same with the intervals of BENT numbers from their profiles. spare: share (0..1) of the cost's allowed rise that is still there,
    for an end that explains the pictures a little worse than the best."""
    wanted = [k for k, p in enumerate(fitted.parameters) if p.kind in BENT and fitted.estimates[k].low is not None]
    spread = np.sqrt(np.diag(fitted.determination.covariance))
    wanted = [k for k in wanted if spread[k] > 0.0]
    if wanted:
        valley = _Valley(fitted, _PIXELS)
        estimates = list(fitted.estimates)
        for k in wanted:
            below, above = (valley.bent(k, sign, math.sqrt(spare)) * TWO_SIDED_95 * spread[k] for sign in (-1.0, 1.0))
            estimates[k] = _stated(fitted, k, below, above)
        fitted = replace(fitted, estimates=estimates)
    return _open_to_their_ends(fitted, spare)


def _open_to_their_ends(fitted: Fitted, spare: float) -> Fitted:
    """The same with intervals that hold what numbers become along the combinations that are not determined."""
    leads = [k for k, e in enumerate(fitted.estimates) if not e.at_bound and not fitted.determination.determined[k]]
    if not leads:
        return fitted
    valley = _Valley(fitted, _OPEN_PIXELS)
    least, most = fitted.theta.copy(), fitted.theta.copy()
    for lead in leads:
        for sign in (-1.0, 1.0):
            for theta in valley.along(lead, sign, TWO_SIDED_95 * math.sqrt(spare)):
                least, most = np.minimum(least, theta), np.maximum(most, theta)
    return replace(fitted, estimates=[_reaching(fitted, k, least[k], most[k]) for k in range(len(fitted.estimates))])


def _reaching(fitted: Fitted, k: int, least: float, most: float) -> Estimate:
    """The estimate, its interval as much longer as number k moves towards `least` and `most`; none where that is more than matters."""
    p, e, theta = fitted.parameters[k], fitted.estimates[k], float(fitted.theta[k])
    if e.low is None or e.high is None or (least == theta and most == theta):
        return e
    if max(theta - least, most - theta) > TWO_SIDED_95 * VAGUE * p.unit:
        return replace(e, low=None, high=None)
    at, low, high = (in_own_unit(fitted.started, p, t) for t in (theta, least, most))
    return replace(e, low=e.low + low - at, high=e.high + high - at)


def _stated(fitted: Fitted, k: int, below: float, above: float) -> Estimate:
    p, e = fitted.parameters[k], fitted.estimates[k]
    if max(below, above) > TWO_SIDED_95 * VAGUE * p.unit:
        return replace(e, low=None, high=None)
    theta = float(fitted.theta[k])
    low, high = (in_own_unit(fitted.started, p, min(max(t, p.low), p.high)) for t in (theta - below, theta + above))
    return replace(e, low=low, high=high)


class _Valley:
    """The model's own picture around the end of a fit."""

    def __init__(self, fitted: Fitted, pixels: int) -> None:
        self.problem: Problem = standing_for_all(fitted.started, pixels)
        self.parameters, self.theta = fitted.parameters, fitted.theta
        self.low, self.high = (np.array([getattr(p, side) for p in fitted.parameters]) for side in ("low", "high"))
        units = np.array([p.unit for p in fitted.parameters])
        self.units, self.hold = units, HOLD / units**2
        self.base, jacobian = self._shown(self.theta)
        self.information = jacobian.T @ jacobian + np.diag(self.hold)

    def _shown(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        values, slopes = [], []
        for k, photo in enumerate(self.problem.photographs):
            seen = self.problem.predict(theta, k)
            # what is saturated tells nothing of how the valley bends
            weight = (photo.values < photo.saturation) / photo.noise
            values.append(seen.values * weight)
            slopes.append(seen.slopes * weight[:, None])
        return np.concatenate(values), np.concatenate(slopes)

    def bent(self, k: int, sign: float, level: float) -> float:
        """Where the profile of number k has risen by half of (1.96 level)^2, in units of where the straight valley's has risen by 1.96."""
        others = np.array([j for j in range(len(self.theta)) if j != k], np.int64)
        covariance = np.linalg.inv(self.information)
        sd = math.sqrt(covariance[k, k])
        path = covariance[:, k] / sd
        reach = TWO_SIDED_95 * level
        t = reach
        for _ in range(_SECANTS):
            if not self.low[k] < self.theta[k] + sign * t * sd < self.high[k]:
                break
            risen = self._risen(k, others, np.clip(self.theta + sign * t * path, self.low, self.high))
            t = min(t * reach / max(risen, 1e-3 * reach), 2.0 * t, _FARTHEST * reach)
            if abs(risen - reach) < 0.03 * reach:
                break
        return t / TWO_SIDED_95

    def along(self, k: int, sign: float, reach: float) -> Iterator[FloatArray]:
        """(p,) where the others are at their best while number k walks away, as long as the cost has risen by less than half of reach^2."""
        others = np.array([j for j in range(len(self.theta)) if j != k], np.int64)
        last, before = self.theta, 0.0
        for _ in range(_STRIDES):
            theta = last.copy()
            theta[k] += sign * _STRIDE * self.units[k]
            if not self.low[k] < theta[k] < self.high[k]:
                return
            theta, risen = self._best_of_others(others, theta, _OPEN_TURNS)
            if risen > reach:
                yield last + (theta - last) * (reach - before) / (risen - before)
                return
            yield theta
            last, before = theta, risen

    def _best_of_others(self, others: IntArray, theta: FloatArray, turns: int) -> tuple[FloatArray, float]:
        """Where the others are at their best, (p,), and the square root of twice the rise in cost there."""
        found, lowest = theta, math.inf
        for turn in range(turns + 1):
            value, jacobian = self._shown(theta)
            away = value - self.base
            size = math.sqrt(float(away @ away))
            if size < lowest:
                found, lowest = theta, size
            if turn == turns:
                break
            part = jacobian[:, others]
            normal = part.T @ part + np.diag(self.hold[others])
            theta = theta.copy()
            theta[others] = np.clip(theta[others] - np.linalg.solve(normal, part.T @ away), self.low[others], self.high[others])
        return found, lowest

    def _risen(self, k: int, others: IntArray, theta: FloatArray) -> float:
        """Square root of twice the rise in cost at `theta[k]`, the others at their best."""
        return self._best_of_others(others, theta, _STEPS)[1]
