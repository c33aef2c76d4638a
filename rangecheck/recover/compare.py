"""Does the scan explain its own brightness image? Relief that the scan has and the picture does not show, or the other way, by matched filters.

Let d = ln(seen / predicted), what is left after material and lamp were fitted on the scan's own surface. A false relief f (mm of range) of the scan
changes ln predicted by t = g . grad f, with g the derivative of shading by slope, and d by -t. Of each place

    a = - sum w d t / sum w t^2        mm of the template there        z = a / its standard deviation

is the most likely amount of a template f: dents of two radii and, for pieces badly joined, steps of eight directions (`filters`). Slow changes (paint, stray
light) are taken from d and templates alike; w is one over the local variance of d. The noise of z is that of z over the picture itself, its tails those of
Student's law with the degrees of freedom that its quantiles show, and the level is Bonferroni's for as many places as templates fit into what is
judged. What explains a place best, false shape, paint, gloss or shadow, is asked in `causes`.

What cannot be judged is said: a cell counts as judged only where a dent of JUDGED_MM would be named. On a painted surface that may be nowhere.
Scan frame, millimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.recover.causes import GLOSS, PAINT, RELIEF_MM, cast_by_scan, causes_of, gloss_patterns, shadow_regions, shadows
from rangecheck.recover.filters import DIRECTIONS, Filters, dent, steps
from rangecheck.recover.fit import Fitted
from rangecheck.recover.grid import ScanGrid, scan_grid, turned_normals
from rangecheck.recover.lamp import lamp_of
from rangecheck.recover.regions import AGAINST_SHAPE, Region, inner
from rangecheck.recover.shading import Shading, shading_of
from rangecheck.scan import RangeScan

#: radii of dents and of steps' discs, in the larger of 1 mm and half the scale of normals
_RADII = (4.0, 8.0)
#: a cell is judged where a dent this deep would be named;  chance of one false name per scan that the level is for
JUDGED_MM, CHANCE = 1.0, 0.01
#: less than this is not named: lamp and smoothing are not known well enough
LEAST_MM = 0.2
_LEAST_COSINE, _LEAST_LIGHT = 0.35, 0.25
#: of a fault's z, what its filter's side lobes may reach
_LOBE = 0.5
_NORMAL_MAD = 0.6744897501960817
#: of Student's laws that tails of z are likened to
_FREEDOMS = (100.0, 50.0, 30.0, 20.0, 15.0, 12.0, 10.0)


@dataclass(frozen=True, eq=False)
class Comparison:
    """regions, the worst first;  z (h, w) of the strongest template, NaN where nothing was compared;  hollow (h, w) that of the strongest dent: above 0 where the
    scan lies too deep;  amount_mm (h, w) of it;  least_mm (h, w) the dent that
    would be named there;  residual (h, w) = ln(seen/predicted);  judged: share of the valid cells;  excluded: shares of them that were not compared, by why;  level: |z| from which a place is named;
    paint: spread of the residual in the scale of dents;  fitted;  grid"""

    regions: tuple[Region, ...]
    z: FloatArray
    hollow: FloatArray
    amount_mm: FloatArray
    least_mm: FloatArray
    residual: FloatArray
    judged: float
    excluded: dict[str, float]
    level: float
    paint: float
    fitted: Fitted
    grid: ScanGrid


def compare(scan: RangeScan, *, step: int = 1, scale_mm: float | None = None, fitted: Fitted | None = None) -> Comparison:
    """The scan against its own brightness image, linear in light.

    scale_mm: over which normals are taken, 3 cells if not said. fitted: material and lamp, if known from elsewhere. Raises ScanError without
    brightness, and where too few cells face the camera."""
    grid = scan_grid(scan, step)
    scale = scale_mm or 3.0 * grid.spacing_mm
    normals, *turns = turned_normals(grid, scale)
    facing = np.nan_to_num(-(normals * grid.rays).sum(-1))
    keep = grid.valid & np.isfinite(normals).all(axis=-1) & (facing > _LEAST_COSINE) & np.isfinite(grid.picture)
    cell = np.flatnonzero(keep)
    fitted = fitted or lamp_of(grid, cell, normals.reshape(-1, 3)[cell])
    shading = shading_of(fitted, grid, cell)
    predicted, slopes = _shading_slopes(shading, grid, cell, normals, turns)
    # shadows that the scan's own shape casts are not in the direct model, and what is nearly dark holds no shading
    bright = predicted > _LEAST_LIGHT * float(np.nanquantile(predicted, 0.95))
    shone = keep & bright & (np.nan_to_num(grid.picture) < shading.saturation)
    with np.errstate(invalid="ignore"):
        seen = np.log(np.maximum(np.where(shone, grid.picture, 1.0), 1e-3)) - np.log(np.where(shone, predicted, 1.0))
    shaded = shadows(seen, predicted, shone)
    # at rims normals and means are one-sided
    used = shone & ~shaded & inner(keep, 2.0 * scale / grid.spacing_mm)
    residual = np.where(used, seen, np.nan)
    unit_cells = max(1.0, 0.5 * scale) / grid.spacing_mm
    radii = [r * unit_cells for r in _RADII]
    filters = Filters(residual, used, slopes, radii)
    # nearer to rims the slow part is the mean of one side
    compared = inner(used, 1.5 * radii[0])
    none: FloatArray = np.zeros(used.shape)
    best, hollow, amount, least, level = none, none, none, none + np.inf, 0.0
    evidence: dict[str, FloatArray] = dict.fromkeys(AGAINST_SHAPE, none - np.inf)
    for radius in radii:
        spread = scale / grid.spacing_mm
        for template, kind in [(dent(radius, spread), "shape"), *((t, "registration") for t in steps(radius, spread))]:
            found = filters.relief(template, radius, compared, RELIEF_MM)
            here = _level(found.z[compared], compared.sum() / (math.pi * radius**2), len(_RADII) * (1 + DIRECTIONS))
            level = max(level, here)
            if kind == "shape":
                least = np.minimum(least, np.maximum(here * found.deviation, LEAST_MM))
                hollow = np.where(np.abs(found.z) > np.abs(hollow), found.z, hollow)
            stronger = np.abs(found.z) > np.abs(best)
            best, amount = np.where(stronger, found.z, best), np.where(stronger, found.amount, amount)
            evidence[kind] = np.maximum(evidence[kind], found.evidence)
    judged = compared & (least < JUDGED_MM)
    wrong = judged & (np.abs(best) > level) & (np.abs(amount) > LEAST_MM)
    radius_mm = radii[0] * grid.spacing_mm
    regions: list[Region] = []
    if wrong.any():
        mirrored = gloss_patterns(shading, cell, normals.reshape(-1, 3)[cell], (used.shape[0], used.shape[1]))
        evidence["albedo"] = filters.spots([none + 1.0], PAINT)
        evidence["highlight"] = filters.spots(mirrored, GLOSS)
        found_there = causes_of(wrong, best, evidence, mirrored[0], grid, radius_mm)
        regions = _strong(found_there, 2.5 * _RADII[1] / _RADII[0] * radius_mm)
        regions = [replace(r, amount_mm=float(amount[r.cell]) if r.kind in AGAINST_SHAPE else None) for r in regions]
    cast = cast_by_scan(grid, fitted, shaded)
    regions += shadow_regions(shaded & ~cast, seen, judged, grid, filters.spread, radius_mm)
    regions = [replace(region, asked=level) for region in regions]
    share = float(judged.sum() / max(1, grid.valid.sum()))
    full = keep & bright & ~shone
    out = {
        "seen too slantingly": grid.valid & ~keep,
        "hardly lit": keep & ~bright,
        "saturated in the picture": full,
        "in shadow": shaded,
    }
    edge_mm = 2.0 * scale + 1.5 * radius_mm
    out[f"within {edge_mm:.0f} mm of those, of rims and of gaps"] = shone & ~shaded & ~compared
    excluded = {why: float(cells.sum() / max(1, grid.valid.sum())) for why, cells in out.items()}
    best, hollow, amount, least = (np.where(compared, v, np.nan) for v in (best, hollow, amount, least))
    return Comparison(tuple(regions), best, hollow, amount, least, residual, share, excluded, level, filters.spread, fitted, grid)


def _shading_slopes(
    shading: Shading, grid: ScanGrid, cell: np.ndarray, normals: FloatArray, turns: list[FloatArray]
) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
    """Predicted brightness (h, w) and how ln of it changes with range per cell along columns and rows, per mm."""
    value, by_normal = shading.at(normals.reshape(-1, 3)[cell])
    shape = grid.valid.shape
    ranges = np.linalg.norm(grid.points.reshape(-1, 3)[cell], axis=1)

    def spread(values: FloatArray, fill: float) -> FloatArray:
        full = np.full(shape[0] * shape[1], fill)
        full[cell] = values
        return full.reshape(shape)

    along = [(by_normal * turn.reshape(-1, 3)[cell]).sum(1) / np.maximum(value, 1e-9) / ranges for turn in turns]
    return spread(value, np.nan), (spread(along[0], 0.0), spread(along[1], 0.0))


def _level(z: FloatArray, places: float, templates: int) -> float:
    """|z| that nothing of this scan's noise passes but with CHANCE: by Student's law with the tails that z itself has up to its last twentieth."""
    from scipy.stats import t

    chance = CHANCE / (2.0 * max(1.0, places) * templates)
    if z.size < 1000:
        return float(t.isf(chance, 30.0))
    tail = float(np.quantile(np.abs(z), 0.95))
    freedom = next((f for f, twentieth in _tails() if twentieth >= tail), _FREEDOMS[-1])
    return float(t.isf(chance, freedom) / t.isf(0.25, freedom)) * _NORMAL_MAD


@cache
def _tails() -> tuple[tuple[float, float], ...]:
    """Of Student's laws, lighter tails first: degrees of freedom, and what one in twenty |t| passes where half of them pass that of a normal law."""
    from scipy.stats import t

    return tuple((f, float(t.isf(0.025, f) / t.isf(0.25, f)) * _NORMAL_MAD) for f in _FREEDOMS)


def _strong(regions: list[Region], reach_mm: float) -> list[Region]:
    """Without what is weaker within a filter's reach of a fault: its side lobes."""
    kept: list[Region] = []
    for region in sorted(regions, key=lambda region: -abs(region.z)):
        if all(math.dist(region.middle_mm, k.middle_mm) > reach_mm or abs(region.z) > _LOBE * abs(k.z) for k in kept):
            kept.append(region)
    return kept
