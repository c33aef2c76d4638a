"""Dents of a scan by a second photograph: filters of a dent's own shape, matched to what two cameras saw.

Were the range longer by o, the second camera's light at a cell would be R_o; against the scan's own light L, both in logarithms, less their mean and over
their spread in a window, the cell disagrees by e(o) = w (L - R_o)^2, w one over its usual disagreement around. A dent in the scan, a raised cosine t of
distance on the surface about a place, is undone by ranges changed by a t:

    G(a) = 1/2 sum e(slow) - e(slow + a t)

is how much better the pictures then agree, as a logarithm of likelihood, and its highest point gives the most likely a. `slow` is the offset of the
place's surroundings, which is the calibration's. No slope of the picture is taken, so that a may carry it over many pixels.

Z = sqrt(2 G) in units of its own spread over the picture tells how far chance is; but ranges are never as good as pictures tell, so that amounts of s0
are found everywhere (its spread is taken from their middle one where the pictures tell much, and counts twice for its long tails), and the measure of a dent is

    z = 1 / sqrt(1/Z^2 + s0^2/a^2)

A place is judged where G(a) falls so much within JUDGED_MM of its best that a dent this deep would be named in 95 of 100 cases. Scan frame, millimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.kernels import kernel
from rangecheck.recover.carried import Carried
from rangecheck.recover.grid import masked_gauss
from rangecheck.recover.regions import inner

#: dents of these radii are looked for, mm;  depth from which one is to be named where a place counts as judged
RADII_MM, JUDGED_MM = (4.0, 6.0, 8.0), 1.0
#: chance of one false name per scan that the level is for, and the share of dents of JUDGED_MM that is named where one is judged
CHANCE, _POWER = 0.01, 0.95
#: most that a range may be off, and steps of it, mm;  window of mean and spread;  of the usual disagreement;  of what is slow
_MOST_MM, _STEP_MM, _WINDOW_MM, _USUAL_MM, _SLOW_MM = 2.4, 0.15, 1.5, 4.0, 20.0
#: share of full scale from which a picture is full;  places nearer to a rim, where the smallest dent is not whole, are not judged, mm
_FULL, _RIM_MM = 0.98, RADII_MM[0]
#: offsets among which the usual disagreement is the least
_NEAR_MM = 1.5
#: offsets beyond what amounts reach, for the surroundings' own;  places are tried this far apart;  cells averaged before what is slow is sought
_SLACK_MM, _APART_MM, _COARSE = 0.6, 1.5, 4
#: least spread of light and least usual disagreement, as shares of the middle one;  squares of disagreement that count at most, in middle ones
_LEAST_SPREAD, _LEAST_USUAL, _CAPPED = 0.02, 0.05, 9.0
#: half of what is normal lies within this many deviations; amounts found everywhere have tails this many times as long
_NORMAL_MAD, _TAILS = 0.6744897501960817, 2.0


@dataclass(frozen=True, eq=False)
class Dents:
    """Dents of the radius that tells most, place by place, on the grid (h, w); NaN where no radius is judged.

    z, amount_mm: by which ranges would have to change;  radius_mm;  level: z from which a dent is named;  spread_mm: s0;  judged: share of
    the valid cells, of each of RADII_MM, judges (k, h, w) which they are;  places: discs that fit into what is judged, of each"""

    z: FloatArray
    amount_mm: FloatArray
    radius_mm: FloatArray
    level: float
    spread_mm: float
    judged: tuple[float, ...]
    judges: BoolArray
    places: tuple[int, ...]

    @property
    def named(self) -> BoolArray:
        """(h, w) cells of the places where a dent is named."""
        return np.asarray(np.nan_to_num(self.z) > self.level)


def dents(pair: Carried) -> Dents:
    """Dents of all RADII_MM where the two pictures tell."""
    offsets = np.arange(-_MOST_MM - _SLACK_MM, _MOST_MM + _SLACK_MM + 0.5 * _STEP_MM, _STEP_MM)
    amounts = np.arange(-_MOST_MM, _MOST_MM + 0.5 * _STEP_MM, _STEP_MM)
    spacing = pair.grid.spacing_mm
    valid = _telling(pair, offsets)
    if not valid.any():
        nothing = np.full(pair.grid.valid.shape, np.nan)
        none = (0.0,) * len(RADII_MM), np.zeros((len(RADII_MM), *nothing.shape), bool), (0,) * len(RADII_MM)
        return Dents(nothing, nothing, nothing, math.inf, math.inf, *none)
    apart = _disagreement(pair, valid, offsets)
    weight = _weight(apart, valid, offsets, spacing)
    slow = _slow(apart * weight, valid, offsets, spacing)
    stride = max(1, round(_APART_MM / spacing))
    rows, columns = np.nonzero(pair.valid)
    on = (rows % stride == 0) & (columns % stride == 0)
    # windows at rims are one-sided
    within = inner(valid, _RIM_MM / spacing)
    rows, columns = rows[on], columns[on]
    points = np.nan_to_num(pair.grid.points[pair.held])
    found = []
    for radius in RADII_MM:
        gain = _gains(
            apart, weight, (slow - offsets[0]) / _STEP_MM, points, valid, rows, columns, radius, math.ceil(radius / spacing),
            amounts / _STEP_MM,
        )  # fmt: skip
        found.append(_peak(gain, amounts))
    valid_mm2 = len(rows) * (stride * spacing) ** 2
    tried = sum(valid_mm2 / (math.pi * radius**2) for radius in RADII_MM)
    level = NormalDist().inv_cdf(1.0 - CHANCE / (2.0 * max(1.0, tried)))
    needed = level + NormalDist().inv_cdf(_POWER)
    # what is found everywhere: of the widest dents, where the pictures alone would tell them
    amount, big, clear = found[-1]
    well = within[rows, columns] & (clear > needed)
    spread_mm = _TAILS * float(np.median(np.abs(amount[well]))) / _NORMAL_MAD if well.any() else math.inf
    z, depth, wide = (np.full(len(rows), np.nan) for _ in range(3))
    shares, places, judges = [], [], []
    for radius, (amount, big, clear) in zip(RADII_MM, found):
        judged = within[rows, columns] & (_combined(clear, np.full(len(clear), JUDGED_MM), spread_mm) > needed)
        here = _combined(big, amount, spread_mm)
        stronger = judged & ~(z >= here)
        z, depth, wide = np.where(stronger, here, z), np.where(stronger, amount, depth), np.where(stronger, radius, wide)
        judges.append(_on_grid(pair, rows, columns, stride, judged.astype(float)) == 1.0)
        shares.append(float(judged.mean()) if len(judged) else 0.0)
        places.append(round(shares[-1] * valid_mm2 / (math.pi * radius**2)))
    maps = [_on_grid(pair, rows, columns, stride, values) for values in (z, depth, wide)]
    return Dents(maps[0], maps[1], maps[2], level, spread_mm, tuple(shares), np.array(judges), tuple(places))


def _combined(big: FloatArray, amount: FloatArray, spread_mm: float) -> FloatArray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(1.0 / np.sqrt(1.0 / big**2 + (spread_mm / amount) ** 2))


def _telling(pair: Carried, offsets: FloatArray) -> BoolArray:
    """(h, w) cells that stay in the second picture at all offsets, away from where either picture is full."""
    from scipy.ndimage import binary_dilation

    inside = pair.holds(float(offsets[0])) & pair.holds(float(offsets[-1]))
    full = (pair.own > math.log(_FULL)) | (pair.there(0.0) > math.log(_FULL * float(pair.light.max())))
    reach = math.ceil(_WINDOW_MM / pair.grid.spacing_mm)
    spoilt = binary_dilation(pair.spread(full.astype(float)) > 0.0, iterations=reach)
    return np.asarray((pair.spread(inside.astype(float)) > 0.0) & ~spoilt)


def _mean(values: FloatArray, valid: BoolArray, cells: float) -> FloatArray:
    return np.nan_to_num(masked_gauss(values, valid.astype(float), cells))


def _disagreement(pair: Carried, valid: BoolArray, offsets: FloatArray) -> FloatArray:
    """(k, h, w) squared difference of the two pictures' local structure, for each offset of the range."""
    window = _WINDOW_MM / pair.grid.spacing_mm

    def structure(light: FloatArray, least: float) -> tuple[FloatArray, float]:
        fine = (light - _mean(light, valid, window)) * valid
        square = _mean(fine * fine, valid, window)
        least = least or _LEAST_SPREAD * float(np.median(square[valid]))
        return fine / np.sqrt(square + max(least, 1e-12)), least

    own, least = structure(pair.spread(pair.own), 0.0)
    apart = np.empty((len(offsets), *valid.shape), np.float32)
    for k, offset in enumerate(offsets):
        apart[k] = (own - structure(pair.spread(pair.there(float(offset))), least)[0]) ** 2
    return apart


