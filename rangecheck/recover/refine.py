"""Shape from what is left: the heights of a scan, within their noise, that also explain its brightness image.

With q = ln range per cell, the sum of squares

    sum (q - q_scan)^2 / sigma_q^2  +  sum (I(n(q)) - I_seen)^2 / sigma_I^2  +  sum (bend q)^2 / bend_sd^2

is least at the refined heights: range and picture weighted by their own uncertainties (Horn, *Height and gradient from shading*, 1990;
Nehab et al., *Efficiently combining positions and normals for precise 3D geometry*, 2005), bends by how much this surface bends. Solved by
Gauss-Newton with the exact derivative of the shading by the slopes; the picture's residuals by Huber's weights, which leaves out shadows' edges.

bend_sd is taken per place, the smallest for which range minus heights stays noise when averaged over a few cells: where more would be taken
away than noise can be, the surface is let bend more (Lepskii's rule). Noise of neighbours must be independent. A step between neighbours that is steeper than
those beside it by more than noise is an edge across which nothing is smoothed, and the sooner where the picture shows its cells too bright for a slope; two
such cells are parted by any step that is steep. At last the heights are held against the ranges once more: where more was taken away than their noise lets
expect, part of it is given back (Stein's unbiased estimate of the error, which needs no truth).

Albedo and shape cannot be told apart by one picture at fine scale, but at coarse scale the range tells the shape: where the brightness, averaged,
differs from what the range's own shape predicts, the surface is painted, and the picture is not used there (each cell's difference is bounded, so that
folds as narrow as cells are not taken for paint). Where that is too large a share, `refine` refuses. Where heights that suit the picture leave the range
by more than noise, the picture's noise is taken for larger, step by step, until they no longer do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import ScanError
from rangecheck.recover.balance import Balance
from rangecheck.recover.fit import Fitted
from rangecheck.recover.grid import ScanGrid, masked_gauss, scan_grid
from rangecheck.recover.heights import HeightGrid, height_grid
from rangecheck.recover.lamp import lamp_of
from rangecheck.recover.shading import Shading, shading_of
from rangecheck.scan import RangeScan
from rangecheck.scan.noise import estimate_noise, surface_cosines
from rangecheck.surface.surface import MEASURED, Surface

#: cells over which brightness is compared with the shading of the range, and the share by which paint-free brightness may differ there
_COARSE, _PAINT = 5.0, 0.05
#: difference of one cell that counts at most: folds as narrow as cells differ by much, paint is all of one side
_CLIPPED = 0.1
#: difference from which a cell is off, where half of the cells around it are
_SPECK = 0.2
#: cells over which albedo may change without being called paint
_SLOW = 30.0
#: share of the well-lit cells that may be painted before the picture is refused
MOST_PAINTED = 0.35
#: weights of a cell's brightness by its own slopes, and by those of each of its links, of which there are two a cell
_OWN_SHARE, _LINK_SHARE = 1.0, 0.5
#: rounds in which the picture's noise is taken for larger where it strains the range, by this factor; times it from which the picture has no say
_DOUBTS, _DOUBT, _LOST = 6, 2.0, 8.0
#: what is taken away that is no noise of tens of thousands of windows, as _NOISE_SIGMAS and _MOST_ENERGY are of one
_DOUBT_SIGMAS, _DOUBT_ENERGY = 4.0, 2.2
#: share of the brightness that lamp and albedo leave uncertain
_LAMP = 0.01
#: slope, as change of range by distance across, and deviations of noise above it, up to which neighbours are linked; deviations of the difference of two
#: steps from which one that is steeper than both its neighbours is a tear, two thirds of them beside another
_STEEPEST, _STEP_SIGMAS, _TORN_SIGMAS = 5.7, 4.0, 3.0
#: deviations by which a cell is too bright for its slope, those of steps from which one beside such a cell is a tear, and the slope above which two such
#: cells are not linked: stairs of strands as narrow as cells look like one slope to the ranges
_BRIGHTER, _TORN_SIGMAS_FLAT, _STEEPEST_FLAT = 3.0, 0.5, 1.0
#: noise of slanted cells that is believed, in that of cells seen face on, at slants over seven cells; cells over which the refined surface's own slant is
#: averaged
_SLANTED, _OWN_SLANT = 1.25, 3.0
_LEAST_LIGHT, _LEAST_COSINE = 0.25, 0.2


@dataclass(frozen=True, eq=False)
class Refined:
    """A scan refined by its picture.

    scan       the same scan with refined ranges
    refined    (h, w) where the picture had a say;  painted (h, w) where it was well lit but not believed
    moved_mm   (h, w) refined less measured range
    noise_mm   (h, w) the range's standard deviation that was assumed;  picture_noise: that of the brightness, parts of full scale
    fitted     material and lamp
    """

    scan: RangeScan
    refined: BoolArray
    painted: BoolArray
    moved_mm: FloatArray
    noise_mm: FloatArray
    picture_noise: float
    fitted: Fitted | None


def refine(scan: RangeScan, *, fitted: Fitted | None = None, noise_mm: float | None = None, use_picture: bool = True) -> Refined:
    """`scan` refined by its brightness, linear in light.

    fitted: material and lamp, found on the scan itself if not given. noise_mm: of range, estimated from the scan if not given.
    use_picture False: what range and bends alone give. Raises ScanError without brightness, and where albedo varies too much to tell
    shape from paint."""
    grid = scan_grid(scan)
    noise = _noise(scan, noise_mm)
    heights = _heights(scan, grid, noise)
    measured = np.log(scan.range_mm.astype(float)).reshape(-1)[heights.cell]
    sigma = (noise / scan.range_mm).reshape(-1)[heights.cell]
    model = Balance(heights, measured, sigma, _bend_unit(grid, heights))
    q = model.settle()
    if not use_picture:
        q = model.trusted(q, _own_noise(scan, heights, q, noise_mm))
        return _done(scan, heights, q, np.zeros(0, int), np.zeros(0, int), noise, 0.0, None)
    smooth = replace(grid, points=heights.spread(np.exp(q))[..., None] * grid.rays)
    normals, _, _ = heights.slopes.normals(q)
    fitted = fitted or lamp_of(smooth, heights.cell[heights.inner], normals)
    shading = shading_of(fitted, smooth, heights.cell[heights.inner])
    flat = _flat_by_picture(model, heights, shading, grid, normals, q)
    if flat.any():
        heights = _heights(scan, grid, noise, flat)
        model = model.on(heights, _bend_unit(grid, heights))
        q = model.settle()
        smooth = replace(grid, points=heights.spread(np.exp(q))[..., None] * grid.rays)
        normals, _, _ = heights.slopes.normals(q)
        shading = shading_of(fitted, smooth, heights.cell[heights.inner])
    believed, painted, albedo, spread = _believed(heights, shading, grid, normals)
    lit = int(believed.sum() + painted.sum())
    if lit == 0:
        raise ScanError(f"{scan.name}: no cell is lit well enough to be refined by its brightness", name=scan.name)
    if painted.sum() > MOST_PAINTED * lit:
        raise ScanError(
            f"{scan.name}: on {100 * painted.sum() / lit:.0f} % of the well-lit cells the brightness differs from the shading of the scan's own shape by more than "
            f"{100 * _PAINT:.0f} % over {_COARSE:g} cells: the albedo varies too much to tell paint from shape (at most {100 * MOST_PAINTED:.0f} % may); "
            "use the scan unrefined",
            name=scan.name, painted=float(painted.sum() / lit),
        )  # fmt: skip
    # a lamp and an albedo are not known better than a few per cent
    noise_seen = known = np.hypot(spread, _LAMP * shading.seen)
    shading = replace(shading, seen=shading.seen / albedo)
    for _ in range(_DOUBTS):
        # as the slopes come nearer to the truth, so does what bends hide of them
        looks = [
            model.look(q, heights.slopes, shading, np.arange(len(albedo))[:, None], _OWN_SHARE),
            model.look(q, heights.between, shading.between(heights.ends), heights.ends, _LINK_SHARE),
        ]
        q = model.with_picture(q, looks, believed, noise_seen)
        # where picture and range cannot both be right within their noise the picture is believed less: folds as narrow as cells, rims of paint
        doubted = model.strained(q, _DOUBT_SIGMAS, _DOUBT_ENERGY)[heights.inner] & believed
        if not doubted.any():
            break
        noise_seen = np.where(doubted, _DOUBT * noise_seen, noise_seen)
    else:
        believed, painted = believed & ~doubted, painted | doubted
        q = model.with_picture(q, looks, believed, noise_seen)
    q = model.trusted(q, _own_noise(scan, heights, q, noise_mm))
    lost = believed & (noise_seen > _LOST * known)
    believed, painted = believed & ~lost, painted | lost
    return _done(scan, heights, q, heights.inner[believed], heights.inner[painted], noise, spread, fitted)


def linked(scan: RangeScan, noise_mm: FloatArray) -> BoolArray:
    """(h, w) cells whose four neighbours returned and lie on the same surface. noise_mm (h, w): of range."""
    heights = _heights(scan, scan_grid(scan), noise_mm)
    return np.asarray(
        np.isin(np.arange(scan.range_mm.size), heights.cell[heights.inner[heights.whole]]).reshape(scan.range_mm.shape)
    )


def _flat_by_picture(
    model: Balance, heights: HeightGrid, shading: Shading, grid: ScanGrid, normals: FloatArray, q: FloatArray
) -> BoolArray:
    """(h, w) cells that are brighter than they could be at their slopes over the links: a step between two of them is no slope."""
    _, _, albedo, spread = _believed(heights, shading, grid, normals)
    even = replace(shading, seen=shading.seen / albedo)
    unseen = model.look(q, heights.slopes, even, np.arange(len(albedo))[:, None], 1.0).unseen
    predicted, _ = even.at(normals)
    deviation = np.hypot(np.hypot(spread, _LAMP * shading.seen), unseen)
    flat = np.zeros(heights.shape[0] * heights.shape[1], bool)
    flat[heights.cell[heights.inner]] = even.seen - predicted > _BRIGHTER * deviation
    return flat.reshape(heights.shape)


def _heights(scan: RangeScan, grid: ScanGrid, noise: FloatArray, flat: BoolArray | None = None) -> HeightGrid:
    ranges = np.where(grid.valid, scan.range_mm, np.nan).astype(float)
    share = noise / np.nan_to_num(scan.range_mm, nan=1.0)
    sigmas = _TORN_SIGMAS if flat is None else np.where(flat, _TORN_SIGMAS_FLAT, _TORN_SIGMAS)
    torn = sigmas * np.sqrt(6.0) * share
    steepest = _STEEPEST if flat is None else np.where(flat, _STEEPEST_FLAT, _STEEPEST)
    return height_grid(ranges, grid.rays, steepest, _STEP_SIGMAS * share, torn)


def _noise(scan: RangeScan, noise_mm: float | None) -> FloatArray:
    """(h, w) standard deviation of each range."""
    if noise_mm is not None:
        return np.full(scan.range_mm.shape, float(noise_mm))
    found = estimate_noise(scan)
    cosine = surface_cosines(scan, 4.0 * found.normal_mm, window=3)
    ranges = np.nan_to_num(scan.range_mm, nan=found.reference_mm)
    # where steep cells bend more than they are noisy their noise is overrated, and detail would go with it
    return np.minimum(found.sigma_mm(ranges, np.nan_to_num(cosine, nan=1.0)), _SLANTED * found.sigma_mm(ranges))


def _own_noise(scan: RangeScan, heights: HeightGrid, q: FloatArray, noise_mm: float | None) -> FloatArray:
    """(n,) standard deviation of ln range at the slants of the refined surface itself, which folds do not make steeper than it is.

    Averaged over a few cells: one cell's slant is steeper by what errs in it, and where more was smoothed away than noise, noise would seem larger."""
    cells = heights.cell
    ranges = scan.range_mm.reshape(-1)[cells].astype(float)
    if noise_mm is not None:
        return np.asarray(noise_mm / ranges)
    found = estimate_noise(scan)
    normals, _, _ = heights.slopes.normals(q)
    one, weight = np.zeros(len(cells)), np.zeros(len(cells))
    one[heights.inner], weight[heights.inner] = -(normals * heights.slopes.rays).sum(1), 1.0
    cosine = masked_gauss(heights.spread(one, 0.0), heights.spread(weight, 0.0), _OWN_SLANT).reshape(-1)[cells]
    slanted = np.where(np.isfinite(cosine), found.sigma_mm(ranges, cosine), _SLANTED * found.sigma_mm(ranges))
    return np.asarray(slanted / ranges)


