"""Origin labels and expected errors for methods that give nothing but triangles. Millimetres.

The expected error of a vertex is the samples' noise along the normal, divided by the root of the number of samples the method
averaged there (those within half a cell of the vertex, at least one); where the nearest sample is farther than `interpolated_mm`, it
is UNSEEN_ERROR of that distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import SettingError
from rangecheck.scan import RangeScan
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.surface.meshing.grid import estimated_noise_mm
from rangecheck.surface.meshing.samples import distance_to_samples, label_faces, sample_grid
from rangecheck.surface.surface import Surface

#: default thresholds of the labels, in sample spacings
MEASURED_IN_SPACINGS, INTERPOLATED_IN_SPACINGS = 2.0, 6.0
#: expected error where nothing was measured, in distances to the nearest sample: the object passes through that sample, so the vertex is
#: at most so far off, and any error up to there is as likely
UNSEEN_ERROR = 1.0 / math.sqrt(3.0)


def thresholds(spacing_mm: float, measured_mm: float | None, interpolated_mm: float | None) -> tuple[float, float]:
    """(measured, interpolated) in mm: as asked for, else by the samples' spacing. Raises SettingError unless 0 < first <= second."""
    measured = MEASURED_IN_SPACINGS * spacing_mm if measured_mm is None else float(measured_mm)
    interpolated = max(INTERPOLATED_IN_SPACINGS * spacing_mm, measured) if interpolated_mm is None else float(interpolated_mm)
    if not (0 < measured <= interpolated < np.inf):
        raise SettingError(
            f"measured_mm is {measured:g} and interpolated_mm {interpolated:g}; both must be positive, in this order",
            key="measured_mm",
        )
    return measured, interpolated


def labelled(
    surface: Surface,
    scans: Sequence[RangeScan | PointCloud],
    cell_mm: float,
    measured_mm: float,
    interpolated_mm: float,
) -> Surface:
    """The surface with origins by distance to the nearest sample and, if every scan's noise is known, expected errors."""
    shift = surface.vertices.mean(axis=0)
    vertices = surface.vertices - shift
    points = np.concatenate([s.points_mm if isinstance(s, PointCloud) else s.points_mm() for s in scans]) - shift
    nearby = sample_grid(points, measured_mm)
    origin = label_faces(nearby, vertices, surface.faces, measured_mm, interpolated_mm)
    noises = [None if isinstance(s, PointCloud) else s.noise_mm or estimated_noise_mm(s) for s in scans]
    known = [noise for noise in noises if noise is not None]
    error: FloatArray | None = None
    if len(known) == len(noises):
        from scipy.spatial import cKDTree

        looks = cKDTree(points).query_ball_point(vertices, 0.5 * cell_mm, return_length=True)
        error = float(np.median(known)) / np.sqrt(np.maximum(looks, 1))
        distance = distance_to_samples(nearby, vertices, interpolated_mm, measured_mm)
        far = ~np.isfinite(distance)
        reach = float(np.linalg.norm(np.ptp(np.concatenate([vertices, points]), axis=0)))
        wide = sample_grid(points, 0.5 * interpolated_mm)
        error[far] = np.maximum(error[far], UNSEEN_ERROR * distance_to_samples(wide, vertices[far], reach))
    return replace(surface, origin_of_face=origin, vertex_error_mm=error)
