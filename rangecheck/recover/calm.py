"""Chance in simulated light, told from what is there by a pixel's neighbours on the same part (Lee, *Digital image enhancement*, PAMI 2, 1980).

What a matt surface receives from others changes little from pixel to pixel, while paths that meet a lamp by chance are few and bright; what a mirror shows
changes much, and has little chance in it. So a pixel keeps as much of its departure from its surroundings' mean as the observations' own variance does
not account for. The variance is that of neighbours outside of the surroundings: its own would be large where light is, and small where none was met.
"""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.recover.sight import Sight

#: sides of the surroundings, and of what their variance is taken from, in pixels of the grid
_AROUND, _BEYOND = 7, 21


def calmed(sight: Sight, values: FloatArray, variance: FloatArray, label: IntArray, step: int) -> tuple[FloatArray, FloatArray]:
    """(n,) values with what neighbours of the same label (n,) know of them, and their variance (n,), of pixels on a grid of every `step`-th row and
    column. Variance of light that few pixels know is shared by all around, so that what they have in common is as uncertain as it is."""
    from scipy.ndimage import uniform_filter

    calm, known = np.empty(len(values)), np.empty(len(values))
    for one in np.unique(label):
        mine = label == one
        some = sight.only(mine)
        grid = [
            some.spread(v, 0.0)[::step, ::step] for v in (np.ones(mine.sum()), values[mine], values[mine] ** 2, variance[mine])
        ]

        def at(picture: FloatArray, some: Sight = some) -> FloatArray:
            row, column = np.divmod(some.pixel, some.shape[1])
            return np.asarray(picture[row // step, column // step])

        near = [at(uniform_filter(g, _AROUND, mode="constant")) * _AROUND**2 for g in grid]
        far = [at(uniform_filter(g, _BEYOND, mode="constant")) * _BEYOND**2 for g in (grid[0], grid[3])]
        count = np.maximum(near[0], 1.0)
        mean, chance = near[1] / count, near[3] / count
        spread = np.maximum(near[2] / count - mean**2, 0.0)
        kept = np.clip(1.0 - chance / np.maximum(spread, 1e-300), 0.0, 1.0)
        calm[mine] = mean + kept * (values[mine] - mean)
        apart = far[0] - near[0]
        beyond = np.where(apart > 0.5 * count, np.maximum(far[1] - near[3], 0.0) / np.maximum(apart, 1.0), chance)
        known[mine] = beyond + kept * variance[mine]
    return calm, known
