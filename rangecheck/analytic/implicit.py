"""Signed functions of a point: negative inside, zero on the surface, positive outside, of slope one near the surface.

Ellipsoids are first-order distances (Quilez, *Distance to an ellipsoid*); unions blend over a band of width `k` with a cubic
polynomial, which is twice continuously differentiable and changes nothing outside the band.
"""

from __future__ import annotations

import math

from rangecheck.kernels import kernel


@kernel
def blend_min(a, b, k):
    """Union of two bodies, rounded where |a - b| < k."""
    h = k - abs(a - b)
    if h <= 0.0:
        return min(a, b)
    return min(a, b) - h * h * h / (6.0 * k * k)


@kernel
def blend_max(a, b, k):
    """Intersection of two bodies, rounded where |a - b| < k; blend_max(a, -b, k) carves b out of a."""
    h = k - abs(a - b)
    if h <= 0.0:
        return max(a, b)
    return max(a, b) + h * h * h / (6.0 * k * k)


@kernel
def soft_abs(x, e):
    """|x| without its corner: sqrt(x^2 + e^2)."""
    return math.sqrt(x * x + e * e)


@kernel
def ramp(x, low, high):
    """0 below `low`, 1 above `high`, and twice differentiable between (Perlin's quintic)."""
    t = (x - low) / (high - low)
    if t <= 0.0:
        return 0.0
    if t >= 1.0:
        return 1.0
    return t * t * t * (t * (6.0 * t - 15.0) + 10.0)


@kernel
def bump(x, width):
    """exp(-(x / width)^2)."""
    t = x / width
    return math.exp(-t * t)


@kernel
def ellipsoid(x, y, z, cx, cy, cz, rx, ry, rz):
    """Ellipsoid with half axes r about c."""
    px, py, pz = (x - cx) / rx, (y - cy) / ry, (z - cz) / rz
    k0 = math.sqrt(px * px + py * py + pz * pz)
    px, py, pz = px / rx, py / ry, pz / rz
    k1 = math.sqrt(px * px + py * py + pz * pz)
    if k1 < 1e-12:
        return -min(rx, min(ry, rz))
    return k0 * (k0 - 1.0) / k1


@kernel
def limb(x, y, z, ax, ay, az, bx, by, bz, ra, rb):
    """Capsule from a to b whose radius goes smoothly from ra to rb."""
    ux, uy, uz = bx - ax, by - ay, bz - az
    px, py, pz = x - ax, y - ay, z - az
    t = (px * ux + py * uy + pz * uz) / (ux * ux + uy * uy + uz * uz)
    t = min(1.0, max(0.0, t))
    px, py, pz = px - t * ux, py - t * uy, pz - t * uz
    return math.sqrt(px * px + py * py + pz * pz) - (ra + (rb - ra) * t * t * (3.0 - 2.0 * t))


@kernel
def disc(radius, y, low, high, r, rounding):
    """Upright cylinder of radius `r` between two heights, its edges rounded; `radius` is the distance from its axis."""
    a = radius - r + rounding
    b = max(low + rounding - y, y - high + rounding)
    outside = math.sqrt(max(a, 0.0) ** 2 + max(b, 0.0) ** 2)
    return outside + min(max(a, b), 0.0) - rounding


@kernel
def ring(radius, y, cy, major, minor):
    """Torus about the upright axis."""
    return math.sqrt((radius - major) ** 2 + (y - cy) ** 2) - minor
