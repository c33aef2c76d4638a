"""Ball pivoting (Bernardini et al. 1999) by open3d: triangles between the samples themselves, open where a ball falls through.

World frame, millimetres. Overlapping scans are thinned first to one sample (the mean) per cell of one spacing, since balls get caught
between sheets that noise holds apart. Two sheets that touch in an edge or a vertex are parted by leaving their faces out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rangecheck.errors import SettingError, SurfaceError
from rangecheck.scan import RangeScan
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.surface.meshing.engines import Engine
from rangecheck.surface.meshing.labels import labelled, thresholds
from rangecheck.surface.meshing.openings import opened
from rangecheck.surface.meshing.oriented import nearest_spacing, oriented_points, spacing_of
from rangecheck.surface.surface import Surface
from rangecheck.surface.topology import non_manifold_edges, non_manifold_vertices

#: radii of the balls, in sample spacings after thinning
RADII = (1.0, 2.0, 4.0)


def pivot(
    scans: Sequence[RangeScan | PointCloud],
    *,
    voxel_mm: float | None = None,
    measured_mm: float | None = None,
    interpolated_mm: float | None = None,
    closing: str = "open",
    largest_hole_mm: float | None = None,
) -> Surface:
    """An open surface whose vertices are (thinned) samples.

    voxel_mm  cell within which samples are averaged (default one sample spacing)
    The other arguments are those of `fuse`; a ball never spans more than it is wide, so little is ever invented.

    Raises ScanError for too few samples, SurfaceError when no ball rests on three, DependencyMissing without open3d."""
    if not (voxel_mm is None or (np.isfinite(voxel_mm) and voxel_mm > 0)):
        raise SettingError(f"voxel_mm is {voxel_mm}; it must be a positive number of millimetres", key="voxel_mm")
    with Engine("open3d") as open3d:
        points, normals = oriented_points(scans, open3d)
        spacing = spacing_of(scans)
        cell, shift = voxel_mm or spacing, points.mean(axis=0)
        few = open3d.ask("thinned", points=points - shift, normals=normals, cell=cell)
        radii = np.array(RADII) * max(nearest_spacing(few["points"]), cell)
        made = open3d.ask("pivoted", **few, radii=radii)
    measured, interpolated = thresholds(spacing, measured_mm, interpolated_mm)
    vertices, faces = made["vertices"] + shift, made["faces"]
    if len(faces) == 0:
        raise SurfaceError(f"no ball of {max(radii):.3g} mm rests on three samples; raise voxel_mm, or use poisson")
    surface = Surface(vertices, faces).with_faces(np.arange(len(faces)))
    while True:
        touching = np.isin(surface.faces, non_manifold_vertices(surface)).any(axis=1)
        edges = non_manifold_edges(surface)
        if len(edges):
            touching |= np.isin(surface.faces, np.unique(edges)).any(axis=1)
        if not touching.any():
            break
        surface = surface.with_faces(np.flatnonzero(~touching))
    return opened(labelled(surface, scans, cell, measured, interpolated), closing, largest_hole_mm)
