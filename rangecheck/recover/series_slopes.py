"""S(g, a) of `reflectance.series` with its exact slopes.

With t_m the m-th term of the sum and <x> = sum x t_m / sum t_m,

    d ln S / d ln g = <m> - g,        d ln S / d a = -<1/m>

so that both come from the sum that S needs anyway. The sum is that of `series.log_lobe_series`: every order where few carry the light,
every h-th where many do.
"""

from __future__ import annotations

import math

from rangecheck.kernels import kernel
from rangecheck.reflectance.series import _DENSE, _NEGLIGIBLE, _STRIDE, _WHOLE, _largest_order, _log_term


@kernel
def log_series_and_slopes(g, a):
    """(ln S, d ln S / d ln g, d ln S / d a) for g > 0, a >= 0; S to 1e-12, the slopes to 1e-9 of 1 + g-free quantities.

    For g = 0 the limit of the first order: (-inf, 1, -1)."""
    if not (g >= 0.0 and a >= 0.0):
        return math.nan, math.nan, math.nan
    if g == 0.0:
        return -math.inf, 1.0, -1.0
    if g > _WHOLE:
        return -a / g - math.log(g), a / g - 1.0, -1.0 / g
    m_best = _largest_order(g, a)
    first = max(1.0, math.floor(m_best + 0.5))
    scale = _log_term(first, g, a)
    width = math.sqrt(m_best / (1.0 + 2.0 * max(0.0, math.log(m_best / g))))
    total, above, inverse = 1.0, first - g, 1.0 / first
    if width < _DENSE:
        term, m = 1.0, first
        while term > _NEGLIGIBLE * total:
            term *= g * m / ((m + 1.0) * (m + 1.0)) * math.exp(a / (m * (m + 1.0)))
            m += 1.0
            total += term
            above += term * (m - g)
            inverse += term / m
        term, m = 1.0, first
        while m > 1.5 and term > _NEGLIGIBLE * total:
            term *= m * m / (g * (m - 1.0)) * math.exp(-a / (m * (m - 1.0)))
            m -= 1.0
            total += term
            above += term * (m - g)
            inverse += term / m
        return scale + math.log(total), above / total, -inverse / total
    stride = math.floor(_STRIDE * width)
    for sign in (1.0, -1.0):
        m = first + sign * stride
        while m >= 1.0:
            term = math.exp(_log_term(m, g, a) - scale)
            total += term
            above += term * (m - g)
            inverse += term / m
            if term < _NEGLIGIBLE * total:
                break
            m += sign * stride
    return scale + math.log(total * stride), above / total, -inverse / total
