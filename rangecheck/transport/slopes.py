"""Facets drawn as a viewer sees them: Gaussian slopes, seen from an angle (Heitz & d'Eon, *Importance sampling microfacet-based BSDFs using
the distribution of visible normals*, 2014).

Slopes are counted in their own width alpha = 2 sigma/T. Seen from an angle whose tangent is k/alpha, the slope t towards the viewer has
the density

    (1 + k t) e^-t^2 / N(k)   for t > -1/k,        N(k) = (sqrt(pi) (1 + erf(1/k)) + k e^(-1/k^2)) / 2

and the one across is Gaussian. The quantile of t is read from cubics in x, the Gaussian quantile of the same probability, and in the
steepness s = k/(1 + k): both run over a finite range, where the quantile is smooth. It is off by less than 1e-5, which is
far less than any sample shows. Smith's masking, which the density of directions holds, is 2 sqrt(pi)/N(k) of a half; it comes from
the same table as h(s) = masking/(1 - s), which does not vanish at grazing angles.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.kernels import inline_kernel, kernel, stage_kernel
from rangecheck.reflectance.fast import chebyshev, power_of_two

#: Gaussian quantiles, in slope widths of the density e^-t^2, that the table spans; probabilities from 1e-12 on
_X_MAX = 5.0
_STEEP_CELLS, _X_CELLS, _DEGREE, _MASKING_DEGREE = 16, 40, 3, 5
_LOG2_E = 1.0 / math.log(2.0)


@kernel
def exact_seen_slope(steep, x):
    """The slope t that x, the Gaussian quantile of its probability, stands for, by bisection. 0 <= steep < 1."""
    tangent = steep / (1.0 - steep)
    low = -1.0 / tangent if tangent > 0.15 else -7.0
    high = 7.0
    root = tangent / math.sqrt(math.pi)
    total = math.erfc(low) + root * math.exp(-low * low)
    goal = 0.5 * math.erfc(-x if x < 0.0 else x) * total
    edge = root * math.exp(-low * low)
    a, b = low, high
    for _ in range(60):
        t = 0.5 * (a + b)
        fall = root * math.exp(-t * t)
        if x < 0.0:
            # from below; with erfc on the side where it keeps its digits
            over = (math.erfc(-t) - math.erfc(-low) if t < 0.0 else math.erf(t) - math.erf(low)) + edge - fall > goal
        else:
            over = math.erfc(t) + fall < goal
        if over:
            b = t
        else:
            a = t
    return 0.5 * (a + b)


@kernel
def _fill(steeps, xs, out):
    for i in range(steeps.size):
        for j in range(xs.size):
            out[i, j] = exact_seen_slope(steeps[i], xs[j])


def _masking(steep: FloatArray) -> FloatArray:
    """Smith's masking over 1 - s."""
    b = np.where(steep > 0, (1.0 - steep) / np.where(steep > 0, steep, 1.0), np.inf)
    flat = np.array([1.0 + math.erf(v) for v in b])
    return np.asarray(2.0 / ((1.0 - steep) * flat + steep * np.exp(-(b**2)) / math.sqrt(math.pi)))


@cache
def slope_table() -> FloatArray:
    """(steep cells, x cells + 1, 16) float64, read-only: cubics of the quantile; in the last column a polynomial of h in s alone."""
    points, fit, powers = chebyshev(_DEGREE, -0.5, 0.5)
    of_points = powers @ fit
    steeps = (np.arange(_STEEP_CELLS)[:, None] + 0.5 + points).ravel() / _STEEP_CELLS
    xs = ((np.arange(_X_CELLS)[:, None] + 0.5 + points).ravel() / _X_CELLS * 2.0 - 1.0) * _X_MAX
    values = np.empty((len(steeps), len(xs)))
    _fill(steeps, xs, values)
    cells = values.reshape(_STEEP_CELLS, _DEGREE + 1, _X_CELLS, _DEGREE + 1)
    table = np.zeros((_STEEP_CELLS, _X_CELLS + 1, 16))
    table[:, :_X_CELLS] = np.einsum("ps,rscx,qx->rcpq", of_points, cells, of_points).reshape(_STEEP_CELLS, _X_CELLS, 16)
    points, fit, powers = chebyshev(_MASKING_DEGREE, -0.5, 0.5)
    steeps = (np.arange(_STEEP_CELLS)[:, None] + 0.5 + points) / _STEEP_CELLS
    seen = _masking(steeps.ravel()).reshape(steeps.shape)
    table[:, _X_CELLS, : _MASKING_DEGREE + 1] = seen @ (powers @ fit).T
    table.flags.writeable = False
    return table


@inline_kernel
def _cubic(row, first, w, w2):
    return (row[first] + w * row[first + 1]) + w2 * (row[first + 2] + w * row[first + 3])


@stage_kernel
def seen_slope(table, steep, x):
    """The slope towards a viewer that x, the Gaussian quantile of its probability, stands for; 0 <= steep < 1."""
    rows = steep * _STEEP_CELLS
    r = np.uintp(min(rows, _STEEP_CELLS - 1.0))
    columns = (x + _X_MAX) * (0.5 * _X_CELLS / _X_MAX)
    k = np.uintp(min(max(columns, 0.0), _X_CELLS - 1.0))
    t, w = rows - float(r) - 0.5, columns - float(k) - 0.5
    w2, row = w * w, table[r, k]
    c0, c1, c2, c3 = _cubic(row, 0, w, w2), _cubic(row, 4, w, w2), _cubic(row, 8, w, w2), _cubic(row, 12, w, w2)
    return (c0 + t * c1) + t * t * (c2 + t * c3)


@stage_kernel
def masking_of_steepness(table, steep):
    """Smith's masking over 1 - steep."""
    rows = steep * _STEEP_CELLS
    r = np.uintp(min(rows, _STEEP_CELLS - 1.0))
    t = rows - float(r) - 0.5
    row = table[r, np.uintp(_X_CELLS)]
    t2 = t * t
    return _cubic(row, 0, t, t2) + t2 * t2 * (row[4] + t * row[5])


@stage_kernel
def slope_density(table, alpha, sine, cos_i, cos_r, toward):
    """Density per steradian of directions of cosine cos_i mirrored by facets of Gaussian slopes of width alpha, as many as a viewer at
    (sine, cos_r) sees: D G1/(4 cos_r)."""
    height2 = 2.0 * (1.0 + toward)
    both = cos_i + cos_r
    if not (height2 > 0.0 and both > 0.0):
        return 0.0
    per_cos2 = max(1.0, height2 / (both * both))
    per_alpha2 = 1.0 / (alpha * alpha)
    away = cos_r + alpha * sine
    seen = masking_of_steepness(table, alpha * sine / away) / away
    fall = power_of_two(max(-1000.0, (1.0 - per_cos2) * per_alpha2 * _LOG2_E))
    return seen * fall * per_alpha2 * per_cos2 * per_cos2 * (0.25 / math.pi)
