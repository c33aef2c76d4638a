"""Range, bends and picture in one sum of squares, and the heights at which it is least.

The unknowns are q = ln range of the valid cells of a grid. Brightness is held against the shading of the slopes of cells and of those halfway between two
linked cells: a cell's own slopes, being means over two links, say nothing of heights that alternate. Bends hide from a cell what happens within it: of
standard deviation s a cell they make slopes that walk at random, and the mean of such a slope over a pixel, which the picture has, and that over the two cells
of a central difference are s / sqrt(24) apart, as are those over a link and over its two pixels. Cells at which surfaces end, with no bend to either side,
hide no less. Where a surface faces the lamp its brightness hardly changes with slope, and what is hidden is of second order. A bend of many standard
deviations is a kink, and weighs as little as it is likely: strands of hair and creases then keep their edges, and what lies beside them stays as smooth as it
is (Black and Rangarajan, *On the unification of line processes, outlier rejection, and robust statistics*, 1996).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.recover.gradients import solve
from rangecheck.recover.grid import masked_gauss
from rangecheck.recover.heights import HeightGrid, Slopes
from rangecheck.recover.shading import Shading

#: bends of a surface, as 1/mm of curvature: the tightest prior tried, and the factor by which it is loosened where it takes too much away
_CURVATURE, _LOOSER, _RUNGS = 1.0 / 60.0, 2.0, 14
#: standard deviations of a bend from which it is more of a kink than of a bend (Cauchy's weights), and solutions of each rung that find its kinks
_KINK, _KINK_TURNS = 2.0, 2
#: cells over which what is taken away is averaged, and how many of its standard deviations are still noise
_WINDOW, _NOISE_SIGMAS = 1.5, 3.0
#: mean square of it, in variances, up to which bends that alternate are still noise: with 28 cells to a window, three deviations above 1
_MOST_ENERGY = 1.8
_STEPS, _BEND = 5, 2.0
#: of the prior's bends, found in steps of `_LOOSER` and so too large by its root in the middle, the part that slopes miss; times it at rims, where
#: slopes are one-sided and surfaces turn away from the view
_MISSED, _RIM = 1.0 / np.sqrt(24.0 * _LOOSER), 4.0
#: cells over which heights are held against the range again (113 to a window), and random signs that tell the influence of a cell on itself
_TRUST_WINDOW, _PROBES = 3.0, 2
#: times the expected square of what is taken away that chance explains (its deviation is 1.13 in such a window), and the power of its excess over that
_CHANCE, _DISTRUST = 1.15, 2.0


@dataclass(frozen=True, eq=False)
class Look:
    """What the picture shows of k places: their slopes and shading; ends (k, e) numbers, among the inner cells, of those whose brightness it is; unseen (k,)
    standard deviation of brightness that comes of bends within; share: weight of each."""

    slopes: Slopes
    shading: Shading
    ends: IntArray
    unseen: FloatArray
    share: float


class Balance:
    """The sum of squares and its least.

    heights; measured (n,) ln range, its standard deviation sigma (n,); bend_unit (b,) second difference of q of a surface of curvature 1/mm."""

    def __init__(self, heights: HeightGrid, measured: FloatArray, sigma: FloatArray, bend_unit: FloatArray) -> None:
        self.heights, self.measured, self.sigma, self.bend_unit = heights, measured, sigma, bend_unit
        self.curvature: FloatArray = np.full(len(measured), _CURVATURE)
        self._data = sparse.diags_array(1.0 / sigma**2)

    def on(self, heights: HeightGrid, bend_unit: FloatArray) -> Balance:
        """The same ranges and bends on the same cells, otherwise linked."""
        there = Balance(heights, self.measured, self.sigma, bend_unit)
        there.curvature = self.curvature
        return there

    def _prior(self, q: FloatArray | None = None, *, second: bool = False) -> sparse.csr_array:
        """Of ranges and bends, the bends weighed as those of heights `q` are likely; or, where they are not negative, their second derivatives at `q`."""
        bend = self.heights.bend
        weight = (self.curvature[self.heights.bend_cell] * self.bend_unit) ** -2.0
        if q is not None:
            z = ((bend @ q) / _KINK) ** 2 * weight
            weight = weight * (np.maximum(1.0 - z, 0.0) / (1.0 + z) ** 2 if second else 1.0 / (1.0 + z))
        return sparse.csr_array(self._data + bend.T @ (sparse.diags_array(weight) @ bend))

    def settle(self) -> FloatArray:
        """Heights of least range and bends, the bends loosened where they take away more than noise."""
        q, right = self.measured, self.measured / self.sigma**2
        bent: FloatArray | None = None
        for _ in range(_RUNGS):
            for _ in range(_KINK_TURNS if bent is not None else 1):
                q = bent = solve(self._prior(bent), right, q, self.sigma)
            strained = self.strained(q)
            if not strained.any():
                break
            self.curvature = np.where(strained, self.curvature * _LOOSER, self.curvature)
        q = solve(self._prior(bent), right, q, self.sigma)
        self.curved = self._prior(q, second=True)
        return q

    def strained(self, q: FloatArray, sigmas: float = _NOISE_SIGMAS, most: float = _MOST_ENERGY) -> BoolArray:
        """(n,) cells around which what was taken away is no noise."""
        from scipy.ndimage import maximum_filter

        ones = self.heights.spread(np.ones(len(q)), 0.0)
        taken = self.heights.spread((q - self.measured) / self.sigma, 0.0)
        # mean over a Gaussian window has 1 / (2 sqrt(pi) w) of the noise of one cell
        away = np.nan_to_num(masked_gauss(taken, ones, _WINDOW)) * 2.0 * np.sqrt(np.pi) * _WINDOW
        energy = np.nan_to_num(masked_gauss(taken * taken, ones, _WINDOW))
        odd = (np.abs(away) > sigmas) | (energy > most)
        near = maximum_filter(odd.astype(np.uint8), size=2 * round(_WINDOW) + 1)
        return np.asarray(near.reshape(-1)[self.heights.cell] > 0)

    def look(self, q: FloatArray, slopes: Slopes, shading: Shading, ends: IntArray, share: float) -> Look:
        """What the picture shows of `slopes`, as far as heights `q` tell how much bends within a cell, or within a link, hide of it."""
        normals, slope_u, slope_v = slopes.normals(q)
        value, by_normal = shading.at(normals)
        unit = self.heights.spacing * np.exp(self.measured)
        bends = _MISSED * (self.curvature * unit)[self.heights.inner] * np.where(self.heights.whole, 1.0, _RIM)
        hidden = bends[ends].mean(axis=1)
        by_slope = np.hypot((by_normal * slope_u).sum(1), (by_normal * slope_v).sum(1))
        # a normal that turns by a and b takes (a^2 + b^2) / 2 of the brightness away: where both are alike and Gaussian (<a^2> + <b^2>) / sqrt(2), root mean square
        squared = hidden**2 * ((slope_u**2).sum(1) + (slope_v**2).sum(1))
        return Look(slopes, shading, ends, np.hypot(hidden * by_slope, np.sqrt(0.5) * value * squared), share)

    def with_picture(self, q: FloatArray, looks: Sequence[Look], believed: BoolArray, noise: FloatArray) -> FloatArray:
        """Gauss-Newton from `q` with what the looks show of believed cells (m,), whose brightness has `noise` (m,)."""
        used = []
        for look in looks:
            keep = np.flatnonzero(believed[look.ends].all(axis=1))
            if len(keep) == 0:
                continue
            deviation = np.sqrt((noise[look.ends] ** 2).mean(axis=1) + look.unseen**2)[keep]
            used.append((look.slopes.only(keep), look.shading.only(keep), deviation, look.share))

        def balance(q: FloatArray, second: bool = False) -> tuple[sparse.csr_array, FloatArray]:
            matrix, right = self._prior(q, second=second), self.measured / self.sigma**2
            for slopes, shading, deviation, share in used:
                normals, slope_u, slope_v = slopes.normals(q)
                value, by_normal = shading.at(normals)
                r = (value - shading.seen) / deviation
                weight = share * (np.abs(r) < _BEND if second else np.minimum(1.0, _BEND / np.maximum(np.abs(r), 1e-9)))
                a = ((by_normal * slope_u).sum(1) / deviation)[:, None]
                b = ((by_normal * slope_v).sum(1) / deviation)[:, None]
                rows = sparse.csr_array(slopes.by_u.multiply(a) + slopes.by_v.multiply(b))
                matrix = sparse.csr_array(matrix + rows.T @ (sparse.diags_array(weight) @ rows))
                right = right + rows.T @ (weight * (rows @ q - r))
            return matrix, right

        for _ in range(_STEPS):
            matrix, right = balance(q)
            moved = solve(matrix, right, q, self.sigma)
            step = float(np.max(np.abs(moved - q) / self.sigma))
            q = moved
            if step < 0.02:
                break
        self.curved, _ = balance(q, second=True)
        return q

    def trusted(self, q: FloatArray, noise: FloatArray) -> FloatArray:
        """`q` moved back towards the measured where more was taken away than noise (n,) lets expect.

        With y measured, its variance 1, d the influence of a cell on itself and e the mean square of q - y, the mean square error of y + t (q - y) is expected to
        be 1 + t^2 e - 2 t (1 - d) whatever the surface (Stein, *Estimation of the mean of a multivariate normal distribution*, 1981): least at
        t = (1 - d) / e. d comes of random signs (Ramani, Blu and Unser, *Monte-Carlo SURE*, 2008). Where e is no larger than chance makes it all is
        kept; where it is, t falls with the square of the excess: what is smoothed was itself chosen by the noise, so that d is too small there."""
        heights, rng = self.heights, np.random.default_rng(0)
        influence = np.zeros(len(q))
        for _ in range(_PROBES):
            sign = rng.choice([-1.0, 1.0], len(q))
            answer = solve(self.curved, sign / self.sigma, np.zeros(len(q)), self.sigma, 0.03)
            influence += sign * answer / (self.sigma * _PROBES)
        ones = heights.spread(np.ones(len(q)), 0.0)

        def mean(values: FloatArray) -> FloatArray:
            return np.asarray(masked_gauss(heights.spread(values, 0.0), ones, _TRUST_WINDOW).reshape(-1)[heights.cell])

        expected = mean(noise**2 * (1.0 - influence))
        taken = mean((q - self.measured) ** 2)
        likely = np.maximum(_CHANCE * expected, 0.0)
        share = np.divide(likely, taken, out=np.ones(len(q)), where=taken > likely) ** _DISTRUST
        return np.asarray(self.measured + share * (q - self.measured))
