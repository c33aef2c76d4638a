"""The noise of a scan, from the scan itself: how much neighbouring ranges differ from a smooth surface, by distance and by angle.

Immerkaer's mask ("Fast noise variance estimation", CVIU 64(2), 1996) answers to noise and not to surfaces of second order; the
median of its absolute answers, in classes of range and of slant, is deaf to the few places where the surface bends more. Then

    sigma = normal_mm (range / reference_mm)^range_power (1 / cosine)^slant_power

is fitted to the classes. Noise that neighbours share (a filtered scan, projector cells wider than a cell, quantised depth below the
step) is not seen by differences of neighbours: the estimate is then a lower bound, and `correlation` says how much they share.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import ScanError
from rangecheck.kernels import in_chunks
from rangecheck.scan.filters_kernels import slants, third_differences
from rangecheck.scan.range_scan import RangeScan

#: median of |x| of a normal variable of standard deviation 1
_MEDIAN = 0.6744897501960817
_FEWEST = 200
_COSINES = np.array([0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 1.0 + 1e-9])
_RANGE_CLASSES = 8
#: a class of range must be this much farther than another before a power of range is fitted
_LEAST_SPREAD = 1.15
#: and a class of slant must differ this much in cosine from another before a power of slant is
_LEAST_TURN = 0.15


@dataclass(frozen=True)
class NoiseEstimate:
    """Standard deviation of one range.

    normal_mm       at reference_mm (the median range) and normal incidence
    range_power     0 where the scan's ranges differ too little to tell
    slant_power     0 where its slants differ too little to tell
    correlation     between answers of the mask three cells apart: 0 where the noise of neighbours is independent
    classes         (k, 4) range_mm, cosine, standard deviation, cells: what was fitted"""

    normal_mm: float
    reference_mm: float
    range_power: float
    slant_power: float
    correlation: float
    classes: FloatArray = field(repr=False)

    def sigma_mm(self, range_mm: FloatArray, cosine: FloatArray | float = 1.0) -> FloatArray:
        """Standard deviation at these ranges and slants; slants past the flattest class count as that one."""
        slant = np.maximum(cosine, _COSINES[0]) ** -self.slant_power
        return self.normal_mm * (np.asarray(range_mm, np.float64) / self.reference_mm) ** self.range_power * slant


def surface_cosines(scan: RangeScan, slack_mm: FloatArray | float = 0.0, window: int = 2, steepest: float = 11.4) -> FloatArray:
    """|normal . ray| (h, w) float32 of every cell, NaN where its surface has fewer than five points within `window` cells.

    steepest  along over across, above which neighbours belong to another surface: 11.4 is 85 degrees from the normal"""
    points, rays = geometry(scan)
    slack = np.broadcast_to(np.asarray(slack_mm, np.float32), scan.range_mm.shape)
    cosine = np.empty(scan.range_mm.shape, np.float32)
    in_chunks(lambda i, j: slants(points, rays, steepest, slack, window, i, j, cosine), len(points), 32)
    return cosine


def geometry(scan: RangeScan) -> tuple[FloatArray, FloatArray]:
    """Points and unit rays (h, w, 3) in the scan frame."""
    _, rays = scan.camera.pixel_rays()
    return scan.grid_points_mm, np.ascontiguousarray(rays)


def estimate_noise(scan: RangeScan) -> NoiseEstimate:
    """Noise of `scan` by range and slant. Raises ScanError with fewer than 200 cells that have all eight neighbours on their surface."""
    points, rays = geometry(scan)
    ranges = scan.range_mm.astype(np.float64)
    slack = np.zeros(ranges.shape, np.float32)
    answer = np.empty(ranges.shape)
    for _ in range(2):  # first generous, then with what noise there is
        third_differences(ranges, points, rays, 11.4, slack, answer)
        known = np.isfinite(answer)
        if known.sum() < _FEWEST:
            raise ScanError(
                f"{scan.name}: {int(known.sum())} cells have all eight neighbours on their surface, and {_FEWEST} are needed to tell noise; "
                "state the scanner's noise instead",
                name=scan.name,
            )
        slack[:] = 4.0 * np.median(np.abs(answer[known])) / _MEDIAN
    cosine = surface_cosines(scan, slack, window=3)
    known &= np.isfinite(cosine) & (cosine >= _COSINES[0])
    if known.sum() < _FEWEST:
        raise ScanError(
            f"{scan.name}: {int(known.sum())} cells have a known slant, and {_FEWEST} are needed to tell noise", name=scan.name
        )
    classes = _classes(ranges[known], cosine[known].astype(np.float64), np.abs(answer[known]))
    reference = float(np.median(ranges[known]))
    normal, range_power, slant_power = _fit(classes, reference)
    return NoiseEstimate(normal, reference, range_power, slant_power, _correlation(answer), classes)


def _classes(ranges: FloatArray, cosine: FloatArray, answer: FloatArray) -> FloatArray:
    edges = np.quantile(ranges, np.linspace(0, 1, _RANGE_CLASSES + 1))
    by_range: IntArray = np.clip(np.searchsorted(edges, ranges, side="right") - 1, 0, _RANGE_CLASSES - 1)
    by_slant = np.searchsorted(_COSINES, cosine, side="right") - 1
    rows = []
    for i in range(_RANGE_CLASSES):
        for j in range(len(_COSINES) - 1):
            mine = (by_range == i) & (by_slant == j)
            if mine.sum() >= _FEWEST // 4:
                row = np.median(ranges[mine]), np.median(cosine[mine]), np.median(answer[mine]) / _MEDIAN, mine.sum()
                rows.append([float(v) for v in row])
    if not rows:
        rows.append([float(np.median(ranges)), float(np.median(cosine)), float(np.median(answer)) / _MEDIAN, float(len(ranges))])
    return np.array(rows)


def _fit(classes: FloatArray, reference: float) -> tuple[float, float, float]:
    """normal_mm, range_power and slant_power that fit the classes' logarithms, by their counts."""
    told = classes[classes[:, 2] > 0]
    if len(told) == 0:
        return 0.0, 0.0, 0.0
    terms: dict[str, FloatArray] = {"normal": np.ones(len(told))}
    if told[:, 0].max() > _LEAST_SPREAD * told[:, 0].min():
        terms["range"] = np.log(told[:, 0] / reference)
    if np.ptp(told[:, 1]) > _LEAST_TURN:
        terms["slant"] = -np.log(told[:, 1])
    design, target, found = np.stack(list(terms.values()), axis=1), np.log(told[:, 2]), np.zeros(len(terms))
    weight = told[:, 3].copy()
    for _ in range(10):  # least absolute departures: classes where the surface bends, as at a limb, do not pull
        root = np.sqrt(weight)[:, None]
        found, *_ = np.linalg.lstsq(design * root, target * root[:, 0], rcond=None)
        weight = told[:, 3] / np.maximum(np.abs(target - design @ found), 0.01)
    powers = dict(zip(terms, found.tolist()))
    return float(np.exp(powers["normal"])), powers.get("range", 0.0), powers.get("slant", 0.0)


def _correlation(answer: FloatArray) -> float:
    """Correlation of the mask's answers three cells apart: masks that share no cell answer independently to independent noise."""
    values = []
    for first, second in ((answer[:, 3:], answer[:, :-3]), (answer[3:], answer[:-3])):
        both = np.isfinite(first) & np.isfinite(second)
        if both.sum() >= _FEWEST:
            a, b = first[both], second[both]
            scale = np.median(np.abs(a)) + np.median(np.abs(b))
            if scale > 0:
                a, b = np.clip(a, -3 * scale, 3 * scale), np.clip(b, -3 * scale, 3 * scale)
                values.append(float((a * b).mean() / np.sqrt((a * a).mean() * (b * b).mean())))
    return float(np.mean(values)) if values else 0.0
