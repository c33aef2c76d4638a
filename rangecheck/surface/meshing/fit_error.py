"""What local fits err by: the noise that is left in them, and the detail that they smooth away.

The windows of `local_fit` in pixels. Noise: neighbours' fits are blended between cells and share most of their samples; and a width at
which noise stopped the growing windows errs more than its noise gain says, by as much as the same choice among fits of pure noise shows.
Detail: the error of a local quadratic grows with the fourth power of its width, so the step from one width to the next, less what noise
makes of it and pooled over a neighbourhood, gives what is left at either (Richardson's extrapolation). Where detail is as fine as the
cells that law says too little: `shared_detail` holds it, and how the samples scatter, against what several scans share.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import in_chunks, kernel

#: standard deviations of the Gaussian windows in pixels, narrow to wide; each window reaches two of them
WIDTHS_PX = (0.9, 1.3, 1.9, 2.7)
#: half widths, in cells, of the neighbourhoods over which the steps between widths are pooled: the small one where the step is so clear
#: that noise makes its square by this factor less, which a handful of cells tells
POOL_CELLS, NEAR_CELLS, CLEAR = 6, 2, 2.0
#: added to the number of a window where the next one was whole and disagreed; numbers of windows and this, a power of two
STOPPED, CODES = 8, 16
COUNTED_ROWS = 32


@lru_cache(maxsize=1)
def quadratic_windows() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Full windows: weights (scales, 3, side, side) for value, u slope, v slope; half sides (scales,); noise gain (scales,)."""
    reach = [math.ceil(2.0 * width) for width in WIDTHS_PX]
    side = 2 * max(reach) + 1
    weights = np.zeros((len(reach), 3, side, side))
    gain = np.zeros(len(reach))
    for scale, (width, r) in enumerate(zip(WIDTHS_PX, reach)):
        v, u = np.mgrid[-r : r + 1, -r : r + 1].astype(float)
        w = np.exp(-0.5 * (u * u + v * v) / width**2).ravel()
        design = np.stack([np.ones(u.size), u.ravel(), v.ravel(), (u * u).ravel(), (u * v).ravel(), (v * v).ravel()], axis=1)
        solve = np.linalg.solve(design.T @ (design * w[:, None]), (design * w[:, None]).T)
        weights[scale, :, : 2 * r + 1, : 2 * r + 1] = solve[:3].reshape(3, 2 * r + 1, 2 * r + 1)
        gain[scale] = np.sqrt((solve[0] ** 2).sum())
    return weights, np.array(reach), gain


@lru_cache(maxsize=1)
def value_weights() -> FloatArray:
    """(scales, side * side) weights of the value in each window, all about one middle."""
    weights, reaches, _ = quadratic_windows()
    side = weights.shape[-1]
    centred = np.zeros((len(reaches), side, side))
    for scale, r in enumerate(reaches):
        first = side // 2 - r
        centred[scale, first : first + 2 * r + 1, first : first + 2 * r + 1] = weights[scale, 0, : 2 * r + 1, : 2 * r + 1]
    return centred.reshape(len(reaches), -1)


@lru_cache(maxsize=1)
def noise_of_blend() -> FloatArray:
    """(scales,) noise of the blend of four neighbours' planes at half slope, over that of one of them, as a root mean square over the square
    between them: neighbours share most of their samples, but not all."""
    weights, reaches, gain = quadratic_windows()
    result = np.zeros(len(reaches))
    places = (np.arange(8) + 0.5) / 8
    for scale, r in enumerate(reaches):
        window = weights[scale, :, : 2 * r + 1, : 2 * r + 1]
        for s in places:
            for t in places:
                blend = np.zeros((2 * r + 2, 2 * r + 2))
                for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
                    part = (s if du else 1 - s) * (t if dv else 1 - t)
                    plane = window[0] + 0.5 * ((s - du) * window[1] + (t - dv) * window[2])
                    blend[dv : dv + 2 * r + 1, du : du + 2 * r + 1] += part * plane
                result[scale] += (blend**2).sum() / len(places) ** 2
    blended: FloatArray = np.sqrt(result) / gain
    return blended


@lru_cache(maxsize=2)
def noise_of_choice(confidence: float) -> tuple[FloatArray, FloatArray]:
    """What the confidence intervals choose in pure noise of one unit, of 200 000 draws of all fits together, which share their samples:
    (scales,) root mean square error where a width is the widest chosen, and (scales,) how often it is."""
    weights = value_weights()
    gain = np.sqrt((weights * weights).sum(axis=1))
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(len(gain)), weights @ weights.T, 200_000, method="cholesky")
    low = np.maximum.accumulate(draws - confidence * gain, axis=1)
    high = np.minimum.accumulate(draws + confidence * gain, axis=1)
    chosen = (low <= high).cumprod(axis=1).sum(axis=1).astype(int) - 1
    errors = draws[np.arange(len(draws)), chosen]
    error = np.array([np.sqrt(np.mean(errors[chosen == k] ** 2)) for k in range(len(gain))])
    return error, np.bincount(chosen, minlength=len(gain)) / len(draws)


@kernel
def _count(chosen, first, last, count):
    for row in range(first, last):
        for col in range(chosen.shape[1]):
            count[chosen[row, col] & CODES - 1] += 1


