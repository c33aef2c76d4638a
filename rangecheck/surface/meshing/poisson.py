"""Screened Poisson reconstruction (Kazhdan & Hoppe 2013) by open3d or MeshLab, trimmed and labelled by distance.

World frame, millimetres. The engine invents surface wherever its field crosses zero; the density quantiles by which it is usually
trimmed say nothing in mm. Here a face counts by the distance from its centroid to the nearest sample, as in every other method.

Traps of the engines: with several threads open3d's bytes differ from run to run, so it gets one; both leave the surface open where it
leaves their box; open3d returns vertices that no face uses; both work in the box of their input, so samples are centred first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import SettingError, SurfaceError
from rangecheck.scan import RangeScan
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.surface.meshing.engines import Engine
from rangecheck.surface.meshing.labels import labelled, thresholds
from rangecheck.surface.meshing.openings import opened
from rangecheck.surface.meshing.oriented import oriented_points, spacing_of
from rangecheck.surface.surface import Surface

#: side of the engine's box in extents of the samples, and the range of octree depths that is used
BOX_SCALE, DEPTHS = 1.1, (5, 11)


def depth_for(points_mm: FloatArray, voxel_mm: float) -> int:
    """Octree depth whose finest cell is at most `voxel_mm` wide."""
    side = BOX_SCALE * float(np.ptp(points_mm, axis=0).max())
    return min(max(math.ceil(math.log2(max(side / voxel_mm, 1.0))), DEPTHS[0]), DEPTHS[1])


def poisson(
    scans: Sequence[RangeScan | PointCloud],
    *,
    voxel_mm: float | None = None,
    depth: int | None = None,
    measured_mm: float | None = None,
    interpolated_mm: float | None = None,
    closing: str = "closed",
    largest_hole_mm: float | None = None,
    engine: str = "open3d",
) -> Surface:
    """A surface through the samples, closed unless it leaves the engine's box.

    voxel_mm  width of the finest octree cell (default 1.5 sample spacings); depth overrides it
    engine    open3d or pymeshlab
    The other arguments are those of `fuse`.

    Raises ScanError for too few samples, SettingError for bad settings, DependencyMissing without the engine."""
    if engine not in ("open3d", "pymeshlab"):
        raise SettingError(f"engine is {engine!r}; it must be open3d or pymeshlab", key="engine")
    with Engine("open3d") as open3d:
        points, normals = oriented_points(scans, open3d)
    spacing = spacing_of(scans)
    step = voxel_mm or 1.5 * spacing
    if not (math.isfinite(step) and step > 0):
        raise SettingError(f"voxel_mm is {voxel_mm}; it must be a positive number of millimetres", key="voxel_mm")
    level = depth_for(points, step) if depth is None else int(depth)
    if not 1 <= level <= 14:
        raise SettingError(f"depth is {depth}; it must be 1 to 14", key="depth")
    measured, interpolated = thresholds(spacing, measured_mm, interpolated_mm)
    shift = points.mean(axis=0)
    with Engine(engine) as solver:
        task = "poisson_open3d" if engine == "open3d" else "poisson_meshlab"
        made = solver.ask(task, points=points - shift, normals=normals, depth=level, scale=BOX_SCALE)
    vertices, faces = made["vertices"], made["faces"]
    if len(faces) == 0:
        raise SurfaceError("Poisson reconstruction found no surface; check the scans' poses, or use fuse")
    surface = Surface(vertices + shift, faces).with_faces(np.arange(len(faces)))
    cell = BOX_SCALE * float(np.ptp(points, axis=0).max()) / 2**level
    return opened(labelled(surface, scans, cell, measured, interpolated), closing, largest_hole_mm)
