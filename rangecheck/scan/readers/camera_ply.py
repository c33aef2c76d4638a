"""Triangulated range maps: PLY with an element `camera` that says where they were seen from (as VCGlib and MeshLab write it).

    view_px view_py view_pz, x_axisx .. z_axisz, focal, scalex scaley, centerx centery, viewportx viewporty, k1 k2 k3 k4

The axes are the rows of camera_from_world with x right, y up, z backwards; a point at (X, Y, -Z) of that frame shows at
centerx + focal X / (scalex Z) to the right and centery + focal Y / (scaley Z) upwards, in pixels of a viewport of that size. Distorted
cameras (k not 0) are refused. Each vertex becomes the cell it projects into, with a ray through it exactly; the triangles are not kept,
for a range scan is triangulated again from its grid. The file does not say its unit.
"""

from __future__ import annotations

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, mm_per
from rangecheck.errors import ArrayError, InputError
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.readers.limits import check_cells
from rangecheck.scan.readers.organised import scan_from_points
from rangecheck.scan.readers.ply import Ply

_AXES = tuple(f"{axis}_axis{part}" for axis in "xyz" for part in "xyz")
_VIEW = ("view_px", "view_py", "view_pz")
_LENS = ("focal", "scalex", "scaley", "centerx", "centery", "viewportx", "viewporty")
#: share of vertices that may share a cell with another before the grid is taken for another one than was triangulated
_MAX_SHARED = 0.02


def scan_of_range_map(ply: Ply, unit: str) -> list[RangeScan]:
    """The one scan of a PLY with elements vertex and camera. Raises InputError when the vertices are no picture of that camera."""
    path = ply.path
    camera = ply.need("camera", *_VIEW, *_AXES, *_LENS)
    if camera.rows != 1:
        raise InputError(path, f"has {camera.rows} cameras; a range map has one")
    value = {name: float(column[0]) for name, column in camera.columns.items()}
    if any(value.get(f"k{k}", 0.0) != 0.0 for k in range(1, 5)):
        raise InputError(path, "its camera has lens distortion k1 .. k4, which is not read; undistort the range map first")
    try:
        axes = np.array([value[name] for name in _AXES]).reshape(3, 3)
        view = mm_per(unit) * np.array([value[name] for name in _VIEW])
        # rows x right, y up, z backwards; the scan frame has y down and z forward
        world_from_scan = rigid.from_rotation_translation((axes * [[1], [-1], [-1]]).T, view)
    except ArrayError as error:
        raise InputError(path, f"its camera has no pose ({error}); export it again") from None
    size = value["viewportx"], value["viewporty"]
    width, height = (int(s) if np.isfinite(s) and 0 < s < 1e6 and s == int(s) else 0 for s in size)
    check_cells(path, width, height)
    if not all(np.isfinite(value[k]) and value[k] != 0 for k in ("focal", "scalex", "scaley")):
        raise InputError(path, "its camera has a focal length or a scale of 0; export it again")
    vertex = ply.need("vertex", "x", "y", "z")
    world = np.stack([vertex.columns[axis].astype(np.float64) for axis in "xyz"], axis=1) * mm_per(unit)
    if width * height > 64 * len(world) + 65536:
        raise InputError(
            path, f"shows {len(world)} vertices in {width} x {height} cells; this is not the camera that measured them"
        )
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        points = rigid.move_points(rigid.inverse(world_from_scan), world)
        u = value["centerx"] + value["focal"] / value["scalex"] * points[:, 0] / points[:, 2]
        v = value["centery"] - value["focal"] / value["scaley"] * points[:, 1] / points[:, 2]
        uv = np.stack([u, v], axis=1)
        column, up = np.rint(uv - _phase(uv)).T
        row = height - 1 - up
        inside = (points[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    if not inside.any():
        raise InputError(path, "its camera sees none of its vertices; check the camera's pose and unit", seen=0)
    cell = row[inside].astype(np.int64) * width + column[inside].astype(np.int64)
    shared = 1 - len(np.unique(cell)) / len(world)
    if shared > _MAX_SHARED:
        raise InputError(
            path,
            f"{100 * shared:.1f} % of its vertices share a cell with another or lie outside the picture (at most {100 * _MAX_SHARED:g} %): "
            "the viewport is not the grid that was triangulated",
            shared=shared,
        )
    order = np.argsort(-points[inside][:, 2], kind="stable")  # of two in one cell the nearer stays
    grid = np.full((height * width, 3), np.nan)
    grid[cell[order]] = points[inside][order]
    scan = scan_from_points(grid.reshape(height, width, 3), world_from_scan=world_from_scan, name=path.stem, unit=unit)
    if scan is None:
        raise InputError(path, "holds no distance in front of its camera; export it again")
    return [scan]


def _phase(uv: FloatArray) -> FloatArray:
    """Where between cells the vertices stand on average (2,), in -0.25..0.75: exporters count from centres or from corners."""
    turn = 2 * np.pi * uv[np.isfinite(uv).all(axis=1)]
    if len(turn) == 0:
        return np.zeros(2)
    share = np.arctan2(np.sin(turn).mean(axis=0), np.cos(turn).mean(axis=0)) / (2 * np.pi)
    return np.mod(share + 0.25, 1.0) - 0.25
