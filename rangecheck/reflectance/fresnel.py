"""Share of unpolarised light that a metal reflects, from its refractive index n + i k (Born & Wolf, section 14.2).

At each facet the angle is the one between the light and the facet, cos = |to_light + to_viewer| / 2, not the one to the mean surface.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.kernels import kernel
from rangecheck.reflectance.octaves import nodes

#: octaves of cos^2 in the table of F: with 16 cells to each, linear interpolation keeps within 2e-4 for metals in visible light
FRESNEL_OCTAVES = 20


@kernel
def conductor_fresnel(c, n, k):
    """F at the angle of cosine c, for the complex refractive index n + i k relative to air. n > 0, k >= 0."""
    c2 = c * c
    s2 = 1.0 - c2
    p = n * n - k * k - s2
    a2b2 = math.sqrt(p * p + 4.0 * n * n * k * k)
    a = math.sqrt(max(0.0, 0.5 * (a2b2 + p)))
    perpendicular = (a2b2 + c2 - 2.0 * a * c) / (a2b2 + c2 + 2.0 * a * c)
    parallel = (a2b2 * c2 + s2 * s2 - 2.0 * a * c * s2) / (a2b2 * c2 + s2 * s2 + 2.0 * a * c * s2)
    return 0.5 * perpendicular * (1.0 + parallel)


@kernel
def conductor_fresnel_slope(c, n, k):
    """(F, dF/dc) of `conductor_fresnel`."""
    c2 = c * c
    s2 = 1.0 - c2
    p = n * n - k * k - s2
    a2b2 = math.sqrt(p * p + 4.0 * n * n * k * k)
    a = math.sqrt(max(0.0, 0.5 * (a2b2 + p)))
    # by c^2: a2b2 grows by p / a2b2, and a by a / (2 a2b2)
    by_a2b2, by_a = 2.0 * c * p / a2b2, c * a / a2b2
    u, w = a2b2 + c2, 2.0 * a * c
    by_u, by_w = by_a2b2 + 2.0 * c, 2.0 * (by_a * c + a)
    perpendicular, by_perpendicular = (u - w) / (u + w), 2.0 * (by_u * w - u * by_w) / (u + w) ** 2
    x, y = a2b2 * c2 + s2 * s2, w * s2
    by_x, by_y = by_a2b2 * c2 + 2.0 * c * a2b2 - 4.0 * c * s2, by_w * s2 - 2.0 * c * w
    parallel, by_parallel = (x - y) / (x + y), 2.0 * (by_x * y - x * by_y) / (x + y) ** 2
    return 0.5 * perpendicular * (1.0 + parallel), 0.5 * (by_perpendicular * (1.0 + parallel) + perpendicular * by_parallel)


def fresnel_table(n: float | None, k: float | None) -> FloatArray:
    """F at `octaves.nodes(FRESNEL_OCTAVES)` of cos^2; ones without n and k (a perfect conductor, as the report has it)."""
    squares = nodes(FRESNEL_OCTAVES)
    if n is None or k is None:
        return np.ones(squares.size)
    return np.array([conductor_fresnel(math.sqrt(min(c2, 1.0)), float(n), float(k)) for c2 in squares])
