"""Heights of a range grid as unknowns: their links, slopes, bends and normals, as sparse matrices over the valid cells.

The unknown of a cell is q = ln(range / mm): its normal then depends on the differences of q alone, because with the ray d(u, v)

    n  ~  (d_u + q_u d) x (d_v + q_v d)

Cells are linked where both returned and no depth jump lies between them. Slopes are central differences per cell, bends second differences
(along u, along v, and across the corner).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from rangecheck.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class HeightGrid:
    """n valid cells of a grid (h, w).

    cell      (n,) index into the flattened grid
    by_u, by_v  (m, n) sparse: slope of q per cell of the m inner cells, those with all four links
    inner     (m,) numbers of these among the n
    bend      (k, n) sparse second differences;  bend_cell (k,) the cell in whose middle each lies
    rays      (n, 3) unit;  ray_u, ray_v (n, 3) their change per cell
    """

    cell: IntArray
    by_u: sparse.csr_array
    by_v: sparse.csr_array
    inner: IntArray
    bend: sparse.csr_array
    bend_cell: IntArray
    rays: FloatArray
    ray_u: FloatArray
    ray_v: FloatArray
    shape: tuple[int, int]

    def spread(self, values: FloatArray, fill: float = np.nan) -> FloatArray:
        """Values (n, ...) put back on the grid (h, w, ...)."""
        grid = np.full((self.shape[0] * self.shape[1], *values.shape[1:]), fill)
        grid[self.cell] = values
        return grid.reshape(*self.shape, *values.shape[1:])

    def normals(self, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Unit normals (m, 3) of the inner cells, towards the camera, and their derivatives by the slopes along u and v."""
        ray = self.rays[self.inner]
        a = self.ray_u[self.inner] + (self.by_u @ q)[:, None] * ray
        b = self.ray_v[self.inner] + (self.by_v @ q)[:, None] * ray
        # u runs right and v down: b x a looks back to the camera
        c = np.cross(b, a)
        length = np.linalg.norm(c, axis=1, keepdims=True)
        n = c / length

        def turned(by: FloatArray) -> FloatArray:
            return (by - (by * n).sum(1, keepdims=True) * n) / length

        return n, turned(np.cross(b, ray)), turned(np.cross(ray, a))


def height_grid(range_mm: FloatArray, rays: FloatArray, steepest: float, slack: FloatArray | float) -> HeightGrid:
    """Of ranges (h, w), NaN where nothing returned, and unit rays (h, w, 3).

    Neighbours are linked unless ln range changes by more than `steepest` times the angle between their rays, plus `slack` (share of range)."""
    valid = np.isfinite(range_mm)
    h, w = range_mm.shape
    number = np.full((h, w), -1)
    number[valid] = np.arange(int(valid.sum()))
    q = np.log(np.where(valid, range_mm, 1.0))
    loose = np.broadcast_to(slack, (h, w))
    right = _linked(q, valid, rays, steepest, loose, 1)
    down = _linked(q, valid, rays, steepest, loose, 0)
    n = int(valid.sum())
    row, column = np.nonzero(valid)
    across = np.zeros((h, w), bool)
    across[:, 1:-1] = right[:, :-1] & right[:, 1:]
    upright = np.zeros((h, w), bool)
    upright[1:-1] = down[:-1] & down[1:]
    inner = number[across & upright]
    rows, columns = row[inner], column[inner]

    def central(dr: int, dc: int) -> sparse.csr_array:
        m = len(inner)
        where = np.concatenate([number[rows + dr, columns + dc], number[rows - dr, columns - dc]])
        return _rows(np.repeat([0.5, -0.5], m), np.tile(np.arange(m), 2), where, (m, n))

    bends, cells = [], []
    for holds, dr, dc in ((across, 0, 1), (upright, 1, 0)):
        i, j = np.nonzero(holds)
        k = len(i)
        where = np.concatenate([number[i, j], number[i + dr, j + dc], number[i - dr, j - dc]])
        bends.append(_rows(np.repeat([-2.0, 1.0, 1.0], k), np.tile(np.arange(k), 3), where, (k, n)))
        cells.append(number[i, j])
    whole = right[:-1] & right[1:] & down[:, :-1] & down[:, 1:]
    i, j = np.nonzero(whole)
    k = len(i)
    corners = [number[i, j], number[i + 1, j + 1], number[i, j + 1], number[i + 1, j]]
    # the mixed derivative counts twice in the squared bend
    signs = np.repeat(np.sqrt(2.0) * np.array([1.0, 1.0, -1.0, -1.0]), k)
    bends.append(_rows(signs, np.tile(np.arange(k), 4), np.concatenate(corners), (k, n)))
    cells.append(number[i, j])
    along = [np.nan_to_num(np.gradient(rays, axis=axis))[valid] for axis in (1, 0)]
    return HeightGrid(
        np.flatnonzero(valid), central(0, 1), central(1, 0), inner, sparse.csr_array(sparse.vstack(bends)), np.concatenate(cells),
        rays[valid], along[0], along[1], (h, w),
    )  # fmt: skip


def _rows(values: FloatArray, row: IntArray, column: IntArray, shape: tuple[int, int]) -> sparse.csr_array:
    return sparse.csr_array(sparse.coo_array((values, (row, column)), shape=shape))


def _linked(q: FloatArray, valid: BoolArray, rays: FloatArray, steepest: float, slack: FloatArray, axis: int) -> BoolArray:
    """(h, w-1) or (h-1, w): whether neighbours along the axis lie on one surface."""
    ahead, behind = [slice(None)] * 2, [slice(None)] * 2
    ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
    a, b = tuple(ahead), tuple(behind)
    apart = np.linalg.norm(rays[a] - rays[b], axis=-1)
    return np.asarray(valid[a] & valid[b] & (np.abs(q[a] - q[b]) < steepest * apart + slack[a]))
