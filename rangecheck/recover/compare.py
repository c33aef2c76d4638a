"""Does the scan explain the photograph? Places where the shading that the scan predicts is not in its brightness image.

Let d = ln(seen / predicted), what is left after material and lamp were fitted, and p = ln predicted, both less their own means over
`BROAD` scales (slow changes are paint and stray light). Where the scan is right, d is paint and noise and knows nothing of p. Where the
scan shows a shape that the picture does not, d holds -p. So the statistic is the projection of d on the scan's own shading,

    z = sum w d p / (s sqrt(sum w p^2))

over a Gaussian window, s the local spread of d, in units of its own robust spread over the picture: about standard normal where the scan is right, far below 0 where it shows what is not
there. Paint that happens to follow the relief (worn ridges, dusty hollows) has z > 0, and is no contradiction of the scan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.recover.fit import Fitted, fit
from rangecheck.recover.grid import ScanGrid, grid_sight, masked_gauss, normals_at, scan_grid
from rangecheck.recover.lights import Light
from rangecheck.recover.problem import Guess, Photograph, Problem, Unknowns
from rangecheck.scan import RangeScan

KINDS = ("shape", "albedo", "shadow edge", "highlight", "registration")
#: window and broad mean, in units of the scale at which normals are taken
WINDOW, BROAD = 3.0, 6.0
#: standard deviations below which a place is named, and the least area of a named region in windows
NAMED, _LEAST_WINDOWS = -4.5, 0.5
_LEAST_COSINE, _LEAST_LIGHT = 0.35, 0.3
#: regions longer than this many times their width are lines, and lines in the shape are steps between surfaces
_LINE = 4.0


@dataclass(frozen=True)
class Region:
    """A place that the scan does not explain: `kind` of KINDS, middle (3,) mm in the scan's frame, area and length mm, worst z, cells."""

    kind: str
    middle_mm: tuple[float, float, float]
    area_mm2: float
    length_mm: float
    width_mm: float
    z: float
    cell: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Comparison:
    """regions, the worst first;  z (h, w), NaN where not judged;  residual (h, w) = ln(seen/predicted);  judged: share of the valid cells;
    fitted;  grid"""

    regions: tuple[Region, ...]
    z: FloatArray
    residual: FloatArray
    judged: float
    fitted: Fitted
    grid: ScanGrid


def fit_to_scan(grid: ScanGrid, scale_mm: float, directions: Sequence[FloatArray] = (), *, pixels: int = 12000) -> Fitted:
    """Material and lamp of a scan's brightness image on its own surface. Paint varies far more than the sensor's noise does: the spread
    assumed is a share of the brightness around, and the residual's own scale widens the intervals."""
    normals = normals_at(grid, scale_mm)
    keep = _seen_well(grid, normals)
    sight = grid_sight(grid, normals, keep)
    values = grid.picture.reshape(-1)[sight.pixel]
    around = masked_gauss(grid.picture, keep.astype(float), 8.0 * scale_mm / grid.spacing_mm).reshape(-1)[sight.pixel]
    chosen = np.arange(0, len(sight), max(1, len(sight) // pixels))
    photo = Photograph(sight, values, np.hypot(0.005, 0.3 * around), np.ones((len(sight), 1), bool), (0,)).only(chosen)
    middle = np.median(sight.points, axis=0)
    away = float(np.linalg.norm(middle))
    ahead = -middle / max(away, 1e-9)
    tried = directions or [ahead, *(ahead + 0.7 * np.array(side) for side in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)))]
    best: Fitted | None = None
    for direction in tried:
        light = Light(np.asarray(direction), math.pi, middle, away, 1.0)
        # first matt, which has one answer for each lamp; then the lobe
        matt = fit(Problem((photo,), (light,), Guess(0.5, 0.0, 0.0, 0.2, 2.0), Unknowns(("K_lm",))), pixels=2000)
        if best is None or matt.cost < best.cost:
            best = matt
    assert best is not None
    problem = Problem(
        (photo,), best.problem.lights, Guess(best.problem.material.K_lm, 0.0, 0.1, 0.2, 1.5), Unknowns(distance=True)
    )
    return fit(problem, known_noise=False, pixels=2000)


