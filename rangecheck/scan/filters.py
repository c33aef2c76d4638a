"""Filters of range scans. Each takes a scan and gives back the scan without what it removed, and a report of what that was.

Cells keep their places: a removed cell becomes NaN, and no cell is ever invented. What belongs to one surface is decided along the ray
(`filters_kernels`): a neighbour does whose point is not more than `grazing` steep, noise allowed for. Noise is `sigma_mm`, one
number or one per cell; by default it is the scan's own statement, else what `estimate_noise` finds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, require
from rangecheck.errors import ArrayError, ScanError
from rangecheck.kernels import in_chunks
from rangecheck.scan.filters_kernels import patches, quadratic_window, smooth, support
from rangecheck.scan.noise import estimate_noise, geometry, surface_cosines
from rangecheck.scan.range_scan import RangeScan

ROWS = 32


@dataclass(frozen=True)
class FilterReport:
    """What a filter did.

    name      of the filter
    removed   (h, w) True where a distance was taken away
    of        cells that held one before
    changed_mm, largest_mm   root mean square and largest change of the ranges that stayed
    said      one sentence"""

    name: str
    removed: BoolArray = field(repr=False)
    of: int
    changed_mm: float
    largest_mm: float
    said: str

    @property
    def count(self) -> int:
        """Cells removed."""
        return int(self.removed.sum())


def remove_flying_pixels(
    scan: RangeScan, *, grazing_deg: float = 84.0, least_friends: int = 3, sigma_mm: FloatArray | float | None = None
) -> tuple[RangeScan, FilterReport]:
    """Remove cells that hang between a near and a far surface, as cells do whose footprint straddles an edge.

    A cell goes when it has a neighbour before it and one behind it, neither on its own surface, and fewer than `least_friends` of its
    eight neighbours on it. Repeated until none goes, at most three times, since flying pixels come in pairs.
    grazing_deg  angle from the normal beyond which neighbours count as two surfaces (45 to 89.5)"""
    steepest, sigma = _steepness(grazing_deg), _sigma(scan, sigma_mm)
    ranges = np.array(scan.range_mm)
    for _ in range(3):
        friends, nearer, farther = _support(replace(scan, range_mm=ranges), steepest, sigma)
        flying = (friends < least_friends) & (nearer > 0) & (farther > 0)
        if not flying.any():
            break
        ranges[flying] = np.nan
    return _without(scan, "flying pixels", scan.valid & np.isnan(ranges), "hang between a nearer and a farther surface")


def remove_isolated(
    scan: RangeScan, *, least_cells: int = 20, grazing_deg: float = 84.0, sigma_mm: FloatArray | float | None = None
) -> tuple[RangeScan, FilterReport]:
    """Remove patches of fewer than `least_cells` cells that touch no other cell of their surface."""
    if least_cells < 1:
        raise ArrayError(f"least_cells is {least_cells}; it must be at least 1", name="least_cells")
    steepest, sigma = _steepness(grazing_deg), _sigma(scan, sigma_mm)
    points, rays = geometry(scan)
    label, size = np.empty(scan.range_mm.shape, np.int64), np.zeros(scan.range_mm.size, np.int64)
    patches(points, rays, steepest, (4 * sigma).astype(np.float32), label, size)
    small = (label >= 0) & (size[np.maximum(label, 0)] < least_cells)
    return _without(scan, "isolated returns", small, f"lie in patches of fewer than {least_cells} cells")


def remove_oblique(
    scan: RangeScan, *, max_angle_deg: float = 80.0, sigma_mm: FloatArray | float | None = None
) -> tuple[RangeScan, FilterReport]:
    """Remove cells whose surface is seen at more than `max_angle_deg` (0 to 89) from its normal, and those whose slant cannot be told
    because they have fewer than five cells of their surface around them."""
    if not 0 < max_angle_deg <= 89:
        raise ArrayError(f"max_angle_deg is {max_angle_deg}; it must lie between 0 and 89", name="max_angle_deg")
    cosine = surface_cosines(scan, 4 * _sigma(scan, sigma_mm), window=1, steepest=_steepness(89.5))
    removed = scan.valid & ~(cosine >= math.cos(math.radians(max_angle_deg)))
    return _without(scan, "oblique cells", removed, f"are seen at more than {max_angle_deg:g} degrees, or too alone to tell")


def smooth_ranges(
    scan: RangeScan, *, window: int = 3, grazing_deg: float = 80.0, sigma_mm: FloatArray | float | None = None
) -> tuple[RangeScan, FilterReport]:
    """Quieten ranges without rounding edges: each becomes the value of a quadratic fitted to the ranges of its own surface within
    `window` cells (2 to 8), a range that disagrees by 3.5 sigma or more weighing less (Tukey's biweight). Ranges that would move more
    than five sigma stay."""
    if not 2 <= window <= 8:
        raise ArrayError(f"window is {window} cells; it must be 2 to 8", name="window")
    steepest, sigma = _steepness(grazing_deg), _sigma(scan, sigma_mm)
    points, rays = geometry(scan)
    ranges = scan.range_mm.astype(np.float64)
    sigma = np.maximum(sigma, 1e-6 * np.nan_to_num(ranges, nan=1.0))  # float32 has no finer steps
    out = np.empty(ranges.shape)
    tables = quadratic_window(window)
    in_chunks(lambda i, j: smooth(ranges, points, rays, steepest, sigma, *tables, i, j, out), len(ranges), ROWS)
    quiet = replace(scan, range_mm=out.astype(np.float32))
    moved = (out - ranges)[scan.valid]
    rms, most = (float(np.sqrt((moved * moved).mean())), float(np.abs(moved).max())) if len(moved) else (0.0, 0.0)
    said = f"smoothing within {window} cells moved {len(moved)} ranges by {rms:.3g} mm (root mean square), at most {most:.3g} mm"
    return quiet, FilterReport("smoothing", np.zeros(ranges.shape, bool), len(moved), rms, most, said)


def _support(scan: RangeScan, steepest: float, sigma: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    points, rays = geometry(scan)
    friends, nearer, farther = np.zeros((3, *scan.range_mm.shape), np.uint8)
    slack = (4 * sigma).astype(np.float32)
    in_chunks(lambda i, j: support(points, rays, steepest, slack, i, j, friends, nearer, farther), len(points), ROWS)
    return friends, nearer, farther


def _steepness(grazing_deg: float) -> float:
    if not 45 <= grazing_deg <= 89.5:
        raise ArrayError(f"grazing_deg is {grazing_deg}; it must lie between 45 and 89.5", name="grazing_deg")
    return math.tan(math.radians(grazing_deg))


def _sigma(scan: RangeScan, sigma_mm: FloatArray | float | None) -> FloatArray:
    """Standard deviation of each cell, (h, w)."""
    if sigma_mm is None:
        if scan.noise_mm is not None:
            sigma_mm = scan.noise_mm
        else:
            try:
                noise = estimate_noise(scan)
                return noise.sigma_mm(np.nan_to_num(scan.range_mm, nan=noise.reference_mm))
            except ScanError:
                sigma_mm = 0.0  # too few cells to tell: every jump counts
    sigma = require("sigma_mm", np.broadcast_to(sigma_mm, scan.range_mm.shape), scan.range_mm.shape, finite=True)
    if (sigma < 0).any():
        raise ArrayError(f"sigma_mm has {sigma.min():g}; a standard deviation is not negative", name="sigma_mm")
    return sigma


def _without(scan: RangeScan, name: str, removed: BoolArray, why: str) -> tuple[RangeScan, FilterReport]:
    removed = removed & scan.valid
    before, count = int(scan.valid.sum()), int(removed.sum())
    left = replace(scan, range_mm=np.where(removed, np.float32(np.nan), scan.range_mm))
    share = 100 * count / max(before, 1)
    return left, FilterReport(name, removed, before, 0.0, 0.0, f"{name}: {count} of {before} cells ({share:.2g} %) {why}")
