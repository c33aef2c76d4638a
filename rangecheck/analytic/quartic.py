"""The smallest root of many quartics beyond a bound, by bisection between their turning points."""

from __future__ import annotations

import itertools

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray

#: halvings: from any bracket to neighbouring float64 numbers
_HALVINGS = 64


def smallest_root_beyond(coefficients: FloatArray, least: FloatArray) -> FloatArray:
    """(...,) smallest x > least with c0 x^4 + c1 x^3 + ... + c4 = 0 and a change of sign there, inf where there is none.

    coefficients (..., 5) with c0 > 0, least (...,). Between two turning points a quartic is monotone, so that a change of sign
    brackets exactly one root; double roots (rays that touch) do not count."""
    c = coefficients / coefficients[..., :1]
    cubic = c[..., :4] * np.array([4.0, 3.0, 2.0, 1.0]) / 4.0
    companion = np.zeros(c.shape[:-1] + (3, 3))
    companion[..., 0, :] = -cubic[..., 1:]
    companion[..., 1, 0] = companion[..., 2, 1] = 1.0
    # a complex pair leaves a real part that is no turning point; an extra cut does no harm
    turns = np.sort(np.linalg.eigvals(companion).real, axis=-1)
    # Cauchy's bound on every root
    bound = 1.0 + np.abs(c[..., 1:]).max(axis=-1)
    least = np.broadcast_to(least, bound.shape)
    cuts = [least, *(np.clip(turns[..., i], least, np.maximum(bound, least)) for i in range(3)), np.maximum(bound, least)]
    answer = np.full(bound.shape, np.inf)
    for low, high in itertools.pairwise(cuts):
        at_low, at_high = _value(c, low), _value(c, high)
        crosses = np.isinf(answer) & (np.sign(at_low) * np.sign(at_high) < 0)
        if crosses.any():
            answer[crosses] = _bisect(c[crosses], low[crosses], high[crosses], at_low[crosses] > 0)
    return answer


def _value(c: FloatArray, x: FloatArray) -> FloatArray:
    return (((c[..., 0] * x + c[..., 1]) * x + c[..., 2]) * x + c[..., 3]) * x + c[..., 4]


def _bisect(c: FloatArray, low: FloatArray, high: FloatArray, falls: BoolArray) -> FloatArray:
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        beyond = (_value(c, middle) <= 0) == falls
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return 0.5 * (low + high)
