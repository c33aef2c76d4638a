"""Does the scan explain a second photograph? The picture on the scan's own grid, carried by the scan's shape into another camera, must be what that
camera saw: paint, which hides shape from shading, is here what shows it.

A range that is wrong by d moves its place in the second picture along the epipolar line. Per cell the offset d is taken at which the two pictures,
in logarithms of light, correlate best over a Gaussian window (normalised cross-correlation, so that each window has its own gain), between the offsets
tried by a parabola. Where paint has no structure, or the cameras see a gloss, they do not correlate and the place is not judged.

Of noise s in what differs, d has the variance s^2 / sum (dL/dd)^2, which is (1 - c^2) over the bend of the correlation c at its top (Cramer and Rao's bound for a
delay): the less two windows agree, as where the cameras see a gloss in different places, the less their offset counts.

Steps are named by the jump of d: the most certain difference between its means over two halves of a disc, over all directions. Slow changes of d are the
calibration's; a dent has a ring of jumps, two badly joined pieces a line of them. The scale of their deviations is taken from the picture itself (median
absolute), amounts s0 that are found where they are small count as found everywhere, and z = jump / sqrt(deviation^2 + s0^2) is named from Bonferroni's level for as
many places as discs fit into what is judged. Its tails are longer than a normal one's, so nothing below
LEAST_MM is named either. Where a false shape changes much within one window, the pictures no longer correlate and the place drops out of what is judged: whole
dents are therefore looked for by filters of their own shape (`dents`), which judge more of the scan. Scan frame, millimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import ScanError
from rangecheck.recover.carried import carried
from rangecheck.recover.dents import Dents, dents
from rangecheck.recover.grid import ScanGrid
from rangecheck.recover.regions import Region, inner, regions_of
from rangecheck.scan import RangeScan
from rangecheck.scan.decode import View

#: Gaussian window of the correlation and radius of the disc, mm;  offsets tried, mm
WINDOW_MM, DISC_MM, REACH_MM, OFFSET_MM = 2.0, 5.0, 1.6, 0.2
#: jumps below this are not named;  chance of one false name per scan that the level is for
LEAST_MM, CHANCE = 0.15, 0.01
#: correlation from which a window is believed, and share of a half disc that must be judged
_CORRELATED, _FILLED = 0.85, 0.5
_DIRECTIONS = 8
_NORMAL_MAD = 0.6744897501960817
#: 1 - c^2 of windows that agree as well as can be
_LEAST_APART = 1e-3


@dataclass(frozen=True, eq=False)
class Agreement:
    """offset_mm (h, w) by which the range would have to change, NaN where not judged;  jump_mm, z (h, w);  noise_mm: of a jump, median;  level: z from which a
    place is named;  level_mm: the jump that is, median;  places: discs that fit into what is judged;  judged: its share of the valid cells;  spacing_mm, step: of the grid;  dents: whole dents, with
    what of the scan is judged for them;  regions, the clearest first"""

    offset_mm: FloatArray
    jump_mm: FloatArray
    z: FloatArray
    noise_mm: float
    level: float
    level_mm: float
    places: int
    judged: float
    spacing_mm: float
    step: int
    dents: Dents
    regions: tuple[Region, ...]


def second_view(scan: RangeScan, picture: FloatArray, view: View, *, step: int = 1) -> Agreement:
    """The scan with its brightness against `picture` (h, w), any scale of light, taken by `view` under the same lamp.

    step: rows and columns averaged to one. Raises ScanError where the scan has no brightness or the two see nothing alike."""
    from scipy.ndimage import gaussian_filter

    pair = carried(scan, picture, view, step)
    grid, valid, seen, own = pair.grid, pair.valid, pair.seen, pair.own
    sigma = WINDOW_MM / grid.spacing_mm
    norm = gaussian_filter(valid.astype(float), sigma)[valid]

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(gaussian_filter(pair.spread(values), sigma)[valid] / norm)

    own_mean = mean(own)
    own_spread = mean(own**2) - own_mean**2
    offsets = np.arange(-REACH_MM, REACH_MM + 0.5 * OFFSET_MM, OFFSET_MM)
    match = np.empty((len(offsets), len(own)))
    for k, offset in enumerate(offsets):
        there = pair.there(float(offset))
        there_mean = mean(there)
        spread = own_spread * (mean(there**2) - there_mean**2)
        match[k] = (mean(own * there) - own_mean * there_mean) / np.sqrt(np.maximum(spread, 1e-18))
    best = match.argmax(axis=0)
    between = np.clip(best, 1, len(offsets) - 2)
    cell = np.arange(len(own))
    before, peak, after = (match[between + d, cell] for d in (-1, 0, 1))
    bend = before - 2.0 * peak + after
    believed = seen & (best == between) & (peak > _CORRELATED) & (bend < 0.0)
    if not believed.any():
        raise ScanError(
            f"{scan.name}: the two pictures agree nowhere; check that both show this scan under one lamp, and the camera"
        )
    found = offsets[between] + 0.5 * OFFSET_MM * (before - after) / np.where(bend < 0.0, bend, -1.0)
    offset_mm = np.full(grid.valid.shape, np.nan)
    offset_mm[grid.valid] = np.where(believed, found, np.nan)
    # windows at rims are one-sided
    offset_mm[~inner(grid.valid, 0.5 * sigma)] = np.nan
    variance = np.full(grid.valid.shape, np.nan)
    variance[grid.valid] = np.maximum(1.0 - peak**2, _LEAST_APART) / np.where(bend < 0.0, -bend, np.nan)
    return _judged(grid, offset_mm, variance, pair.held, dents(pair))


def _judged(grid: ScanGrid, offset_mm: FloatArray, variance: FloatArray, held: tuple[slice, slice], sunken: Dents) -> Agreement:
    jump, z = (np.full(grid.valid.shape, np.nan) for _ in range(2))
    jump[held], unscaled = jumps(offset_mm[held], variance[held], DISC_MM / grid.spacing_mm)
    known = np.isfinite(jump)
    count = int(known.sum())
    places = max(1, round(count * grid.spacing_mm**2 / (math.pi * DISC_MM**2)))
    # the jump is the most certain of several directions, each of either sign
    level = NormalDist().inv_cdf(1.0 - CHANCE / (2.0 * _DIRECTIONS * places))
    noise = level_mm = math.nan
    if count:
        deviation = np.full(grid.valid.shape, np.nan)
        deviation[held] = unscaled
        deviation *= float(np.median((jump / deviation)[known])) / _NORMAL_MAD
        well = known & (deviation <= np.median(deviation[known]))
        whole_deviation = np.hypot(deviation, float(np.median(jump[well])) / _NORMAL_MAD)
        z = jump / whole_deviation
        noise = float(np.median(whole_deviation[known]))
        level_mm = max(LEAST_MM, level * noise)
    # a jump is as wide as its disc: less is the picture's grain
    least = 0.25 * math.pi * WINDOW_MM**2
    over = (np.nan_to_num(z) > level) & (np.nan_to_num(jump) > LEAST_MM)
    stepped = regions_of(over, z, grid.points, grid.spacing_mm, least)
    whole = [
        replace(region, kind="shape", asked=sunken.level, amount_mm=-float(sunken.amount_mm[region.cell]))
        for region, _ in regions_of(sunken.named, sunken.z, grid.points, grid.spacing_mm, 0.0)
    ]
    # around a dent the range jumps, too
    reaches = [(grid.points[region.cell], float(sunken.radius_mm[region.cell]) + DISC_MM) for region in whole]
    alone = [
        replace(region, asked=level, amount_mm=float(jump[region.cell])) for region, _ in stepped
        if all(float(np.linalg.norm(grid.points[region.cell] - middle)) > reach for middle, reach in reaches)
    ]  # fmt: skip
    regions = tuple(sorted([*whole, *alone], key=lambda region: -region.z))
    share = count / max(1, int(grid.valid.sum()))
    return Agreement(offset_mm, jump, z, noise, level, level_mm, places, share, grid.spacing_mm, grid.step, sunken, regions)


def jumps(values: FloatArray, variance: FloatArray, radius: float) -> tuple[FloatArray, FloatArray]:
    """(h, w) the most certain absolute difference of means over two halves of a disc (radius in cells), weighted by one over the values' variance, and its
    deviation as if each half were one value; NaN where a half is not filled."""
    from scipy.signal import fftconvolve

    reach = math.ceil(radius)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = np.hypot(x, y) <= radius
    known = np.isfinite(values) & np.isfinite(variance)
    # sums by Fourier transforms err by parts of the largest term
    least = 1e-3 * float(np.median(variance[known])) if known.any() else 1.0
    weight = np.where(known, 1.0 / np.maximum(np.where(known, variance, 1.0), least), 0.0)
    filled, ones = np.where(known, values, 0.0) * weight, known.astype(float)
    jump, deviation = (np.full(values.shape, np.nan) for _ in range(2))
    for angle in np.arange(_DIRECTIONS) * math.pi / _DIRECTIONS:
        side = math.cos(angle) * x + math.sin(angle) * y
        means, squares, full = [], np.zeros(values.shape), known.copy()
        for half in (disc & (side > 0.5), disc & (side < -0.5)):
            kernel = half[::-1, ::-1].astype(float)
            count, total, top = (fftconvolve(field, kernel, mode="same") for field in (ones, weight, filled))
            full &= count > _FILLED * half.sum()
            total = np.where(full, total, 1.0)
            means.append(top / total)
            squares += count / total
        apart, sure = np.abs(means[0] - means[1]), np.sqrt(np.maximum(squares, 0.0))
        surer = full & ~(jump * sure >= apart * deviation)
        jump, deviation = np.where(surer, apart, jump), np.where(surer, sure, deviation)
    return jump, deviation
