"""Surfaces continued a few cells beyond what a scan saw of them, at the curvature they had.

A membrane that closes a hole (`closing`) leaves the measured surface at an angle; the surface itself rarely does. So where a ray returned
nothing although some scan saw something there, the local fits around go on, with next to no weight: whatever any scan measured or saw to
be empty overrules them, and no vertex that rests on them counts as seen.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.kernels import kernel

#: cells by which surfaces are continued, and around a continued cell those that tell how, by a Gaussian of so many cells
CELLS, WINDOW, WIDTH = 2, 4, 1.5
#: fewest cells that tell
FEWEST = 6
#: weight of a continued cell, in weights of the cells that it continues; it is kept below 0, which tells them apart
SHARE = 1e-4
#: prior of the bend, as a share of the weights
RIDGE = 0.02


@kernel
def _line_through(w, wu, wv, wuu, wuv, wvv, y, yu, yv):
    """(value at 0, u slope, v slope) of weighted values, the slopes held back by a ridge."""
    auu, auv, avv = wuu - wu * wu / w + RIDGE * w, wuv - wu * wv / w, wvv - wv * wv / w + RIDGE * w
    bu, bv = yu - y * wu / w, yv - y * wv / w
    det = auu * avv - auv * auv
    u, v = (avv * bu - auv * bv) / det, (auu * bv - auv * bu) / det
    return (y - u * wu - v * wv) / w, u, v


@kernel
def continue_cells(cells, pitch):
    """Continue the records `cells` (h, w, FIELDS) of one scan into cells where nothing is known (NaN)."""
    height, width = cells.shape[0], cells.shape[1]
    for row in range(height):
        for col in range(width):
            if not math.isnan(cells[row, col, 0]):
                continue
            # the nearest cell that was measured, the first in reading order
            near, nv, nu = 100, 0, 0
            for dv in range(max(-CELLS, -row), min(CELLS, height - 1 - row) + 1):
                for du in range(max(-CELLS, -col), min(CELLS, width - 1 - col) + 1):
                    if dv * dv + du * du < near and cells[row + dv, col + du, 3] > 0.0 and cells[row + dv, col + du, 0] < np.inf:
                        near, nv, nu = dv * dv + du * du, dv, du
            if near == 100:
                continue
            first = cells[row + nv, col + nu]
            w = wu = wv = wuu = wuv = wvv = 0.0
            a = au = av = b = bu = bv = weight = 0.0
            n = 0
            for dv in range(max(-WINDOW, -row), min(WINDOW, height - 1 - row) + 1):
                for du in range(max(-WINDOW, -col), min(WINDOW, width - 1 - col) + 1):
                    one = cells[row + dv, col + du]
                    if not (one[3] > 0.0 and one[0] < np.inf):
                        continue
                    if not one[4] * first[4] + one[5] * first[5] + one[6] * first[6] > 0.7:
                        continue
                    x, y = du - nu, dv - nv
                    # each lies, as the other's plane has it, where it is, but for the bend between them
                    ahead = (one[1] + first[1]) * x + (one[2] + first[2]) * y
                    lateral = pitch[0] * first[0] + pitch[1]
                    if not abs(one[0] - first[0] - ahead) * first[7] < 0.5 * lateral * (abs(x) + abs(y) + 1):
                        continue
                    g = math.exp(-0.5 * (du * du + dv * dv) / WIDTH**2)
                    w, wu, wv = w + g, wu + g * du, wv + g * dv
                    wuu, wuv, wvv = wuu + g * du * du, wuv + g * du * dv, wvv + g * dv * dv
                    su, sv = 2.0 * one[1], 2.0 * one[2]
                    a, au, av = a + g * su, au + g * su * du, av + g * su * dv
                    b, bu, bv = b + g * sv, bu + g * sv * du, bv + g * sv * dv
                    weight += g * one[3]
                    n += 1
            if n < FEWEST:
                continue
            su, uu, uv = _line_through(w, wu, wv, wuu, wuv, wvv, a, au, av)
            sv, vu, vv = _line_through(w, wu, wv, wuu, wuv, wvv, b, bu, bv)
            cross = 0.5 * (uv + vu)
            r = total = 0.0
            for dv in range(max(-WINDOW, -row), min(WINDOW, height - 1 - row) + 1):
                for du in range(max(-WINDOW, -col), min(WINDOW, width - 1 - col) + 1):
                    one = cells[row + dv, col + du]
                    if not (one[3] > 0.0 and one[0] < np.inf) or (du - nu) ** 2 + (dv - nv) ** 2 > 2:
                        continue
                    if not one[4] * first[4] + one[5] * first[5] + one[6] * first[6] > 0.7:
                        continue
                    g = math.exp(-0.5 * (du * du + dv * dv) / WIDTH**2)
                    r += g * (one[0] - su * du - sv * dv - 0.5 * (uu * du * du + vv * dv * dv) - cross * du * dv)
                    total += g
            r /= total
            if not r > 0.0:
                continue
            cells[row, col, 0], cells[row, col, 1], cells[row, col, 2] = r, 0.5 * su, 0.5 * sv
            cells[row, col, 3] = -SHARE * weight / w / (1.0 + near)
            cells[row, col, 4], cells[row, col, 5], cells[row, col, 6] = first[4], first[5], first[6]
            cells[row, col, 7] = first[7]
