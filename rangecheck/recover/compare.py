"""Does the scan explain its own brightness image? Relief that the scan has and the picture does not show, or the other way, by matched filters.

Let d = ln(seen / predicted), what is left after material and lamp were fitted on the scan's own surface. A false relief f (mm of range) of the scan
changes ln predicted by t = g . grad f, with g the derivative of shading by slope, and d by -t. Of each place

    a = - sum w d t / sum w t^2        mm of the template there        z = a / its standard deviation

is the most likely amount of a template f: dents of two radii and, for pieces badly joined, steps of eight directions. The same with a spot of paint in
place of t says whether albedo explains the place better. Slow changes (paint, stray light) are taken from d and templates alike; w is one over the
local variance of d. The noise of z is that of z over the picture itself, its tails those of Student's law with the degrees of freedom that its quantiles
show, and the level is Bonferroni's for as many places as templates fit into what is judged.

What cannot be judged is said: a cell counts as judged only where a dent of JUDGED_MM would be named. On a painted surface that may be nowhere.
Scan frame, millimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.recover.fit import Fitted
from rangecheck.recover.grid import ScanGrid, masked_gauss, scan_grid, turned_normals
from rangecheck.recover.lamp import lamp_of
from rangecheck.recover.regions import Region, inner, regions_of
from rangecheck.recover.shading import Shading, shading_of
from rangecheck.scan import RangeScan

#: radii of dents and of steps' discs, in the larger of 1 mm and half the scale of normals;  broad mean, in radii
_RADII, _BROAD = (4.0, 8.0), 1.0
_DIRECTIONS = 8
#: a cell is judged where a dent this deep would be named;  chance of one false name per scan that the level is for
JUDGED_MM, CHANCE = 1.0, 0.01
#: less than this is not named: lamp and smoothing are not known well enough
LEAST_MM = 0.2
_LEAST_COSINE, _LEAST_LIGHT, _LEAST_SEEN = 0.35, 0.25, 0.35
#: share of the light that is mirrored, from which a place is a highlight
_GLOSSY = 0.4
#: of a fault's z, what its filter's side lobes may reach
_LOBE = 0.5
_NORMAL_MAD = 0.6744897501960817
#: what lies further out than this many deviations is what is looked for, not what it is judged by
_CAPPED = 3.0


@dataclass(frozen=True, eq=False)
class Comparison:
    """regions, the worst first;  z (h, w) of the strongest template, NaN where nothing was compared;  amount_mm (h, w) of it;  least_mm (h, w) the dent that
    would be named there;  residual (h, w) = ln(seen/predicted);  judged: share of the valid cells;  level: |z| from which a place is named;
    paint: spread of the residual in the scale of dents;  fitted;  grid"""

    regions: tuple[Region, ...]
    z: FloatArray
    amount_mm: FloatArray
    least_mm: FloatArray
    residual: FloatArray
    judged: float
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
    dark = np.nan_to_num(grid.picture) < _LEAST_SEEN * np.nan_to_num(predicted)
    used = keep & bright & ~dark & (np.nan_to_num(grid.picture) < shading.saturation)
    # at rims normals and means are one-sided
    used &= inner(keep, 2.0 * scale / grid.spacing_mm)
    residual = np.where(used, np.log(np.where(used, grid.picture, 1.0)) - np.log(np.where(used, predicted, 1.0)), np.nan)
    filters = _Filters(residual, used, slopes)
    unit_cells = max(1.0, 0.5 * scale) / grid.spacing_mm
    best = np.zeros(used.shape)
    amount = np.zeros(used.shape)
    stepped = np.zeros(used.shape, bool)
    least = np.full(used.shape, np.inf)
    # nearer to rims the slow part is the mean of one side
    compared = inner(used, 1.5 * _RADII[0] * unit_cells)
    level = 0.0
    for radius in (r * unit_cells for r in _RADII):
        spread = scale / grid.spacing_mm
        shapes = [(_dent(radius, spread), False), *((t, True) for t in _steps(radius, spread))]
        for template, is_step in shapes:
            z, a, sd = filters.relief(template, radius, compared)
            here = _level(z[compared], compared.sum() / (math.pi * radius**2), len(_RADII) * (1 + _DIRECTIONS))
            level = max(level, here)
            if not is_step:
                least = np.minimum(least, np.maximum(here * sd, LEAST_MM))
            stronger = np.abs(z) > np.abs(best)
            best, amount, stepped = (
                np.where(stronger, z, best),
                np.where(stronger, a, amount),
                np.where(stronger, is_step, stepped),
            )
    paint = np.zeros(used.shape)
    for radius in (r * unit_cells for r in _RADII):
        z = filters.paint(radius, compared)
        paint = np.where(np.abs(z) > np.abs(paint), z, paint)
    judged = compared & (least < JUDGED_MM)
    wrong = judged & (np.abs(best) > level) & (np.abs(amount) > LEAST_MM)
    regions = _classed(
        wrong,
        best,
        stepped,
        paint,
        dark & keep,
        fitted,
        shading,
        cell,
        predicted,
        grid,
        (_RADII[0] * unit_cells * grid.spacing_mm),
    )
    share = float(judged.sum() / max(1, grid.valid.sum()))
    best, amount, least = (np.where(compared, v, np.nan) for v in (best, amount, least))
    return Comparison(regions, best, amount, least, residual, share, level, filters.spread, fitted, grid)


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


class _Filters:
    """The residual, less its slow part, ready to be projected on templates."""

    def __init__(self, residual: FloatArray, used: BoolArray, slopes: tuple[FloatArray, FloatArray]) -> None:
        self.residual, self.used = np.nan_to_num(residual), used.astype(float)
        self.g_u, self.g_v = (np.where(used, g, 0.0) for g in slopes)
        self.spread = 0.0

    def _left(self, radius: float) -> tuple[FloatArray, FloatArray]:
        """The residual without what changes slower than templates do, and its weight, one over the local variance."""
        slow = np.nan_to_num(masked_gauss(self.residual, self.used, _BROAD * radius))
        d = (self.residual - slow) * self.used
        far = d[self.used > 0.0]
        self.spread = float(np.median(np.abs(far))) / _NORMAL_MAD if far.size else 1.0
        most = (_CAPPED * self.spread) ** 2
        local = np.nan_to_num(masked_gauss(np.minimum(d * d, most), self.used, 4.0 * radius), nan=most)
        return d, self.used / np.maximum(local, 0.05 * self.spread**2 + 1e-12)

    def relief(self, template: FloatArray, radius: float, compared: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """z, most likely amount and its standard deviation (mm) of a template (its relief per mm) about each cell."""
        d, w = self._left(radius)
        whole = _without_slow(template, radius)
        f_v, f_u = (np.asarray(np.gradient(whole, axis=axis)) for axis in (0, 1))
        top = _correlated(w * d * self.g_u, f_u) + _correlated(w * d * self.g_v, f_v)
        energy = _correlated(w * self.g_u**2, f_u**2) + _correlated(w * self.g_v**2, f_v**2)
        energy = np.maximum(energy + 2.0 * _correlated(w * self.g_u * self.g_v, f_u * f_v), 1e-12)
        z = -top / np.sqrt(energy)
        unit = _unit(z[compared])
        return z / unit, -top / energy, unit / np.sqrt(energy)

    def paint(self, radius: float, compared: BoolArray) -> FloatArray:
        """z of a spot of another albedo about each cell."""
        d, w = self._left(radius)
        spot = _without_slow(_dent(radius, 1.0), radius)
        z = _correlated(w * d, spot) / np.sqrt(np.maximum(_correlated(w, spot**2), 1e-12))
        return np.asarray(z / _unit(z[compared]))


def _unit(z: FloatArray) -> float:
    return max(float(np.median(np.abs(z))) / _NORMAL_MAD, 1e-12) if z.size else 1.0


def _level(z: FloatArray, places: float, templates: int) -> float:
    """|z| that nothing of this scan's noise passes but with CHANCE: by Student's law with the tails that z itself has up to its last twentieth."""
    from scipy.stats import t

    chance = CHANCE / (2.0 * max(1.0, places) * templates)
    if z.size < 1000:
        return float(t.isf(chance, 30.0))
    tail = float(np.quantile(np.abs(z), 0.95))
    # quantile over median of |t| falls with the degrees of freedom
    for freedom in (100.0, 50.0, 30.0, 20.0, 15.0, 12.0, 10.0):
        if float(t.isf(0.025, freedom) / t.isf(0.25, freedom)) * _NORMAL_MAD >= tail:
            break
    return float(t.isf(chance, freedom) / t.isf(0.25, freedom)) * _NORMAL_MAD


def _mesh(radius: float) -> tuple[FloatArray, FloatArray]:
    reach = math.ceil(2.5 * radius)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1].astype(float)
    return x, y


def _dent(radius: float, smoothing: float) -> FloatArray:
    """A raised cosine of this radius (cells), as normals smoothed over `smoothing` cells show it."""
    from scipy.ndimage import gaussian_filter

    x, y = _mesh(radius)
    apart = np.minimum(np.hypot(x, y) / radius, 1.0)
    return np.asarray(gaussian_filter(0.5 * (1.0 + np.cos(math.pi * apart)), smoothing))


def _steps(radius: float, smoothing: float) -> list[FloatArray]:
    """Steps across a disc of this radius in _DIRECTIONS directions; what leads up to them fades slowly."""
    from scipy.ndimage import gaussian_filter

    x, y = _mesh(radius)
    fade = np.exp(-0.5 * (np.hypot(x, y) / radius) ** 2)
    angles = np.arange(_DIRECTIONS) * math.pi / _DIRECTIONS
    return [np.asarray(gaussian_filter(np.sign(math.cos(a) * x + math.sin(a) * y), smoothing)) * 0.5 * fade for a in angles]


def _without_slow(template: FloatArray, radius: float) -> FloatArray:
    from scipy.ndimage import gaussian_filter

    return np.asarray(template - gaussian_filter(template, _BROAD * radius, truncate=3.0))


def _correlated(field: FloatArray, kernel: FloatArray) -> FloatArray:
    from scipy.signal import fftconvolve

    return np.asarray(fftconvolve(field, kernel[::-1, ::-1], mode="same"))


def _classed(
    wrong: BoolArray, z: FloatArray, stepped: FloatArray, paint: FloatArray, shadow: BoolArray, fitted: Fitted, shading: Shading,
    cell: np.ndarray, predicted: FloatArray, grid: ScanGrid, least_mm: float,
) -> tuple[Region, ...]:  # fmt: skip
    from scipy.ndimage import binary_dilation, maximum_filter

    glossy = _glossy(fitted, shading, cell, predicted, grid)
    near, in_reach = (binary_dilation(shadow, iterations=max(1, round(r * least_mm / grid.spacing_mm))) for r in (0.5, 2.5))
    # a spot's rim looks like relief: its middle tells that it is paint
    stained = maximum_filter(np.abs(paint), size=2 * round(2.0 * least_mm / grid.spacing_mm) + 1)
    found = []
    for region, cells in regions_of(wrong, z, grid.points, grid.spacing_mm, 0.25 * math.pi * (0.5 * least_mm) ** 2):
        at = region.cell
        if near[cells].mean() > 0.5:
            kind = "shadow edge"
        elif glossy[cells].mean() > 0.5:
            kind = "highlight"
        elif stained[at] > abs(region.z):
            # what is darker beside a shadow is its penumbra
            kind = "shadow edge" if in_reach[at] else "albedo"
        else:
            # a step is where steps explain most places best
            kind = "registration" if stepped[at] and stepped[cells].mean() > 0.5 else "shape"
        found.append(replace(region, kind=kind))
    # what is weaker within a filter's reach of a fault is its side lobe
    kept: list[Region] = []
    reach = 2.5 * _RADII[1] / _RADII[0] * least_mm
    for region in sorted(found, key=lambda region: -abs(region.z)):
        if all(math.dist(region.middle_mm, k.middle_mm) > reach or abs(region.z) > _LOBE * abs(k.z) for k in kept):
            kept.append(region)
    return tuple(kept)


def _glossy(fitted: Fitted, shading: Shading, cell: np.ndarray, predicted: FloatArray, grid: ScanGrid) -> BoolArray:
    """(h, w) where the fitted lobe gives much of the light."""
    guess = fitted.problem.material
    photo = shading.problem.photographs[0]
    # Lambert's share alone: the rest is mirrored
    light = fitted.problem.lights[0]
    towards = light.centre_mm - photo.sight.points
    away = np.linalg.norm(towards, axis=1)
    normals = turned_normals(grid, 3.0 * grid.spacing_mm)[0].reshape(-1, 3)[cell]
    cosine = np.maximum((normals * towards).sum(1) / away, 0.0)
    matt = photo.exposure * guess.K_lm / math.pi * light.irradiance * cosine * (light.distance_mm / away) ** 2
    full = np.zeros(grid.valid.size, bool)
    full[cell] = np.nan_to_num(1.0 - matt / np.maximum(predicted.reshape(-1)[cell], 1e-9)) > _GLOSSY
    return full.reshape(grid.valid.shape)
