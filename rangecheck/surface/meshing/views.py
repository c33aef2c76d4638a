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
from itertools import pairwise

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import ScanError
from rangecheck.kernels import in_chunks, kernel
from rangecheck.optics import Camera, RayGrid
from rangecheck.scan import RangeScan
from rangecheck.surface.meshing.beyond import continue_cells
from rangecheck.surface.meshing.edge_fit import BEND_TAN
from rangecheck.surface.meshing.fit_error import CODES, STOPPED, middle_weights
from rangecheck.surface.meshing.local_fit import quiet_ranges
from rangecheck.surface.meshing.projection import Projection, project, projection_of
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
#: share of the stated noise below which what neighbours show is not all of it: they share the rest, as in ranges that were smoothed or refined
SHOWN = 0.5
#: cells seen at a flatter angle than this carry no weight
FLATTEST_COSINE = 0.1


@dataclass(frozen=True)
class Views:
    """All scans, concatenated.

    kind (s,) int64; numbers (s, 37) pose and camera; size (s, 2) int64 height, width; start (s,) int64 first cell of each scan;
    cells (n, 10) float32 records: range is NaN where nothing is known and +inf where the ray met nothing;
    samples_mm (k, 3) valid samples, shifted world frame; spacing_mm median distance between neighbouring samples along the surface; shift_mm (3,)."""

    kind: IntArray
    numbers: FloatArray
    size: IntArray
    start: IntArray
    cells: FloatArray
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
def _records(
    ranges, chosen, factors, shared, left_out, origins, directions, rotation, edge, pitch, first, last, cells, clues, residual, lateral
):  # fmt: skip
    """Make the local fits in `cells` (h, w, FIELDS) the records of rows first..last; clues and residuals become distances along the normal."""
    height, width = edge.shape[0], edge.shape[1]
    for row in range(first, last):
        r0, r1 = max(row - 1, 0), min(row + 1, height - 1)
        for col in range(width):
            record = cells[row, col]
            r, su, sv, quiet = float(record[0]), float(record[1]), float(record[2]), float(record[3])
            record[:] = 0.0
            record[0] = residual[row, col] = lateral[row, col] = np.nan
            if not math.isfinite(r):
                clues[row, col, :] = 0.0
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
            pu0, pu1, pu2 = pu0 + su * d[0], pu1 + su * d[1], pu2 + su * d[2]
            pv0, pv1, pv2 = pv0 + sv * d[0], pv1 + sv * d[1], pv2 + sv * d[2]
            nx, ny, nz = pu1 * pv2 - pu2 * pv1, pu2 * pv0 - pu0 * pv2, pu0 * pv1 - pu1 * pv0
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            along = (nx * d[0] + ny * d[1] + nz * d[2]) / length
            cosine = abs(along)
            if not (length > 0.0 and cosine >= FLATTEST_COSINE):
                clues[row, col, :] = 0.0
                continue
            flip = -1.0 if along > 0.0 else 1.0
            nx, ny, nz = flip * nx / length, flip * ny / length, flip * nz / length
            lateral[row, col] = pitch[0] * r + pitch[1]
            aside = ASIDE_CELLS * (pitch[0] * r + pitch[1])
            error = math.hypot(quiet * cosine, aside * math.sqrt(max(1.0 - cosine * cosine, 0.0)))
            feather = min(1.0, edge[row, col] / FEATHER_CELLS)
            record[0], record[1], record[2] = r, 0.5 * su, 0.5 * sv
            record[3] = feather * cosine / (error * error)
            record[4] = rotation[0, 0] * nx + rotation[0, 1] * ny + rotation[0, 2] * nz
            record[5] = rotation[1, 0] * nx + rotation[1, 1] * ny + rotation[1, 2] * nz
            record[6] = rotation[2, 0] * nx + rotation[2, 1] * ny + rotation[2, 2] * nz
            record[7], record[8] = cosine, (shared * factors[chosen[row, col] & CODES - 1] * quiet * cosine) ** 2
            for k in range(CLUES):
                clues[row, col, k] *= cosine * cosine
            if chosen[row, col] >= 0:
                residual[row, col] = (ranges[row, col] - r) * left_out[chosen[row, col] % STOPPED] * cosine


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
class _Told:
    """What is known of all cells beside their records, only while these are made: noise of one range, what is left of the sample beside its
    fit along the normal, lateral pitch, all (n,); clues (n, CLUES); and whether a window wider than the narrowest was chosen (n,)."""

    noise_mm: FloatArray
    residual: FloatArray
    lateral_mm: FloatArray
    clues: FloatArray
    wide: BoolArray

    @classmethod
    def of(cls, n: int) -> _Told:
        noise, residual, lateral = (np.empty(n, np.float32) for _ in range(3))
        return cls(noise, residual, lateral, np.empty((n, CLUES), np.float32), np.empty(n, bool))


