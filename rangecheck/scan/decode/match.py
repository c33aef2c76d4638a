"""From projector coordinates seen by two cameras to points on the first camera's rays.

Both cameras' coordinates are first smoothed by planes fitted to small windows; the second camera's become a table: for the middle of
every projector cell, the place in its picture and how that place moves with the coordinates. A pixel of the first camera looks its
own coordinates up there, blending the four nearest cells, so that its partner is found to a part of a pixel and of a cell.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.kernels import in_chunks, kernel

#: pixels around the middle of a window
WINDOW = 2
#: cells by which neighbours in a window may differ from its middle before they count as another surface
MAX_STEP = 4.0
#: cells by which a neighbour may leave the first plane through a window before it is dropped from the second
OUTLIER = 0.5
#: pixels by which places of one cell may scatter before the cell is taken for two surfaces
MAX_SCATTER_PX = 2.0


class Smoothed(NamedTuple):
    """Planes fitted to projector coordinates: value (h, w, 2) column and row; slope (h, w, 4) their changes per pixel to the right
    (2) and down (2); rms (h, w) cells; own (h, w) whether the middle pixel had a coordinate itself. NaN where no plane fits."""

    value: FloatArray
    slope: FloatArray
    rms: FloatArray
    own: BoolArray


@kernel
def _fit(column, row, window, first, last, value, slope, rms, own):
    height, width = column.shape
    weights = np.empty((2 * window + 1, 2 * window + 1))
    for j in range(-window, window + 1):
        for i in range(-window, window + 1):
            weights[j + window, i + window] = math.exp(-float(i * i + j * j) / (window * window))
    for y in range(first, last):
        for x in range(width):
            c0, r0 = float(column[y, x]), float(row[y, x])
            mine = math.isfinite(c0) and math.isfinite(r0)
            if not mine:
                # the mean of what lies around; a pixel without code between good ones is interpolated
                n, c0, r0 = 0, 0.0, 0.0
                for j in range(max(y - 1, 0), min(y + 2, height)):
                    for i in range(max(x - 1, 0), min(x + 2, width)):
                        if math.isfinite(column[j, i]) and math.isfinite(row[j, i]):
                            n, c0, r0 = n + 1, c0 + column[j, i], r0 + row[j, i]
                if n < 4:
                    continue
                c0, r0 = c0 / n, r0 / n
            ac = bc = dc = ar = br = dr = 0.0
            good = False
            for turn in range(2):
                n = 0
                sw = sx = sy = sxx = sxy = syy = sc = scx = scy = sr = srx = sry = 0.0
                square = 0.0
                for j in range(max(y - window, 0), min(y + window + 1, height)):
                    for i in range(max(x - window, 0), min(x + window + 1, width)):
                        c, r = column[j, i] - c0, row[j, i] - r0
                        if not (abs(c) < MAX_STEP and abs(r) < MAX_STEP):
                            continue
                        dx, dy = float(i - x), float(j - y)
                        if turn == 1:
                            ec, er = c - ac - bc * dx - dc * dy, r - ar - br * dx - dr * dy
                            if abs(ec) > OUTLIER or abs(er) > OUTLIER:
                                continue
                            square += ec * ec + er * er
                        w = weights[j - y + window, i - x + window]
                        n += 1
                        sw, sx, sy, sxx, sxy, syy = (
                            sw + w,
                            sx + w * dx,
                            sy + w * dy,
                            sxx + w * dx * dx,
                            sxy + w * dx * dy,
                            syy + w * dy * dy,
                        )
                        sc, scx, scy, sr, srx, sry = (
                            sc + w * c,
                            scx + w * c * dx,
                            scy + w * c * dy,
                            sr + w * r,
                            srx + w * r * dx,
                            sry + w * r * dy,
                        )
                if n < (6 if mine else 10):
                    good = False
                    break
                # normal equations of three unknowns, centred
                mx, my, mc, mr = sx / sw, sy / sw, sc / sw, sr / sw
                xx, xy, yy = sxx - sx * mx, sxy - sx * my, syy - sy * my
                det = xx * yy - xy * xy
                if det < 1e-3 * sw * sw:
                    good = False
                    break
                cx, cy, rx, ry = scx - sc * mx, scy - sc * my, srx - sr * mx, sry - sr * my
                bc, dc = (yy * cx - xy * cy) / det, (xx * cy - xy * cx) / det
                br, dr = (yy * rx - xy * ry) / det, (xx * ry - xy * rx) / det
                ac, ar = mc - bc * mx - dc * my, mr - br * mx - dr * my
                good = True
                if turn == 1:
                    rms[y, x] = math.sqrt(square / (2 * n))
            if good:
                value[y, x, 0], value[y, x, 1] = c0 + ac, r0 + ar
                slope[y, x, 0], slope[y, x, 1], slope[y, x, 2], slope[y, x, 3] = bc, br, dc, dr
                own[y, x] = mine


def smoothed(column: FloatArray, row: FloatArray, window: int = WINDOW) -> Smoothed:
    """Planes through the projector coordinates (h, w) in windows of 2 window + 1 pixels."""
    height, width = column.shape
    value, slope = np.full((height, width, 2), np.nan, np.float32), np.full((height, width, 4), np.nan, np.float32)
    rms, own = np.full((height, width), np.nan, np.float32), np.zeros((height, width), np.bool_)
    in_chunks(lambda i, j: _fit(column, row, window, i, j, value, slope, rms, own), height, 64)
    return Smoothed(value, slope, rms, own)


@kernel
def _table(value, slope, columns, rows):
    """Per cell: place x y, its change per column (2) and per row (2), number of pixels; then the scatter of the places."""
    height, width = value.shape[0], value.shape[1]
    table = np.zeros((rows, columns, 8))
    for turn in range(2):
        for y in range(height):
            for x in range(width):
                c, r = value[y, x, 0], value[y, x, 1]
                if not (0.0 <= c < columns and 0.0 <= r < rows):
                    continue
                i, j = int(c), int(r)
                cu, ru, cv, rv = float(slope[y, x, 0]), float(slope[y, x, 1]), float(slope[y, x, 2]), float(slope[y, x, 3])
                det = cu * rv - cv * ru
                if abs(det) < 1e-4:
                    continue
                dc, dr = i + 0.5 - c, j + 0.5 - r
                uc, ur, vc, vr = rv / det, -cv / det, -ru / det, cu / det
                px, py = x + uc * dc + ur * dr, y + vc * dc + vr * dr
                if turn == 0:
                    cell = table[j, i]
                    cell[0], cell[1], cell[2], cell[3] = cell[0] + px, cell[1] + py, cell[2] + uc, cell[3] + vc
                    cell[4], cell[5], cell[6] = cell[4] + ur, cell[5] + vr, cell[6] + 1.0
                else:
                    ex, ey = px - table[j, i, 0], py - table[j, i, 1]
                    table[j, i, 7] += (ex * ex + ey * ey) / table[j, i, 6]
        if turn == 0:
            for j in range(rows):
                for i in range(columns):
                    if table[j, i, 6] > 0:
                        for k in range(6):
                            table[j, i, k] /= table[j, i, 6]
    return table


@kernel
def _look_up(value, table, first, last, partner):
    """partner (h, w, 2): place in the second picture; scatter above MAX_SCATTER_PX or disagreement leaves NaN, -1 if no cell is there."""
    rows, columns = table.shape[0], table.shape[1]
    for y in range(first, last):
        for x in range(value.shape[1]):
            c, r = value[y, x, 0], value[y, x, 1]
            partner[y, x, 0] = partner[y, x, 1] = math.nan
            if not (math.isfinite(c) and math.isfinite(r)):
                continue
            i0, j0 = math.floor(c - 0.5), math.floor(r - 0.5)
            weight = px = py = 0.0
            low_x = low_y = 1e30
            high_x = high_y = -1e30
            for j in range(j0, j0 + 2):
                for i in range(i0, i0 + 2):
                    if not (0 <= i < columns and 0 <= j < rows):
                        continue
                    cell = table[j, i]
                    if cell[6] < 1.0 or cell[7] > MAX_SCATTER_PX * MAX_SCATTER_PX:
                        continue
                    dc, dr = c - i - 0.5, r - j - 0.5
                    w = (1.0 - abs(dc)) * (1.0 - abs(dr)) + 1e-9
                    qx, qy = cell[0] + cell[2] * dc + cell[4] * dr, cell[1] + cell[3] * dc + cell[5] * dr
                    weight, px, py = weight + w, px + w * qx, py + w * qy
                    low_x, high_x, low_y, high_y = min(low_x, qx), max(high_x, qx), min(low_y, qy), max(high_y, qy)
            if weight < 0.25:
                partner[y, x, 0] = -1.0
            elif high_x - low_x < 2 * MAX_SCATTER_PX and high_y - low_y < 2 * MAX_SCATTER_PX:
                partner[y, x, 0], partner[y, x, 1] = px / weight, py / weight


def partners(first: Smoothed, second: Smoothed) -> tuple[FloatArray, BoolArray]:
    """Place (h, w, 2) in the second picture of what each pixel of the first sees, NaN where none; and where the second camera does
    not see the pixel's cell at all (h, w), as opposed to seeing two places that contradict each other."""
    columns, rows = (int(np.nanmax(second.value[..., k], initial=0.0)) + 1 for k in (0, 1))
    table = _table(second.value, second.slope, columns, rows)
    partner = np.empty(first.value.shape, np.float64)
    in_chunks(lambda i, j: _look_up(first.value, table, i, j, partner), len(partner), 64)
    unseen = partner[..., 0] == -1.0
    partner[unseen] = np.nan
    return partner, unseen
