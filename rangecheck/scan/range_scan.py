"""`RangeScan`: distances along the rays of a camera, with the cells where nothing returned kept as such.

The grid is kept to the end: neighbours in the grid are neighbours on the surface, or there is a depth jump between them.
Scan frame = camera frame (x right, y down, z forward); world frame by `world_from_scan`. Millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, require
from rangecheck.errors import ScanError
from rangecheck.optics import Camera


@dataclass(frozen=True, eq=False)
class RangeScan:
    """One range image.

    range_mm        (h, w) float32, length along each pixel's ray, NaN where nothing returned
    camera          which ray belongs to which pixel
    world_from_scan (4, 4) rigid motion
    brightness      (h, w) float32 in 0..1, or None
    name            for messages, reports and file names
    unit            unit of the file it was read from ("mm" if made here); range_mm is in mm whatever it says
    noise_mm        standard deviation of range at normal incidence if the scanner states it, else None
    """

    range_mm: FloatArray = field(repr=False)
    camera: Camera
    world_from_scan: FloatArray = field(default_factory=rigid.identity, repr=False)
    brightness: FloatArray | None = field(default=None, repr=False)
    name: str = "scan"
    unit: str = "mm"
    noise_mm: float | None = None

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width)
        ranges = require("range_mm", self.range_mm, shape, np.float32)
        # zero, negative and infinite readings are how sensors say "nothing returned"
        bad = ~(np.isfinite(ranges) & (ranges > 0))
        if (bad & ~np.isnan(ranges)).any():
            ranges = np.where(bad, np.float32(np.nan), ranges)
        ranges = ranges.view()
        ranges.flags.writeable = False
        object.__setattr__(self, "range_mm", ranges)
        object.__setattr__(self, "world_from_scan", rigid.checked(self.world_from_scan, "world_from_scan"))
        if self.brightness is not None:
            object.__setattr__(self, "brightness", require("brightness", self.brightness, shape, np.float32))

    @cached_property
    def valid(self) -> BoolArray:
        """(h, w) True where something returned."""
        return ~np.isnan(self.range_mm)

    @cached_property
    def grid_points_mm(self) -> FloatArray:
        """(h, w, 3) float64 points in the scan frame, NaN where nothing returned."""
        origins, directions = self.camera.pixel_rays()
        return origins + self.range_mm.astype(np.float64)[..., None] * directions

    @cached_property
    def depth_mm(self) -> FloatArray:
        """(h, w) float32 depth: the component along the optical axis, not the range."""
        return self.grid_points_mm[..., 2].astype(np.float32)

    def points_mm(self) -> FloatArray:
        """(n, 3) float64 valid points in the world frame, row by row."""
        return rigid.move_points(self.world_from_scan, self.grid_points_mm[self.valid])

    def _repr_png_(self) -> bytes:
        """A notebook's look at the scan: its relief under one light."""
        from rangecheck.quick_look import LONGEST, grid_normals, shaded_png

        step = max(1, -(-max(self.range_mm.shape) // LONGEST))
        return shaded_png(grid_normals(self.grid_points_mm[::step, ::step]))

    def need_points(self, least: int = 3) -> RangeScan:
        """This scan, if it has at least `least` valid cells; raises ScanError otherwise."""
        count = int(self.valid.sum())
        if count < least:
            raise ScanError(
                f"{self.name}: {count} of {self.range_mm.size} cells hold a distance; at least {least} are needed; "
                "check the unit, the depth scale and the invalid value of the file",
                name=self.name,
                valid=count,
            )
        return self

    def moved(self, world_from_scan: FloatArray) -> RangeScan:
        """The same measurement at another pose."""
        return replace(self, world_from_scan=world_from_scan)
