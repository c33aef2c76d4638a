"""How far the nearest sample is, and what that makes of a face: measured, interpolated or invented. Millimetres.

A face is measured when a sample lies within `measured_mm` of its centroid, interpolated when one lies within `interpolated_mm`,
and invented otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import ArrayError
from rangecheck.kernels import in_chunks, kernel
from rangecheck.surface.surface import INTERPOLATED, INVENTED, MEASURED


@dataclass(frozen=True)
class SampleGrid:
    """Samples sorted into cubic cells: points (n, 3), first (cells + 1,) index of each cell's samples, cells x fastest."""

    points_mm: FloatArray
    first: IntArray
    origin_mm: FloatArray
    cell_mm: float
    shape: IntArray


@kernel
def _cell_of(points, origin, cell, shape, number):
    for i in range(len(points)):
        x = min(max(int((points[i, 0] - origin[0]) / cell), 0), shape[0] - 1)
        y = min(max(int((points[i, 1] - origin[1]) / cell), 0), shape[1] - 1)
        z = min(max(int((points[i, 2] - origin[2]) / cell), 0), shape[2] - 1)
        number[i] = x + shape[0] * (y + shape[1] * z)


@kernel
def _counting_sort(number, first, points, out):
    for i in range(len(number)):
        first[number[i] + 1] += 1
    for c in range(1, len(first)):
        first[c] += first[c - 1]
    at = first[:-1].copy()
    for i in range(len(number)):
        k = at[number[i]]
        at[number[i]] += 1
        out[k, 0], out[k, 1], out[k, 2] = points[i, 0], points[i, 1], points[i, 2]


def sample_grid(points_mm: FloatArray, cell_mm: float) -> SampleGrid:
    """Sort samples (n, 3) into cells of `cell_mm`, or larger where that would make more than eight cells a sample."""
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    cell = max(cell_mm, float(np.prod(np.maximum(high - low, cell_mm)) / (8.0 * len(points_mm))) ** (1 / 3))
    shape = np.ceil((high - low) / cell).astype(np.int64) + 1
    number, first = np.empty(len(points_mm), np.int64), np.zeros(int(np.prod(shape)) + 1, np.int64)
    _cell_of(points_mm, low, cell, shape, number)
    out = np.empty_like(points_mm)
    _counting_sort(number, first, points_mm, out)
    return SampleGrid(out, first, low, cell, shape)


@kernel
def _nearest(points, first_of, origin, cell, shape, queries, enough, limit, first, last, distance):
    """Distance to the nearest sample; the search ends at one within `enough`, and gives inf beyond `limit`."""
    for q in range(first, last):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        ci = math.floor((x - origin[0]) / cell)
        cj = math.floor((y - origin[1]) / cell)
        ck = math.floor((z - origin[2]) / cell)
        best = np.inf
        ring = 0
        while True:
            # all samples within ring * cell have been seen once this ring is done
            for k in range(max(ck - ring, 0), min(ck + ring, shape[2] - 1) + 1):
                for j in range(max(cj - ring, 0), min(cj + ring, shape[1] - 1) + 1):
                    shell = abs(k - ck) == ring or abs(j - cj) == ring
                    for i in range(max(ci - ring, 0), min(ci + ring, shape[0] - 1) + 1):
                        if not shell and abs(i - ci) != ring:
                            continue
                        c = i + shape[0] * (j + shape[1] * k)
                        for s in range(first_of[c], first_of[c + 1]):
                            d = (points[s, 0] - x) ** 2 + (points[s, 1] - y) ** 2 + (points[s, 2] - z) ** 2
                            if d < best:
                                best = d
                    if best <= enough * enough:
                        break
                if best <= enough * enough:
                    break
            reached = ring * cell
            if best <= max(enough * enough, reached * reached) or reached >= limit:
                break
            ring += 1
        distance[q] = math.sqrt(best) if best <= limit * limit else np.inf


def distance_to_samples(grid: SampleGrid, queries_mm: FloatArray, limit_mm: float, enough_mm: float = 0.0) -> FloatArray:
    """(n,) mm from each query (n, 3) to its nearest sample, inf beyond `limit_mm`; any sample within `enough_mm` will do."""
    distance = np.empty(len(queries_mm))
    in_chunks(
        lambda i, j: _nearest(
            grid.points_mm, grid.first, grid.origin_mm, grid.cell_mm, grid.shape, queries_mm, enough_mm, limit_mm, i, j, distance
        ),
        len(queries_mm),
        4096,
    )
    return distance


def label_faces(
    grid: SampleGrid, vertices_mm: FloatArray, faces: IntArray, measured_mm: float, interpolated_mm: float
) -> IntArray:
    """(m,) uint8 origin of each face by the rule at the top of this file. Raises ArrayError unless 0 < measured <= interpolated."""
    if not 0 < measured_mm <= interpolated_mm:
        raise ArrayError(
            f"measured_mm is {measured_mm} and interpolated_mm {interpolated_mm}; they must be positive and in this order",
            name="measured_mm",
        )
    centroids = (vertices_mm[faces[:, 0]] + vertices_mm[faces[:, 1]] + vertices_mm[faces[:, 2]]) / 3.0
    distance = distance_to_samples(grid, centroids, interpolated_mm, measured_mm)
    return np.where(distance <= measured_mm, MEASURED, np.where(distance <= interpolated_mm, INTERPOLATED, INVENTED)).astype(
        np.uint8
    )
