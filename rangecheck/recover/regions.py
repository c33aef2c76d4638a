"""Places that a scan does not explain: connected cells of one class, with their middle, size and worst cell. Scan frame, millimetres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray

#: what may be wrong at a place; albedo and highlight say nothing against the scan's shape
KINDS = ("shape", "registration", "shadow edge", "highlight", "albedo")
AGAINST_SHAPE = ("shape", "registration")
#: regions this many times longer than wide are lines, and lines in the shape are steps between surfaces
LINE = 3.0


@dataclass(frozen=True)
class Region:
    """A place that the scan does not explain: `kind` of KINDS, middle (3,) mm in the scan's frame, area and length mm, worst z and its cell; asked: |z| from
    which a place is named;  amount_mm: by how much the scan lies too deep there, or a step's height; None where the shape is not what is wrong"""

    kind: str
    middle_mm: tuple[float, float, float]
    area_mm2: float
    length_mm: float
    width_mm: float
    z: float
    cell: tuple[int, int]
    asked: float = 0.0
    amount_mm: float | None = None


def inner(mask: BoolArray, cells: float) -> BoolArray:
    """The mask without what lies within so many cells of its rim."""
    from scipy.ndimage import distance_transform_edt

    return np.asarray(distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1] > cells)


def regions_of(
    mask: BoolArray, z: FloatArray, points: FloatArray, spacing_mm: float, least_mm2: float
) -> list[tuple[Region, BoolArray]]:
    """Connected regions of `mask` (h, w) no smaller than `least_mm2`, each with its cells; long ones are steps, others shape. z: how far off each cell is."""
    from scipy.ndimage import label

    spots, count = label(mask, np.ones((3, 3)))
    found = []
    for k in range(1, count + 1):
        rows, columns = np.nonzero(spots == k)
        area = len(rows) * spacing_mm**2
        if area < least_mm2:
            continue
        here = points[rows, columns]
        spread = np.linalg.svd(here - here.mean(axis=0), compute_uv=False) / math.sqrt(len(here))
        length, width = (2.0 * math.sqrt(3.0) * float(s) for s in (*spread[:2], 0.0)[:2])
        worst = int(np.argmax(np.abs(z[rows, columns])))
        x, y, depth = (float(v) for v in np.median(here, axis=0))
        kind = "registration" if length > LINE * max(width, spacing_mm) else "shape"
        region = Region(
            kind, (x, y, depth), float(area), length, width, float(z[rows[worst], columns[worst]]), (int(rows[worst]), int(columns[worst]))
        )  # fmt: skip
        found.append((region, spots == k))
    return found
