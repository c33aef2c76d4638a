"""Matched filters over what a picture leaves unexplained: of each place, how much of a template there is and how well that is known.

A template acts on d = ln(seen / predicted) as fields of the grid times kernels about the place; slow changes are taken from d and kernels alike, and w is one
over the local variance of d. With b = sum w d t and M = sum w t^2 the most likely amount is b / M, its z is b / sqrt(M), and against no amount at all the
evidence of one that is taken to be normal with variance 1/P beforehand is

    ln E = 1/2 b (M + P)^-1 b - 1/2 ln det(1 + M / P)

which charges a cause for what it leaves open (MacKay, *Bayesian interpolation*, 1992). Both are in units of the spread that z has over the picture itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.recover.grid import masked_gauss

#: width of what is slow, in radii;  directions of steps
BROAD, DIRECTIONS = 1.0, 8
_NORMAL_MAD = 0.6744897501960817
#: what lies further out than this many deviations is what is looked for, not what it is judged by
_CAPPED = 3.0
#: reach of kernels, in radii
_REACH = 2.5


class Relief(NamedTuple):
    """Of a template about each cell, (h, w): z, most likely amount and its standard deviation (mm), and ln of its evidence."""

    z: FloatArray
    amount: FloatArray
    deviation: FloatArray
    evidence: FloatArray


class _Left(NamedTuple):
    """The residual without what is slower than templates of a radius, its weight, and transforms of fields on it."""

    d: FloatArray
    w: FloatArray
    along: tuple[FloatArray, FloatArray]
    energies: tuple[FloatArray, FloatArray, FloatArray]


class Filters:
    """The residual (h, w), 0 where not `used`, ready to be projected on templates; slopes: how it falls with range per cell along columns and rows."""

    def __init__(
        self, residual: FloatArray, used: BoolArray, slopes: tuple[FloatArray, FloatArray], radii: Sequence[float]
    ) -> None:
        from scipy.fft import next_fast_len

        self.residual, self.used = np.nan_to_num(residual), used.astype(float)
        self.g_u, self.g_v = (np.where(used, g, 0.0) for g in slopes)
        wide = 2 * math.ceil(_REACH * max(radii)) + 1
        self._size = tuple(next_fast_len(n + wide, real=True) for n in used.shape)
        self.spread, self.unit = 0.0, 0.0
        self._left_of = {radius: self._left(radius) for radius in radii}

    def _left(self, radius: float) -> _Left:
        slow = np.nan_to_num(masked_gauss(self.residual, self.used, BROAD * radius))
        d = (self.residual - slow) * self.used
        far = d[self.used > 0.0]
        self.spread = float(np.median(np.abs(far))) / _NORMAL_MAD if far.size else 1.0
        most = (_CAPPED * self.spread) ** 2
        local = np.nan_to_num(masked_gauss(np.minimum(d * d, most), self.used, 4.0 * radius), nan=most)
        w = self.used / np.maximum(local, 0.05 * self.spread**2 + 1e-12)
        u, v = self.g_u, self.g_v
        along = self._field(w * d * u), self._field(w * d * v)
        return _Left(d, w, along, (self._field(w * u * u), self._field(w * v * v), self._field(2.0 * w * u * v)))

    def _field(self, values: FloatArray) -> FloatArray:
        from scipy.fft import rfft2

        return np.asarray(rfft2(values, self._size))

    def _kernel(self, values: FloatArray) -> FloatArray:
        return np.asarray(np.conj(self._field(values)))

    def _summed(self, transform: FloatArray, kernel: FloatArray) -> FloatArray:
        """The correlation whose transform this is, about the middle of the kernel."""
        from scipy.fft import irfft2

        h, w = self.used.shape
        middle = [n // 2 for n in kernel.shape]
        return np.asarray(np.roll(irfft2(transform, self._size), middle, (0, 1))[:h, :w])

    def relief(self, template: FloatArray, radius: float, compared: BoolArray, expected_mm: float) -> Relief:
        """Of a relief (its height per mm) about each cell; `expected_mm`: standard deviation of its amount beforehand."""
        left = self._left_of[radius]
        whole = without_slow(template, radius)
        f_v, f_u = (np.asarray(np.gradient(whole, axis=axis)) for axis in (0, 1))
        top = self._summed(left.along[0] * self._kernel(f_u) + left.along[1] * self._kernel(f_v), whole)
        uu, vv, uv = left.energies
        energy = self._summed(
            uu * self._kernel(f_u**2) + vv * self._kernel(f_v**2) + uv * self._kernel(f_u * f_v), whole
        )  # fmt: skip
        energy = np.maximum(energy, 1e-12)
        z = -top / np.sqrt(energy)
        unit = _unit(z[compared])
        self.unit = self.unit or unit
        known = energy / self.unit**2 * expected_mm**2
        evidence = 0.5 * (z / self.unit) ** 2 * known / (1.0 + known) - 0.5 * np.log1p(known)
        return Relief(z / unit, -top / energy, unit / np.sqrt(energy), evidence)

    def spots(self, patterns: Sequence[FloatArray], expected: float) -> FloatArray:
        """(h, w) ln of the evidence of a spot, of the better radius, in which d changes by some of each of the patterns (h, w): normal amounts of deviation
        `expected`."""
        return np.asarray(np.max([self._spot(patterns, expected, radius) for radius in self._left_of], axis=0))

    def _spot(self, patterns: Sequence[FloatArray], expected: float, radius: float) -> FloatArray:
        left = self._left_of[radius]
        spot = without_slow(dent(radius, 1.0), radius)
        once, twice = self._kernel(spot), self._kernel(spot**2)

        def about(values: FloatArray, kernel: FloatArray) -> FloatArray:
            return self._summed(self._field(left.w * values) * kernel, spot)

        right = np.stack([about(left.d * p, once) for p in patterns], axis=-1) / self.unit**2
        rows = [np.stack([about(p * q, twice) for p in patterns], axis=-1) for q in patterns]
        prior = np.eye(len(patterns)) / expected**2
        whole = np.stack(rows, axis=-2) / self.unit**2 + prior
        explained = (right * np.linalg.solve(whole, right[..., None])[..., 0]).sum(-1)
        return np.asarray(0.5 * explained - 0.5 * np.log(np.linalg.det(whole * expected**2)))


def _unit(z: FloatArray) -> float:
    return max(float(np.median(np.abs(z))) / _NORMAL_MAD, 1e-12) if z.size else 1.0


def _mesh(radius: float) -> tuple[FloatArray, FloatArray]:
    reach = math.ceil(_REACH * radius)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(float)
    return x, y


def dent(radius: float, smoothing: float) -> FloatArray:
    """A raised cosine of this radius (cells), as normals smoothed over `smoothing` cells show it."""
    from scipy.ndimage import gaussian_filter

    x, y = _mesh(radius)
    apart = np.minimum(np.hypot(x, y) / radius, 1.0)
    return np.asarray(gaussian_filter(0.5 * (1.0 + np.cos(math.pi * apart)), smoothing))


def steps(radius: float, smoothing: float) -> list[FloatArray]:
    """Steps across a disc of this radius in DIRECTIONS directions; what leads up to them fades slowly."""
    from scipy.ndimage import gaussian_filter

    x, y = _mesh(radius)
    fade = np.exp(-0.5 * (np.hypot(x, y) / radius) ** 2)
    angles = np.arange(DIRECTIONS) * math.pi / DIRECTIONS
    return [np.asarray(gaussian_filter(np.sign(math.cos(a) * x + math.sin(a) * y), smoothing)) * 0.5 * fade for a in angles]


def without_slow(template: FloatArray, radius: float) -> FloatArray:
    """The template as it is left when what is slow is taken from it."""
    from scipy.ndimage import gaussian_filter

    return np.asarray(template - gaussian_filter(template, BROAD * radius, truncate=3.0))