def compare(
    scan: RangeScan, *, step: int = 1, scale_mm: float | None = None, fitted: Fitted | None = None, named: float = NAMED
) -> Comparison:
    """The scan against its own brightness image, linear in light.

    scale_mm: over which normals are taken, 3 cells if not said. fitted: material and lamp, if known from elsewhere. Raises ScanError without
    brightness."""
    grid = scan_grid(scan, step)
    scale = scale_mm or 3.0 * grid.spacing_mm
    fitted = fitted or fit_to_scan(grid, scale)
    normals = normals_at(grid, scale)
    keep = _seen_well(grid, normals)
    predicted = predict_on(grid, normals, keep, fitted)
    # shadows that the scan's own shape casts are not in the direct model, and what is nearly dark holds no shading
    bright = predicted > _LEAST_LIGHT * float(np.nanquantile(predicted, 0.95))
    judged = keep & bright & np.isfinite(predicted) & (grid.picture > 0.0)
    weight = judged.astype(float)
    log_p = np.log(np.where(judged, predicted, 1.0))
    left = np.log(np.where(judged, grid.picture, 1.0)) - log_p
    cells = scale / grid.spacing_mm
    d, p = (np.where(judged, f - masked_gauss(f, weight, BROAD * cells), 0.0) for f in (left, log_p))
    z = projection(d, p, weight, WINDOW * cells)
    # at rims the broad means and the normals are one-sided
    judged = inner(judged, 2.0 * cells)
    z[~judged] = np.nan
    regions = _regions(grid, z, judged, named, WINDOW * scale, fitted, predicted)
    residual = np.where(judged, left, np.nan)
    return Comparison(regions, z, residual, float(judged.sum() / max(1, grid.valid.sum())), fitted, grid)


def predict_on(grid: ScanGrid, normals: FloatArray, keep: BoolArray, fitted: Fitted) -> FloatArray:
    """(h, w) what the fitted material and lamp show on the grid, NaN where not kept."""
    sight = grid_sight(grid, normals, keep)
    n = len(sight)
    problem = fitted.problem
    photo = Photograph(sight, np.zeros(n), np.ones(n), np.ones((n, 1), bool), (0,), exposure=problem.photographs[0].exposure)
    there = Problem((photo,), problem.lights, problem.material, Unknowns(problem.unknowns.material), problem.nodes)
    return sight.spread(there.predict(there.start(), 0, slopes=False).values)


def projection(d: FloatArray, p: FloatArray, weight: FloatArray, window: float) -> FloatArray:
    """z (h, w) of d against p over Gaussian windows of `window` cells, in units of its own robust spread over the picture: how far paint
    varies together is taken from the picture itself."""
    from scipy.ndimage import gaussian_filter

    top = gaussian_filter(weight * d * p, window)
    energy = gaussian_filter(weight * p * p, window)
    spread = gaussian_filter(weight * np.minimum(d * d, _capped(d, weight)), 4.0 * window)
    count = gaussian_filter(weight, 4.0 * window)
    raw = top / np.sqrt(np.maximum(spread / np.maximum(count, 1e-6) * energy, 1e-24))
    used = raw[weight > 0]
    unit = float(np.median(np.abs(used - np.median(used)))) / 0.6744897501960817 if used.size else 1.0
    return np.asarray(raw / max(unit, 1e-12))


def inner(mask: BoolArray, cells: float) -> BoolArray:
    """The mask without what lies within so many cells of its rim."""
    from scipy.ndimage import distance_transform_edt

    return np.asarray(distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1] > cells)


def _capped(d: FloatArray, weight: FloatArray) -> float:
    """Nine times the robust variance: what lies further out is what is looked for, not what it is judged by."""
    used = d[weight > 0]
    return 9.0 * float(np.median(np.abs(used)) / 0.6745) ** 2 if used.size else 1.0


def _seen_well(grid: ScanGrid, normals: FloatArray) -> BoolArray:
    facing = -(normals * grid.rays).sum(-1)
    return np.asarray(
        grid.valid & np.isfinite(normals).all(axis=-1) & (np.nan_to_num(facing) > _LEAST_COSINE) & np.isfinite(grid.picture)
    )


def _regions(
    grid: ScanGrid, z: FloatArray, judged: BoolArray, named: float, window_mm: float, fitted: Fitted,
    predicted: FloatArray,
) -> tuple[Region, ...]:  # fmt: skip
    from scipy.ndimage import label

    low = np.where(judged, z, 0.0) < named
    spots, count = label(low, np.ones((3, 3)))
    found = []
    for k in range(1, count + 1):
        rows, columns = np.nonzero(spots == k)
        area = len(rows) * grid.spacing_mm**2
        if area < _LEAST_WINDOWS * window_mm**2:
            continue
        points = grid.points[rows, columns]
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / math.sqrt(len(points))
        length, width = 2.0 * math.sqrt(3.0) * spread[0], 2.0 * math.sqrt(3.0) * spread[1]
        worst = int(np.argmin(z[rows, columns]))
        kind = "registration" if length > _LINE * max(width, grid.spacing_mm) else "shape"
        bright = float(np.median(predicted[rows, columns])) > 2.0 * float(np.nanmedian(predicted))
        if kind == "shape" and bright:
            kind = "highlight"
        x, y, depth = (float(v) for v in np.median(points, axis=0))
        found.append(
            Region(kind, (x, y, depth), float(area), float(length), float(width), float(z[rows, columns].min()),
                   (int(rows[worst]), int(columns[worst])))
        )  # fmt: skip
    return tuple(sorted(found, key=lambda region: region.z))
