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

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.kernels import in_chunks, inline_kernel, kernel
from rangecheck.surface.meshing.fit_error import (
    STOPPED,
    middle_weights,
    noise_of_fits,
    noise_of_steps,
    quadratic_windows,
    smoothed_away,
)

#: half length of a confidence interval in standard errors: short, since what noise is left is averaged over several scans
CONFIDENCE = 0.7
#: neighbours steeper than this against the plane across the ray belong to another surface
STEEPEST_TAN = math.tan(math.radians(80.0))
#: how far, in tangent of slope, the surface may bend within a window before a neighbour is taken for another surface
BEND_TAN = 0.6
#: edges of the obliquity classes of the noise estimate, cosine
COSINE_CLASSES = np.array([0.0, 0.25, 0.4, 0.55, 0.7, 0.85, 1.0])
#: the same where neighbours are missing
EDGE_WIDTHS_PX = np.array([0.8])
#: prior of the curvature at the edges: one standard deviation is a pitch / sqrt(RIDGE) per squared cell
RIDGE = 2.0
ROWS = 16
#: numbers per cell of what `quiet_ranges` returns
FIELDS = 10
Offsets = tuple[FloatArray | None, FloatArray | None]


@inline_kernel
def allowed_step(distance_px, pitch_mm, sigma_mm):
    """Largest departure from the local plane, at `distance_px`, of a sample of the same surface."""
    return 5.0 * sigma_mm + BEND_TAN * pitch_mm * distance_px


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
def _cholesky(a):
    """Lower factor of the symmetric 6 x 6 matrix whose lower half is in `a`, in place; False when it is not positive definite."""
    for i in range(6):
        for j in range(i + 1):
            s = a[i, j]
            for k in range(j):
                s -= a[i, k] * a[j, k]
            if i == j:
                if s <= 1e-12:
                    return False
                a[i, i] = math.sqrt(s)
            else:
                a[i, j] = s / a[j, j]
    return True


@kernel
def _solve(a, b):
    """b becomes the solution of (a a^T) x = b for a lower factor a."""
    for i in range(6):
        for k in range(i):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            b[i] -= a[k, i] * b[k]
        b[i] /= a[i, i]


@kernel
def _edge_fit(ranges, row, col, plane_u, plane_v, pitch_mm, sigma, widths, confidence, a, b, unit, out):
    """Quadratics over the neighbours that belong to the cell's own surface, where some are missing: their curvature is held back by
    a ridge, their width chosen as above. out: value above the cell's own range, slopes, noise gain."""
    height, width = ranges.shape
    centre = ranges[row, col]
    # a curvature of BEND_TAN / 2 per pixel is one standard deviation of the prior
    ridge = RIDGE * (sigma / (pitch_mm + 1e-9)) ** 2 + 1e-3
    low, high = -np.inf, np.inf
    found = False
    for scale in range(len(widths)):
        reach = math.ceil(2.0 * widths[scale])
        falloff = -0.5 / widths[scale] ** 2
        a[:] = 0.0
        b[:] = 0.0
        count = 0
        for dv in range(max(-reach, -row), min(reach, height - 1 - row) + 1):
            for du in range(max(-reach, -col), min(reach, width - 1 - col) + 1):
                z = ranges[row + dv, col + du] - centre - plane_u * du - plane_v * dv
                if not abs(z) <= allowed_step(math.sqrt(du * du + dv * dv), pitch_mm, sigma):
                    continue
                w = math.exp(falloff * (du * du + dv * dv))
                wu, wv = w * du, w * dv
                wuu, wuv, wvv = wu * du, wu * dv, wv * dv
                b[0], b[1], b[2] = b[0] + w * z, b[1] + wu * z, b[2] + wv * z
                b[3], b[4], b[5] = b[3] + wuu * z, b[4] + wuv * z, b[5] + wvv * z
                a[0, 0], a[1, 0], a[2, 0] = a[0, 0] + w, a[1, 0] + wu, a[2, 0] + wv
                a[3, 0], a[4, 0], a[5, 0] = a[3, 0] + wuu, a[4, 0] + wuv, a[5, 0] + wvv
                a[3, 1], a[4, 1], a[5, 1] = a[3, 1] + wuu * du, a[4, 1] + wuu * dv, a[5, 1] + wuv * dv
                a[5, 2] += wvv * dv
                a[3, 3], a[4, 3], a[5, 3] = a[3, 3] + wuu * du * du, a[4, 3] + wuu * du * dv, a[5, 3] + wuu * dv * dv
                a[5, 4], a[5, 5] = a[5, 4] + wuv * dv * dv, a[5, 5] + wvv * dv * dv
                count += 1
        if count < 6:
            continue
        a[1, 1], a[2, 1], a[2, 2] = a[3, 0], a[4, 0], a[5, 0]
        a[3, 2], a[4, 2], a[4, 4] = a[4, 1], a[5, 1], a[5, 3]
        for i in range(3, 6):
            a[i, i] += ridge
        unit[:] = 0.0
        unit[0] = 1.0
        if not _cholesky(a):
            continue
        _solve(a, b)
        _solve(a, unit)
        variance = 0.0
        for dv in range(max(-reach, -row), min(reach, height - 1 - row) + 1):
            for du in range(max(-reach, -col), min(reach, width - 1 - col) + 1):
                z = ranges[row + dv, col + du] - centre - plane_u * du - plane_v * dv
                if not abs(z) <= allowed_step(math.sqrt(du * du + dv * dv), pitch_mm, sigma):
                    continue
                part = unit[0] + unit[1] * du + unit[2] * dv + unit[3] * du * du + unit[4] * du * dv + unit[5] * dv * dv
                variance += (math.exp(falloff * (du * du + dv * dv)) * part) ** 2
        gain = math.sqrt(variance)
        low, high = max(low, b[0] - confidence * gain * sigma), min(high, b[0] + confidence * gain * sigma)
        if found and low > high:
            break
        found = True
        out[0], out[1], out[2], out[3] = b[0], plane_u + b[1], plane_v + b[2], gain
    return found


