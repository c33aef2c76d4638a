"""What a scan can say about a whole block at once: the nearest and farthest range within each tile of its cells.

Where a block lies wholly behind all that a view shows there, the view says nothing about it; where it lies wholly before, all of it
is free. Only the views in between are looked up corner by corner. The answers are the same as without this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import kernel
from rangecheck.surface.meshing.projection import project
from rangecheck.surface.meshing.views import Views

#: cells along a tile's side
TILE = 4
BEHIND, BETWEEN, BEFORE = 0, 1, 2


@dataclass(frozen=True)
class Tiles:
    """start (s,) first tile of each scan, rows of tiles after each other; low, high (t,) nearest and farthest range in each tile;
    flattest (t,) least |ray . normal| in it.

    A cell that is unknown, or only continued, makes `low` -inf; an unknown one counts for nothing in `high`; one whose ray met nothing is at +inf in both."""

    start: IntArray
    low: FloatArray
    high: FloatArray
    flattest: FloatArray


@kernel
def _fill(cells, first_cell, height, width, first_tile, low, high, flattest):
    across = (width + TILE - 1) // TILE
    for row in range(height):
        for col in range(width):
            here = cells[first_cell + row * width + col, 0]
            tile = first_tile + (row // TILE) * across + col // TILE
            if here < np.inf and cells[first_cell + row * width + col, 3] < 0.0:
                low[tile], high[tile] = -np.inf, max(high[tile], here)
                flattest[tile] = min(flattest[tile], cells[first_cell + row * width + col, 7])
            elif here == here:
                low[tile], high[tile] = min(low[tile], here), max(high[tile], here)
                if here < np.inf:
                    flattest[tile] = min(flattest[tile], cells[first_cell + row * width + col, 7])
            else:
                low[tile] = -np.inf


def tiles_of(views: Views) -> Tiles:
    """The tiles of all scans."""
    counts = [-(-int(h) // TILE) * -(-int(w) // TILE) for h, w in views.size]
    start = np.cumsum([0, *counts]).astype(np.int64)
    low, high = np.full(int(start[-1]), np.inf, np.float32), np.full(int(start[-1]), -np.inf, np.float32)
    flattest = np.ones(int(start[-1]), np.float32)
    for s, (height, width) in enumerate(views.size):
        _fill(views.cells, views.start[s], height, width, start[s], low, high, flattest)
    return Tiles(start[:-1], low, high, flattest)


@kernel
def side_of_block(kind, n, height, width, first_tile, low, high, flattest, x, y, z, edge, before_mm, behind_mm):
    """BEHIND, BEFORE or BETWEEN: where the block with lowest corner x, y, z and side `edge` lies in one view."""
    half = 0.5 * edge
    _, _, middle = project(kind, n, x + half, y + half, z + half)
    reach = half * math.sqrt(3.0)
    if middle <= reach:
        return BETWEEN
    u0 = v0 = np.inf
    u1 = v1 = -np.inf
    for c in range(8):
        u, v, r = project(kind, n, x + edge * (c & 1), y + edge * (c >> 1 & 1), z + edge * (c >> 2))
        if r <= 0.0:
            return BETWEEN
        u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
    # a cell for the interpolation, one for curved edges of the block's picture
    u0, u1, v0, v1 = u0 - 2.0, u1 + 2.0, v0 - 2.0, v1 + 2.0
    if u1 < 0.0 or v1 < 0.0 or u0 > width - 1.0 or v0 > height - 1.0:
        return BEHIND
    if u1 - u0 > 0.5 * width:
        return BETWEEN
    whole = u0 >= 0.0 and v0 >= 0.0 and u1 <= width - 1.0 and v1 <= height - 1.0
    across = (width + TILE - 1) // TILE
    nearest, farthest, cosine = np.inf, -np.inf, 1.0
    for row in range(int(max(v0, 0.0)) // TILE, int(min(v1, height - 1.0)) // TILE + 1):
        for col in range(int(max(u0, 0.0)) // TILE, int(min(u1, width - 1.0)) // TILE + 1):
            tile = first_tile + row * across + col
            nearest, farthest = min(nearest, low[tile]), max(farthest, high[tile])
            cosine = min(cosine, flattest[tile])
    # a distance is a difference of ranges times a cosine
    if middle - reach > farthest + behind_mm / cosine + 1.0:
        return BEHIND
    if whole and middle + reach < nearest - before_mm / cosine - 1.0:
        return BEFORE
    return BETWEEN
