"""Local fits in the range grid: a quiet range, its slopes and its standard error for every cell of a scan.

Conventions: range r(u, v) in mm over pixel coordinates (u along columns, v along rows); slopes in mm per pixel; `pitch` is the
lateral distance in mm between neighbouring cells seen face-on. NaN = nothing there.

Every cell gets a local quadratic by weighted least squares (Cleveland & Devlin 1988). Its width follows the rule of
intersecting confidence intervals (Katkovnik 1999): it grows until the fitted value leaves what the narrower fits allow, so flat
cheeks are averaged widely and eyelids are not. Cells across a depth jump never enter a fit. The noise comes from the scan
itself: the 3 x 3 mask of Immerkaer (1996), which annihilates quadratics, in classes of obliquity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import in_chunks, kernel
from rangecheck.surface.meshing.edge_fit import BEND_TAN, EDGE_WIDTHS_PX, edge_fit
from rangecheck.surface.meshing.fit_error import STOPPED, noise_factors, noise_of_steps, quadratic_windows, smoothed_away

#: half length of a confidence interval in standard errors: short, since what noise is left is averaged over several scans
CONFIDENCE = 0.7
#: neighbours steeper than this against the plane across the ray belong to another surface
STEEPEST_TAN = math.tan(math.radians(80.0))
#: edges of the obliquity classes of the noise estimate, cosine
COSINE_CLASSES = np.array([0.0, 0.25, 0.4, 0.55, 0.7, 0.85, 1.0])
ROWS = 16
#: cells of a row that are fitted side by side
LANES = 32
Offsets = tuple[FloatArray | None, FloatArray | None]


@kernel
def _planes(ranges, pitch, sigma, first, last, slope_u, slope_v, roughness):
    """Plane through the 5 x 5 neighbours of each cell that no depth jump parts from it; Immerkaer's mask where the 3 x 3 are whole."""
    height, width = ranges.shape
    for row in range(first, last):
        for col in range(width):
            centre = ranges[row, col]
            slope_u[row, col] = slope_v[row, col] = roughness[row, col] = np.nan
            if not math.isfinite(centre):
                continue
            step = STEEPEST_TAN * (pitch[0] * centre + pitch[1])
            n = su = sv = suu = suv = svv = sz = szu = szv = 0.0
            near = 0
            for dv in range(max(-2, -row), min(2, height - 1 - row) + 1):
                for du in range(max(-2, -col), min(2, width - 1 - col) + 1):
                    z = ranges[row + dv, col + du] - centre
                    reach = max(abs(du), abs(dv))
                    if not abs(z) <= step * reach + 5.0 * sigma:
                        continue
                    if reach == 1:
                        near += 1
                    n += 1.0
                    su += du
                    sv += dv
                    suu += du * du
                    suv += du * dv
                    svv += dv * dv
                    sz += z
                    szu += z * du
                    szv += z * dv
            if n < 6.0 or near < 2:
                continue
            auu, auv, avv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
            bu, bv = szu - su * sz / n, szv - sv * sz / n
            det = auu * avv - auv * auv
            if det < 0.5 * n:
                continue
            slope_u[row, col] = (avv * bu - auv * bv) / det
            slope_v[row, col] = (auu * bv - auv * bu) / det
            if near == 8:
                cross = ranges[row - 1, col] + ranges[row + 1, col] + ranges[row, col - 1] + ranges[row, col + 1]
                corners = (
                    ranges[row - 1, col - 1] + ranges[row - 1, col + 1] + ranges[row + 1, col - 1] + ranges[row + 1, col + 1]
                )
                roughness[row, col] = abs(4.0 * centre - 2.0 * cross + corners) / 6.0


@kernel
def _window_sums(ranges, row, first, n, r, window, apart, centre, plane_u, plane_v, slack, bend, sums, whole):
    """sums (3, n): value, u slope, v slope of one window for the n cells first..first + n - 1 of a row, whose sides are all inside the grid;
    whole (n,) 0 where a neighbour lies across a depth jump. All lists of n: cells side by side, so that the processor takes several at once."""
    for c in range(n):
        sums[0, c] = sums[1, c] = sums[2, c] = 0.0
    for dv in range(-r, r + 1):
        line = ranges[row + dv, first - r : first + n + r]
        some = 0
        for du in range(-r, r + 1):
            here = line[du + r : du + r + n]
            value, slope_u, slope_v = window[0, dv + r, du + r], window[1, dv + r, du + r], window[2, dv + r, du + r]
            far = apart[dv + r, du + r]
            for c in range(n):
                z = here[c] - centre[c] - plane_u[c] * du - plane_v[c] * dv
                whole[c] &= np.int64(abs(z) <= slack[c] + bend[c] * far)
                sums[0, c] += value * z
                sums[1, c] += slope_u * z
                sums[2, c] += slope_v * z
        for c in range(n):
            some |= whole[c]
        if not some:
            return