def _weight(apart: FloatArray, valid: BoolArray, offsets: FloatArray, spacing_mm: float) -> FloatArray:
    """(h, w) one over the usual disagreement around, at the offset where it is least: a fault of the range is no noise."""
    middle = float(np.median(apart[len(offsets) // 2][valid]))
    usual = np.full(valid.shape, np.inf)
    for k in np.flatnonzero(np.abs(offsets) <= _NEAR_MM)[::2]:
        usual = np.minimum(usual, _mean(np.minimum(apart[k], _CAPPED * middle), valid, _USUAL_MM / spacing_mm))
    return np.where(valid, 1.0 / np.maximum(usual, _LEAST_USUAL * middle + 1e-12), 0.0)


def _slow(apart: FloatArray, valid: BoolArray, offsets: FloatArray, spacing_mm: float) -> FloatArray:
    """(h, w) the offset at which the surroundings agree best."""
    h, w = (-(-n // _COARSE) * _COARSE for n in valid.shape)

    def coarse(values: FloatArray) -> FloatArray:
        full = np.zeros((h, w))
        full[: values.shape[0], : values.shape[1]] = values
        return np.asarray(full.reshape(h // _COARSE, _COARSE, w // _COARSE, _COARSE).sum(axis=(1, 3)))

    count = coarse(valid.astype(float))
    sigma = _SLOW_MM / spacing_mm / _COARSE
    means = [np.nan_to_num(masked_gauss(coarse(values) / np.maximum(count, 1.0), count, sigma)) for values in apart]
    place, _ = _lowest(np.moveaxis(np.array(means), 0, -1))
    fine = np.repeat(np.repeat(offsets[0] + _STEP_MM * place, _COARSE, axis=0), _COARSE, axis=1)
    return fine[: valid.shape[0], : valid.shape[1]]


def _lowest(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Place (in steps) and value of the least along the last axis, between the steps by a parabola."""
    k = np.clip(values.argmin(axis=-1), 1, values.shape[-1] - 2)
    before, least, after = (np.take_along_axis(values, (k + d)[..., None], -1)[..., 0] for d in (-1, 0, 1))
    bend = before - 2.0 * least + after
    aside = np.where(bend > 0.0, np.clip(0.5 * (before - after) / np.where(bend > 0.0, bend, 1.0), -1.0, 1.0), 0.0)
    return k + aside, least + 0.25 * aside * (after - before)


def _peak(gain: FloatArray, amounts: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of gains (n, k): most likely amounts (n,) mm; Z there; and what Z would be, were the scan wrong by JUDGED_MM more or less than that."""
    zero, reach = len(amounts) // 2, round(JUDGED_MM / _STEP_MM)
    place, lowest = _lowest(-gain)
    best = np.rint(place).astype(np.intp)
    fallen = np.full(len(gain), np.inf)
    for other in (best - reach, best + reach):
        # what still rises towards the last amount tried has no height of its own
        at = np.take_along_axis(gain, np.clip(other, 0, len(amounts) - 1)[:, None], 1)[:, 0]
        fallen = np.minimum(fallen, -lowest - at)
    # the spread of Z is that of slope over root of bend at no dent
    slope, bend = gain[:, zero + 2] - gain[:, zero - 2], -(gain[:, zero + 2] + gain[:, zero - 2])
    bent = bend > 0.0
    near = np.abs(slope[bent]) / np.sqrt(bend[bent]) / 2.0
    unit = max(1.0, float(np.median(near)) / _NORMAL_MAD) if near.size else math.inf
    big, clear = (np.sqrt(2.0 * np.maximum(values, 0.0)) / unit for values in (-lowest, fallen))
    return amounts[0] + _STEP_MM * place, big, clear


def _on_grid(pair: Carried, rows: IntArray, columns: IntArray, stride: int, values: FloatArray) -> FloatArray:
    """Places' values on all valid cells of their squares."""
    h, w = (-(-n // stride) for n in pair.valid.shape)
    coarse = np.full((h, w), np.nan)
    coarse[rows // stride, columns // stride] = values
    fine = np.repeat(np.repeat(coarse, stride, axis=0), stride, axis=1)[: pair.valid.shape[0], : pair.valid.shape[1]]
    full = np.full(pair.grid.valid.shape, np.nan)
    full[pair.held] = np.where(pair.valid, fine, np.nan)
    return full


@kernel
def _gains(apart, weight, slow, points, valid, rows, columns, radius, reach, amounts):
    """G(a) of dents of `radius` mm about each place, (n, k); slow and amounts in steps of the offsets."""
    gain = np.zeros((len(rows), len(amounts)))
    count, h, w = apart.shape
    for i in range(len(rows)):
        row, column = rows[i], columns[i]
        for r in range(max(0, row - reach), min(h, row + reach + 1)):
            for c in range(max(0, column - reach), min(w, column + reach + 1)):
                if not valid[r, c]:
                    continue
                x = points[r, c, 0] - points[row, column, 0]
                y = points[r, c, 1] - points[row, column, 1]
                z = points[r, c, 2] - points[row, column, 2]
                away = math.sqrt(x * x + y * y + z * z) / radius
                if away >= 1.0:
                    continue
                t = 0.5 * (1.0 + math.cos(math.pi * away))
                for j in range(len(amounts)):
                    at = min(max(slow[r, c] + amounts[j] * t, 0.0), count - 1.000001)
                    k = int(at)
                    gain[i, j] -= 0.5 * weight[r, c] * ((1.0 - at + k) * apart[k, r, c] + (at - k) * apart[k + 1, r, c])
        level = gain[i, len(amounts) // 2]
        for j in range(len(amounts)):
            gain[i, j] -= level
    return gain
