"""The bust as the report shows it: fewer faces within a measured distance, and on its vertices what is known of the real one.

World frame of the finished part, millimetres. Nothing here enters the STL.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import NotSolid
from rangecheck.scan import RangeScan
from rangecheck.solid import Verdict
from rangecheck.solid.engine import simplified
from rangecheck.solid.findings import SEVERITIES
from rangecheck.solid.thickness import Samples, wall_thickness_mm
from rangecheck.surface import INVENTED, MEASURED, Surface
from rangecheck.surface.coarse import clustered
from rangecheck.surface.distance import SurfaceDistance

#: faces that a page can hold
MOST_FACES = 220_000
#: the first tolerance, as a share of the extent
_FIRST = 1 / 3600
#: samples of the scans, and vertices of the real surface, that are compared
_MOST_SAMPLES, _MOST_LOOKED_AT = 150_000, 100_000


@dataclass(frozen=True, eq=False)
class Likeness:
    """surface: what is shown; off_mm: farthest that any of the real one's vertices that were looked at lies from it, off_99_mm: 99 % of them lie nearer;
    faces: of the real one. On its vertices, NaN where there is none: error_mm expected, deviation_mm of the scans' samples from the real
    surface (positive outside), thickness_mm of the wall; flagged: 0, or 1 + the worst severity of a finding there."""

    surface: Surface
    off_mm: float
    off_99_mm: float
    faces: int
    error_mm: FloatArray = field(repr=False)
    deviation_mm: FloatArray = field(repr=False)
    thickness_mm: FloatArray = field(repr=False)
    flagged: IntArray = field(repr=False)


def likeness(
    shown: Surface, meshed: Surface, scans: Sequence[RangeScan], found: Verdict | None, *, same_place: bool = True
) -> Likeness:
    """The likeness of `shown`. `meshed` is what it was made of and carries the expected errors; `found` names faces of `shown`.

    With same_place False, `shown` was scaled or moved since, and nothing measured is carried over."""
    light = lighter(shown)
    real, here = SurfaceDistance(shown), SurfaceDistance(light)
    looked_at = shown.vertices[:: max(1, len(shown.vertices) // _MOST_LOOKED_AT)]
    away = here.distance_mm(looked_at)[0] if len(looked_at) else np.zeros(1)
    nothing = np.full(len(light.vertices), np.nan)
    flagged = np.zeros(len(light.vertices), np.uint8)
    if found is not None:
        rank = np.zeros(len(shown.faces), np.uint8)
        for one in reversed(found.findings):
            rank[one.faces] = np.maximum(rank[one.faces], 1 + SEVERITIES.index(one.severity))
        if rank.any():
            flagged = rank[real.distance_mm(light.vertices)[1]]
    if shown.refined_of_face is not None:
        face = real.distance_mm(light.triangles.mean(axis=1))[1]
        light = replace(light, refined_of_face=shown.refined_of_face[face] & (light.origin_of_face == MEASURED))
    return Likeness(
        surface=light,
        off_mm=float(away.max()),
        off_99_mm=float(np.quantile(away, 0.99)),
        faces=len(shown.faces),
        error_mm=_errors(light, meshed) if same_place else nothing,
        deviation_mm=_deviations(light, real, scans) if same_place else nothing,
        thickness_mm=_thickness(light),
        flagged=flagged,
    )


def lighter(surface: Surface) -> Surface:
    """`surface` with at most MOST_FACES faces; faces of another part or origin are not merged where the engine takes it."""
    if len(surface.faces) <= MOST_FACES:
        return surface
    tolerance = _FIRST * surface.extent_mm
    light = surface
    try:
        while len(light.faces) > MOST_FACES:
            light = simplified(light, tolerance)
            tolerance *= 2
    except NotSolid:
        cell = 2 * tolerance
        while len(light.faces) > MOST_FACES:
            light = clustered(surface, cell)
            cell *= 1.3
    return light


def _errors(light: Surface, meshed: Surface) -> FloatArray:
    """Expected error of the nearest vertex as meshed; none where the surface was invented or cut."""
    from scipy.spatial import cKDTree

    values = np.full(len(light.vertices), np.nan)
    if meshed.vertex_error_mm is None or not len(meshed.faces):
        return values
    longest, trusted = np.zeros(len(meshed.vertices)), np.zeros(len(meshed.vertices), bool)
    trusted[meshed.faces[meshed.origin_of_face != INVENTED]] = True
    for corner in range(3):
        edge = meshed.triangles[:, corner] - meshed.triangles[:, corner - 1]
        np.maximum.at(longest, meshed.faces[:, corner], np.sqrt(np.einsum("ij,ij->i", edge, edge)))
    away, vertex = cKDTree(meshed.vertices).query(light.vertices)
    known = trusted[vertex] & (away <= longest[vertex])
    values[known] = meshed.vertex_error_mm[vertex[known]]
    return values


def _deviations(light: Surface, real: SurfaceDistance, scans: Sequence[RangeScan]) -> FloatArray:
    """Mean signed distance from the real surface of the scans' samples that lie nearest to each vertex."""
    from scipy.spatial import cKDTree

    values = np.full(len(light.vertices), np.nan)
    if not scans:
        return values
    points = np.concatenate([scan.points_mm() for scan in scans])
    points = points[:: max(1, -(-len(points) // _MOST_SAMPLES))]
    distance, _ = real.signed_distance_mm(points)
    _, vertex = cKDTree(light.vertices).query(points)
    # a sample far off belongs to something that the surface does not show
    near = np.abs(distance) <= 0.02 * light.extent_mm
    count = np.bincount(vertex[near], minlength=len(values))
    total = np.bincount(vertex[near], distance[near], minlength=len(values))
    values[count > 0] = total[count > 0] / count[count > 0]
    return values


def _thickness(light: Surface) -> FloatArray:
    """The thinnest wall at the middles of the faces around each vertex."""
    count = len(light.faces)
    samples = Samples(light.triangles.mean(axis=1), np.arange(count, dtype=np.int32), light.face_areas)
    of_face = wall_thickness_mm(light, samples)
    values = np.full(len(light.vertices), np.inf)
    for corner in range(3):
        np.minimum.at(values, light.faces[:, corner], of_face)
    values[~np.isfinite(values)] = np.nan
    return values
