"""One door to all meshing methods, and the choice between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rangecheck.errors import ScanError, SettingError
from rangecheck.scan import RangeScan
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.surface.meshing.fuse import fuse
from rangecheck.surface.meshing.grid import grid_mesh
from rangecheck.surface.meshing.pivot import pivot
from rangecheck.surface.meshing.poisson import poisson
from rangecheck.surface.meshing.projection import projection_of
from rangecheck.surface.surface import Surface


def _grid(
    scans: Sequence[RangeScan | PointCloud], *, max_angle_deg: float | None = None, noise_mm: float | None = None
) -> Surface:
    if len(scans) != 1:
        raise ScanError(f"grid meshes one range scan, and there are {len(scans)} scans; use fuse, or choose one scan")
    assert isinstance(scans[0], RangeScan)  # clouds were refused at the door
    angle = {} if max_angle_deg is None else {"max_angle_deg": max_angle_deg}
    return grid_mesh(scans[0], noise_mm=noise_mm, **angle)


_BY_NAME: dict[str, Callable[..., Surface]] = {"grid": _grid, "fuse": fuse, "poisson": poisson, "pivot": pivot}
METHODS = ("auto", *_BY_NAME)
#: settings that some methods have no use for
_ONLY_GRID = ("max_angle_deg", "noise_mm")
_NOT_GRID = ("voxel_mm", "measured_mm", "interpolated_mm", "closing", "largest_hole_mm")
_ONLY_FUSE = ("voxel_in_spacings",)


def choose_method(scans: Sequence[RangeScan | PointCloud]) -> tuple[str, str]:
    """The method that suits the scans, and why in one clause. Raises ScanError when there are none."""
    if not scans:
        raise ScanError("there are no scans; a surface needs at least one")
    clouds = [scan.name for scan in scans if isinstance(scan, PointCloud)]
    if clouds:
        return "poisson", f"{clouds[0]} is a cloud without grid or viewpoint, which only poisson and pivot take"
    if len(scans) == 1:
        return "grid", "a single scan is its own grid of neighbours, and nothing behind it was seen"
    for scan in scans:
        try:
            projection_of(scan)  # type: ignore[arg-type]
        except ScanError as error:
            return "poisson", f"free space cannot be told: {error}"
    return "fuse", f"{len(scans)} posed scans that points can be projected into, so free space is carved and errors are weighed"


def mesh_scans(scans: Sequence[RangeScan | PointCloud], method: str = "auto", **settings: Any) -> Surface:
    """One surface from the scans by `method`: auto, grid (one scan), fuse, poisson or pivot.

    settings  those of the method; None means its default; those that only other methods know (max_angle_deg and noise_mm: grid; voxel_mm,
              measured_mm, interpolated_mm, closing, largest_hole_mm: all but grid; voxel_in_spacings: fuse) are left aside
    Raises SettingError for an unknown method or setting, and what the method raises."""
    if method not in METHODS:
        raise SettingError(f"meshing method is {method!r}; it must be one of {', '.join(METHODS)}", key="meshing.method")
    if method == "auto":
        method, _ = choose_method(scans)
    aside = (_NOT_GRID if method == "grid" else _ONLY_GRID) + (() if method == "fuse" else _ONLY_FUSE)
    clouds = [scan for scan in scans if isinstance(scan, PointCloud)]
    if clouds and method in ("grid", "fuse"):
        raise ScanError(
            f"{clouds[0].name} is {len(clouds[0].points_mm)} points without a grid or a place they were seen from, and {method} needs "
            "both; use poisson or pivot",
            name=clouds[0].name,
        )
    given = {name: value for name, value in settings.items() if value is not None and name not in aside}
    try:
        return _BY_NAME[method](scans, **given)
    except TypeError as error:
        if "keyword argument" not in str(error):
            raise
        raise SettingError(f"{method} has no such setting ({error})", key="meshing") from None
