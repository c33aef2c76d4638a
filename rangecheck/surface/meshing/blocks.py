"""A sparse grid: blocks of 8 x 8 x 8 corners where the surface may run, over a dense coarse field everywhere else.

Corner (i, j, k) lies at origin + step (i, j, k); block (bx, by, bz) owns corners 8 b .. 8 b + 7 and the cells of which these are the
lowest corners. The coarse field has its nodes at every fourth corner, over the whole box. field < 0 is inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import SettingError
from rangecheck.kernels import in_chunks, inline_kernel, kernel
from rangecheck.surface.meshing.distance import BLOCK, CORNERS, SEEN

#: corners between nodes of the coarse field
COARSE = 4
MISSING = -1
#: a block index of 200 MB and a coarse field of 2 GB
MOST_BLOCKS = 5e7


@dataclass
class Grid:
    """shape (3,) blocks in the box; index (bx, by, bz) int32 row of each block or MISSING; place (n, 3) int32 of each row;
    near (n, 27) int32 rows of the blocks around, the 27 offsets x fastest; field (n, 512) float32; state (n, 512) uint8."""

    origin_mm: FloatArray
    step_mm: float
    index: IntArray
    place: IntArray
    near: IntArray
    field: FloatArray
    state: IntArray

    def corner_origins(self, rows: slice | IntArray = slice(None)) -> FloatArray:
        """(n, 3) mm: lowest corner of each block."""
        return self.origin_mm + self.place[rows] * (BLOCK * self.step_mm)


def box_for(samples_mm: FloatArray, step_mm: float) -> tuple[FloatArray, IntArray]:
    """Origin (3,) and number of blocks (3,), even, of a box with two blocks of room around the samples.

    Raises SettingError when these would be more than MOST_BLOCKS."""
    low, high = samples_mm.min(axis=0), samples_mm.max(axis=0)
    edge = BLOCK * step_mm
    wanted = np.ceil((high - low) / edge) + 4
    if not np.prod(wanted) <= MOST_BLOCKS:
        extent = " x ".join(f"{length:.4g}" for length in high - low)
        raise SettingError(
            f"a grid of {step_mm:.3g} mm over {extent} mm has {np.prod(wanted):.3g} blocks, and {MOST_BLOCKS:.0e} fit in memory; "
            "raise voxel_mm, or remove samples that lie far away",
            key="voxel_mm",
        )
    count = wanted.astype(np.int64)
    count += count % 2
    return 0.5 * (low + high) - 0.5 * count * edge, count


@kernel
def _mark_near_samples(samples, origin, edge, reach, index):
    for i in range(len(samples)):
        x, y, z = samples[i, 0] - origin[0], samples[i, 1] - origin[1], samples[i, 2] - origin[2]
        for bx in range(int((x - reach) / edge), int((x + reach) / edge) + 1):
            for by in range(int((y - reach) / edge), int((y + reach) / edge) + 1):
                for bz in range(int((z - reach) / edge), int((z + reach) / edge) + 1):
                    index[bx, by, bz] = 0


def grid_near(
    samples_mm: FloatArray, origin_mm: FloatArray, shape: IntArray, step_mm: float, reach_mm: float, also: BoolArray
) -> Grid:
    """An empty grid whose blocks lie within `reach_mm` of a sample, or where `also` (bx, by, bz) says so."""
    index = np.full(tuple(shape), MISSING, np.int32)
    _mark_near_samples(samples_mm, origin_mm, BLOCK * step_mm, reach_mm, index)
    index[also] = 0
    # one order in memory from the first: kernels that take it are compiled once
    place = np.argwhere(index == 0).astype(np.int32, order="C")
    none = np.empty((0, CORNERS), np.float32)
    grid = Grid(origin_mm, step_mm, index, place[:0], np.empty((0, 27), np.int32), none, np.empty((0, CORNERS), np.uint8))
    return add_blocks(grid, place)


def add_blocks(grid: Grid, place: IntArray) -> Grid:
    """The grid with blocks appended at `place` (m, 3), their values still to be filled."""
    grid.place = np.concatenate([grid.place, place])
    n = len(grid.place)
    grid.index[tuple(grid.place.T)] = np.arange(n, dtype=np.int32)
    more = np.empty((len(place), CORNERS), np.float32)
    grid.field = np.concatenate([grid.field, more])
    grid.state = np.concatenate([grid.state, np.empty((len(place), CORNERS), np.uint8)])
    grid.near = np.empty((n, 27), np.int32)
    _neighbours(grid.index, grid.place, grid.near)
    return grid


@kernel
def _neighbours(index, place, near):
    for b in range(len(place)):
        k = 0
        for dz in range(-1, 2):
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    x, y, z = place[b, 0] + dx, place[b, 1] + dy, place[b, 2] + dz
                    inside = 0 <= x < index.shape[0] and 0 <= y < index.shape[1] and 0 <= z < index.shape[2]
                    near[b, k] = index[x, y, z] if inside else MISSING
                    k += 1


@inline_kernel
def coarse_value(coarse, i, j, k):
    """Trilinear value of the coarse field (nodes along x, y, z) at corner i, j, k; its border value outside the box."""
    i = min(max(i, 0), COARSE * (coarse.shape[0] - 1))
    j = min(max(j, 0), COARSE * (coarse.shape[1] - 1))
    k = min(max(k, 0), COARSE * (coarse.shape[2] - 1))
    ci = min(i // COARSE, coarse.shape[0] - 2)
    cj = min(j // COARSE, coarse.shape[1] - 2)
    ck = min(k // COARSE, coarse.shape[2] - 2)
    a, b, c = (i - ci * COARSE) / COARSE, (j - cj * COARSE) / COARSE, (k - ck * COARSE) / COARSE
    low = (1 - b) * ((1 - a) * coarse[ci, cj, ck] + a * coarse[ci + 1, cj, ck])
    low += b * ((1 - a) * coarse[ci, cj + 1, ck] + a * coarse[ci + 1, cj + 1, ck])
    high = (1 - b) * ((1 - a) * coarse[ci, cj, ck + 1] + a * coarse[ci + 1, cj, ck + 1])
    high += b * ((1 - a) * coarse[ci, cj + 1, ck + 1] + a * coarse[ci + 1, cj + 1, ck + 1])
    return (1 - c) * low + c * high


@inline_kernel
def find(near, b, i, j, k):
    """(row, corner) of the corner i, j, k counted from block b's lowest, each -8..15; row MISSING where no block is."""
    di, dj, dk = (i >> 3) + 1, (j >> 3) + 1, (k >> 3) + 1
    return near[b, di + 3 * dj + 9 * dk], (i & 7) + 8 * (j & 7) + 64 * (k & 7)


