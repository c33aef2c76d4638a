"""Directions drawn by scattering order: an exact, cheap importance sampler of spike and lobe.

e^-g g^m / m! is a Poisson law in the order m, with g at the specular angle. Order 0 is the spike, a mirror. Order m >= 1 moves the
tangential part of the mirror direction by a Gaussian of variance 2 m (lambda/(2 pi T))^2 per axis = m / (2 reach), after which the
direction is lifted back to the hemisphere; offsets that leave it carry no light. Over all orders >= 1 the density per tangential area
is (reach/pi) S(g_0, a), so the weight that remains, f_lobe cos / density, is close to 1.

Local frame: z is the normal, the viewer lies in the x-z plane at (s_v, 0, c_v), the mirror direction is (-s_v, 0, c_v).
Uniform numbers in [0, 1) come from the caller, three to a direction, so that stratified and counter-based ones both serve.
"""

from __future__ import annotations

import math

from rangecheck.kernels import inline_kernel, kernel
from rangecheck.reflectance.fast import lobe_fast
from rangecheck.reflectance.tables import REACH, ROUGHNESS

#: mean above which the order comes from the asymptotic quantile instead of the sum of probabilities
_ASYMPTOTIC = 24.0


@kernel
def normal_quantile(p):
    """The x below which a standard normal number falls with probability p, 0 < p < 1; relative error 1.2e-9 (Acklam)."""
    if p < 0.02425 or p > 0.97575:
        q = math.sqrt(-2.0 * math.log(min(p, 1.0 - p)))
        x = (
            ((((-7.784894002430293e-03 * q - 3.223964580411365e-01) * q - 2.400758277161838) * q - 2.549732539343734) * q
             + 4.374664141464968) * q + 2.938163982698783
        ) / (
            (((7.784695709041462e-03 * q + 3.224671290700398e-01) * q + 2.445134137142996) * q + 3.754408661907416) * q + 1.0
        )  # fmt: skip
        return x if p < 0.5 else -x
    q = p - 0.5
    r = q * q
    return (
        (((((-39.69683028665376 * r + 220.9460984245205) * r - 275.9285104469687) * r + 138.3577518672690) * r
          - 30.66479806614716) * r + 2.506628277459239) * q
    ) / (
        ((((-54.47609879822406 * r + 161.5858368580409) * r - 155.6989798598866) * r + 66.80131188771972) * r
         - 13.28068155288572) * r + 1.0
    )  # fmt: skip


@kernel
def scattering_order(mean, u, least):
    """The order m >= `least` (0 or 1) that the uniform number u in [0, 1) picks from the Poisson law of this mean.

    Exact by summation for a mean below 24; above, by the expansion of the quantile of Giles 2016 (ACM TOMS 42, algorithm 955),
    whose probabilities are off by less than 1e-4 of each."""
    if not mean > 0.0:
        return least
    if mean < _ASYMPTOTIC:
        m = least
        term = math.exp(-mean) * (mean if least == 1 else 1.0)
        left = u * (-math.expm1(-mean) if least == 1 else 1.0)
        while left >= term and m < 400:
            left -= term
            m += 1
            term *= mean / m
        return m
    w = normal_quantile(min(max(u, 1e-300), 1.0 - 1e-16))
    root = math.sqrt(mean)
    w2 = w * w
    q = mean + root * w + (1.0 / 3.0 + w2 / 6.0) - (w / 36.0 + w * w2 / 72.0) / root
    q += (-8.0 / 405.0 + 7.0 * w2 / 810.0 + w2 * w2 / 270.0) / mean
    return max(least, int(q))


@kernel
def scattered_direction(order, reach, c_v, u_length, u_around):
    """(x, y, z) of light scattered `order` times, in the local frame; z = 0 where the offset leaves the hemisphere."""
    s_v = math.sqrt(max(0.0, 1.0 - c_v * c_v))
    if order == 0:
        return -s_v, 0.0, c_v
    length = math.sqrt(-order * math.log1p(-u_length) / reach)
    x = -s_v + length * math.cos(2.0 * math.pi * u_around)
    y = length * math.sin(2.0 * math.pi * u_around)
    z2 = 1.0 - x * x - y * y
    return x, y, math.sqrt(z2) if z2 > 0.0 else 0.0


@kernel
def sample_lobe(surfaces, series, material, wave, c_v, u_order, u_length, u_around):
    """(x, y, z, sxy2, density) of a direction drawn for the lobe alone (orders >= 1) seen from cosine c_v.

    `density` is per steradian. At every wavelength w of the material, `lobe_value(surfaces, series, material, w, z, c_v, sxy2) * z / density` is
    the weight of the radiance from there. z = 0: the draw carries nothing and counts as a sample of weight 0."""
    reach = surfaces[material, wave, REACH]
    g = 4.0 * surfaces[material, wave, ROUGHNESS] * c_v * c_v
    order = scattering_order(g, u_order, 1)
    x, y, z = scattered_direction(order, reach, c_v, u_length, u_around)
    dx = x + math.sqrt(max(0.0, 1.0 - c_v * c_v))
    sxy2 = dx * dx + y * y
    return x, y, z, sxy2, lobe_density(surfaces, series, material, wave, c_v, z, sxy2)


@inline_kernel
def lobe_density(surfaces, series, material, wave, c_v, c_i, sxy2):
    """Density per steradian with which `sample_lobe` draws the direction of cosine c_i; 0 for a surface without roughness."""
    reach = surfaces[material, wave, REACH]
    g = 4.0 * surfaces[material, wave, ROUGHNESS] * c_v * c_v
    share = -math.expm1(-g)
    return reach / math.pi * lobe_fast(series, g, reach * sxy2) * c_i / share if share > 0.0 else 0.0
