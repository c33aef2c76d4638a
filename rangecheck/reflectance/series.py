"""The sum over scattering orders of a rough surface, stable over the whole range that light and roughness can span.

    S(g, a) = e^-g  sum over m >= 1 of  g^m / (m! m) e^(-a/m)

g is the roughness that the light sees (2), a the squared distance from the mirror direction in units of the lobe's first
order, both without unit. Beckmann & Spizzichino 1963; equation numbers are those of CMU-RI-TR-91-16.

Read e^-g g^m / m! as the Poisson probability of scattering m times. Its logarithm is taken from the deviance, after Loader
(2000, "Fast and accurate computation of binomial probabilities"), so that nothing large is ever subtracted from something large.
The largest term lies near the m that solves m^2 ln(m/g) = a. Around it the terms are close to a Gaussian of known width; where
that spans many orders, every h-th term times h gives the same sum: for h = 0.7 widths Poisson's summation formula bounds the
difference by 2 e^(-2 pi^2 / 0.49), which is below 1e-17.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.kernels import kernel

#: ln n! - (n + 1/2) ln n + n - ln sqrt(2 pi) for n = 0 (unused), 1, ... 15
_STIRLING = np.array(
    [0.0] + [math.lgamma(n + 1) - (n + 0.5) * math.log(n) + n - 0.5 * math.log(2 * math.pi) for n in range(1, 16)]
)
#: orders per width between the terms that are summed once a width spans more than _DENSE orders
_STRIDE, _DENSE = 0.7, 8.0
#: above this orders are no longer told apart in float64, and the rough form (7) is within 1e-9 of S
_WHOLE = 1e15
#: a term this far below the sum so far ends the sum
_NEGLIGIBLE = 1e-17


@kernel
def _stirling_error(m):
    """What Stirling's formula lacks of ln m!, m a whole number >= 1."""
    if m < 15.5:
        return _STIRLING[int(m)]
    q = 1.0 / (m * m)
    return (1 / 12 - (1 / 360 - (1 / 1260 - (1 / 1680 - q / 1188) * q) * q) * q) / m


@kernel
def _deviance(m, g):
    """m ln(m/g) + g - m without cancellation where m is close to g."""
    d = m - g
    if abs(d) < 0.1 * (m + g):
        v = d / (m + g)
        total = d * v
        power = 2.0 * m * v
        v2 = v * v
        for j in range(3, 400, 2):
            power *= v2
            more = total + power / j
            if more == total:
                break
            total = more
        return total
    return m * math.log(m / g) + g - m


@kernel
def _log_term(m, g, a):
    """ln of the m-th term of S(g, a)."""
    return -_stirling_error(m) - _deviance(m, g) - 0.5 * math.log(2.0 * math.pi * m) - math.log(m) - a / m


@kernel
def _largest_order(g, a):
    """The m > 0, not whole, at which m^2 ln(m/g) = a; g where a = 0."""
    if a == 0.0:
        return g
    # with y = 2 ln(m/g): y e^y = 2 a / g^2, solved for y by Newton on y + ln y, which is concave
    log_z = math.log(2.0 * a) - 2.0 * math.log(g)
    if log_z < -36.0:
        return g
    y = math.exp(log_z) if log_z < -1.0 else (0.6 if log_z < 2.0 else log_z - math.log(log_z))
    for _ in range(40):
        step = (y + math.log(y) - log_z) * y / (1.0 + y)
        y = max(y - step, 0.1 * y)
        if abs(step) < 1e-12 * y:
            break
    return g * math.exp(0.5 * y)


@kernel
def log_lobe_series(g, a):
    """ln S(g, a) for g >= 0, a >= 0; -inf for g = 0. The reference: within 1e-12 of S where S is a normal number."""
    if not (g >= 0.0 and a >= 0.0):
        return math.nan
    if g == 0.0 or g == math.inf or a == math.inf:
        return -math.inf
    if g > _WHOLE:
        return -a / g - math.log(g)
    m_best = _largest_order(g, a)
    first = max(1.0, math.floor(m_best + 0.5))
    scale = _log_term(first, g, a)
    width = math.sqrt(m_best / (1.0 + 2.0 * max(0.0, math.log(m_best / g))))
    total = 1.0
    if width < _DENSE:
        term, m = 1.0, first
        while term > _NEGLIGIBLE * total:
            term *= g * m / ((m + 1.0) * (m + 1.0)) * math.exp(a / (m * (m + 1.0)))
            m += 1.0
            total += term
        term, m = 1.0, first
        while m > 1.5 and term > _NEGLIGIBLE * total:
            term *= m * m / (g * (m - 1.0)) * math.exp(-a / (m * (m - 1.0)))
            m -= 1.0
            total += term
        return scale + math.log(total)
    stride = math.floor(_STRIDE * width)
    for sign in (1.0, -1.0):
        m = first + sign * stride
        while m >= 1.0:
            term = math.exp(_log_term(m, g, a) - scale)
            total += term
            if term < _NEGLIGIBLE * total:
                break
            m += sign * stride
    return scale + math.log(total * stride)


@kernel
def lobe_series(g, a):
    """S(g, a), the general form (1); within 1e-9 relative wherever it exceeds 1e-290 (g 1e-12 to 1e8, a 0 to 1e8)."""
    return math.exp(log_lobe_series(g, a))


@kernel
def lobe_smooth(g, a):
    """S(g, a) for g << 1: the first order alone (6)."""
    return g * math.exp(-g - a)


@kernel
def lobe_rough(g, a):
    """S(g, a) for g >> 1: (7), (13). Written for g = 0 too, where it is 0 off the mirror direction and inf on it."""
    if g == 0.0:
        return math.inf if a == 0.0 else 0.0
    return math.exp(-a / g) / g