@kernel
def gather(near, place, field, coarse, b, low, box):
    """Copy the values at corners low .. low + box.shape - 1 of block b, from its neighbours and the coarse field too."""
    n = box.shape[0]
    for k in range(n):
        for j in range(n):
            for i in range(n):
                row, corner = find(near, b, i + low, j + low, k + low)
                if row >= 0:
                    box[i, j, k] = field[row, corner]
                else:
                    box[i, j, k] = coarse_value(
                        coarse, 8 * place[b, 0] + i + low, 8 * place[b, 1] + j + low, 8 * place[b, 2] + k + low
                    )


@kernel
def _wanted(near, place, field, coarse, first, last, wanted):
    """wanted (n, 27) True: a missing neighbour that holds a corner of a cell which the surface crosses."""
    box = np.empty((10, 10, 10), np.float32)
    for b in range(first, last):
        missing = False
        for k in range(27):
            wanted[b, k] = False
            missing = missing or near[b, k] < 0
        if not missing:
            continue
        gather(near, place, field, coarse, b, -1, box)
        for k in range(9):
            for j in range(9):
                for i in range(9):
                    if not (i in (0, 8) or j in (0, 8) or k in (0, 8)):
                        continue
                    inside = 0
                    for c in range(8):
                        inside += box[i + (c & 1), j + (c >> 1 & 1), k + (c >> 2)] < 0.0
                    if inside in (0, 8):
                        continue
                    for c in range(8):
                        x, y, z = i + (c & 1) - 1, j + (c >> 1 & 1) - 1, k + (c >> 2) - 1
                        at = (x >> 3) + 1 + 3 * ((y >> 3) + 1) + 9 * ((z >> 3) + 1)
                        if near[b, at] < 0:
                            wanted[b, at] = True


