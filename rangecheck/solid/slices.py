"""Cross-sections of a closed surface: exact areas at given heights, and a grid of cells told solid from air.

Frame of the grid: `up` is its third axis. Columns of cells are cut by every face over them; a point is inside where the faces above it,
counted with their direction, do not cancel. The rule at shared edges is half-open (as for polygons), so no column counts an edge twice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray, require
from rangecheck.errors import SurfaceError
from rangecheck.kernels import in_chunks, kernel
from rangecheck.surface.surface import Surface


def frame_of(up: npt.ArrayLike) -> FloatArray:
    """(3, 3) rows: two axes of the plane, and the unit vector up; right-handed."""
    z = require("up", up, (3,), finite=True)
    if not np.linalg.norm(z) > 0:
        raise SurfaceError("up has length 0; an orientation needs a direction")
    z = z / np.linalg.norm(z)
    x, y = rigid.across(z)
    return np.stack([-x, -y, z])


def section_areas_mm2(surface: Surface, heights_mm: FloatArray, up: npt.ArrayLike = (0.0, 1.0, 0.0)) -> FloatArray:
    """(k,) area of the solid's cross-section at each height along `up` (ascending)."""
    heights = require("heights_mm", heights_mm, (None,), finite=True)
    corners = (surface.vertices @ frame_of(up).T)[surface.faces]
    corners[..., :2] -= corners[..., :2].reshape(-1, 2).mean(axis=0) if len(corners) else 0.0
    pieces = in_chunks(lambda a, b: _section_areas(corners[a:b], heights), len(corners), 1 << 16)
    return np.sum(pieces, axis=0) if pieces else np.zeros(len(heights))


@kernel
def _section_areas(corners, heights):
    """Green's theorem over the segments that each face contributes to each section."""
    areas = np.zeros(len(heights))
    for f in range(len(corners)):
        low = min(corners[f, 0, 2], corners[f, 1, 2], corners[f, 2, 2])
        high = max(corners[f, 0, 2], corners[f, 1, 2], corners[f, 2, 2])
        k = np.searchsorted(heights, low)
        while k < len(heights) and heights[k] <= high:
            z = heights[k]
            sx = sy = ex = ey = 0.0
            cuts = 0
            for i in range(3):
                p, q = corners[f, i], corners[f, (i + 1) % 3]
                if (p[2] > z) != (q[2] > z):
                    s = (z - p[2]) / (q[2] - p[2])
                    x, y = p[0] + s * (q[0] - p[0]), p[1] + s * (q[1] - p[1])
                    cuts += 1
                    # where the rim of the face goes down through the section, the outline of the solid begins
                    if p[2] > z:
                        sx, sy = x, y
                    else:
                        ex, ey = x, y
            if cuts == 2:
                areas[k] += 0.5 * (sx * ey - sy * ex)
            k += 1
    return areas


@dataclass(frozen=True)
class Cells:
    """solid (nx, ny, nz) bool; low_mm (3,) corner of the grid in its frame; frame (3, 3) rows of axes; step_mm side of a cell."""

    solid: BoolArray = field(repr=False)
    low_mm: FloatArray
    frame: FloatArray
    step_mm: float

    def places_mm(self, index: IntArray) -> FloatArray:
        """(k, 3) middles of cells (k, 3), in the frame of the surface."""
        return (self.low_mm + (index + 0.5) * self.step_mm) @ self.frame


