"""Intervals of numbers on which light depends far from linearly: the lengths and the lobe's strength, whose trade is a curved valley.

The profile of a number is what the others' best cost rises by when it is held elsewhere; its 95 % interval ends where that is 1.92 (half of 1.96
squared: Wilks 1938, Venzon & Moolgavkar 1988). It is followed on some thousand pixels, weighed so that they stand for all, of the model's own
picture without noise, and then taken relative to the straight valley's on the same pixels: what is wanted is how the valley bends.
"""

from __future__ import annotations

import math
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


def profiled(fitted: Fitted, spare: float = 1.0) -> Fitted:
    """The same with the intervals of BENT numbers from their profiles. spare: share (0..1) of the cost's allowed rise that is still there,
    for an end that explains the pictures a little worse than the best."""
    wanted = [k for k, p in enumerate(fitted.parameters) if p.kind in BENT and fitted.estimates[k].low is not None]
    spread = np.sqrt(np.diag(fitted.determination.covariance))
    wanted = [k for k in wanted if spread[k] > 0.0]
    if not wanted:
        return fitted
    valley = _Valley(fitted)
    estimates = list(fitted.estimates)
    for k in wanted:
        below, above = (valley.bent(k, sign, math.sqrt(spare)) * TWO_SIDED_95 * spread[k] for sign in (-1.0, 1.0))
        estimates[k] = _stated(fitted, k, below, above)
    return replace(fitted, estimates=estimates)


def _stated(fitted: Fitted, k: int, below: float, above: float) -> Estimate:
    p, e = fitted.parameters[k], fitted.estimates[k]
    if max(below, above) > TWO_SIDED_95 * VAGUE * p.unit:
        return replace(e, low=None, high=None)
    theta = float(fitted.theta[k])
    low, high = (in_own_unit(fitted.started, p, min(max(t, p.low), p.high)) for t in (theta - below, theta + above))
    return replace(e, low=low, high=high)


class _Valley:
    """The model's own picture around the end of a fit."""

    def __init__(self, fitted: Fitted) -> None:
        self.problem: Problem = standing_for_all(fitted.started, _PIXELS)
        self.parameters, self.theta = fitted.parameters, fitted.theta
        self.low, self.high = (np.array([getattr(p, side) for p in fitted.parameters]) for side in ("low", "high"))
        units = np.array([p.unit for p in fitted.parameters])
        self.hold = HOLD / units**2
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

    def _risen(self, k: int, others: IntArray, theta: FloatArray) -> float:
        """Square root of twice the rise in cost at `theta[k]`, the others at their best."""
        lowest = math.inf
        for _ in range(_STEPS):
            value, jacobian = self._shown(theta)
            away = value - self.base
            lowest = min(lowest, math.sqrt(float(away @ away)))
            part = jacobian[:, others]
            normal = part.T @ part + np.diag(self.hold[others])
            theta = theta.copy()
            theta[others] = np.clip(theta[others] - np.linalg.solve(normal, part.T @ away), self.low[others], self.high[others])
        value, _ = self._shown(theta)
        return min(lowest, float(np.linalg.norm(value - self.base)))
