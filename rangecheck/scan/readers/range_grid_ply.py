"""Stanford range-grid PLY (Cyberware, 1994-96): a grid of columns and rows whose cells list no vertex or one.

File frame: x right, y up, z towards the scanner; the scan frame (x right, y down, z forward) starts on a plane 100 mm in front of
the nearest vertex, and `world_from_scan` leads back to the file's frame, in mm. The first row of the scan is the top one, whichever
comes first in the file. The file does not say its unit.

Such a scanner sweeps a sheet of light along x while a camera beside it looks along it: columns stand at steady x (rows may be
interlaced by a fraction of a column), and the camera's rows fan out, so that a row's y depends on z. A row's rays share one direction,
a linear function of the row fitted over the whole scan; each ray of a valid cell passes through its vertex exactly, whatever the fit leaves over. Rays of empty
cells take the fit and the smoothed remainder of the cells around.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray, mm_per, unit_vectors
from rangecheck.errors import InputError, UnitMissing
from rangecheck.optics import RayGrid
from rangecheck.optics.ray_law import fill_smoothly, least_squares
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.readers.limits import check_cells
from rangecheck.scan.readers.ply import Ply, read_ply

STAND_OFF_MM = 100.0


def is_range_grid(ply: Ply) -> bool:
    return "range_grid" in ply.elements


def read_range_grid(path: Path, unit: str | None = None) -> list[RangeScan]:
    """The one scan of the file. Raises InputError when the grid and the vertices do not fit, UnitMissing without a unit."""
    if unit is None:
        raise UnitMissing(path)
    return [scan_of_grid(read_ply(path), unit)]


def scan_of_grid(ply: Ply, unit: str) -> RangeScan:
    """The scan in a PLY with elements vertex and range_grid."""
    path = ply.path
    vertex = ply.need("vertex", "x", "y", "z")
    index, valid = _grid(ply)
    if _rises(vertex.columns["y"], index):
        index, valid = index[::-1], valid[::-1].copy()
    points = np.stack([vertex.columns[axis] for axis in "xyz"], axis=1).astype(np.float64)[index[valid]] * mm_per(unit)
    finite = np.isfinite(points).all(axis=1)
    valid[valid] = finite
    points = points[finite]
    if len(points) == 0:
        raise InputError(path, "holds no distance: every cell of its range grid is empty; check the file")
    front = float(points[:, 2].max()) + STAND_OFF_MM
    file_from_scan = np.diag([1.0, -1.0, -1.0, 1.0])
    file_from_scan[2, 3] = front
    grid = np.full((*valid.shape, 3), np.nan)
    grid[valid] = points * [1.0, -1.0, -1.0] + [0.0, 0.0, front]
    origins, directions = _rays(grid, valid)
    camera = RayGrid(valid.shape[1], valid.shape[0], origins, directions)
    ranges = grid[..., 2] / directions[..., 2]
    return RangeScan(ranges, camera, rigid.checked(file_from_scan), _brightness(ply, index, valid), path.stem, unit)


def _grid(ply: Ply) -> tuple[IntArray, BoolArray]:
    """Vertex index per cell (rows, columns), -1 where empty, and the mask of cells that hold one."""
    path, cells = ply.path, ply.need("range_grid")
    try:
        width, height = int(ply.info["num_cols"]), int(ply.info["num_rows"])
    except (KeyError, ValueError):
        raise InputError(path, "its header does not say num_cols and num_rows as obj_info; a range grid needs both") from None
    check_cells(path, width, height)
    if cells.rows != width * height or len(cells.lists) != 1:
        raise InputError(
            path, f"its range grid has {cells.rows} cells and its header {width} columns x {height} rows; export it again"
        )
    lengths, items = next(iter(cells.lists.values()))
    if lengths.max(initial=0) > 1:
        raise InputError(path, f"a cell of its range grid lists {lengths.max()} vertices; a range grid lists none or one")
    count = ply.need("vertex").rows
    wrong = ~((items >= 0) & (items < count) & (items == np.floor(items)))
    if wrong.any():
        raise InputError(
            path, f"its range grid names vertex {items[wrong][0]:g} of {count}; export it again", count=int(wrong.sum())
        )
    flat = np.full(width * height, -1, np.int64)
    flat[lengths == 1] = items.astype(np.int64)
    index = flat.reshape(height, width)
    return index, index >= 0


def _rises(y: FloatArray, index: IntArray) -> bool:
    """Whether rows run upwards in the file's frame, y up; scans keep their first row on top."""
    both = (index[1:] >= 0) & (index[:-1] >= 0)
    return float((y[index[1:][both]].astype(np.float64) - y[index[:-1][both]]).sum()) > 0