def _fill_cells(scan: RangeScan, seen: Projection, cells: FloatArray, told: _Told, rows: slice) -> None:
    """Fill the records `cells` (n, FIELDS), and what is told beside them, of the scan whose cells are `rows` of them."""
    height, width = scan.range_mm.shape
    mine = cells[rows].reshape(height, width, FIELDS)
    fits = quiet_ranges(seen.ranges, seen.pitch, scan.noise_mm, off=(seen.off_u, seen.off_v), into=mine)
    edge = np.empty((height, width), np.float32)
    _cells_from_edge(mine, seen.pitch, edge)
    told.noise_mm[rows], told.wide[rows] = fits.noise_mm.ravel(), (fits.chosen >= 0).ravel()
    told.wide[rows] &= (fits.chosen % STOPPED > 0).ravel()
    clues = told.clues[rows].reshape(height, width, CLUES)
    clues[...] = fits.clues
    residual, lateral = (a[rows].reshape(height, width) for a in (told.residual, told.lateral_mm))
    rotation = np.ascontiguousarray(scan.world_from_scan[:3, :3])
    left_out, shared = 1.0 / (1.0 - middle_weights()), _shared(scan, fits.noise_mm)
    in_chunks(
        lambda i, j: _records(
            seen.ranges, fits.chosen, fits.factors, shared, left_out, seen.origins, seen.directions, rotation, edge, seen.pitch, i, j, mine,
            clues, residual, lateral,
        ),
        height, 32,
    )  # fmt: skip


def _shared(scan: RangeScan, shown_mm: FloatArray) -> float:
    """The noise that fits are taken to err by, over what neighbours show of it: 1, but where they share most of what is stated."""
    shown = float(np.median(shown_mm[scan.valid]))
    return scan.noise_mm / shown if scan.noise_mm is not None and shown < SHOWN * scan.noise_mm else 1.0


def _points_of(scan: RangeScan, seen: Projection) -> FloatArray:
    """(k, 3) samples in the world frame, as `RangeScan.points_mm` gives them, from the cells' rays if they are the measured ones."""
    if isinstance(scan.camera, RayGrid):
        return scan.points_mm()
    ranges = scan.range_mm[scan.valid].astype(np.float64)
    return rigid.move_points(scan.world_from_scan, seen.origins[scan.valid] + ranges[:, None] * seen.directions[scan.valid])


def views_of(scans: Sequence[RangeScan]) -> Views:
    """Prepare the scans. Raises ScanError when none holds a surface, or a camera cannot be projected into."""
    if not scans:
        raise ScanError("there are no scans; a surface needs at least one")
    starts = np.cumsum([0, *(scan.need_points(16).range_mm.size for scan in scans)])
    cells, told = np.empty((starts[-1], FIELDS), np.float32), _Told.of(int(starts[-1]))
    known: dict[Camera, tuple[FloatArray, FloatArray]] = {}  # scans mostly share one camera
    kinds, cameras, pitches, samples, own = [], [], [], [], []
    for scan, start, stop in zip(scans, starts[:-1], starts[1:]):
        seen = projection_of(scan, known.get(scan.camera))
        known.clear()
        known[scan.camera] = seen.origins, seen.directions
        kinds.append(seen.kind)
        cameras.append(seen.numbers)
        pitches.append(seen.pitch)
        samples.append(_points_of(scan, seen))
        own.append(start + np.flatnonzero(scan.valid))
        _fill_cells(scan, seen, cells, told, slice(int(start), int(stop)))
    known.clear()
    spacing = np.concatenate([_spacings(cells[i:j], told.lateral_mm[i:j]) for i, j in pairwise(starts)])
    if len(spacing) == 0:
        raise ScanError("the scans' samples lie too far apart to span a surface; check the unit, or use poisson or pivot")
    shift = 0.5 * (np.min([p.min(axis=0) for p in samples], axis=0) + np.max([p.max(axis=0) for p in samples], axis=0))
    numbers = []
    for scan, camera in zip(scans, cameras):
        pose = scan.world_from_scan.copy()
        pose[:3, 3] -= shift
        back = rigid.inverse(pose)
        numbers.append(np.concatenate([back[:3, :3].ravel(), back[:3, 3], camera]))
    views = Views(
        kind=np.array(kinds, np.int64),
        numbers=np.array(numbers),
        size=np.array([scan.range_mm.shape for scan in scans], np.int64),
        start=starts[:-1].astype(np.int64),
        cells=cells,
        samples_mm=np.concatenate([points - shift for points in samples]),
        spacing_mm=float(np.median(spacing)),
        shift_mm=shift,
    )
    detail_lost(
        views.arrays, told.residual, told.clues, told.wide, told.noise_mm, views.samples_mm, np.concatenate(own), views.spacing_mm,
        cells[:, SMOOTHED],
    )  # fmt: skip

    def empty_space(first: int, _: int) -> None:
        hit = scans[first].valid.copy()
        _mark_hit(views.kind[first], views.numbers[first], *hit.shape, views.samples_mm, 2, hit)
        # a ray that returned nothing, and on which no other scan saw anything, ran through empty space
        mine = cells[starts[first] : starts[first + 1]]
        mine[:, RANGE][~_closed_up(hit).ravel()] = np.inf
        continue_cells(mine.reshape(*hit.shape, FIELDS), pitches[first])

    in_chunks(empty_space, len(scans), 1)
    return views


def _spacings(cells: FloatArray, lateral: FloatArray) -> FloatArray:
    """Distances along the surface between neighbouring samples, of the cells that have a weight."""
    good = cells[:, WEIGHT] > 0
    spacings: FloatArray = lateral[good] / np.sqrt(cells[good, COSINE])
    return spacings
