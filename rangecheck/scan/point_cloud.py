"""`PointCloud`: points without a grid and without a place they were seen from.

Poisson meshing and registration by features can use it. What needs neighbours in a grid or free space along rays cannot, and
`read_scans` says so instead of making up a scanner.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from rangecheck.arrays import FloatArray, require
from rangecheck.errors import ArrayError


@dataclass(frozen=True, eq=False)
class PointCloud:
    """points_mm (n, 3) float64, finite, world frame; normals (n, 3) unit or None; name and unit of the file it came from."""

    points_mm: FloatArray = field(repr=False)
    normals: FloatArray | None = field(default=None, repr=False)
    name: str = "cloud"
    unit: str = "mm"

    def __post_init__(self) -> None:
        points = require("points_mm", self.points_mm, (None, 3), finite=True)
        if len(points) == 0:
            raise ArrayError(f"{self.name} holds no point", name="points_mm")
        object.__setattr__(self, "points_mm", points)
        if self.normals is not None:
            object.__setattr__(self, "normals", require("normals", self.normals, (len(points), 3), finite=True))
