"""Brown-Conrady lens distortion in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6, and its inverse.

Coordinates are normalised: x = X / Z, y = Y / Z. Brown, *Decentering distortion of lenses*, 1966. The radial polynomial of a
calibration is trusted only out to its fold, the radius where it stops growing: beyond it one point of the picture would have two
rays, and points far outside the field of view would appear inside the picture. There both directions give NaN.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.kernels import in_chunks, inline_kernel, kernel

#: Newton's step is below this, in normalised coordinates, when the inverse is found: 1e-6 px at a focal length of 1e6 px
CONVERGED = 1e-13
NEWTON_STEPS = 60
_CHUNK = 65536


def coefficients(distortion: tuple[float, ...]) -> FloatArray:
    """(8,) k1 k2 p1 p2 k3 k4 k5 k6, zeros where `distortion` is shorter."""
    return np.array([*distortion, *([0.0] * (8 - len(distortion)))], dtype=np.float64)


@lru_cache(maxsize=256)
def fold_radius(distortion: tuple[float, ...]) -> float:
    """Undistorted radius at which the radial part stops growing or has a pole; inf where it never does."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients(distortion)
    # in s = r^2: d(r N / D)/dr = 0 where N D + 2 s (N' D - N D') = 0
    top, bottom = np.polynomial.Polynomial([1, k1, k2, k3]), np.polynomial.Polynomial([1, k4, k5, k6])
    s = np.polynomial.Polynomial([0, 1])
    slope = top * bottom + 2 * s * (top.deriv() * bottom - top * bottom.deriv())
    roots = np.concatenate([slope.roots(), bottom.roots()]).astype(np.complex128)
    real = np.asarray(roots.real, dtype=np.float64)
    radii2 = real[(real > 0) & (np.abs(roots.imag) < 1e-9 * np.abs(real))]
    return math.sqrt(float(radii2.min())) if len(radii2) else math.inf


@inline_kernel
def _distorted(x, y, k):
    """xd, yd and the Jacobian's four entries."""
    r2 = x * x + y * y
    top = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    bottom = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    radial = top / bottom
    slope = ((k[0] + r2 * (2.0 * k[1] + r2 * 3.0 * k[4])) - radial * (k[5] + r2 * (2.0 * k[6] + r2 * 3.0 * k[7]))) / bottom
    xd = x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x)
    yd = y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y
    xx = radial + 2.0 * x * x * slope + 2.0 * k[2] * y + 6.0 * k[3] * x
    xy = 2.0 * x * y * slope + 2.0 * k[2] * x + 2.0 * k[3] * y
    yy = radial + 2.0 * y * y * slope + 6.0 * k[2] * y + 2.0 * k[3] * x
    return xd, yd, xx, xy, yy


@kernel
def _distort_all(x, y, k, fold, xd, yd):
    for i in range(x.size):
        if x[i] * x[i] + y[i] * y[i] > fold * fold:
            xd[i], yd[i] = np.nan, np.nan
        else:
            xd[i], yd[i], _, _, _ = _distorted(x[i], y[i], k)


@kernel
def _undistort_all(xd, yd, k, fold, converged, steps, x, y):
    for i in range(xd.size):
        # from the middle outwards the map is one to one, so Newton starts there, and steps past the fold are cut short
        u, v = 0.0, 0.0
        found = False
        for _ in range(steps):
            px, py, xx, xy, yy = _distorted(u, v, k)
            determinant = xx * yy - xy * xy
            if not determinant > 0.0:
                break
            ex, ey = xd[i] - px, yd[i] - py
            du, dv = (yy * ex - xy * ey) / determinant, (xx * ey - xy * ex) / determinant
            # a step is taken only as far as it brings the point nearer: the polynomial may bend sharply before its fold
            share = 1.0
            for _ in range(40):
                a, b = u + share * du, v + share * dv
                if a * a + b * b <= fold * fold:
                    qx, qy, _, _, _ = _distorted(a, b, k)
                    if math.hypot(xd[i] - qx, yd[i] - qy) <= math.hypot(ex, ey):
                        break
                share *= 0.5
            u, v = u + share * du, v + share * dv
            if share * math.hypot(du, dv) <= converged * (1.0 + math.hypot(u, v)):
                found = True
                break
        if found:
            px, py, xx, xy, yy = _distorted(u, v, k)
            found = math.hypot(xd[i] - px, yd[i] - py) <= 100.0 * converged * (1.0 + math.hypot(u, v))
        x[i], y[i] = (u, v) if found else (np.nan, np.nan)


def distort(x: FloatArray, y: FloatArray, distortion: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Distorted normalised coordinates of undistorted ones; NaN beyond the lens model's fold."""
    a, b = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    xd, yd = np.empty(a.size), np.empty(a.size)
    _distort_all(a.ravel(), b.ravel(), coefficients(distortion), fold_radius(distortion), xd, yd)
    return xd.reshape(a.shape), yd.reshape(a.shape)


def undistort(xd: FloatArray, yd: FloatArray, distortion: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Undistorted coordinates of distorted ones: Newton's method on the branch that holds the middle; NaN beyond the fold."""
    a, b = np.broadcast_arrays(np.asarray(xd, np.float64), np.asarray(yd, np.float64))
    x, y = np.empty(a.size), np.empty(a.size)
    flat, k, fold = (a.ravel(), b.ravel()), coefficients(distortion), fold_radius(distortion)
    in_chunks(
        lambda i, j: _undistort_all(flat[0][i:j], flat[1][i:j], k, fold, CONVERGED, NEWTON_STEPS, x[i:j], y[i:j]), a.size, _CHUNK
    )
    return x.reshape(a.shape), y.reshape(a.shape)


def largest_shift(xd: FloatArray, yd: FloatArray, distortion: tuple[float, ...]) -> float:
    """How far (normalised coordinates) distortion moves the worst of these distorted points; inf where one has no ray."""
    x, y = undistort(xd, yd, distortion)
    shift = np.hypot(x - xd, y - yd)
    return float(np.where(np.isnan(shift), np.inf, shift).max(initial=0.0))
