"""Heights of a range grid as unknowns: their links, slopes, bends and normals, as sparse matrices over the valid cells.

The unknown of a cell is q = ln(range / mm): its normal then depends on the differences of q alone, because with the ray d(u, v)

    n  ~  (d_u + q_u d) x (d_v + q_v d)

Cells are linked where both returned and no depth jump lies between them. Slopes of a cell are the mean over its links, so central differences where it has
both and one-sided ones at rims; those halfway between two linked cells are the step itself along the link, and across it the mean of the two
cells'. Central differences alone do not see heights that alternate. Bends are second differences (along u, along v, and across the corner).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from rangecheck.arrays import BoolArray, FloatArray, IntArray, unit_vectors

#: of a step that is a tear, the part that is one beside a tear: edges go on, and two deviations, not three, tell them there
_GOING_ON = 2.0 / 3.0


@dataclass(frozen=True, eq=False)
class Slopes:
    """m places where q has a slope along u and along v.

    by_u, by_v  (m, n) sparse: slope of q per cell, of the n valid cells
    rays      (m, 3) unit;  ray_u, ray_v (m, 3) their change per cell
    """

    by_u: sparse.csr_array
    by_v: sparse.csr_array
    rays: FloatArray
    ray_u: FloatArray
    ray_v: FloatArray

    def normals(self, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Unit normals (m, 3), towards the camera, and their derivatives by the slopes along u and v."""
        a = self.ray_u + (self.by_u @ q)[:, None] * self.rays
        b = self.ray_v + (self.by_v @ q)[:, None] * self.rays
        # u runs right and v down: b x a looks back to the camera
        c = np.cross(b, a)
        length = np.linalg.norm(c, axis=1, keepdims=True)
        n = c / length

        def turned(by: FloatArray) -> FloatArray:
            return (by - (by * n).sum(1, keepdims=True) * n) / length

        return n, turned(np.cross(b, self.rays)), turned(np.cross(self.rays, a))

    def only(self, keep: IntArray) -> Slopes:
        """At the places `keep`, among the m."""
        return Slopes(self.by_u[keep], self.by_v[keep], self.rays[keep], self.ray_u[keep], self.ray_v[keep])


@dataclass(frozen=True, eq=False)
class HeightGrid:
    """n valid cells of a grid (h, w).

    cell      (n,) index into the flattened grid
    inner     (m,) numbers of the cells, among the n, that have a link along both axes;  whole (m,) which of them have all four
    slopes    at these m, the mean over the links that each has
    ends      (k, 2) numbers, among the m, of linked cells;  between: slopes halfway between the two, along the link that of the link itself
    bend      (b, n) sparse second differences;  bend_cell (b,) the cell in whose middle each lies
    spacing   (n,) angle that a cell is wide times that it is high
    """

    cell: IntArray
    inner: IntArray
    whole: BoolArray
    slopes: Slopes
    ends: IntArray
    between: Slopes
    bend: sparse.csr_array
    bend_cell: IntArray
    spacing: FloatArray
    shape: tuple[int, int]

    def spread(self, values: FloatArray, fill: float = np.nan) -> FloatArray:
        """Values (n, ...) put back on the grid (h, w, ...)."""
        grid = np.full((self.shape[0] * self.shape[1], *values.shape[1:]), fill)
        grid[self.cell] = values
        return grid.reshape(*self.shape, *values.shape[1:])


