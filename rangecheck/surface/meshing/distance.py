"""Signed distance to what the scans saw, at any set of points (Curless & Levoy 1996), positive outside. Millimetres.

A view's distance at a point is the gap between the point and the view's surface along the ray, turned into the distance to the
tangent plane there; views are averaged with their weights. Between four cells the surface is the blend of their local planes at
half slope, which is exact for quadratics. Where the four disagree there is a depth jump, and the view says nothing.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import in_chunks, inline_kernel, kernel
from rangecheck.surface.meshing.projection import project
from rangecheck.surface.meshing.tiles import BEFORE, BEHIND, Tiles, side_of_block
from rangecheck.surface.meshing.views import Views

#: what is known at a point
UNKNOWN, FREE, SEEN, CONTINUED = 0, 1, 2, 3
BLOCK = 8
CORNERS = BLOCK**3


@inline_kernel
def look(cells, start, height, width, u, v, r):
    """(state, distance, weight, normal, variance, smoothed away) of one view at a point that projects to u, v with range r.

    state: -1 nothing known, 0 free space reaches beyond every limit (the ray met nothing), 1 a surface at `distance` (signed), 2 one that
    is only continued beyond what was seen (`beyond`), which says nothing about the space before it."""
    state = -1
    distance = weight = nx = ny = nz = variance = smoothed = 0.0
    inside = r > 0.0 and -0.5 < u < width - 0.5 and -0.5 < v < height - 0.5
    attempt = 1
    while inside and attempt < 3:
        c0, r0 = math.floor(u), math.floor(v)
        s, t = u - c0, v - r0
        total = empty = value = cosine = 0.0
        weight = nx = ny = nz = variance = smoothed = 0.0
        low, high = np.inf, -np.inf
        slope = 0.0
        continued = False
        for k in range(4):
            dc, dr = k & 1, k >> 1
            col, row = c0 + dc, r0 + dr
            part = (s if dc else 1.0 - s) * (t if dr else 1.0 - t)
            if not (0 <= col < width and 0 <= row < height):
                continue
            cell = start + row * width + col
            here = cells[cell, 0]
            if math.isinf(here):
                empty += part
            elif here == here and part > 0.0:
                heavy = abs(cells[cell, 3])
                if cells[cell, 3] < 0.0:
                    continued = True
                    if attempt == 1:
                        continue
                lean = cells[cell, 1] * (u - col) + cells[cell, 2] * (v - row)
                ahead = here + lean
                low, high = min(low, ahead + lean), max(high, ahead + lean)
                slope = max(slope, abs(cells[cell, 1]), abs(cells[cell, 2]))
                total += part
                value += part * ahead
                weight += part * heavy
                nx += part * cells[cell, 4]
                ny += part * cells[cell, 5]
                nz += part * cells[cell, 6]
                cosine += part * cells[cell, 7]
                variance += part * cells[cell, 8]
                smoothed += part * cells[cell, 9]
        if total > 0.999 or (total >= 0.5 and empty == 0.0):
            value /= total
            cosine /= total
            # the sign of a gap wider than this is certain even across a jump: the point lies before every surface
            if high - low > 0.5 + slope:
                if r < low - 1.0:
                    state, distance, weight = attempt, low - r, 0.0
                elif r > high + 1.0:
                    state, distance, weight = attempt, high - r, 0.0
            else:
                state, distance = attempt, (value - r) * cosine
        elif empty > 0.999:
            state = 0
        elif total > 0.0 and total + empty > 0.999 and r < low - 1.0:
            state, distance, weight = attempt, low - r, 0.0
        attempt = attempt + 1 if continued and state < 0 else 3
    return state, distance, weight, nx, ny, nz, variance, smoothed


@kernel
def _fill_blocks(
    kind, numbers, size, start, cells, free_weight, tile_start, tile_low, tile_high, flattest,
    origins, step, before_mm, behind_mm, first, last, field, state,
):  # fmt: skip
    total, weighted, free = np.empty(CORNERS), np.empty(CORNERS), np.empty(CORNERS)
    seen = np.empty(CORNERS, np.bool_)
    for b in range(first, last):
        total[:] = 0.0
        weighted[:] = 0.0
        seen[:] = False
        free[:] = 0.0
        for s in range(len(kind)):
            n = numbers[s]
            for part in range(8):
                # eight smaller blocks of 4 x 4 x 4, so that more of them lie wholly on one side
                i0, j0, k0 = (part & 1) * 4, (part >> 1 & 1) * 4, (part >> 2) * 4
                x0, y0, z0 = origins[b, 0] + i0 * step, origins[b, 1] + j0 * step, origins[b, 2] + k0 * step
                side = side_of_block(
                    kind[s], n, size[s, 0], size[s, 1], tile_start[s], tile_low, tile_high, flattest,
                    x0, y0, z0, 3.0 * step, before_mm, behind_mm,
                )  # fmt: skip
                if side == BEHIND:
                    continue
                for local in range(64):
                    i, j, k = local & 3, local >> 2 & 3, local >> 4
                    corner = i0 + i + 8 * (j0 + j) + 64 * (k0 + k)
                    if side == BEFORE:
                        free[corner] += free_weight
                        continue
                    u, v, r = project(kind[s], n, x0 + i * step, y0 + j * step, z0 + k * step)
                    known, d, w, _, _, _, _, _ = look(cells, start[s], size[s, 0], size[s, 1], u, v, r)
                    if known == 0 or (known == 1 and d > before_mm):
                        free[corner] += free_weight
                    elif known > 0 and w > 0.0 and -behind_mm <= d <= before_mm:
                        # behind the surface the weight falls: what lies there may be another side of something thin
                        if d < -0.4 * behind_mm:
                            w *= (d + behind_mm) / (0.6 * behind_mm) + 1e-3
                        total[corner] += w
                        weighted[corner] += w * d
                        seen[corner] |= known == 1
        for corner in range(CORNERS):
            sum_d = weighted[corner]
            if total[corner] > 0.0 and (sum_d >= 0.0 or sum_d + free[corner] * before_mm <= 0.0):
                field[b, corner] = sum_d / total[corner]
                state[b, corner] = SEEN if seen[corner] else CONTINUED
            elif free[corner] > 0.0:
                field[b, corner], state[b, corner] = before_mm, FREE
            else:
                field[b, corner], state[b, corner] = -behind_mm, UNKNOWN


def fill_blocks(
    views: Views, tiles: Tiles, origins_mm: FloatArray, step_mm: float, before_mm: float, behind_mm: float
) -> tuple[FloatArray, IntArray]:
    """Field (n, 512) float32 and state (n, 512) uint8 at the corners of n blocks of 8 x 8 x 8, x fastest.

    A corner where views only continue surfaces beyond what they saw is CONTINUED. `before_mm`, `behind_mm`: how far before and behind a surface its distance counts. Free corners hold the one, unknown ones minus
    the other.

    Behind the rim of what a view sees its tangent planes run on into empty space: what they call inside is outside if the views
    that saw it empty outweigh them, each counting as a typical cell `before_mm` away."""
    n = len(origins_mm)
    field, state = np.empty((n, CORNERS), np.float32), np.empty((n, CORNERS), np.uint8)
    weight = views.typical_weight
    in_chunks(
        lambda i, j: _fill_blocks(
            *views.arrays,
            weight,
            tiles.start,
            tiles.low,
            tiles.high,
            tiles.flattest,
            origins_mm,
            step_mm,
            before_mm,
            behind_mm,
            i,
            j,
            field,
            state,
        ),
        n,
        64,
    )
    return field, state


@kernel
def _settle(
    kind, numbers, size, start, cells, points, normals, reach_mm, steps, low, high, first, last, variance_of, scatter, looks
):
    """Move points onto the averaged surface by Newton steps along its normal, kept inside their boxes."""
    for i in range(first, last):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        gx, gy, gz = normals[i, 0], normals[i, 1], normals[i, 2]
        total = 0.0
        seen_by = (1 << min(len(kind), 63)) - 1
        for _ in range(steps):
            total = sum_d = sum_dd = noise = single = lost = mx = my = mz = 0.0
            n = 0
            for s in range(len(kind)):
                if not (seen_by >> min(s, 62)) & 1:
                    continue
                u, v, r = project(kind[s], numbers[s], x, y, z)
                state, d, w, nx, ny, nz, variance, smoothed = look(cells, start[s], size[s, 0], size[s, 1], u, v, r)
                if state != 1 or w <= 0.0 or abs(d) > 2.0 * reach_mm:
                    if s < 62:
                        seen_by &= ~(1 << s)
                    continue
                if abs(d) > reach_mm:
                    continue
                length = math.sqrt(nx * nx + ny * ny + nz * nz)
                agree = (nx * gx + ny * gy + nz * gz) / length
                if agree < 0.3:
                    continue
                w *= agree
                total += w
                sum_d += w * d
                sum_dd += w * d * d
                noise += w * w * variance
                single += w * variance
                lost += w * smoothed
                mx, my, mz = mx + w * nx / length, my + w * ny / length, mz + w * nz / length
                n += 1
            if n == 0:
                break
            length = math.sqrt(mx * mx + my * my + mz * mz)
            gx, gy, gz = mx / length, my / length, mz / length
            d = sum_d / total
            x = min(max(x - d * gx, low[i, 0]), high[i, 0])
            y = min(max(y - d * gy, low[i, 1]), high[i, 1])
            z = min(max(z - d * gz, low[i, 2]), high[i, 2])
            looks[i] = n
        if total > 0.0:
            # noise averages out over the views, and what all of them smooth away does not
            mean, noise = sum_d / total, noise / (total * total)
            variance_of[i] = max(noise + lost / total, 0.5 * noise)
            scatter[i] = (sum_dd / total - mean * mean - (single / total - noise)) / n
            points[i, 0], points[i, 1], points[i, 2] = x, y, z
            normals[i, 0], normals[i, 1], normals[i, 2] = gx, gy, gz


def settle(
    views: Views, points_mm: FloatArray, normals: FloatArray, reach_mm: float, low: FloatArray, high: FloatArray, steps: int = 2
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Move `points_mm` (n, 3), in place, onto the surface that the views average to, inside the boxes low..high (n, 3).

    Returns, in mm^2, (n,) what the views' noise and smoothing make of the mean's error squared (inf where no view is within `reach_mm`),
    (n,) what their scatter beyond noise adds (below 0 where they scatter less; 0 with one view); and (n,) the number of views."""
    n = len(points_mm)
    variance, scatter, looks = np.full(n, np.inf), np.zeros(n), np.zeros(n, np.int32)
    in_chunks(
        lambda i, j: _settle(*views.arrays, points_mm, normals, reach_mm, steps, low, high, i, j, variance, scatter, looks),
        n,
        8192,
    )
    return variance, scatter, looks
