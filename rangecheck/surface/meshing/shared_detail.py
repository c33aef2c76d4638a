"""How much detail the scans' local fits lose, told by what their residuals share. Millimetres along the normal, squared.

Where two scans see one place, what is left of their samples beside their own fits is noise, which they do not share, and detail that the
fits smoothed away or that is finer than the cells, which they do: the mean product of the two residuals is the mean square of the
detail, whatever the noise is. Residuals are of fits without the sample itself (its weight h in the fit makes them residual / (1 - h)),
as a vertex between samples is not helped by a sample of its own.

One product says little, so it is regressed, in the narrowest windows and in wider ones, on clues that every cell has: how far the fit
moved from one width to the next, and by how much the samples around scatter beyond noise. Coefficients are not negative and the
regression forgets products far out of line (Holland & Welsch 1977, Cauchy's weights), such as those of samples of two surfaces.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.kernels import in_chunks, kernel
from rangecheck.surface.meshing.fit_error import middle_weights, noise_of_steps
from rangecheck.surface.meshing.projection import project

#: clues of a cell: mean square of the step of its fit's width, by the fourth-power law; of what samples near and around it scatter beyond noise
CLUES = 3
#: products of a sample with one of another scan this near, in cells of that scan
NEAR_CELLS = 0.35
#: fewer products tell nothing: the law of the steps is then believed
FEWEST = 1000
#: samples asked
MOST = 200_000
#: a product this many standard deviations out of line has half its weight
OUT_OF_LINE = 4.0
ROUNDS = 5
BELIEVED = np.array([0.0, 1.0, 0.0, 0.0])


@kernel
def _products(kind, numbers, size, start, cells, residual, points, own, scan, near, reach, first, last, product, other):
    """product (n,): mean over the other scans of residual times residual, NaN where none sees the sample; other: a cell that does."""
    for i in range(first, last):
        product[i] = np.nan
        mine = own[i]
        a = residual[mine]
        if not math.isfinite(a):
            continue
        total = 0.0
        count = 0
        for s in range(len(kind)):
            if s == scan[i]:
                continue
            u, v, r = project(kind[s], numbers[s], points[i, 0], points[i, 1], points[i, 2])
            if not (r > 0.0 and -0.5 < u < size[s, 1] - 0.5 and -0.5 < v < size[s, 0] - 0.5):
                continue
            col, row = math.floor(u + 0.5), math.floor(v + 0.5)
            if (u - col) ** 2 + (v - row) ** 2 > near * near:
                continue
            cell = start[s] + row * size[s, 1] + col
            b = residual[cell]
            if not (math.isfinite(b) and abs(cells[cell, 0] - r) * cells[cell, 7] < reach):
                continue
            agree = cells[mine, 4] * cells[cell, 4] + cells[mine, 5] * cells[cell, 5] + cells[mine, 6] * cells[cell, 6]
            if agree < 0.5:
                continue
            total += a * b
            count += 1
            other[i] = cell
        if count:
            product[i] = total / count


def detail_lost(
    arrays: tuple[IntArray, FloatArray, IntArray, IntArray, FloatArray],
    residual: FloatArray, clues: FloatArray, wide: BoolArray, noise: FloatArray, points_mm: FloatArray, own: IntArray, reach_mm: float,
    lost: FloatArray,
) -> None:  # fmt: skip
    """Fill `lost` (n,) float32 with the mean square of the detail lost in each cell's fit; below 0 where clues say less than nothing.

    arrays     of `Views`: kind, numbers, size, start, cells
    residual   (n,) of each cell's sample beside its fit without it, NaN where unknown; noise (n,) its standard deviation
    clues      (n, CLUES); wide (n,) where a window wider than the narrowest was chosen
    points_mm  (k, 3) the samples, in the cells `own` (k,); reach_mm how far scans may lie apart where they see one place"""
    _, _, _, start, cells = arrays
    step = max(1, len(own) // MOST)
    points, own = np.ascontiguousarray(points_mm[::step]), own[::step]
    product, other = np.empty(len(own)), np.zeros(len(own), np.int64)
    scan = np.searchsorted(start, own, side="right") - 1
    in_chunks(
        lambda i, j: _products(*arrays, residual, points, own, scan, NEAR_CELLS, reach_mm, i, j, product, other), len(own), 4096
    )
    told = np.isfinite(product) & np.isfinite(clues[own]).all(axis=1)
    left_out = float(noise_of_steps()[0] / (1.0 - middle_weights()[0]) ** 2)
    weights = np.empty((2, 1 + CLUES), np.float32)
    for group in (0, 1):
        mine = told & (wide[own] == group)
        chosen = own[mine]
        spread = left_out * noise[chosen] * noise[other[mine]]
        enough = len(chosen) >= FEWEST
        weights[group] = _regressed(product[mine], clues[chosen].astype(float), spread.astype(float)) if enough else BELIEVED
    in_chunks(lambda i, j: _predict(clues, wide, weights, i, j, lost), len(cells), 65536)


@kernel
def _predict(clues, wide, weights, first, last, lost):
    for i in range(first, last):
        of = weights[1] if wide[i] else weights[0]
        value = of[0]
        for k in range(CLUES):
            value += of[1 + k] * clues[i, k]
        lost[i] = value


def _regressed(product: FloatArray, clues: FloatArray, spread: FloatArray) -> FloatArray:
    """(1 + CLUES,) constant and coefficients, none negative. The products' own standard deviation is that of noise and what they tell."""
    from scipy.optimize import nnls

    design = np.concatenate([np.ones((len(product), 1)), clues], axis=1)
    told, found = spread, np.zeros(design.shape[1])
    weight = 1.0 / told**2
    for _ in range(ROUNDS):
        # sums in one order, whatever number of threads the linear algebra has
        normal, right = np.einsum("ni,nj,n->ij", design, design, weight), np.einsum("ni,n,n->i", design, product, weight)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        values, axes = np.linalg.eigh(normal * np.outer(scale, scale))
        root = np.sqrt(np.maximum(values, 1e-12 * values[-1]))
        found = scale * nnls(root[:, None] * axes.T, (axes.T @ (right * scale)) / root)[0]
        expected = np.maximum(design @ found, 0.0)
        told = spread + expected
        weight = 1.0 / (told**2 * (1.0 + ((product - expected) / (OUT_OF_LINE * told)) ** 2))
    return found