@kernel
def _fits(
    ranges,
    sigma_cell,
    pitch,
    plane_u,
    plane_v,
    windows,
    reaches,
    gains,
    apart,
    edge_widths,
    confidence,
    first,
    last,
    out,
    chosen,
    steps,
):
    """out (h, w, 4): range, slopes, noise gain times noise in mm of each cell, NaN where a cell has too few neighbours of its own surface;
    chosen (h, w): number of the window, -1 at edges, plus STOPPED where the next one was whole and disagreed; steps (h / 2, w / 2, scales): square of the step from
    the sample to the narrowest width and from each width to the next, less what noise makes of it, as far as windows are whole (NaN elsewhere)."""
    height, width = ranges.shape
    scales = len(reaches)
    a, b, unit, edge = np.zeros((6, 6)), np.zeros(6), np.zeros(6), np.zeros(4)
    for row in range(first, last):
        for col in range(width):
            out[row, col, :] = np.nan
            chosen[row, col] = -1
            told = row % 2 == 0 and col % 2 == 0
            if told:
                steps[row // 2, col // 2, :] = np.nan
            pu, pv = plane_u[row, col], plane_v[row, col]
            if not math.isfinite(pu):
                continue
            centre, sigma = ranges[row, col], sigma_cell[row, col]
            pitch_mm = pitch[0] * centre + pitch[1]
            low, high = -np.inf, np.inf
            found = settled = False
            narrower = 0.0
            for scale in range(scales):
                r = reaches[scale]
                if row < r or col < r or row + r >= height or col + r >= width:
                    break
                value = slope_u = slope_v = 0.0
                whole = True
                for dv in range(-r, r + 1):
                    for du in range(-r, r + 1):
                        z = ranges[row + dv, col + du] - centre - pu * du - pv * dv
                        if not abs(z) <= allowed_step(math.sqrt(du * du + dv * dv), pitch_mm, sigma):
                            whole = False
                            break
                        value += windows[scale, 0, dv + r, du + r] * z
                        slope_u += windows[scale, 1, dv + r, du + r] * z
                        slope_v += windows[scale, 2, dv + r, du + r] * z
                    if not whole:
                        break
                if not whole:
                    break
                if told:
                    steps[row // 2, col // 2, scale] = (value - narrower) ** 2 - apart[scale] * sigma * sigma
                narrower = value
                half = confidence * gains[scale] * sigma
                low, high = max(low, value - half), min(high, value + half)
                if found and low > high and not settled:
                    settled = True
                    chosen[row, col] += STOPPED
                if settled:
                    if told:
                        continue
                    break
                found = True
                chosen[row, col] = scale
                out[row, col, 0] = centre + value
                out[row, col, 1] = pu + slope_u
                out[row, col, 2] = pv + slope_v
                out[row, col, 3] = gains[scale] * sigma
            if not found and _edge_fit(ranges, row, col, pu, pv, pitch_mm, sigma, edge_widths, confidence, a, b, unit, edge):
                out[row, col, 0], out[row, col, 1], out[row, col, 2] = centre + edge[0], edge[1], edge[2]
                out[row, col, 3] = edge[3] * sigma


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


def quiet_ranges(
    ranges: FloatArray,
    pitch: FloatArray,
    stated_noise_mm: float | None = None,
    *,
    off: Offsets = (None, None),
    confidence: float = CONFIDENCE,
) -> tuple[FloatArray, FloatArray]:
    """Local fits of one scan.

    ranges (h, w) float64 mm, NaN where nothing returned; pitch (2,): mm per pixel is pitch[0] * range + pitch[1]; off: how far
    the samples lie off their cells' centres, in pixels along u and v, (h, w) each: they are moved there along the local plane.
    Returns (h, w, FIELDS) float32: range, u slope, v slope, noise gain times noise in mm, standard error by noise in mm of what is read
    between cells, the clues of `shared_detail` in mm^2 (3), what is left of the range beside its fit without it in mm (NaN at edges), and
    the number of the window (-1 at edges); and (h, w) float32 standard deviation of one range."""
    height, width = ranges.shape
    finite = np.isfinite(ranges)
    slope_u, slope_v, rough = (np.empty((height, width), np.float32) for _ in range(3))
    start = stated_noise_mm or 0.0
    in_chunks(lambda i, j: _planes(ranges, pitch, start, i, j, slope_u, slope_v, rough), height, ROWS)
    if off[0] is not None and off[1] is not None:
        ranges = ranges - np.where(np.isfinite(slope_u), slope_u * off[0] + slope_v * off[1], 0.0)
        in_chunks(lambda i, j: _planes(ranges, pitch, start, i, j, slope_u, slope_v, rough), height, ROWS)
    lateral = pitch[0] * np.where(finite, ranges, 0.0) + pitch[1]
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = 1.0 / np.sqrt(1.0 + (slope_u * slope_u + slope_v * slope_v) / lateral**2)
    classes = noise_by_obliquity(rough, cosine, stated_noise_mm)
    centres = 0.5 * (COSINE_CLASSES[1:] + COSINE_CLASSES[:-1])
    sigma = np.interp(np.nan_to_num(cosine), centres, classes).astype(np.float32)
    sigma = np.maximum(sigma, np.float32(1e-3) * lateral.astype(np.float32))
    out = np.empty((height, width, FIELDS), np.float32)
    windows, reaches, gains = quadratic_windows()
    apart = noise_of_steps()
    chosen = np.empty((height, width), np.int8)
    steps = np.empty((-(-height // 2), -(-width // 2), len(gains)), np.float32)
    in_chunks(
        lambda i, j: _fits(
            ranges,
            sigma,
            pitch,
            slope_u,
            slope_v,
            windows,
            reaches,
            gains,
            apart,
            EDGE_WIDTHS_PX,
            confidence,
            i,
            j,
            out,
            chosen,
            steps,
        ),
        height,
        ROWS,
    )
    out[..., 4] = noise_of_fits(out[..., 3], sigma, chosen, confidence)
    smoothed_away(steps, apart * sigma[::2, ::2, None] ** 2, chosen, out[..., 5:8])
    left_out = 1.0 / (1.0 - np.append(middle_weights(), np.nan)).astype(np.float32)
    out[..., 9] = window = np.where(chosen < 0, -1, chosen % STOPPED)
    out[..., 8] = (ranges - out[..., 0]) * left_out[window]
    return out, sigma
