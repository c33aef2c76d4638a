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


def fresnel_table(n: float | None, k: float | None) -> FloatArray:
    """F at `octaves.nodes(FRESNEL_OCTAVES)` of cos^2; ones without n and k (a perfect conductor, as the report has it)."""
    squares = nodes(FRESNEL_OCTAVES)
    if n is None or k is None:
        return np.ones(squares.size)
    return np.array([conductor_fresnel(math.sqrt(min(c2, 1.0)), float(n), float(k)) for c2 in squares])
