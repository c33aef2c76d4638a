"""Places that bend unlike their smooth surroundings, found in normals that pictures of a surface tell: no sound surface is needed.

What a hollow (or bump) of Gaussian form explains of each place's slopes, beyond what a smooth form does (`hollow_fit`), is held against how
much of that other places of the same surface show: beyond their median the number of ratios falls exponentially, which tells how many
would reach a ratio by chance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rangecheck.animation.hollow_fit import matched
from rangecheck.animation.measured_normals import MeasuredNormals
from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import in_chunks
from rangecheck.maps import Maps
from rangecheck.optics import PinholeCamera
from rangecheck.surface import Surface

#: half widths of what is looked for, mm: wider hollows, such as that of the throat, are form
HALF_WIDTHS_MM = (1.0, 1.5, 2.0)
#: in half widths: what a place is fitted over, the cells in which normals are averaged, and how far places lie APART
REACH, CELL, APART = 4.0, 0.5, 2.0
#: places that stand out by chance, expected of a whole surface
FALSE_PLACES = 0.05
#: the least share of what the polynomial leaves that the hollow must explain, however rare that is: where noise is most of what is left, few
#: places tell how high clutter reaches
EXPLAINED = 0.75
#: largest share of the places beyond the median that do not tell how fast their number falls: they may be defects; fewest that tell it
DEFECTS, FEWEST = 0.05, 20
_PLACES_PER_CHUNK = 512


@dataclass(frozen=True, eq=False)
class Look:
    """The places of a surface, looked at for one half width.

    points_mm (k, 3); ratios (k,) of the hollow to what is left around it; depths_mm (k,), below 0 a bump; median: of the ratios; rate: mean of
    what ratios exceed it by; looks: with how many half widths the surface was looked at"""

    half_width_mm: float
    points_mm: FloatArray = field(repr=False)
    ratios: FloatArray = field(repr=False)
    depths_mm: FloatArray = field(repr=False)
    median: float
    rate: float
    looks: int = 1

    def expected(self, ratio: float) -> float:
        """How many places of the whole surface reach this ratio by chance, for all half widths together; infinite where too few tell."""
        if not math.isfinite(self.rate):
            return math.inf
        return 0.5 * self.looks * len(self.ratios) * math.exp(-max(ratio - self.median, 0.0) / self.rate)

    @property
    def threshold(self) -> float:
        """The ratio that FALSE_PLACES places are expected to reach by chance, at least that of EXPLAINED; infinite where too few tell."""
        if not math.isfinite(self.rate):
            return math.inf
        rare = self.median + self.rate * math.log(max(0.5 * self.looks * len(self.ratios) / FALSE_PLACES, 1.0))
        return max(rare, math.sqrt(EXPLAINED / (1 - EXPLAINED)))


@dataclass(frozen=True)
class Spot:
    """Where a surface bends unlike its surroundings: middle, half width and depth (below 0: a bump), mm; its ratio to what is left around
    it; what it takes to be named; and how many places of the surface would reach this by chance."""

    centre_mm: tuple[float, float, float]
    half_width_mm: float
    depth_mm: float
    ratio: float
    asked: float
    by_chance: float


class _Along:
    """Averages along a surface, from vertex to vertex."""

    def __init__(self, surface: Surface) -> None:
        from scipy.sparse import coo_matrix, diags

        faces, count = surface.faces, len(surface.vertices)
        rows, columns = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
        ones = np.ones(2 * len(rows))
        near = coo_matrix((ones, (np.r_[rows, columns], np.r_[columns, rows])), shape=(count, count)).tocsr()
        near.data[:] = 1.0
        degree = np.maximum(np.asarray(near.sum(axis=1)).ravel(), 1.0)
        edges = surface.vertices[rows] - surface.vertices[columns]
        self._step2 = float((edges * edges).sum(axis=1).mean())
        self._mean = (diags(0.5 / degree) @ near + diags(np.full(count, 0.5))).tocsr()

    def averaged(self, values: FloatArray, length_mm: float) -> FloatArray:
        """`values` of the vertices averaged over `length_mm`, one standard deviation."""
        # each sweep spreads by half the mean square of an edge, over two axes
        for _ in range(max(1, round(length_mm**2 / (self._step2 / 4)))):
            values = self._mean @ values
        return values


def normals_around(surface: Surface, length_mm: float) -> FloatArray:
    """(n, 3) unit normals that the surroundings of each vertex suggest, averaged along the surface over `length_mm`."""
    normals = _Along(surface).averaged(np.asarray(surface.vertex_normals, np.float64), length_mm)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def look_at_places(measured: MeasuredNormals, half_widths_mm: Sequence[float] = HALF_WIDTHS_MM) -> list[Look]:
    """A look for each half width at what pictures tell of a surface's normals."""
    return [_look(_in_cells(measured, CELL * w), w, len(half_widths_mm)) for w in half_widths_mm]


