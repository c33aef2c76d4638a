"""One door to all meshing methods, and the choice between them."""

from __future__ import annotations

from collections.abc import Sequence

from rangecheck.errors import ScanError, SettingError
from rangecheck.scan import RangeScan
from rangecheck.surface.meshing.fuse import fuse
from rangecheck.surface.meshing.grid import grid_mesh
from rangecheck.surface.meshing.projection import projection_of
from rangecheck.surface.surface import Surface

METHODS = ("auto", "grid", "fuse")


def choose_method(scans: Sequence[RangeScan]) -> tuple[str, str]:
    """The method that suits the scans, and why in one clause. Raises ScanError when there are none."""
    if not scans:
        raise ScanError("there are no scans; a surface needs at least one")
    if len(scans) == 1:
        projection_of(scans[0])
        return "grid", "a single scan is its own grid of neighbours, and nothing behind it was seen"
    for scan in scans:
        projection_of(scan)
    return "fuse", f"{len(scans)} posed scans, all of which points can be projected into"


def mesh_scans(
    scans: Sequence[RangeScan], method: str = "auto", *, voxel_mm: float | None = None, max_angle_deg: float | None = None
) -> Surface:
    """One surface from the scans by `method`: auto, grid (one scan) or fuse; settings a method has no use for are left aside.

    Raises SettingError for an unknown method, and what the method raises."""
    if method not in METHODS:
        raise SettingError(f"meshing method is {method!r}; it must be one of {', '.join(METHODS)}", key="meshing.method")
    if method == "auto":
        method, _ = choose_method(scans)
    if method == "grid":
        if len(scans) != 1:
            raise ScanError(f"grid meshes one scan, and there are {len(scans)}; use fuse, or choose one scan")
        return grid_mesh(scans[0]) if max_angle_deg is None else grid_mesh(scans[0], max_angle_deg=max_angle_deg)
    return fuse(scans, voxel_mm=voxel_mm)
