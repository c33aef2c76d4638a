"""Slopes of a scan on its own surface, where truth tells which neighbours lie on one.

A slope is the limit of a difference quotient as its two ends come together on one surface. Between two cells that an occluding edge parts, the
quotient has no limit: the closer the rays, the steeper it is, and no shape of either surface has it. Whether an edge lies between two neighbours is found by
that definition: the arc between their rays is halved towards the larger change of the true range, which dies away on one surface and stays at an edge.
Slopes are differences to the neighbours on the cell's own surface, of both sides or of one. Scan frame, millimetres.
"""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, unit_vectors
from rangecheck.raycast import Hits
from rangecheck.scan import RangeScan
from rangecheck.scan.simulate import Caster, SimulatedScan

#: halvings, after which an arc is 1/500 of a cell;  share of the change that may be left on one surface
_HALVINGS, _LEFT = 9, 0.1


def one_surface(made: SimulatedScan, caster: Caster) -> tuple[BoolArray, BoolArray]:
    """(h, w-1) and (h-1, w): whether the true surface goes on between neighbours along the row and along the column."""
    scan = made.scan
    origins, rays = scan.camera.pixel_rays()
    pose = scan.world_from_scan
    found = []
    for axis in (1, 0):
        ahead, behind = (
            tuple(part if k == axis else slice(None) for k in range(2)) for part in (slice(1, None), slice(None, -1))
        )
        first, last = made.true_range_mm[behind], made.true_range_mm[ahead]
        joined = np.isfinite(first) & np.isfinite(last)
        # a change of less than the cells are apart hides no edge worth the name
        apart = np.linalg.norm(rays[ahead] - rays[behind], axis=-1) * first
        asked = np.nonzero(joined & (np.abs(last - first) > apart))
        a, b = rays[behind][asked], rays[ahead][asked]
        at_a, at_b = first[asked], last[asked]
        whole = np.abs(at_b - at_a)
        begin = np.broadcast_to(pose[:3, :3] @ origins[0, 0] + pose[:3, 3], a.shape)
        for _ in range(_HALVINGS):
            middle = unit_vectors(a + b)
            hit: Hits = caster.closest(np.ascontiguousarray(begin), middle @ pose[:3, :3].T)
            # a ray between two hits that meets nothing passes an edge
            at = hit.distance_mm
            with np.errstate(invalid="ignore"):
                upper = np.abs(at_b - at) > np.abs(at - at_a)
            a, at_a = np.where(upper[:, None], middle, a), np.where(upper, at, at_a)
            b, at_b = np.where(upper[:, None], b, middle), np.where(upper, at_b, at)
        with np.errstate(invalid="ignore"):
            joined[asked] = np.abs(at_b - at_a) < _LEFT * whole
        found.append(joined)
    return found[0], found[1]


def surface_slope_errors_deg(scan: RangeScan, made: SimulatedScan, joined: tuple[BoolArray, BoolArray]) -> FloatArray:
    """(h, w) angle between the normals by differences to neighbours on the same surface and the true ones; NaN where the cell has none along one axis."""
    points = scan.grid_points_mm
    along = []
    for axis, links in ((1, joined[0]), (0, joined[1])):
        ahead, behind = (
            tuple(part if k == axis else slice(None) for k in range(2)) for part in (slice(1, None), slice(None, -1))
        )
        known = np.isfinite(scan.range_mm)
        held = links & known[ahead] & known[behind]
        step = np.where(held[..., None], points[ahead] - points[behind], 0.0)
        total, count = np.zeros(points.shape), np.zeros(scan.range_mm.shape)
        for side in (ahead, behind):
            total[side] += step
            count[side] += held
        along.append(np.where(count[..., None] > 0, total / np.maximum(count, 1)[..., None], np.nan))
    normals = unit_vectors(np.cross(along[1], along[0]))
    truth = made.true_normal @ scan.world_from_scan[:3, :3]
    return np.asarray(np.degrees(np.arccos(np.clip((normals * truth).sum(-1), -1.0, 1.0))))