def height_grid(
    range_mm: FloatArray,
    rays: FloatArray,
    steepest: FloatArray | float,
    slack: FloatArray | float,
    torn: FloatArray | float = np.inf,
) -> HeightGrid:
    """Of ranges (h, w), NaN where nothing returned, and unit rays (h, w, 3).

    Neighbours are linked unless ln range changes by more than `steepest`, of either, times the angle between their rays, plus `slack` (share of range), or by more than
    the links before and after it do, the same way, by `torn` (share of range), or by two thirds of it beside one that does."""
    valid = np.isfinite(range_mm)
    h, w = range_mm.shape
    n = int(valid.sum())
    number = np.full((h, w), -1)
    number[valid] = np.arange(n)
    q = np.log(np.where(valid, range_mm, 1.0))
    steep, loose = np.broadcast_to(steepest, (h, w)), np.broadcast_to(slack, (h, w))
    linked = [_linked(q, valid, rays, steep, loose, axis) for axis in (1, 0)]
    linked = [whole & ~_edges(q, whole, np.broadcast_to(torn, (h, w)), axis) for whole, axis in zip(linked, (1, 0), strict=True)]
    right, down = np.zeros((h, w), bool), np.zeros((h, w), bool)
    right[:, :-1], down[:-1] = linked
    left, up = np.zeros((h, w), bool), np.zeros((h, w), bool)
    left[:, 1:], up[1:] = linked
    along = [np.nan_to_num(np.gradient(rays, axis=axis))[valid] for axis in (1, 0)]
    flat = rays[valid]
    sides = (left | right) & (up | down)
    inner = number[sides]
    of_inner = np.full((h, w), -1)
    of_inner[sides] = np.arange(len(inner))
    i, j = np.nonzero(sides)

    def mean(before: BoolArray, after: BoolArray, di: int, dj: int) -> sparse.csr_array:
        b, a = before[i, j], after[i, j]
        weight = 1.0 / (b.astype(float) + a)
        row = np.arange(len(inner))
        return _rows(
            np.concatenate([weight[a], -weight[b], (weight * (b.astype(float) - a))[a != b]]),
            np.concatenate([row[a], row[b], row[a != b]]),
            np.concatenate([number[i[a] + di, j[a] + dj], number[i[b] - di, j[b] - dj], inner[a != b]]),
            (len(inner), n),
        )

    slopes = Slopes(mean(left, right, 0, 1), mean(up, down, 1, 0), flat[inner], along[0][inner], along[1][inner])
    ends, by_u, by_v = [], [], []
    for held, di, dj, across in ((right, 0, 1, slopes.by_v), (down, 1, 0, slopes.by_u)):
        i, j = np.nonzero(held)
        first, second = of_inner[i, j], of_inner[i + di, j + dj]
        both = (first >= 0) & (second >= 0)
        first, second = first[both], second[both]
        k = len(first)
        step = _rows(np.repeat([-1.0, 1.0], k), np.tile(np.arange(k), 2), np.concatenate([inner[first], inner[second]]), (k, n))
        halfway = 0.5 * (across[first] + across[second])
        by_u.append(step if dj else halfway)
        by_v.append(halfway if dj else step)
        ends.append(np.stack([first, second], axis=1))
    pairs = np.concatenate(ends)
    middle = [0.5 * (part[pairs[:, 0]] + part[pairs[:, 1]]) for part in (slopes.rays, slopes.ray_u, slopes.ray_v)]
    between = Slopes(
        sparse.csr_array(sparse.vstack(by_u)), sparse.csr_array(sparse.vstack(by_v)), unit_vectors(middle[0]), *middle[1:]
    )

    bends, cells = [], []
    for holds, dr, dc in ((left & right, 0, 1), (up & down, 1, 0)):
        i, j = np.nonzero(holds)
        k = len(i)
        where = np.concatenate([number[i, j], number[i + dr, j + dc], number[i - dr, j - dc]])
        bends.append(_rows(np.repeat([-2.0, 1.0, 1.0], k), np.tile(np.arange(k), 3), where, (k, n)))
        cells.append(number[i, j])
    i, j = np.nonzero(linked[0][:-1] & linked[0][1:] & linked[1][:, :-1] & linked[1][:, 1:])
    k = len(i)
    corners = [number[i, j], number[i + 1, j + 1], number[i, j + 1], number[i + 1, j]]
    # the mixed derivative counts twice in the squared bend
    signs = np.repeat(np.sqrt(2.0) * np.array([1.0, 1.0, -1.0, -1.0]), k)
    bends.append(_rows(signs, np.tile(np.arange(k), 4), np.concatenate(corners), (k, n)))
    cells.append(number[i, j])
    spacing = np.linalg.norm(along[0], axis=1) * np.linalg.norm(along[1], axis=1)
    whole = (left & right & up & down)[sides]
    return HeightGrid(
        np.flatnonzero(valid),
        inner,
        whole,
        slopes,
        pairs,
        between,
        sparse.csr_array(sparse.vstack(bends)),
        np.concatenate(cells),
        spacing,
        (h, w),
    )


def _edges(q: FloatArray, linked: BoolArray, torn: FloatArray, axis: int) -> BoolArray:
    """Links torn by more than `torn`, and those that go on from them to the sides by more than `_GOING_ON` of it (Canny, *A computational approach to edge
    detection*, 1986)."""
    from scipy.ndimage import binary_propagation

    begun = _torn(q, linked, torn, axis)
    return np.asarray(binary_propagation(begun, np.ones((3, 3), bool), mask=begun | _torn(q, linked, _GOING_ON * torn, axis)))


def _torn(q: FloatArray, linked: BoolArray, torn: FloatArray, axis: int) -> BoolArray:
    """Links whose step is steeper than those before and after by more than `torn`; one of the two is enough where there is no other."""
    step = np.diff(q, axis=axis)
    ahead, behind = [slice(None)] * 2, [slice(None)] * 2
    ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
    a, b = tuple(ahead), tuple(behind)
    limit = np.maximum(torn[a], torn[b])
    asked, alike = np.zeros(step.shape, bool), np.zeros(step.shape, bool)
    for mine, other in ((a, b), (b, a)):
        more = np.sign(step[mine]) * (step[mine] - step[other])
        steeper = (more > limit[mine]) & (np.abs(step[mine]) > np.abs(step[other]))
        asked[mine] |= linked[other]
        alike[mine] |= linked[other] & ~steeper
    return np.asarray(linked & asked & ~alike)


def _rows(values: FloatArray, row: IntArray, column: IntArray, shape: tuple[int, int]) -> sparse.csr_array:
    return sparse.csr_array(sparse.coo_array((values, (row, column)), shape=shape))


def _linked(q: FloatArray, valid: BoolArray, rays: FloatArray, steepest: FloatArray, slack: FloatArray, axis: int) -> BoolArray:
    """(h, w-1) or (h-1, w): whether neighbours along the axis lie on one surface."""
    ahead, behind = [slice(None)] * 2, [slice(None)] * 2
    ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
    a, b = tuple(ahead), tuple(behind)
    apart = np.linalg.norm(rays[a] - rays[b], axis=-1)
    most = np.maximum(steepest[a], steepest[b]) * apart + slack[a]
    return np.asarray(valid[a] & valid[b] & (np.abs(q[a] - q[b]) < most))
