"""Grids of points seen from one place, as range scans: shared by PCD, PTX, E57 and triangulated range maps.

A grid whose points fit a pinhole without distortion to PINHOLE_PX gets that camera. Any other keeps its own ray per cell, through
the point exactly; rays of empty cells take the law of the others and their smoothed remainder.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.errors import CameraError
from rangecheck.optics import Camera, PinholeCamera, RayGrid
from rangecheck.optics.ray_law import fit_law, least_squares
from rangecheck.scan.range_scan import RangeScan

#: axes of the scan frame in a scanner's frame with z up and x ahead, as columns: x right = -y, y down = -z, z forward = x
FILE_FROM_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

#: pixels by which every point may miss its pixel's ray for a pinhole to be taken: lateral errors of a millionth of the distance
PINHOLE_PX = 2e-3


def scan_from_points(
    points_mm: FloatArray,
    *,
    world_from_scan: FloatArray,
    brightness: FloatArray | None = None,
    name: str,
    unit: str,
) -> RangeScan | None:
    """The scan of points (h, w, 3) in the scan frame (x right, y down, z forward; the scanner at the origin), NaN where empty.

    None when no point is left. Rows are turned over when they run upwards, so that the first row is the top one."""
    with np.errstate(over="ignore", invalid="ignore"):
        ranges = np.sqrt((points_mm * points_mm).sum(axis=-1))
    valid = (ranges > 1e-30) & (ranges < 1e30)
    if not valid.any():
        return None
    if _mirrored(points_mm, valid):
        points_mm, ranges, valid = points_mm[::-1], ranges[::-1], valid[::-1]
        brightness = None if brightness is None else brightness[::-1]
    camera = fit_pinhole(points_mm, valid) or _own_rays(points_mm, ranges, valid)
    return RangeScan(np.where(valid, ranges, np.nan), camera, world_from_scan, brightness, name, unit)


def level_frame(points_mm: FloatArray) -> FloatArray:
    """file_from_scan (4, 4) for a scanner whose file frame has z up: scan axes x right, y down, z forward, turned about the vertical
    so that forward is the middle of what was seen (the file's x where that is all around)."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        away = np.hypot(points_mm[:, 0], points_mm[:, 1])
        heading = np.nansum(points_mm[:, :2] / away[:, None], axis=0)
    file_from_scan: FloatArray = np.eye(4)
    if np.hypot(*heading) > 0.05 * len(points_mm):
        file_from_scan = rigid.about_axis((0, 0, 1), math.atan2(heading[1], heading[0]))
    file_from_scan[:3, :3] = file_from_scan[:3, :3] @ FILE_FROM_LEVEL
    return file_from_scan


def fit_pinhole(points_mm: FloatArray, valid: BoolArray) -> Camera | None:
    """The pinhole that sees every point in the middle of its cell to PINHOLE_PX, or None."""
    rows, columns = np.nonzero(valid)
    height, width = valid.shape
    x, y, z = points_mm[valid].T
    if len(z) < 6 or not (z > 0).all() or np.ptp(columns) == 0 or np.ptp(rows) == 0:
        return None
    ones = np.ones(len(z))
    with np.errstate(over="ignore", invalid="ignore"):
        across, down = x / z, y / z
    if not (np.isfinite(across).all() and np.isfinite(down).all()):
        return None
    fx, cx = least_squares(np.column_stack([across, ones]), columns.astype(float))
    fy, cy = least_squares(np.column_stack([down, ones]), rows.astype(float))
    missed = max(np.abs(fx * across + cx - columns).max(), np.abs(fy * down + cy - rows).max())
    if not (fx > 0 and fy > 0 and missed <= PINHOLE_PX):
        return None
    return PinholeCamera(width, height, float(fx), float(fy), float(cx), float(cy))


def _mirrored(points_mm: FloatArray, valid: BoolArray) -> bool:
    """Whether columns to the right and rows downwards turn the wrong way around the direction of view."""
    if min(valid.shape) < 2:
        return False
    both = valid[1:, 1:] & valid[1:, :-1] & valid[:-1, 1:]
    middle = points_mm[1:, 1:][both]
    with np.errstate(over="ignore", invalid="ignore"):
        away = np.sqrt((middle * middle).sum(axis=1, keepdims=True))
        along_u = (middle - points_mm[1:, :-1][both]) / away
        along_v = (middle - points_mm[:-1, 1:][both]) / away
        turn = np.sign((np.cross(along_u, along_v) * middle).sum(axis=1))
    return float(np.nansum(turn)) < 0


def _own_rays(points_mm: FloatArray, ranges: FloatArray, valid: BoolArray) -> RayGrid:
    height, width = valid.shape
    directions = np.full((height, width, 3), np.nan)
    directions[valid] = points_mm[valid] / ranges[valid][:, None]
    origins = np.zeros((height, width, 3))
    try:
        law = fit_law(np.where(valid[..., None], origins, np.nan), directions)
    except CameraError:  # too few cells to know how the others look
        return RayGrid(width, height, origins, directions)
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    law_term = law.a if law.angular else law.s
    rest = law.left_over[..., :2] if law.angular else law.left_over[..., 2:4]
    first, second = (law_term[k, 0] + law_term[k, 1] * u + law_term[k, 2] * v + rest[..., k] for k in (0, 1))
    if law.angular:
        others = np.stack([np.cos(second) * np.sin(first), np.sin(second), np.cos(second) * np.cos(first)], axis=-1)
    else:
        others = np.stack([first, second, np.ones_like(first)], axis=-1)
        others /= np.linalg.norm(others, axis=-1, keepdims=True)
    return RayGrid(width, height, origins, np.where(valid[..., None], directions, others))