def _rays(grid: FloatArray, valid: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Origins on z = 0 and unit directions (h, w, 3), one ray for every cell; those of valid cells meet their point."""
    height, width = valid.shape
    rows, columns = np.nonzero(valid)
    x, y, z = grid[valid].T
    middle, depth = float(np.median(z)), max(float(np.ptp(z)), 1e-9)
    r, c = 2 * np.arange(height) / max(height - 1, 1) - 1, 2 * np.arange(width) / max(width - 1, 1) - 1
    # y = cubic(row) + tilt column + (z - middle) (fan0 + fan1 row); fewer powers where fewer rows are there
    powers = r[:, None] ** np.arange(min(4, len(np.unique(rows))))
    deep = (z - middle) / depth
    found = least_squares(np.column_stack([powers[rows], c[columns], deep, deep * r[rows]]), y)
    slope = (found[-2] + found[-1] * r) / depth
    lawful_y = (powers @ found[:-3] - middle * slope)[:, None] + found[-3] * c
    lawful_x = _columns(x, columns, rows, valid.shape)
    rest: FloatArray = np.zeros((height, width, 2))
    rest[valid] = np.column_stack([x - lawful_x[valid], y - lawful_y[valid] - z * slope[rows]])
    rest = fill_smoothly(rest, valid)
    origins = np.stack([lawful_x + rest[..., 0], lawful_y + rest[..., 1], np.zeros((height, width))], axis=-1)
    directions = unit_vectors(np.stack([np.zeros(height), slope, np.ones(height)], axis=-1))
    return origins, np.repeat(directions[:, None, :], width, axis=1)


def _columns(x: FloatArray, columns: IntArray, rows: IntArray, shape: tuple[int, int]) -> FloatArray:
    """x of every cell (h, w): one pitch, and an offset per row, empty rows taking that of the nearest row of the same parity."""
    height, width = shape
    odd = rows % 2
    pitch = float(least_squares(np.column_stack([columns, 1 - odd, odd]).astype(float), x)[0])
    count = np.bincount(rows, minlength=height)
    offset = np.bincount(rows, x - pitch * columns, height) / np.maximum(count, 1)
    used = np.flatnonzero(count)
    for parity in (0, 1):
        mine = used[used % 2 == parity]
        source = mine if len(mine) else used
        lines = np.arange(parity, height, 2)
        after = np.clip(np.searchsorted(source, lines), 1, max(len(source) - 1, 1))
        near, far = source[after - 1], source[np.minimum(after, len(source) - 1)]
        offset[lines] = offset[np.where(np.abs(lines - near) <= np.abs(far - lines), near, far)]
    return pitch * np.arange(width)[None, :] + offset[:, None]


def _brightness(ply: Ply, index: IntArray, valid: BoolArray) -> FloatArray | None:
    """Brightness 0..1 from 8-bit colours (Rec. 709 weights) or an intensity already in 0..1; else None."""
    columns = ply.elements["vertex"].columns
    if all(c in columns for c in ("red", "green", "blue")):
        values = (0.2126 * columns["red"] + 0.7152 * columns["green"] + 0.0722 * columns["blue"]) / 255.0
    elif "intensity" in columns:
        values = columns["intensity"]
    else:
        return None
    values = np.asarray(values, np.float64)
    if not (np.isfinite(values).all() and values.min(initial=0) >= 0 and values.max(initial=0) <= 1):
        return None
    bright = np.zeros(valid.shape, np.float32)
    bright[valid] = values[index[valid]]
    return bright
