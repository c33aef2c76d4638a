"""Where nothing was measured: the signed distance extended as a membrane, so that unseen space is closed (Davis et al. 2002).

A harmonic function takes the measured distances where there are some, stays positive in space that a ray was seen to cross, and is
positive on the border of the box. Its zero set continues the surface over what nobody saw. It is solved coarse to fine by
red-black over-relaxation with the free space as an obstacle; within a pass the points of one colour read only the other's, so the
bytes do not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import in_chunks, kernel
from rangecheck.surface.meshing.blocks import COARSE, Grid, find, from_coarse
from rangecheck.surface.meshing.distance import BLOCK, CORNERS, FREE, SEEN, fill_blocks
from rangecheck.surface.meshing.tiles import Tiles
from rangecheck.surface.meshing.views import Views

SWEEPS = 40
RELAXATION = 1.8
#: distance in coarse steps within which a view's distance is taken at a coarse node
COARSE_REACH = 1.5
#: of the 27 blocks around and including one: itself and those that share a face with it
FACES_AND_SELF = [4, 10, 12, 13, 14, 16, 22]


@kernel
def _relax(field, state, least, colour, first, last):
    nx, ny, nz = field.shape
    for i in range(max(first, 1), min(last, nx - 1)):
        for j in range(1, ny - 1):
            for k in range(1 + (i + j + 1 + colour) % 2, nz - 1, 2):
                if state[i, j, k] >= SEEN:
                    continue
                mean = (
                    field[i - 1, j, k] + field[i + 1, j, k] + field[i, j - 1, k]
                    + field[i, j + 1, k] + field[i, j, k - 1] + field[i, j, k + 1]
                ) / 6.0  # fmt: skip
                value = field[i, j, k] + RELAXATION * (mean - field[i, j, k])
                field[i, j, k] = max(value, least) if state[i, j, k] == 1 else value


def _solve(field: FloatArray, state: IntArray, least: float, sweeps: int) -> None:
    def half(colour: int) -> None:
        in_chunks(lambda i, j: _relax(field, state, least, colour, i, j), len(field), 16)

    for _ in range(sweeps):
        half(0)
        half(1)


def _finer(field: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Trilinear values at twice the nodes."""
    for axis in range(3):
        ahead = np.moveaxis(field, axis, 0)
        fine = np.empty((2 * len(ahead) - 1, *ahead.shape[1:]), np.float32)
        fine[::2], fine[1::2] = ahead, 0.5 * (ahead[:-1] + ahead[1:])
        field = np.moveaxis(fine, 0, axis)
    assert field.shape == shape
    return np.ascontiguousarray(field)


def _assembled(values: Any, count: tuple[int, ...], shape: tuple[int, ...]) -> Any:
    """Blocks (n, 512), x fastest inside, last index fastest among them, as one array of `shape` along x, y, z."""
    boxes = values.reshape(*count, BLOCK, BLOCK, BLOCK).transpose(0, 5, 1, 4, 2, 3)
    whole = boxes.reshape([c * BLOCK for c in count])
    return np.ascontiguousarray(whole[: shape[0], : shape[1], : shape[2]])


def coarse_field(
    views: Views, tiles: Tiles, origin_mm: FloatArray, blocks: IntArray, step_mm: float
) -> tuple[FloatArray, IntArray]:
    """Field in mm and state at the coarse nodes of the box, (2 bx + 1, 2 by + 1, 2 bz + 1), closed everywhere."""
    shape = tuple(int(b) * BLOCK // COARSE + 1 for b in blocks)
    coarse_step = COARSE * step_mm
    reach = COARSE_REACH * coarse_step
    count = tuple(-(-length // BLOCK) for length in shape)
    place = np.indices(count).reshape(3, -1).T
    parts = fill_blocks(views, tiles, origin_mm + place * (BLOCK * coarse_step), coarse_step, reach, reach)
    field, state = (_assembled(part, count, shape) for part in parts)
    for axis in range(3):
        for side in (0, -1):
            np.moveaxis(field, axis, 0)[side], np.moveaxis(state, axis, 0)[side] = reach, SEEN
    least = 0.02 * coarse_step
    levels = [(field[::s, ::s, ::s], state[::s, ::s, ::s]) for s in (4, 2, 1)]
    guess = None
    for values, known in levels:
        values, known = np.ascontiguousarray(values), np.ascontiguousarray(known)
        if guess is not None:
            start = _finer(guess, values.shape)
            values = np.where(known >= SEEN, values, np.where(known == FREE, np.maximum(start, least), start)).astype(np.float32)
        _solve(values, known, least, SWEEPS)
        guess = values
    assert guess is not None
    return guess, state


@kernel
def _open_blocks(near, field, state, first, last, chosen):
    """chosen: blocks in which the surface passes a corner that no view is near to."""
    for b in range(first, last):
        chosen[b] = False
        for corner in range(CORNERS):
            i, j, k = corner & 7, corner >> 3 & 7, corner >> 6
            here = field[b, corner] < 0.0
            for axis in range(3):
                row, other = find(near, b, i + (axis == 0), j + (axis == 1), k + (axis == 2))
                if row < 0:
                    continue
                if here != (field[row, other] < 0.0) and (state[b, corner] < SEEN or state[row, other] < SEEN):
                    chosen[b] = True


@kernel
def _relax_blocks(near, field, state, rows, least, colour, first, last):
    for n in range(first, last):
        b = rows[n]
        for corner in range(CORNERS):
            i, j, k = corner & 7, corner >> 3 & 7, corner >> 6
            if state[b, corner] >= SEEN or (i + j + k) % 2 != colour:
                continue
            total = 0.0
            count = 0
            for axis in range(3):
                for side in range(-1, 2, 2):
                    row, other = find(near, b, i + side * (axis == 0), j + side * (axis == 1), k + side * (axis == 2))
                    if row >= 0:
                        total += field[row, other]
                        count += 1
            if count < 6:
                continue
            value = total / 6.0
            field[b, corner] = max(value, least) if state[b, corner] == 1 else value


def fill_open(grid: Grid, coarse: FloatArray, rows: slice = slice(None)) -> None:
    """Give the corners of the blocks `rows` that no view is near to the coarse field's values."""
    first, last, _ = rows.indices(len(grid.place))
    least = 0.02 * grid.step_mm
    in_chunks(
        lambda i, j: from_coarse(grid.place, grid.field, grid.state, coarse, least, first + i, first + j), last - first, 256
    )


def smooth_open(grid: Grid, sweeps: int) -> None:
    """Relax the field around the closed parts at full resolution, so that they meet the measured ones without a step."""
    chosen = np.zeros(len(grid.place), bool)
    in_chunks(lambda i, j: _open_blocks(grid.near, grid.field, grid.state, i, j, chosen), len(grid.place), 256)
    around = np.unique(grid.near[chosen][:, FACES_AND_SELF])
    rows = around[around >= 0].astype(np.int64)
    least = 0.02 * grid.step_mm

    def half(colour: int) -> None:
        in_chunks(lambda i, j: _relax_blocks(grid.near, grid.field, grid.state, rows, least, colour, i, j), len(rows), 64)

    for _ in range(sweeps):
        half(0)
        half(1)
