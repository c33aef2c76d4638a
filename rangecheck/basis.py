"""Two directions across a third, so that the three make a right-handed frame (Duff and others, *Building an orthonormal basis,
revisited*, 2017)."""

from __future__ import annotations

from rangecheck.kernels import stage_kernel


@stage_kernel
def frame_around(x, y, z):
    """Two unit vectors across the unit vector (x, y, z) and across each other, as six numbers. They jump where z changes its sign."""
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return 1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y