def cells_of(surface: Surface, step_mm: float, up: npt.ArrayLike = (0.0, 1.0, 0.0), *, most: int = 200_000_000) -> Cells:
    """The solid as cells of `step_mm`, with a layer of air around. Raises SurfaceError when that takes more than `most` cells."""
    frame = frame_of(up)
    local = surface.vertices @ frame.T
    low, high = local.min(axis=0), local.max(axis=0)
    shape = np.ceil((high - low) / step_mm).astype(int) + 3
    if not step_mm > 0 or math.prod(shape.tolist()) > most:
        raise SurfaceError(
            f"cells of {step_mm:g} mm make {math.prod(shape.tolist()):.3g} of them; choose a larger step", step_mm=step_mm
        )
    # half a cell of margin, moved by an odd share of a cell so that flat faces do not pass through the middles of cells
    origin = low - np.array([1.382, 1.434, 1.291]) * step_mm
    corners = ((local - origin) / step_mm)[surface.faces]
    count = np.zeros(shape[:2], np.int32)
    crossings(corners, count, np.zeros(1), np.zeros(1, np.int8), np.zeros(shape[:2], np.int64), True)
    start = (np.cumsum(count.ravel()) - count.ravel()).reshape(count.shape)
    height, sign = np.empty(max(int(count.sum()), 1)), np.empty(max(int(count.sum()), 1), np.int8)
    crossings(corners, np.zeros_like(count), height, sign, start, False)
    solid = np.zeros(tuple(shape), np.bool_)
    fill_columns(count, start, height, sign, solid)
    return Cells(solid, origin, frame, step_mm)


@kernel
def crossings(corners, count, height, sign, start, only_count):
    """Where faces (m, 3, 3), in cells, cross the middle lines of columns: their number, or heights and directions from `start` on."""
    nx, ny = count.shape
    for f in range(len(corners)):
        t = corners[f]
        x0, x1 = min(t[0, 0], t[1, 0], t[2, 0]), max(t[0, 0], t[1, 0], t[2, 0])
        y0, y1 = min(t[0, 1], t[1, 1], t[2, 1]), max(t[0, 1], t[1, 1], t[2, 1])
        area = (t[1, 0] - t[0, 0]) * (t[2, 1] - t[0, 1]) - (t[1, 1] - t[0, 1]) * (t[2, 0] - t[0, 0])
        if area == 0.0:
            continue
        for i in range(max(0, math.ceil(x0 - 0.5)), min(nx, math.floor(x1 - 0.5) + 1)):
            x = i + 0.5
            for j in range(max(0, math.ceil(y0 - 0.5)), min(ny, math.floor(y1 - 0.5) + 1)):
                y = j + 0.5
                inside = False
                for k in range(3):
                    a, b = t[k], t[(k + 1) % 3]
                    if (a[1] > y) != (b[1] > y):
                        # the lower end first, so that both faces at an edge compute the same crossing
                        if a[1] > b[1]:
                            a, b = b, a
                        if x < a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0]):
                            inside = not inside
                if not inside:
                    continue
                if not only_count:
                    v = ((x - t[0, 0]) * (t[2, 1] - t[0, 1]) - (y - t[0, 1]) * (t[2, 0] - t[0, 0])) / area
                    w = ((t[1, 0] - t[0, 0]) * (y - t[0, 1]) - (t[1, 1] - t[0, 1]) * (x - t[0, 0])) / area
                    place = start[i, j] + count[i, j]
                    height[place] = t[0, 2] + v * (t[1, 2] - t[0, 2]) + w * (t[2, 2] - t[0, 2])
                    sign[place] = 1 if area > 0.0 else -1
                count[i, j] += 1


@kernel
def fill_columns(count, start, height, sign, solid):
    """Cells whose middles have a non-zero sum of crossings below them; a floor faces down and counts 1, a ceiling -1."""
    nx, ny, nz = solid.shape
    for i in range(nx):
        for j in range(ny):
            first, n = start[i, j], count[i, j]
            if n == 0:
                continue
            for k in range(first + 1, first + n):
                # few crossings in a column: insertion keeps them in order
                h, s, m = height[k], sign[k], k
                while m > first and height[m - 1] > h:
                    height[m], sign[m] = height[m - 1], sign[m - 1]
                    m -= 1
                height[m], sign[m] = h, s
            level = 0
            for k in range(first, first + n - 1):
                level -= sign[k]
                if level > 0:
                    bottom, top = math.ceil(height[k] - 0.5), math.ceil(height[k + 1] - 0.5)
                    for c in range(max(0, bottom), min(nz, top)):
                        solid[i, j, c] = True
