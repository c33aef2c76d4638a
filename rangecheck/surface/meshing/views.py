"""The scans as numbers that compiled kernels understand: projection, local fits, normals and weights, one record per cell.

Frame: the world frame shifted so that the middle of the samples is the origin; `Views.shift_mm` undoes it. Millimetres.
A cell's record holds the range of its local fit, half its slopes, its weight (1 / variance along the normal, feathered to
zero at the edge of what the scan saw, Curless & Levoy 1996), its normal in the world frame, and |ray . normal|.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import ScanError
from rangecheck.kernels import in_chunks, kernel
from rangecheck.optics import Camera
from rangecheck.scan import RangeScan
from rangecheck.surface.meshing.local_fit import BEND_TAN, quiet_ranges
from rangecheck.surface.meshing.projection import project, projection_of
from rangecheck.surface.meshing.shared_detail import CLUES, detail_lost

#: numbers per cell: range, half u slope, half v slope, weight, normal x y z, |ray . normal|, variance along the normal by noise, and
#: mean square of what the fit smooths away
RANGE, HALF_U, HALF_V, WEIGHT, NORMAL, COSINE, VARIANCE, SMOOTHED, FIELDS = 0, 1, 2, 3, 4, 7, 8, 9, 10
#: cells over which the weight rises from the edge of what a scan saw
FEATHER_CELLS = 2.5
#: half width of the gaps between samples of other scans, projected into a scan, that count as covered
GAP_CELLS = 2
#: standard error, in cells, of where a ray points
ASIDE_CELLS = 0.05
#: cells seen at a flatter angle than this carry no weight
FLATTEST_COSINE = 0.1


@dataclass(frozen=True)
class Views:
    """All scans, concatenated.

    kind (s,) int64; numbers (s, 37) pose and camera; size (s, 2) int64 height, width; start (s,) int64 first cell of each scan;
    cells (n, 10) float32 records: range is NaN where nothing is known and +inf where the ray met nothing;
    noise_mm (n,) float32 standard deviation of one range; samples_mm (k, 3) valid samples, shifted world frame;
    spacing_mm median distance between neighbouring samples along the surface; shift_mm (3,)."""

    kind: IntArray
    numbers: FloatArray
    size: IntArray
    start: IntArray
    cells: FloatArray
    noise_mm: FloatArray
    samples_mm: FloatArray
    spacing_mm: float
    shift_mm: FloatArray

    @cached_property
    def typical_weight(self) -> float:
        """Median weight of the cells that have one."""
        weight = self.cells[:, WEIGHT]
        return float(np.median(weight[weight > 0]))

    @property
    def arrays(self) -> tuple[IntArray, FloatArray, IntArray, IntArray, FloatArray]:
        """What the kernels take first: kind, numbers, size, start, cells."""
        return self.kind, self.numbers, self.size, self.start, self.cells


@kernel
def _records(fit, origins, directions, rotation, edge, pitch, first, last, cells, clues, residual):
    """Fill the records, clues and residuals of rows first..last from the local fits."""
    height, width = fit.shape[0], fit.shape[1]
    for row in range(first, last):
        r0, r1 = max(row - 1, 0), min(row + 1, height - 1)
        for col in range(width):
            i = row * width + col
            cells[i, :] = 0.0
            cells[i, 0] = residual[i] = np.nan
            clues[i, :] = 0.0
            r = float(fit[row, col, 0])
            if not math.isfinite(r):
                continue
            c0, c1 = max(col - 1, 0), min(col + 1, width - 1)
            du, dv = 1.0 / (c1 - c0), 1.0 / (r1 - r0)
            d = directions[row, col]
            pu0 = (origins[row, c1, 0] - origins[row, c0, 0] + r * (directions[row, c1, 0] - directions[row, c0, 0])) * du
            pu1 = (origins[row, c1, 1] - origins[row, c0, 1] + r * (directions[row, c1, 1] - directions[row, c0, 1])) * du
            pu2 = (origins[row, c1, 2] - origins[row, c0, 2] + r * (directions[row, c1, 2] - directions[row, c0, 2])) * du
            pv0 = (origins[r1, col, 0] - origins[r0, col, 0] + r * (directions[r1, col, 0] - directions[r0, col, 0])) * dv
            pv1 = (origins[r1, col, 1] - origins[r0, col, 1] + r * (directions[r1, col, 1] - directions[r0, col, 1])) * dv
            pv2 = (origins[r1, col, 2] - origins[r0, col, 2] + r * (directions[r1, col, 2] - directions[r0, col, 2])) * dv
            su, sv = float(fit[row, col, 1]), float(fit[row, col, 2])
            pu0, pu1, pu2 = pu0 + su * d[0], pu1 + su * d[1], pu2 + su * d[2]
            pv0, pv1, pv2 = pv0 + sv * d[0], pv1 + sv * d[1], pv2 + sv * d[2]
            nx, ny, nz = pu1 * pv2 - pu2 * pv1, pu2 * pv0 - pu0 * pv2, pu0 * pv1 - pu1 * pv0
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            if not length > 0.0:
                continue
            along = (nx * d[0] + ny * d[1] + nz * d[2]) / length
            flip = -1.0 if along > 0.0 else 1.0
            nx, ny, nz = flip * nx / length, flip * ny / length, flip * nz / length
            cosine = abs(along)
            aside = ASIDE_CELLS * (pitch[0] * r + pitch[1])
            if cosine < FLATTEST_COSINE:
                continue
            error = math.hypot(float(fit[row, col, 3]) * cosine, aside * math.sqrt(max(1.0 - cosine * cosine, 0.0)))
            feather = min(1.0, edge[row, col] / FEATHER_CELLS)
            cells[i, 0], cells[i, 1], cells[i, 2] = r, 0.5 * su, 0.5 * sv
            cells[i, 3] = feather * cosine / (error * error)
            cells[i, 4] = rotation[0, 0] * nx + rotation[0, 1] * ny + rotation[0, 2] * nz
            cells[i, 5] = rotation[1, 0] * nx + rotation[1, 1] * ny + rotation[1, 2] * nz
            cells[i, 6] = rotation[2, 0] * nx + rotation[2, 1] * ny + rotation[2, 2] * nz
            cells[i, 7], cells[i, 8] = cosine, (float(fit[row, col, 4]) * cosine) ** 2
            for k in range(CLUES):
                clues[i, k] = fit[row, col, 5 + k] * cosine * cosine
            residual[i] = fit[row, col, 8] * cosine


@kernel
def _cells_from_edge(fit, pitch, distance):
    """Distance of each fitted cell, in cells (chamfer), from the nearest cell without a fit, depth jump, or border of the grid."""
    height, width = fit.shape[0], fit.shape[1]
    for row in range(height):
        for col in range(width):
            inside = math.isfinite(fit[row, col, 0])
            if inside:
                inside = 0 < row < height - 1 and 0 < col < width - 1
            if inside:
                step = BEND_TAN * 2.0 * (pitch[0] * fit[row, col, 0] + pitch[1])
                for k in range(4):
                    dv, du = (0, 1, 0, -1)[k], (1, 0, -1, 0)[k]
                    other = fit[row + dv, col + du, 0]
                    ahead = fit[row, col, 0] + fit[row, col, 1] * du + fit[row, col, 2] * dv
                    if not abs(other - ahead) <= step + 6.0 * fit[row, col, 3]:
                        inside = False
            distance[row, col] = 1e3 if inside else 0.5
    for sweep in range(2):
        for i in range(height):
            row = i if sweep == 0 else height - 1 - i
            back = -1 if sweep == 0 else 1
            for j in range(width):
                col = j if sweep == 0 else width - 1 - j
                best = distance[row, col]
                if 0 <= row + back < height:
                    best = min(best, distance[row + back, col] + 1.0)
                    if col > 0:
                        best = min(best, distance[row + back, col - 1] + 1.4)
                    if col < width - 1:
                        best = min(best, distance[row + back, col + 1] + 1.4)
                if 0 <= col + back < width:
                    best = min(best, distance[row, col + back] + 1.0)
                distance[row, col] = best


@kernel
def _mark_hit(kind, numbers, height, width, samples, step, hit):
    """hit (h, w): cells on which a sample of any scan projects."""
    for i in range(0, len(samples), step):
        u, v, r = project(kind, numbers, samples[i, 0], samples[i, 1], samples[i, 2])
        if r > 0.0 and -0.5 < u < width - 0.5 and -0.5 < v < height - 0.5:
            hit[math.floor(v + 0.5), math.floor(u + 0.5)] = True


def _closed_up(mask: BoolArray) -> BoolArray:
    """The mask with its gaps of up to 2 GAP_CELLS closed (dilated, then eroded), its outline unchanged."""
    padded: BoolArray = np.pad(mask, 2 * GAP_CELLS)
    for axis in (0, 1):
        padded = _run(padded, axis, np.logical_or)
    for axis in (0, 1):
        padded = _run(padded, axis, np.logical_and)
    return padded


def _run(mask: BoolArray, axis: int, combine: np.ufunc) -> BoolArray:
    """Each run of 2 GAP_CELLS + 1 neighbours along `axis`, combined."""
    ahead = np.moveaxis(mask, axis, 0)
    count = len(ahead) - 2 * GAP_CELLS
    out = ahead[:count].copy()
    for k in range(1, 2 * GAP_CELLS + 1):
        combine(out, ahead[k : k + count], out=out)
    return np.moveaxis(out, 0, axis)


@dataclass(frozen=True)
class _Prepared:
    """One scan: kind, numbers (37,), records (h w, 10), and (h w,) each noise and lateral pitch, along the normal what is left of the sample
    beside its fit, its clues (h w, CLUES), and whether a window wider than the narrowest was chosen."""

    kind: int
    numbers: FloatArray
    cells: FloatArray
    noise_mm: FloatArray
    lateral_mm: FloatArray
    residual: FloatArray
    clues: FloatArray
    wide: BoolArray


def _cells_of(scan: RangeScan, pose: FloatArray, known: dict[Camera, tuple[FloatArray, FloatArray]]) -> _Prepared:
    """One scan at `pose` (4, 4)."""
    seen = projection_of(scan, known.get(scan.camera))
    known.clear()
    known[scan.camera] = seen.origins, seen.directions
    back = rigid.inverse(pose)
    fit, noise = quiet_ranges(seen.ranges, seen.pitch, scan.noise_mm, off=(seen.off_u, seen.off_v))
    height, width = noise.shape
    edge = np.empty((height, width), np.float32)
    _cells_from_edge(fit, seen.pitch, edge)
    cells, clues = np.empty((height * width, FIELDS), np.float32), np.empty((height * width, CLUES), np.float32)
    residual = np.empty(height * width, np.float32)
    rotation = np.ascontiguousarray(pose[:3, :3])
    in_chunks(
        lambda i, j: _records(fit, seen.origins, seen.directions, rotation, edge, seen.pitch, i, j, cells, clues, residual),
        height,
        32,
    )
    numbers = np.concatenate([back[:3, :3].ravel(), back[:3, 3], seen.numbers])
    wide = (fit[..., 9] > 0).ravel()
    return _Prepared(
        seen.kind, numbers, cells, noise.ravel(), seen.pitch[0] * cells[:, RANGE] + seen.pitch[1], residual, clues, wide
    )


def views_of(scans: Sequence[RangeScan]) -> Views:
    """Prepare the scans. Raises ScanError when none holds a surface, or a camera cannot be projected into."""
    if not scans:
        raise ScanError("there are no scans; a surface needs at least one")
    samples = [scan.need_points(16).points_mm() for scan in scans]
    shift = 0.5 * (np.min([p.min(axis=0) for p in samples], axis=0) + np.max([p.max(axis=0) for p in samples], axis=0))
    points = np.concatenate(samples) - shift
    known: dict[Camera, tuple[FloatArray, FloatArray]] = {}  # scans mostly share one camera
    poses = [scan.world_from_scan.copy() for scan in scans]
    for pose in poses:
        pose[:3, 3] -= shift
    parts = [_cells_of(scan, pose, known) for scan, pose in zip(scans, poses)]
    spacings, own = [], []
    starts = np.cumsum([0] + [len(part.cells) for part in parts[:-1]]).astype(np.int64)
    for scan, part, start in zip(scans, parts, starts):
        good = part.cells[:, WEIGHT] > 0
        spacings.append(part.lateral_mm[good] / np.sqrt(part.cells[good, COSINE]))
        own.append(start + np.flatnonzero(scan.valid))
    spacing = np.concatenate(spacings)
    if len(spacing) == 0:
        raise ScanError("the scans' samples lie too far apart to span a surface; check the unit, or use poisson or pivot")
    views = Views(
        kind=np.array([part.kind for part in parts], np.int64),
        numbers=np.array([part.numbers for part in parts]),
        size=np.array([scan.range_mm.shape for scan in scans], np.int64),
        start=starts,
        cells=np.concatenate([part.cells for part in parts]),
        noise_mm=np.concatenate([part.noise_mm for part in parts]),
        samples_mm=points,
        spacing_mm=float(np.median(spacing)),
        shift_mm=shift,
    )
    residual, clues, wide = (np.concatenate([getattr(part, name) for part in parts]) for name in ("residual", "clues", "wide"))
    del parts
    views.cells[:, SMOOTHED] = detail_lost(
        views.arrays, residual, clues, wide, views.noise_mm, points, np.concatenate(own), views.spacing_mm
    )
    for s, scan in enumerate(scans):
        hit = scan.valid.copy()
        _mark_hit(views.kind[s], views.numbers[s], *hit.shape, points, 2, hit)
        # a ray that returned nothing, and on which no other scan saw anything, ran through empty space
        views.cells[starts[s] : starts[s] + hit.size, RANGE][~_closed_up(hit).ravel()] = np.inf
    return views