def _bend_unit(grid: ScanGrid, heights: HeightGrid) -> FloatArray:
    """Second difference of q of a surface of curvature 1/mm seen face on, per bend."""
    ranges = np.linalg.norm(grid.points.reshape(-1, 3)[heights.cell], axis=1)
    return np.asarray((heights.spacing * ranges)[heights.bend_cell])


def _believed(
    heights: HeightGrid, shading: Shading, grid: ScanGrid, normals: FloatArray
) -> tuple[BoolArray, BoolArray, FloatArray, float]:
    """Of the inner cells: (those whose brightness is shading, those that look painted, slow albedo relative to the fit's, picture noise)."""
    from scipy.ndimage import maximum_filter

    seen = shading.seen
    predicted, _ = shading.at(normals)
    facing = -(normals * heights.slopes.rays).sum(1)
    bright = _LEAST_LIGHT * float(np.quantile(predicted, 0.95))
    lit = (predicted > bright) & (facing > _LEAST_COSINE) & (seen > 0.2 * bright) & (seen < shading.saturation)
    cell = heights.cell[heights.inner]

    def spread(values: FloatArray) -> FloatArray:
        grid_values = np.zeros(heights.shape[0] * heights.shape[1])
        grid_values[cell] = values
        return grid_values.reshape(heights.shape)

    weight = spread(lit.astype(float))
    apart = spread(np.where(lit, np.log(np.maximum(seen, 1e-9) / np.maximum(predicted, 1e-9)), 0.0))
    # grain of paint, dark and bright, averages out, but most of its cells are off
    speckled = masked_gauss((np.abs(apart) > _SPECK).astype(float), weight, _COARSE) > 0.5
    apart = np.clip(apart, -_CLIPPED, _CLIPPED)
    coarse = masked_gauss(apart, weight, _COARSE)
    slow = coarse
    for _ in range(3):
        kept = weight * (np.abs(np.nan_to_num(coarse - slow)) < _PAINT)
        found = masked_gauss(apart, kept, _SLOW)
        slow = np.where(np.isfinite(found), found, 0.0)
    odd = (weight > 0) & (~(np.abs(coarse - slow) < _PAINT) | speckled)
    odd = maximum_filter(odd.astype(np.uint8), size=2 * round(_COARSE) + 1) > 0
    painted = lit & odd.reshape(-1)[cell]
    albedo = np.exp(slow.reshape(-1)[cell])
    return lit & ~painted, painted, albedo, _picture_noise(grid.picture, spread(lit.astype(float)) > 0)


