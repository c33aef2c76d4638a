"""Volumetric fusion: several posed scans become one closed surface (Curless & Levoy 1996).

World frame, millimetres. Steps: local fits in each scan's own grid; their signed distances averaged at the corners of a sparse
grid; space that a ray was seen to cross is outside; what nobody saw is closed by a membrane; the zero set as a dual mesh, closed
and manifold by construction; its vertices settled onto the average of the scans' local surfaces, which beats the grid's step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import SettingError, SurfaceError
from rangecheck.kernels import in_chunks, kernel
from rangecheck.scan import RangeScan
from rangecheck.surface.meshing.blocks import Grid, add_blocks, box_for, grid_near, missing_blocks, part_touching
from rangecheck.surface.meshing.closing import coarse_field, fill_open, smooth_open
from rangecheck.surface.meshing.distance import fill_blocks, settle
from rangecheck.surface.meshing.extract import MARGIN, split_quads, zero_set
from rangecheck.surface.meshing.labels import UNSEEN_ERROR, thresholds
from rangecheck.surface.meshing.openings import opened
from rangecheck.surface.meshing.samples import distance_to_samples, label_faces, sample_grid
from rangecheck.surface.meshing.shells import areas, shell_of_vertex, shells_to_keep
from rangecheck.surface.meshing.tiles import Tiles, tiles_of
from rangecheck.surface.meshing.views import Views, views_of
from rangecheck.surface.surface import MEASURED, Surface

#: step of the grid in median sample spacings
VOXEL_IN_SPACINGS = 1.0
#: how far before and behind a surface its distance is used, in steps of the grid
BEFORE_STEPS, BEHIND_STEPS = 2.5, 2.5
#: shells with less than this share of the largest shell's measured area are floating bits
LEAST_SHELL = 0.02
#: rings of neighbours over which the scatter of the views is pooled
SCATTER_RINGS = 4
OPEN_SWEEPS = 8


def fuse(
    scans: Sequence[RangeScan],
    *,
    voxel_mm: float | None = None,
    voxel_in_spacings: float = VOXEL_IN_SPACINGS,
    measured_mm: float | None = None,
    interpolated_mm: float | None = None,
    closing: str = "closed",
    largest_hole_mm: float | None = None,
    least_shell: float = LEAST_SHELL,
) -> Surface:
    """One outward-oriented 2-manifold from posed scans, closed unless `closing` says otherwise.

    voxel_mm         step of the grid; by default `voxel_in_spacings` times the median distance between neighbouring samples
    measured_mm      a face with a sample this near to its centroid is measured (default 2 sample spacings)
    interpolated_mm  one with a sample this near is interpolated (default 6 spacings); the rest is invented
    closing          closed; half: invented patches wider than `largest_hole_mm` are left open; open: all are
    least_shell      shells with less than this share of the largest shell's measured area are dropped

    Raises ScanError for scans without a surface or cameras that cannot be projected into, SettingError for a bad setting."""
    if voxel_mm is not None and not (np.isfinite(voxel_mm) and voxel_mm > 0):
        raise SettingError(f"voxel_mm is {voxel_mm}; it must be a positive number of millimetres", key="voxel_mm")
    if not (np.isfinite(voxel_in_spacings) and voxel_in_spacings > 0):
        raise SettingError(f"voxel_in_spacings is {voxel_in_spacings}; it must be a positive number", key="voxel_in_spacings")
    views = views_of(scans)
    step = voxel_mm or voxel_in_spacings * views.spacing_mm
    measured, interpolated = thresholds(views.spacing_mm, measured_mm, interpolated_mm)
    grid, coarse = _grid_of_distances(views, step)
    points, normals, low, seen, quads = zero_set(grid, coarse)
    del grid, coarse
    if len(quads) == 0:
        raise SurfaceError("the scans' distances have no zero set; check their poses and unit, or choose a smaller voxel_mm")
    error = _settle(views, points, normals, low, seen, quads, step)
    samples, shift = views.samples_mm, views.shift_mm
    del views, normals, low, seen
    faces = split_quads(points, quads)
    del quads
    nearby = sample_grid(samples, measured)
    origin = label_faces(nearby, points, faces, measured, interpolated)
    points, faces, origin, error = _without_floating_bits(points, faces, origin, error, least_shell)
    unseen = ~np.isfinite(error)
    reach = float(np.linalg.norm(np.ptp(points, axis=0)))
    error[unseen] = UNSEEN_ERROR * distance_to_samples(nearby, points[unseen], reach)
    del nearby, samples
    points += shift
    surface = Surface(points, faces, origin_of_face=origin, vertex_error_mm=error)
    return opened(surface, closing, largest_hole_mm)


def _grid_of_distances(views: Views, step: float) -> tuple[Grid, FloatArray]:
    """The sparse grid, filled, closed and free of touching sheets, and the coarse field around it."""
    origin, shape = box_for(views.samples_mm, step)
    tiles = tiles_of(views)
    coarse, _ = coarse_field(views, tiles, origin, shape, step)
    grid = grid_near(views.samples_mm, origin, shape, step, BEFORE_STEPS * step, _crossed(coarse))
    _fill(views, tiles, grid, coarse, 0)
    smooth_open(grid, OPEN_SWEEPS)
    while True:
        more = missing_blocks(grid, coarse)
        if len(more):
            before = len(grid.place)
            add_blocks(grid, more)
            _fill(views, tiles, grid, coarse, before)
        elif part_touching(grid, coarse) == 0:
            return grid, coarse


def _fill(views: Views, tiles: Tiles, grid: Grid, coarse: FloatArray, first: int) -> None:
    rows = slice(first, len(grid.place))
    before, behind = BEFORE_STEPS * grid.step_mm, BEHIND_STEPS * grid.step_mm
    grid.field[rows], grid.state[rows] = fill_blocks(views, tiles, grid.corner_origins(rows), grid.step_mm, before, behind)
    fill_open(grid, coarse, rows)


def _crossed(coarse: FloatArray) -> BoolArray:
    """(bx, by, bz) True: blocks whose 27 coarse nodes differ in sign."""
    inside = coarse < 0
    some, every = inside, inside
    for axis in range(3):
        parts = [np.take(some, range(k, some.shape[axis] - 2 + k, 2), axis=axis) for k in range(3)]
        some = parts[0] | parts[1] | parts[2]
        parts = [np.take(every, range(k, every.shape[axis] - 2 + k, 2), axis=axis) for k in range(3)]
        every = parts[0] & parts[1] & parts[2]
    return some & ~every


def _settle(
    views: Views, points: FloatArray, normals: FloatArray, low: FloatArray, seen: BoolArray, quads: IntArray, step: float
) -> FloatArray:
    """Settle the vertices that come from measured distances; returns (n,) standard error in mm, inf for the others.

    Poses that are off, and detail that views resolve differently, show as scatter of the views beyond their noise. Two or three views
    tell it badly at one vertex: it is the mean over the vertices around."""
    error, scatter, others = np.full(len(points), np.inf), np.zeros(len(points)), np.zeros(len(points))
    chosen = np.flatnonzero(seen)
    moved, directions = points[chosen], normals[chosen]
    box_low, box_high = low[chosen] + MARGIN * step, low[chosen] + (1 - MARGIN) * step
    variance, beyond, looks = settle(views, moved, directions, 1.5 * step, box_low, box_high)
    points[chosen], normals[chosen] = moved, directions
    others[chosen] = np.maximum(looks - 1, 0)
    scatter[chosen] = beyond * others[chosen]
    both = np.stack([scatter, others], axis=1)
    _pool_over_neighbours(quads, both, SCATTER_RINGS)
    pooled = np.maximum(both[chosen, 0], 0.0) / np.maximum(both[chosen, 1], 1e-12)
    error[chosen] = np.sqrt(variance + np.where(looks > 1, pooled, 0.0))
    return error


@kernel
def _pool_over_neighbours(quads, values, rings):
    """`rings` times: each vertex's values (n, 2) plus those at the other ends of its edges, every edge as often as it has faces, over one
    plus their number."""
    count = np.ones(len(values), np.int32)
    for q in range(len(quads)):
        for corner in range(4):
            count[quads[q, corner]] += 2
    before = np.empty_like(values)
    for _ in range(rings):
        before[:] = values
        for q in range(len(quads)):
            for corner in range(4):
                a, b = quads[q, corner], quads[q, (corner + 1) % 4]
                for k in range(2):
                    values[a, k] += before[b, k]
                    values[b, k] += before[a, k]
        for v in range(len(values)):
            for k in range(2):
                values[v, k] /= count[v]


def _without_floating_bits(
    points: FloatArray, faces: IntArray, origin: IntArray, error: FloatArray, least_share: float
) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
    shell = shell_of_vertex(faces, len(points))
    if len(shell) == 0 or shell.max() == 0:
        return points, faces, origin, error
    area = np.empty(len(faces))
    in_chunks(lambda i, j: areas(points, faces, i, j, area), len(faces), 65536)
    wanted = np.zeros(int(shell.max()) + 1, bool)
    wanted[shells_to_keep(shell[faces[:, 0]], area, origin == MEASURED, least_share)] = True
    keep = wanted[shell]
    if keep.all():
        return points, faces, origin, error
    number = np.cumsum(keep, dtype=np.int32) - np.int32(1)
    kept = np.flatnonzero(keep[faces[:, 0]])
    fewer = np.empty((len(kept), 3), np.int32)
    in_chunks(lambda i, j: _renumbered(faces, kept, number, i, j, fewer), len(kept), 65536)
    return points[keep], fewer, origin[kept], error[keep]


@kernel
def _renumbered(faces, kept, number, first, last, out):
    for f in range(first, last):
        for corner in range(3):
            out[f, corner] = number[faces[kept[f], corner]]
