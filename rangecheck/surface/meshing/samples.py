"""How far the nearest sample is, and what that makes of a face: measured, interpolated or invented. Millimetres.

A face is measured when a sample lies within `measured_mm` of its centroid, interpolated when one lies within `interpolated_mm`,
and invented otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import ArrayError
from rangecheck.kernels import in_chunks, kernel
from rangecheck.surface.surface import INTERPOLATED, INVENTED, MEASURED

#: rings of cells searched around a query before the search goes down the tree of occupied cells
RINGS = 2


@dataclass(frozen=True)
class SampleGrid:
    """Samples sorted into cubic cells: points (n, 3), first (cells + 1,) index of each cell's samples, cells z fastest, as the blocks of
    the grid are, so that what is asked one after the other lies side by side.

    shapes (levels, 3) and starts (levels,) of a tree over the cells, each level half the one before along each axis, down to one;
    occupied: whether any sample lies in a node, all levels after each other."""

    points_mm: FloatArray
    first: IntArray
    origin_mm: FloatArray
    cell_mm: float
    shapes: IntArray
    starts: IntArray
    occupied: BoolArray

    @property
    def arrays(self) -> tuple[FloatArray, IntArray, FloatArray, float, IntArray, IntArray, BoolArray]:
        """What the kernels take first."""
        return self.points_mm, self.first, self.origin_mm, self.cell_mm, self.shapes, self.starts, self.occupied


@kernel
def _cell_of(points, origin, cell, shape, first, last, number):
    for i in range(first, last):
        x = min(max(int((points[i, 0] - origin[0]) / cell), 0), shape[0] - 1)
        y = min(max(int((points[i, 1] - origin[1]) / cell), 0), shape[1] - 1)
        z = min(max(int((points[i, 2] - origin[2]) / cell), 0), shape[2] - 1)
        number[i] = z + shape[2] * (y + shape[1] * x)


@kernel
def _counting_sort(number, first, points, out):
    for i in range(len(number)):
        first[number[i] + 1] += 1
    for c in range(1, len(first)):
        first[c] += first[c - 1]
    for i in range(len(number)):
        k = first[number[i]]
        first[number[i]] += 1
        out[k, 0], out[k, 1], out[k, 2] = points[i, 0], points[i, 1], points[i, 2]
    for c in range(len(first) - 1, 0, -1):
        first[c] = first[c - 1]
    first[0] = 0


@kernel
def _grow_tree(first, shapes, starts, occupied):
    """Fill `occupied` from the samples up."""
    for c in range(len(first) - 1):
        occupied[c] = first[c + 1] > first[c]
    for level in range(1, len(starts)):
        low, here = shapes[level - 1], shapes[level]
        for i in range(low[0]):
            for j in range(low[1]):
                for k in range(low[2]):
                    if occupied[starts[level - 1] + k + low[2] * (j + low[1] * i)]:
                        occupied[starts[level] + (k >> 1) + here[2] * ((j >> 1) + here[1] * (i >> 1))] = True


def sample_grid(points_mm: FloatArray, cell_mm: float) -> SampleGrid:
    """Sort samples (n, 3) into cells of `cell_mm`, or larger where that would make more than eight cells a sample."""
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    cell = max(cell_mm, float(np.prod(np.maximum(high - low, cell_mm)) / (8.0 * len(points_mm))) ** (1 / 3))
    shape = np.ceil((high - low) / cell).astype(np.int64) + 1
    shapes = [shape]
    while shapes[-1].max() > 1:
        shapes.append((shapes[-1] + 1) // 2)
    starts = np.cumsum([0, *(int(np.prod(s)) for s in shapes)])
    number, first = np.empty(len(points_mm), np.int64), np.zeros(int(np.prod(shape)) + 1, np.int64)
    in_chunks(lambda i, j: _cell_of(points_mm, low, cell, shape, i, j, number), len(points_mm), 65536)
    out = np.empty_like(points_mm)
    _counting_sort(number, first, points_mm, out)
    occupied = np.zeros(int(starts[-1]), bool)
    grid = SampleGrid(out, first, low, cell, np.array(shapes), starts[:-1], occupied)
    _grow_tree(first, grid.shapes, grid.starts, occupied)
    return grid


@kernel
def _nearest_in_rings(points, first_of, origin, cell, shape, x, y, z, enough, limit):
    """(square of the distance to the nearest sample, whether that is certain), from RINGS rings of cells; any within `enough` will do."""
    ci = math.floor((x - origin[0]) / cell)
    cj = math.floor((y - origin[1]) / cell)
    ck = math.floor((z - origin[2]) / cell)
    best = np.inf
    for ring in range(RINGS + 1):
        for i in range(max(ci - ring, 0), min(ci + ring, shape[0] - 1) + 1):
            for j in range(max(cj - ring, 0), min(cj + ring, shape[1] - 1) + 1):
                shell = abs(i - ci) == ring or abs(j - cj) == ring
                for k in range(max(ck - ring, 0), min(ck + ring, shape[2] - 1) + 1):
                    if not shell and abs(k - ck) != ring:
                        continue
                    c = k + shape[2] * (j + shape[1] * i)
                    for s in range(first_of[c], first_of[c + 1]):
                        d = (points[s, 0] - x) ** 2 + (points[s, 1] - y) ** 2 + (points[s, 2] - z) ** 2
                        if d < best:
                            best = d
                if best <= enough * enough:
                    return best, True
        # all samples within ring * cell have been seen
        reached = ring * cell
        if best <= reached * reached or reached >= limit:
            return best, True
    return best, False


@kernel
def _nearest_in_tree(points, first_of, origin, cell, shapes, starts, occupied, stack, x, y, z, best):
    """The square of the distance to the nearest sample, or `best` where none is nearer: branch and bound, nearest children first."""
    top = len(starts) - 1
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = top, 0, 0, 0
    waiting = 1
    while waiting:
        waiting -= 1
        level, i, j, k = stack[waiting, 0], stack[waiting, 1], stack[waiting, 2], stack[waiting, 3]
        edge = cell * (1 << level)
        ax, ay, az = x - origin[0] - i * edge, y - origin[1] - j * edge, z - origin[2] - k * edge
        bx, by, bz = max(-ax, ax - edge, 0.0), max(-ay, ay - edge, 0.0), max(-az, az - edge, 0.0)
        if bx * bx + by * by + bz * bz >= best:
            continue
        if level == 0:
            c = k + shapes[0, 2] * (j + shapes[0, 1] * i)
            for s in range(first_of[c], first_of[c + 1]):
                d = (points[s, 0] - x) ** 2 + (points[s, 1] - y) ** 2 + (points[s, 2] - z) ** 2
                best = min(best, d)
            continue
        below = level - 1
        nearest = (ax > 0.5 * edge) | (ay > 0.5 * edge) << 1 | (az > 0.5 * edge) << 2
        for c in range(7, -1, -1):
            child = c ^ nearest
            ci, cj, ck = 2 * i + (child & 1), 2 * j + (child >> 1 & 1), 2 * k + (child >> 2)
            if ci >= shapes[below, 0] or cj >= shapes[below, 1] or ck >= shapes[below, 2]:
                continue
            if occupied[starts[below] + ck + shapes[below, 2] * (cj + shapes[below, 1] * ci)]:
                stack[waiting, 0], stack[waiting, 1], stack[waiting, 2], stack[waiting, 3] = below, ci, cj, ck
                waiting += 1
    return best


@kernel
def _nearest(points, first_of, origin, cell, shapes, starts, occupied, queries, enough, limit, first, last, distance):
    """Distance to the nearest sample; the search ends at one within `enough`, and gives inf beyond `limit`."""
    stack = np.empty((8 * len(starts) + 1, 4), np.int64)
    for q in range(first, last):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        best, certain = _nearest_in_rings(points, first_of, origin, cell, shapes[0], x, y, z, enough, limit)
        if not certain:
            far = min(best, np.nextafter(limit * limit, np.inf))
            best = _nearest_in_tree(points, first_of, origin, cell, shapes, starts, occupied, stack, x, y, z, far)
        distance[q] = math.sqrt(best) if best <= limit * limit else np.inf


def distance_to_samples(grid: SampleGrid, queries_mm: FloatArray, limit_mm: float, enough_mm: float = 0.0) -> FloatArray:
    """(n,) mm from each query (n, 3) to its nearest sample, inf beyond `limit_mm`; any sample within `enough_mm` will do."""
    distance = np.empty(len(queries_mm))
    in_chunks(lambda i, j: _nearest(*grid.arrays, queries_mm, enough_mm, limit_mm, i, j, distance), len(queries_mm), 4096)
    return distance


@kernel
def _label(points, first_of, origin, cell, shapes, starts, occupied, vertices, faces, measured, interpolated, first, last, label):
    stack = np.empty((8 * len(starts) + 1, 4), np.int64)
    for f in range(first, last):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        x = (vertices[a, 0] + vertices[b, 0] + vertices[c, 0]) / 3.0
        y = (vertices[a, 1] + vertices[b, 1] + vertices[c, 1]) / 3.0
        z = (vertices[a, 2] + vertices[b, 2] + vertices[c, 2]) / 3.0
        best, certain = _nearest_in_rings(points, first_of, origin, cell, shapes[0], x, y, z, measured, interpolated)
        if not certain:
            far = min(best, np.nextafter(interpolated * interpolated, np.inf))
            best = _nearest_in_tree(points, first_of, origin, cell, shapes, starts, occupied, stack, x, y, z, far)
        if math.sqrt(best) <= measured:
            label[f] = MEASURED
        else:
            label[f] = INTERPOLATED if best <= interpolated * interpolated else INVENTED


def label_faces(
    grid: SampleGrid, vertices_mm: FloatArray, faces: IntArray, measured_mm: float, interpolated_mm: float
) -> IntArray:
    """(m,) uint8 origin of each face by the rule at the top of this file. Raises ArrayError unless 0 < measured <= interpolated."""
    if not 0 < measured_mm <= interpolated_mm:
        raise ArrayError(
            f"measured_mm is {measured_mm} and interpolated_mm {interpolated_mm}; they must be positive and in this order",
            name="measured_mm",
        )
    label = np.empty(len(faces), np.uint8)
    in_chunks(lambda i, j: _label(*grid.arrays, vertices_mm, faces, measured_mm, interpolated_mm, i, j, label), len(faces), 8192)
    return label