def _picture_noise(picture: FloatArray, where: BoolArray) -> float:
    """Standard deviation of the picture's finest structure (Immerkaer 1996), which noise and texture both are."""
    from scipy.ndimage import convolve, minimum_filter

    mask = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
    answer = convolve(np.nan_to_num(picture), mask)
    inside = minimum_filter(where.astype(np.uint8), size=3) > 0
    return float(np.median(np.abs(answer[inside])) / 0.6744897501960817) if inside.any() else 0.01


def _done(
    scan: RangeScan, heights: HeightGrid, q: FloatArray, refined: IntArray, painted: IntArray, noise: FloatArray, spread: float,
    fitted: Fitted | None,
) -> Refined:  # fmt: skip
    ranges = heights.spread(np.exp(q))
    h, w = heights.shape

    def mask(cells: IntArray) -> BoolArray:
        flat = np.zeros(h * w, bool)
        flat[heights.cell[cells]] = True
        return flat.reshape(h, w)

    better = replace(scan, range_mm=np.where(scan.valid, ranges, np.nan).astype(np.float32))
    return Refined(better, mask(refined), mask(painted), ranges - scan.range_mm, noise, spread, fitted)


def refined_faces(surface: Surface, refined: Sequence[Refined], reach_mm: float) -> BoolArray:
    """(m,) which measured faces of a surface stand on refined cells: their middles lie within `reach_mm`, along the ray, of a cell that the picture had a
    say in. World frame."""
    found = np.zeros(len(surface.faces), bool)
    middles = surface.triangles.mean(axis=1)
    for one in refined:
        scan = one.scan
        uv, away = scan.camera.project(rigid.move_points(rigid.inverse(scan.world_from_scan), middles))
        inside = np.isfinite(uv).all(axis=1) & np.isfinite(away)
        column, row = (np.rint(np.where(inside, uv[:, k], -1.0)).astype(np.int64) for k in (0, 1))
        h, w = scan.range_mm.shape
        inside &= (row >= 0) & (row < h) & (column >= 0) & (column < w)
        at = np.flatnonzero(inside)
        cells = row[at], column[at]
        found[at] |= one.refined[cells] & (np.abs(scan.range_mm[cells] - away[at]) < reach_mm)
    return found & (surface.origin_of_face == MEASURED)