def _in_cells(measured: MeasuredNormals, cell_mm: float) -> MeasuredNormals:
    """The mean point and normal of each cell of a grid; sides that face otherwise are kept apart."""
    if not len(measured.points_mm):
        return measured
    cells = np.floor(measured.points_mm / cell_mm).astype(np.int64)
    axis = np.abs(measured.normals).argmax(axis=1)
    faces = 2 * axis + (np.take_along_axis(measured.normals, axis[:, None], axis=1)[:, 0] > 0)
    cells -= cells.min(axis=0)
    high = cells.max(axis=0) + 1
    number = ((cells[:, 0] * high[1] + cells[:, 1]) * high[2] + cells[:, 2]) * 6 + faces
    cell = np.unique(number, return_inverse=True)[1]
    weight = 1 / measured.noise_rad**2
    total = np.bincount(cell, weight)

    def mean(values: FloatArray) -> FloatArray:
        return np.stack([np.bincount(cell, weight * values[:, k]) / total for k in range(3)], axis=1)

    normals = mean(measured.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    noise = np.stack([np.bincount(cell, weight * weight * row) / total**2 for row in measured.covariance.T], axis=1)
    return MeasuredNormals(mean(measured.points_mm), normals, noise)


def _look(cells: MeasuredNormals, half_width_mm: float, looks: int) -> Look:
    from scipy.spatial import cKDTree

    points, count = cells.points_mm, len(cells.points_mm)
    if not count:
        return look_of(half_width_mm, np.empty((0, 3)), np.empty(0), np.empty(0), looks)
    tree = cKDTree(points)
    weight = 1 / cells.noise_rad**2
    # weights tell which normals are surer than others, and stay of the size of one
    weight /= weight.mean()
    ratios, depths = np.full(count, np.nan), np.full(count, np.nan)

    def chunk(start: int, stop: int) -> None:
        near = tree.query_ball_point(points[start:stop], REACH * half_width_mm, return_sorted=True)
        begins = np.r_[0, np.cumsum([len(who) for who in near])].astype(np.int64)
        who = np.concatenate([np.array(some, np.int64) for some in near])
        here = slice(start, stop)
        matched(
            points,
            cells.normals,
            cells.covariance,
            weight,
            start,
            begins,
            who,
            REACH * half_width_mm,
            half_width_mm,
            ratios[here],
            depths[here],
        )

    in_chunks(chunk, count, _PLACES_PER_CHUNK)
    judged = np.flatnonzero(np.isfinite(ratios))
    highest = judged[_highest(points[judged], ratios[judged], APART * half_width_mm)]
    return look_of(half_width_mm, points[highest], ratios[highest], depths[highest], looks)


def look_of(
    half_width_mm: float, points_mm: FloatArray, ratios: FloatArray, depths_mm: FloatArray | None = None, looks: int = 1
) -> Look:
    """The look, with how fast the number of its places falls beyond their median."""
    median = float(np.median(ratios)) if len(ratios) else 0.0
    depths = np.zeros(len(ratios)) if depths_mm is None else depths_mm
    return Look(half_width_mm, points_mm, ratios, depths, median, _rate(np.sort(ratios[ratios > median] - median)), looks)


def _rate(beyond: FloatArray) -> float:
    """Mean of an exponential law from sorted values of which the highest count as if they only were no lower than those below them."""
    kept = len(beyond) - math.ceil(DEFECTS * len(beyond))
    if kept < FEWEST:
        return math.inf
    return float(beyond[:kept].sum() + (len(beyond) - kept) * beyond[kept - 1]) / kept


def _highest(points: FloatArray, ratios: FloatArray, apart_mm: float) -> IntArray:
    """Places whose ratio none exceeds within `apart_mm`."""
    from scipy.spatial import cKDTree

    if not len(points):
        return np.empty(0, np.int64)
    pairs = cKDTree(points).query_pairs(apart_mm, output_type="ndarray")
    highest = np.ones(len(points), bool)
    a, b = pairs[:, 0], pairs[:, 1]
    highest[a[ratios[a] < ratios[b]]] = False
    highest[b[ratios[b] < ratios[a]]] = False
    return np.flatnonzero(highest)


def pixel_width_mm(maps: Maps) -> float:
    """Width of a pixel at the median depth."""
    assert isinstance(maps.camera, PinholeCamera)
    return float(np.nanmedian(maps.depth_mm)) / maps.camera.fx if maps.hit.any() else 1.0


def spots(looks: Sequence[Look]) -> list[Spot]:
    """Places that reach what is asked, the least likely by chance first, each once within reach of the wider."""
    found: list[Spot] = []
    for look in looks:
        for point, ratio, depth in zip(look.points_mm, look.ratios, look.depths_mm):
            by_chance = look.expected(float(ratio))
            if ratio >= look.threshold:
                x, y, z = (float(c) for c in point)
                found.append(Spot((x, y, z), look.half_width_mm, float(depth), float(ratio), look.threshold, by_chance))
    kept: list[Spot] = []
    for spot in sorted(found, key=lambda spot: (spot.by_chance, spot.centre_mm)):
        if all(math.dist(spot.centre_mm, o.centre_mm) > REACH * max(spot.half_width_mm, o.half_width_mm) for o in kept):
            kept.append(spot)
    return kept
