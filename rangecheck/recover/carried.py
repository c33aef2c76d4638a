"""A second photograph as a scan's shape carries it to the scan's own grid: what its camera saw of each cell, were the cell's range another.

Scan frame, millimetres; light in logarithms, so that gain is a shift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.errors import ScanError
from rangecheck.recover.grid import ScanGrid, scan_grid
from rangecheck.scan import RangeScan
from rangecheck.scan.decode import View


@dataclass(frozen=True, eq=False)
class Carried:
    """The n valid cells of a grid and where the second camera sees them.

    grid;  held: rows and columns around all that is valid, valid (h, w) within;  own (n,) ln of the scan's brightness;  seen (n,) the second camera's
    picture holds it;  at, along (n, 2) pixels, and how they move per mm of range;  light: the second picture, as coarse as the grid's cells"""

    grid: ScanGrid
    held: tuple[slice, slice]
    valid: BoolArray
    own: FloatArray
    seen: BoolArray
    at: FloatArray
    along: FloatArray
    light: FloatArray

    def there(self, offset_mm: float) -> FloatArray:
        """(n,) ln of the light that the second camera saw, were all ranges longer by `offset_mm`."""
        from scipy.ndimage import map_coordinates

        u, v = (self.at + offset_mm * self.along).T
        floor = max(1e-3 * float(self.light.max()), 1e-12)
        return np.log(np.maximum(map_coordinates(self.light, [v, u], order=1, mode="nearest"), floor))

    def holds(self, offset_mm: float) -> BoolArray:
        """(n,) whether the second picture holds the cell, were its range longer by `offset_mm`."""
        h, w = self.light.shape
        u, v = (self.at + offset_mm * self.along).T
        return np.asarray(self.seen & (u >= 0.0) & (u <= w - 1.0) & (v >= 0.0) & (v <= h - 1.0))

    def spread(self, values: FloatArray) -> FloatArray:
        """Values (n,) on the held part of the grid, 0 elsewhere."""
        full = np.zeros(self.valid.shape)
        full[self.valid] = values
        return full


def carried(scan: RangeScan, picture: FloatArray, view: View, step: int) -> Carried:
    """`picture` (h, w) taken by `view`, on the grid of the scan. step: rows and columns averaged to one.

    Raises ScanError where the scan has no brightness or the picture is not of the view's size."""
    from scipy.ndimage import gaussian_filter

    if picture.shape != (view.camera.height, view.camera.width):
        raise ScanError(
            f"{scan.name}: the second picture is {picture.shape[1]} x {picture.shape[0]}, its camera {view.camera.width} x {view.camera.height}; "
            "give the camera of this picture"
        )
    grid = scan_grid(scan, step)
    rows, columns = (np.flatnonzero(grid.valid.any(axis=axis)) for axis in (1, 0))
    held = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    points, rays = grid.points[grid.valid], grid.rays[grid.valid]
    other = rigid.inverse(view.world_from_camera) @ scan.world_from_scan
    at, _ = view.camera.project(rigid.move_points(other, points))
    ahead, _ = view.camera.project(rigid.move_points(other, points + rays))
    inside = (at >= 0) & (at <= np.array(picture.shape[::-1]) - 1.0)
    seen: BoolArray = np.asarray((np.isfinite(ahead) & inside).all(axis=1))
    at, along = np.where(seen[:, None], at, 0.0), np.where(seen[:, None], ahead - at, 0.0)
    # as coarse as the grid's own cells, whose picture is the mean of step x step
    light = gaussian_filter(picture.astype(float), 0.5 * step)
    own = np.log(np.maximum(np.nan_to_num(grid.picture[grid.valid]), 1e-3))
    return Carried(grid, held, grid.valid[held], own, seen, at, along, light)