def noise_factors(chosen: IntArray, confidence: float) -> FloatArray:
    """(CODES,) float32, by what a cell chose: the noise of the blend of four neighbours over that of its own fit, and more where noise stopped
    the windows. chosen (h, w): number of the window plus STOPPED where the next one disagreed; -1, of which the last entry tells, at edges.

    A width that a scan's cells stop at more often than noise alone would make them was chosen, beyond that share, for the surface."""
    error, often = noise_of_choice(confidence)
    gain, blend = quadratic_windows()[2], noise_of_blend()
    counts = np.zeros((-(-len(chosen) // COUNTED_ROWS), CODES), np.int64)
    in_chunks(lambda i, j: _count(chosen, i, j, counts[i // COUNTED_ROWS]), len(chosen), COUNTED_ROWS)
    whole, stopped = counts.sum(axis=0)[: len(gain)], counts.sum(axis=0)[STOPPED : STOPPED + len(gain)]
    factors = np.full(CODES, blend[0])
    for scale in range(len(gain)):
        factors[scale] = factors[scale + STOPPED] = blend[scale]
        if scale < len(gain) - 1:
            able = int(whole[scale + 1 :].sum() + stopped[scale:].sum())
            share = min(1.0, often[scale] * able / max(int(stopped[scale]), 1))
            factors[scale + STOPPED] *= math.sqrt(share * (error[scale] / gain[scale]) ** 2 + 1.0 - share)
    return factors.astype(np.float32)


@kernel
def _pool(steps, cells, first, last, pooled):
    """The mean of `steps` (h, w, n), which stand for every second cell, over `cells` to each side, of those known; 0 where none is."""
    height, width, scales = steps.shape
    r = cells // 2
    total, known = np.empty((width, scales), np.float32), np.empty((width, scales), np.float32)
    for row in range(first, last):
        total[:] = 0.0
        known[:] = 0.0
        for v in range(max(row - r, 0), min(row + r, height - 1) + 1):
            for col in range(width):
                for k in range(scales):
                    if steps[v, col, k] == steps[v, col, k]:
                        total[col, k] += steps[v, col, k]
                        known[col, k] += 1.0
        for col in range(width):
            for k in range(scales):
                s = n = np.float32(0.0)
                for u in range(max(col - r, 0), min(col + r, width - 1) + 1):
                    s += total[u, k]
                    n += known[u, k]
                pooled[row, col, k] = s / n if n > 0.0 else np.float32(0.0)


def _pooled(steps: FloatArray, cells: int) -> FloatArray:
    pooled = np.empty_like(steps)
    in_chunks(lambda i, j: _pool(steps, cells, i, j, pooled), len(steps), COUNTED_ROWS)
    return pooled


@lru_cache(maxsize=1)
def middle_weights() -> FloatArray:
    """(scales,) weight of the middle sample in the value of each full window."""
    weights, reaches, _ = quadratic_windows()
    return np.array([weights[scale, 0, r, r] for scale, r in enumerate(reaches)])


@lru_cache(maxsize=1)
def noise_of_steps() -> FloatArray:
    """(scales,) variance, in noises squared, of the step from the sample itself to the narrowest window, and from each to the next."""
    weights = value_weights()
    sample = np.zeros((1, weights.shape[1]))
    sample[0, weights.shape[1] // 2] = 1.0
    steps: FloatArray = (np.diff(np.concatenate([sample, weights]), axis=0) ** 2).sum(axis=1)
    return steps


@kernel
def _clues(near, around, apart, sigma, chosen, share, left_out, first, last, clues):
    for row in range(first, last):
        for col in range(chosen.shape[1]):
            v, u = row // 2, col // 2
            scale = 0 if chosen[row, col] < 0 else chosen[row, col] % STOPPED
            step = max(scale, 1)
            clear = near[v, u, step] > CLEAR * apart[step] * sigma[2 * v, 2 * u] ** 2
            clues[row, col, 0] = (near[v, u, step] if clear else around[v, u, step]) * share[scale]
            clues[row, col, 1], clues[row, col, 2] = near[v, u, 0] * left_out, around[v, u, 0] * left_out


def smoothed_away(steps: FloatArray, sigma: FloatArray, chosen: IntArray, clues: FloatArray) -> None:
    """Fill `clues` (h, w, 3), mm^2, below 0 where noise says less than nothing: what the chosen width smooths away by the fourth-power
    law, and by how much the samples near the cell and around it scatter about the narrowest fit without them, beyond noise.

    steps (h / 2, w / 2, scales) squares of the steps between widths less their noise's; sigma (h, w) noise of one range."""
    near, around = _pooled(steps, NEAR_CELLS), _pooled(steps, POOL_CELLS)
    fourth = np.array(WIDTHS_PX) ** 4
    share = np.array([fourth[0] / (fourth[1] - fourth[0]), *(fourth[1:] / (fourth[1:] - fourth[:-1]))]) ** 2
    left_out = 1.0 / (1.0 - middle_weights()[0]) ** 2
    apart = noise_of_steps()
    in_chunks(lambda i, j: _clues(near, around, apart, sigma, chosen, share, left_out, i, j, clues), len(chosen), COUNTED_ROWS)
