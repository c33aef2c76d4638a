"""Points with outward normals, for the methods that take points rather than grids. World frame, millimetres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray
from rangecheck.errors import ScanError
from rangecheck.scan import RangeScan
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.surface.meshing.engines import Asked

#: neighbours through which a normal's plane is laid
NEIGHBOURS = 24
#: a plane needs its two larger variances apart from zero; below this share of the largest the neighbours lie on a line
FLATTEST = 1e-4


def oriented_points(scans: Sequence[RangeScan | PointCloud], open3d: Asked) -> tuple[FloatArray, FloatArray]:
    """All samples (n, 3) mm and unit normals (n, 3), turned towards the scanner that saw each; open3d finds the neighbours.

    Normals are those of the plane through the NEIGHBOURS nearest samples of all scans. A cloud's own normals are kept; without any
    they are made consistent from point to point, outward at the outermost. Samples whose neighbours lie on a line have no normal
    and are left out (the engine would give them (0, 0, 1), silently). Raises ScanError when under 16 remain."""
    if not scans:
        raise ScanError("there are no scans; a surface needs at least one")
    points = np.concatenate([s.points_mm if isinstance(s, PointCloud) else s.points_mm() for s in scans])
    if len(points) < 16:
        raise ScanError(
            f"{_named(scans)} {len(points)} samples; at least 16 are needed: scan it again, or mesh more scans together",
            valid=len(points),
        )
    shift = points.mean(axis=0)
    near = open3d.ask("covariances", points=points - shift, neighbours=min(NEIGHBOURS, len(points) - 1))
    values, vectors = np.linalg.eigh(near["covariances"])
    normals = np.ascontiguousarray(vectors[:, :, 0])
    spread = values[:, 1] > FLATTEST * np.maximum(values[:, 2], np.finfo(float).tiny)
    start = 0
    for scan in scans:
        count = len(scan.points_mm) if isinstance(scan, PointCloud) else int(scan.valid.sum())
        part = slice(start, start + count)
        if isinstance(scan, RangeScan):
            _, directions = scan.camera.pixel_rays()
            rays = rigid.move_directions(scan.world_from_scan, directions[scan.valid])
            normals[part] *= np.where((normals[part] * rays).sum(axis=1) > 0, -1.0, 1.0)[:, None]
        elif scan.normals is not None:
            normals[part], spread[part] = scan.normals, True
        else:
            flat = np.flatnonzero(spread[part]) + start
            normals[flat] = _consistent(open3d, points[flat], normals[flat])
        start += count
    if spread.sum() < 16:
        raise ScanError(
            f"{_named(scans)} {int(spread.sum())} samples whose neighbours span a plane; at least 16 are needed: look for lines or copies of points"
        )
    return points[spread], normals[spread]


def _named(scans: Sequence[RangeScan | PointCloud]) -> str:
    """What holds the samples, for a message that goes on with how many."""
    names = [scan.name or "unnamed" for scan in scans]
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"{', '.join(names[:3])}{more}:"


def _consistent(open3d: Asked, points: FloatArray, normals: FloatArray) -> FloatArray:
    if len(points) < 16:
        return normals
    # the engine's Delaunay step refuses points in one plane or on one sphere: moved by a millionth of the extent they are not
    jitter = np.random.default_rng(0).uniform(-1e-6, 1e-6, points.shape) * float(np.ptp(points, axis=0).max())
    neighbours = min(NEIGHBOURS, len(points) - 1)
    turned = np.asarray(open3d.ask("turned", points=points + jitter, normals=normals, neighbours=neighbours)["normals"])
    outermost = int(np.argmax(((points - points.mean(axis=0)) ** 2).sum(axis=1)))
    outward = points[outermost] - points.mean(axis=0)
    return turned if turned[outermost] @ outward >= 0 else -turned


def spacing_of(scans: Sequence[RangeScan | PointCloud]) -> float:
    """Median distance (mm) between neighbouring samples along the surface: neighbours in the grid, or nearest ones in a cloud."""
    steps = []
    for scan in scans:
        if isinstance(scan, PointCloud):
            steps.append(np.array([nearest_spacing(scan.points_mm)]))
            continue
        points = scan.grid_points_mm
        for axis in (0, 1):
            apart = np.linalg.norm(np.diff(points, axis=axis), axis=-1)
            steps.append(apart[np.isfinite(apart)])
    together = np.concatenate(steps) if steps else np.empty(0)
    if len(together) == 0:
        return nearest_spacing(np.concatenate([s.points_mm if isinstance(s, PointCloud) else s.points_mm() for s in scans]))
    return float(np.median(together))


def nearest_spacing(points_mm: FloatArray) -> float:
    """Median distance (mm) of a sample to its nearest neighbour, of up to 20 000 samples evenly taken."""
    from scipy.spatial import cKDTree

    some = points_mm[:: max(1, len(points_mm) // 20000)]
    distance, _ = cKDTree(points_mm).query(some, k=2)
    positive = distance[:, 1][distance[:, 1] > 0]
    if len(positive) == 0:
        raise ScanError("all samples lie in one point; check the unit and the depth scale")
    return float(np.median(positive))