def missing_blocks(grid: Grid, coarse: FloatArray) -> IntArray:
    """(m, 3) places of the blocks that the surface enters and that are not there yet."""
    wanted = np.zeros((len(grid.place), 27), bool)
    in_chunks(lambda i, j: _wanted(grid.near, grid.place, grid.field, coarse, i, j, wanted), len(grid.place), 256)
    rows, at = np.nonzero(wanted)
    offset = np.stack([at % 3, at // 3 % 3, at // 9], axis=1) - 1
    place = grid.place[rows] + offset
    inside = ((place >= 0) & (place < grid.index.shape)).all(axis=1)
    return np.unique(place[inside], axis=0).astype(np.int32)


@kernel
def _touching(near, place, field, coarse, first, last, flip):
    """flip (n, 512): of every face whose corners alternate, the inside corner nearer to the surface."""
    box = np.empty((9, 9, 9), np.float32)
    for b in range(first, last):
        gather(near, place, field, coarse, b, 0, box)
        for k in range(8):
            for j in range(8):
                for i in range(8):
                    here = box[i, j, k] < 0.0
                    for axis in range(3):
                        if axis == 0:
                            di, dj, dk, ei, ej, ek = 0, 1, 0, 0, 0, 1
                        elif axis == 1:
                            di, dj, dk, ei, ej, ek = 1, 0, 0, 0, 0, 1
                        else:
                            di, dj, dk, ei, ej, ek = 1, 0, 0, 0, 1, 0
                        far = box[i + di + ei, j + dj + ej, k + dk + ek] < 0.0
                        one, two = box[i + di, j + dj, k + dk] < 0.0, box[i + ei, j + ej, k + ek] < 0.0
                        if here != far or one != two or here == one:
                            continue
                        if here:
                            first_better = box[i, j, k] >= box[i + di + ei, j + dj + ej, k + dk + ek]
                            x, y, z = (i, j, k) if first_better else (i + di + ei, j + dj + ej, k + dk + ek)
                        else:
                            first_better = box[i + di, j + dj, k + dk] >= box[i + ei, j + ej, k + ek]
                            x, y, z = (i + di, j + dj, k + dk) if first_better else (i + ei, j + ej, k + ek)
                        row, corner = find(near, b, x, y, z)
                        if row >= 0:
                            flip[row, corner] = True


def _touching_corners(grid: Grid, coarse: FloatArray) -> BoolArray:
    flip = np.zeros(grid.field.shape, bool)
    in_chunks(lambda i, j: _touching(grid.near, grid.place, grid.field, coarse, i, j, flip), len(grid.place), 256)
    return flip


def part_touching(grid: Grid, coarse: FloatArray) -> int:
    """Move the inside corners by which two sheets touch across a face to the outside, until none is left; returns how many.

    Each pass only adds outside corners, so it ends."""
    moved = 0
    while True:
        flip = _touching_corners(grid, coarse)
        count = int(flip.sum())
        if count == 0:
            return moved
        grid.field[flip] = np.float32(0.05 * grid.step_mm)
        moved += count


@kernel
def from_coarse(place, field, state, coarse, least, first, last):
    """Fill what no view is near to from the coarse field; free space stays outside by `least`."""
    for b in range(first, last):
        corner = 0
        for k in range(8):
            for j in range(8):
                for i in range(8):
                    if state[b, corner] < SEEN:
                        value = coarse_value(coarse, 8 * place[b, 0] + i, 8 * place[b, 1] + j, 8 * place[b, 2] + k)
                        field[b, corner] = max(value, least) if state[b, corner] == 1 else value
                    corner += 1