@kernel
def _fits(
    ranges, sigma_cell, pitch, plane_u, plane_v, windows, reaches, gains, apart, edge_widths, confidence, first, last, out, chosen, steps
):  # fmt: skip
    """out (h, w, 4 or more): range, slopes, noise gain times noise in mm of each cell, NaN where a cell has too few neighbours of its own
    surface; chosen (h, w): number of the window, -1 at edges, plus STOPPED where the next one was whole and disagreed; steps (h / 2, w / 2,
    scales): square of the step from the sample to the narrowest width and from each width to the next, less what noise makes of it, as far
    as windows are whole (NaN elsewhere)."""
    height, width = ranges.shape
    scales = len(reaches)
    a, b, unit, edge = np.zeros((6, 6)), np.zeros(6), np.zeros(6), np.zeros(4)
    # of the cells side by side: range, slopes of the plane, what a neighbour may be off, noise, bounds of the value, last value
    centre, pu, pv, slack, bend, sigma = (
        np.empty(LANES),
        np.empty(LANES),
        np.empty(LANES),
        np.empty(LANES),
        np.empty(LANES),
        np.empty(LANES),
    )
    low, high, narrower = np.empty(LANES), np.empty(LANES), np.empty(LANES)
    sums, whole, going = np.empty((3, LANES)), np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    distance = np.empty((2 * reaches[scales - 1] + 1, 2 * reaches[scales - 1] + 1))
    for row in range(first, last):
        for start in range(0, width, LANES):
            n = min(LANES, width - start)
            any_plane = False
            for c in range(n):
                col = start + c
                out[row, col, 0] = out[row, col, 1] = out[row, col, 2] = out[row, col, 3] = np.nan
                chosen[row, col] = -1
                if row % 2 == 0 and col % 2 == 0:
                    steps[row // 2, col // 2, :] = np.nan
                pu[c], pv[c] = plane_u[row, col], plane_v[row, col]
                going[c] = math.isfinite(pu[c])
                any_plane = any_plane or going[c] == 1
                centre[c], sigma[c] = ranges[row, col], sigma_cell[row, col]
                slack[c], bend[c] = 5.0 * sigma[c], BEND_TAN * (pitch[0] * centre[c] + pitch[1])
                low[c], high[c], narrower[c] = -np.inf, np.inf, 0.0
            if not any_plane:
                continue
            for scale in range(scales):
                r = reaches[scale]
                left, right = max(start, r) - start, min(start + n, width - r) - start
                if row < r or row + r >= height or right <= left:
                    break
                for c in range(n):
                    whole[c] = going[c] if left <= c < right else 0
                for dv in range(2 * r + 1):
                    for du in range(2 * r + 1):
                        distance[dv, du] = math.sqrt((du - r) * (du - r) + (dv - r) * (dv - r))
                _window_sums(
                    ranges, row, start + left, right - left, r, windows[scale], distance, centre[left:], pu[left:], pv[left:], slack[left:],
                    bend[left:], sums, whole[left:],
                )  # fmt: skip
                some = False
                for c in range(n):
                    if not whole[c]:
                        going[c] = 0
                        continue
                    col = start + c
                    told = row % 2 == 0 and col % 2 == 0
                    value = sums[0, c - left]
                    if told:
                        steps[row // 2, col // 2, scale] = (value - narrower[c]) ** 2 - apart[scale] * sigma[c] * sigma[c]
                    narrower[c] = value
                    half = confidence * gains[scale] * sigma[c]
                    low[c], high[c] = max(low[c], value - half), min(high[c], value + half)
                    settled = chosen[row, col] >= STOPPED
                    if chosen[row, col] >= 0 and low[c] > high[c] and not settled:
                        settled = True
                        chosen[row, col] += STOPPED
                    if settled:
                        going[c] = told
                        some = some or told
                        continue
                    some = True
                    chosen[row, col] = scale
                    out[row, col, 0] = centre[c] + value
                    out[row, col, 1] = pu[c] + sums[1, c - left]
                    out[row, col, 2] = pv[c] + sums[2, c - left]
                    out[row, col, 3] = gains[scale] * sigma[c]
                if not some:
                    break
            for c in range(n):
                col = start + c
                if chosen[row, col] >= 0 or not math.isfinite(pu[c]):
                    continue
                pitch_mm = pitch[0] * centre[c] + pitch[1]
                if edge_fit(ranges, row, col, pu[c], pv[c], pitch_mm, sigma[c], edge_widths, confidence, a, b, unit, edge):
                    out[row, col, 0], out[row, col, 1], out[row, col, 2] = centre[c] + edge[0], edge[1], edge[2]
                    out[row, col, 3] = edge[3] * sigma[c]


@kernel
def _obliquity(ranges, slope_u, slope_v, pitch, first, last, cosine):
    for row in range(first, last):
        for col in range(ranges.shape[1]):
            lateral = pitch[0] * ranges[row, col] + pitch[1]
            u, v = slope_u[row, col], slope_v[row, col]
            cosine[row, col] = 1.0 / math.sqrt(1.0 + (u * u + v * v) / (lateral * lateral))


@kernel
def _noise(ranges, cosine, pitch, centres, classes, first, last, sigma):
    """sigma (h, w): noise of a range by its obliquity, interpolated between the middles of the classes, never under a thousandth of a pitch."""
    for row in range(first, last):
        for col in range(ranges.shape[1]):
            x = cosine[row, col] if math.isfinite(cosine[row, col]) else 0.0
            k = 0
            while k < len(centres) - 2 and x > centres[k + 1]:
                k += 1
            t = min(max((x - centres[k]) / (centres[k + 1] - centres[k]), 0.0), 1.0)
            value = classes[k] + t * (classes[k + 1] - classes[k])
            r = ranges[row, col]
            lateral = pitch[0] * (r if math.isfinite(r) else 0.0) + pitch[1]
            sigma[row, col] = max(value, 1e-3 * lateral)


def noise_by_obliquity(roughness: FloatArray, cosine: FloatArray, stated_mm: float | None) -> FloatArray:
    """Standard deviation of range in each class of COSINE_CLASSES, (6,) mm.

    A class with under 200 cells takes its neighbour's; a scan with none takes `stated_mm`, or nothing (zero)."""
    sigma = np.full(len(COSINE_CLASSES) - 1, np.nan)
    which = np.digitize(cosine, COSINE_CLASSES[1:-1])
    usable = np.isfinite(roughness) & np.isfinite(cosine)
    for k in range(len(sigma)):
        values = roughness[usable & (which == k)]
        if len(values) >= 200:
            # depth jumps and creases are a tail: the mean of what lies within three medians, which for a normal law is 0.7255 sigma
            median = float(np.median(values))
            kept = values[values <= 3.0 * median] if median > 0 else values
            sigma[k] = float(kept.mean()) / 0.7255
    known = np.flatnonzero(np.isfinite(sigma))
    if len(known) == 0:
        values = roughness[usable]
        fallback = float(values.mean()) / 0.7979 if len(values) >= 20 else (stated_mm or 0.0)
        return np.full(len(sigma), fallback)
    return np.interp(np.arange(len(sigma)), known, sigma[known])


@dataclass(frozen=True)
class Fits:
    """Local fits of one scan.

    values (h, w, 4 or more) float32: range, u slope, v slope, noise gain times noise in mm, NaN where there is no fit; noise_mm (h, w) float32
    standard deviation of one range; chosen (h, w) int8 number of the window (see `_fits`) and factors (CODES,) float32 by it: the noise of
    what is read between cells over that of the cell's own fit; clues (h, w, 3) float32, of `shared_detail`, mm^2."""

    values: FloatArray
    noise_mm: FloatArray
    chosen: IntArray
    factors: FloatArray
    clues: FloatArray


def quiet_ranges(
    ranges: FloatArray,
    pitch: FloatArray,
    stated_noise_mm: float | None = None,
    *,
    off: Offsets = (None, None),
    confidence: float = CONFIDENCE,
    into: FloatArray | None = None,
) -> Fits:
    """Local fits of one scan.

    ranges (h, w) float64 mm, NaN where nothing returned; pitch (2,): mm per pixel is pitch[0] * range + pitch[1]; off: how far
    the samples lie off their cells' centres, in pixels along u and v, (h, w) each: they are moved there along the local plane, in `ranges`
    too. into: where the values go, (h, w, 4 or more) float32, if they have a place already."""
    height, width = ranges.shape
    slope_u, slope_v, rough = (np.empty((height, width), np.float32) for _ in range(3))
    start = stated_noise_mm or 0.0
    in_chunks(lambda i, j: _planes(ranges, pitch, start, i, j, slope_u, slope_v, rough), height, ROWS)
    if off[0] is not None and off[1] is not None:
        ranges -= np.where(np.isfinite(slope_u), slope_u * off[0] + slope_v * off[1], 0.0)
        in_chunks(lambda i, j: _planes(ranges, pitch, start, i, j, slope_u, slope_v, rough), height, ROWS)
    cosine, sigma = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    in_chunks(lambda i, j: _obliquity(ranges, slope_u, slope_v, pitch, i, j, cosine), height, ROWS)
    classes = noise_by_obliquity(rough, cosine, stated_noise_mm)
    centres = 0.5 * (COSINE_CLASSES[1:] + COSINE_CLASSES[:-1])
    in_chunks(lambda i, j: _noise(ranges, cosine, pitch, centres, classes, i, j, sigma), height, ROWS)
    values = np.empty((height, width, 4), np.float32) if into is None else into
    windows, reaches, gains = quadratic_windows()
    chosen = np.empty((height, width), np.int8)
    steps = np.empty((-(-height // 2), -(-width // 2), len(gains)), np.float32)
    in_chunks(
        lambda i, j: _fits(
            ranges, sigma, pitch, slope_u, slope_v, windows, reaches, gains, noise_of_steps(), EDGE_WIDTHS_PX, confidence, i, j, values,
            chosen, steps,
        ),
        height,
        ROWS,
    )  # fmt: skip
    clues = np.empty((height, width, 3), np.float32)
    smoothed_away(steps, sigma, chosen, clues)
    return Fits(values, sigma, chosen, noise_factors(chosen, confidence), clues)
