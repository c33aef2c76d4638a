"""What people look for when a bust turns before them: speckle, jumping highlights, outlines that do not fit - measured.

Slope noise is how far a facet's normal departs from those around it beyond what smooth curvature explains: residual of a linear fit of
the normals over the nearest facets, divided by its own leverage, so that white noise is measured without bias. A mirror doubles it:
highlights jump by twice the angle. Height noise is the same for vertices about the quadric of their neighbours. Both are at the scale of
the facets; features as fine as the facets count as noise, since nothing in the surface tells them apart.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.basis import frame_around
from rangecheck.errors import SurfaceError
from rangecheck.kernels import in_chunks, kernel, thread_count
from rangecheck.maps import Maps, trace_maps
from rangecheck.maps.trace import Caster
from rangecheck.scan import RangeScan
from rangecheck.surface import Surface

#: facets around each that its normal is compared with
NEIGHBOURS = 36
#: facets that lean further than this from it belong to another side or feature
ALIKE = math.cos(math.radians(50))
#: a place is flagged where its slope residual exceeds this many times the surface's own level
FLAGGED_TIMES = 6.0
_FACES_PER_CHUNK = 4096


@dataclass(frozen=True)
class Place:
    """Where something stands out: middle and diameter in mm, largest departure in degrees, number of facets."""

    centre_mm: tuple[float, float, float]
    size_mm: float
    peak_deg: float
    facets: int


@dataclass(frozen=True, eq=False)
class Consistency:
    """Slope and height noise of the facets that were seen.

    slope_noise_deg   robust standard error: the area-weighted median of the residual angles, scaled as for a two-dimensional normal law
    slope_rms_deg     area-weighted RMS, features and defects included
    height_noise_mm   robust, of the vertices about local quadrics
    highlight_jump_deg  by how much a mirrored highlight jumps from facet to facet: twice the slope noise
    residual_deg      (m,) per facet of the surface, NaN where not seen or without enough neighbours
    places            flagged places, worst first
    """

    slope_noise_deg: float
    slope_rms_deg: float
    height_noise_mm: float
    facets: int
    residual_deg: FloatArray = field(repr=False)
    places: tuple[Place, ...] = ()

    @property
    def highlight_jump_deg(self) -> float:
        """Mean jump of a mirrored highlight, degrees."""
        return 2.0 * self.slope_noise_deg


def faces_seen(frames: Iterable[Maps], count: int) -> IntArray:
    """(count,) int64 in how many pixels of the frames each of the surface's faces was seen."""
    total = np.zeros(count, np.int64)
    for maps in frames:
        total += np.bincount(maps.face[maps.hit], minlength=count)
    return total


def measure_consistency(surface: Surface, seen: IntArray | BoolArray | None = None, *, most: int | None = None) -> Consistency:
    """Slope and height noise over the faces with `seen` > 0 (all by default), and the places that stand out.

    With `most`, about so many of them, evenly spread, are judged, each among all of its neighbours; then `residual_deg` is known of
    these alone, and a place needs to be seen by several of them. Raises SurfaceError when fewer than NEIGHBOURS facets have area and
    were seen."""
    from scipy.spatial import cKDTree

    chosen: BoolArray = np.ones(len(surface.faces), bool) if seen is None else np.asarray(seen, np.int64) > 0
    used = np.flatnonzero(chosen & (surface.face_areas > 0))
    if len(used) < NEIGHBOURS:
        raise SurfaceError(
            f"{len(used)} facets were seen; at least {NEIGHBOURS} are needed to tell noise from shape", facets=len(used)
        )
    normals, middles = surface.face_normals[used], surface.triangles[used].mean(axis=1)
    judged = _spread(len(used), most)
    near = cKDTree(middles).query(middles[judged], NEIGHBOURS, workers=thread_count())[1]
    part = surface.part_of_face[used]
    slope, unused = np.full(len(judged), np.nan), np.empty(len(judged))

    def chunk(start: int, stop: int) -> None:
        here = slice(start, stop)
        _residuals(normals, middles, part, near[here], judged[here], ALIKE, slope[here], unused[here])

    in_chunks(chunk, len(judged), _FACES_PER_CHUNK)
    heights = _vertex_heights(surface, np.unique(surface.faces[used]), most)
    area = surface.face_areas[used][judged]
    known = np.isfinite(slope)
    if not known.any():
        raise SurfaceError("no facet has enough neighbours on its own side; the surface is too coarse to tell noise from shape")
    # median of a Rayleigh law is sqrt(2 ln 2) per axis; the angle's RMS is sqrt(2) per axis
    level = _weighted_median(slope[known], area[known]) / math.sqrt(math.log(2.0))
    residual = np.full(len(surface.faces), np.nan)
    residual[used[judged]] = np.degrees(slope)
    if len(judged) < len(used):
        near = cKDTree(middles[judged]).query(middles[judged], min(NEIGHBOURS, len(judged)))[1]
    return Consistency(
        slope_noise_deg=math.degrees(level),
        slope_rms_deg=math.degrees(math.sqrt(float(np.average(slope[known] ** 2, weights=area[known])))),
        height_noise_mm=1.4826 * float(np.median(np.abs(heights))) if len(heights) else math.nan,
        facets=int(known.sum()),
        residual_deg=residual,
        places=_places(middles[judged], slope, near, FLAGGED_TIMES * level),
    )


def _spread(count: int, most: int | None) -> IntArray:
    """Every k-th of so many, about `most` of them."""
    return np.arange(0, count, max(1, -(-count // most)) if most else 1)


def _vertex_heights(surface: Surface, used: IntArray, most: int | None) -> FloatArray:
    """(n,) standardised heights, mm, of the vertices `used` over the quadrics of their neighbours, where they have enough."""
    from scipy.spatial import cKDTree

    if len(used) < NEIGHBOURS:
        return np.empty(0)
    points, normals = surface.vertices[used], surface.vertex_normals[used]
    judged = _spread(len(used), most)
    near = cKDTree(points).query(points[judged], NEIGHBOURS, workers=thread_count())[1]
    height, unused = np.full(len(judged), np.nan), np.empty(len(judged))
    part = np.zeros(len(used), np.int32)

    def chunk(start: int, stop: int) -> None:
        here = slice(start, stop)
        _residuals(normals, points, part, near[here], judged[here], ALIKE, unused[here], height[here])

    in_chunks(chunk, len(judged), _FACES_PER_CHUNK)
    return height[np.isfinite(height)]


@kernel
def _solved_first(gram, p):
    """First column of the inverse of the symmetric positive gram[:p, :p], left in gram[:p, p]; False where it is singular."""
    for i in range(p):
        gram[i, p] = 1.0 if i == 0 else 0.0
    for i in range(p):
        if gram[i, i] < 1e-9:
            return False
        for k in range(i + 1, p):
            share = gram[k, i] / gram[i, i]
            for j in range(i, p + 1):
                gram[k, j] -= share * gram[i, j]
    for i in range(p - 1, -1, -1):
        for j in range(i + 1, p):
            gram[i, p] -= gram[i, j] * gram[j, p]
        gram[i, p] /= gram[i, i]
    return True


@kernel
def _residuals(normals, middles, part, near, judged, alike, slope, height):
    """Angle between each normal and what a linear fit of its neighbours' predicts, and height of each middle over their quadric.

    Both are divided by sqrt(1 - leverage). Coordinates lie in the plane of the neighbourhood's mean normal, so that one odd facet does
    not tilt its own frame; the facet itself is the origin."""
    count = near.shape[1]
    gram = np.empty((6, 7))
    row = np.empty(6)
    for i in range(len(slope)):
        me = judged[i]
        slope[i], height[i] = np.nan, np.nan
        mx, my, mz, used = 0.0, 0.0, 0.0, 0
        for k in range(count):
            j = near[i, k]
            cosine = normals[me, 0] * normals[j, 0] + normals[me, 1] * normals[j, 1] + normals[me, 2] * normals[j, 2]
            if cosine > alike and part[j] == part[me]:
                mx, my, mz, used = mx + normals[j, 0], my + normals[j, 1], mz + normals[j, 2], used + 1
        if used < 6:
            continue
        length = math.sqrt(mx * mx + my * my + mz * mz)
        mx, my, mz = mx / length, my / length, mz / length
        ux, uy, uz, vx, vy, vz = frame_around(mx, my, mz)
        spread = 0.0
        for k in range(count):
            j = near[i, k]
            dx, dy, dz = middles[j, 0] - middles[me, 0], middles[j, 1] - middles[me, 1], middles[j, 2] - middles[me, 2]
            spread = max(spread, dx * dx + dy * dy + dz * dz)
        scale = 1.0 / math.sqrt(spread) if spread > 0.0 else 1.0
        for p in (3, 6):
            if used < 2 * p:
                continue
            gram[:] = 0.0
            for sweep in range(2):
                fitted_u, fitted_v, level = 0.0, 0.0, 0.0
                for k in range(count):
                    j = near[i, k]
                    cosine = normals[me, 0] * normals[j, 0] + normals[me, 1] * normals[j, 1] + normals[me, 2] * normals[j, 2]
                    if not (cosine > alike and part[j] == part[me]):
                        continue
                    dx, dy, dz = middles[j, 0] - middles[me, 0], middles[j, 1] - middles[me, 1], middles[j, 2] - middles[me, 2]
                    x, y = (dx * ux + dy * uy + dz * uz) * scale, (dx * vx + dy * vy + dz * vz) * scale
                    row[0], row[1], row[2], row[3], row[4], row[5] = 1.0, x, y, x * x, x * y, y * y
                    if sweep == 0:
                        for a in range(p):
                            for b in range(p):
                                gram[a, b] += row[a] * row[b]
                    else:
                        weight = 0.0
                        for a in range(p):
                            weight += gram[a, p] * row[a]
                        fitted_u += weight * (normals[j, 0] * ux + normals[j, 1] * uy + normals[j, 2] * uz)
                        fitted_v += weight * (normals[j, 0] * vx + normals[j, 1] * vy + normals[j, 2] * vz)
                        level += weight * (dx * mx + dy * my + dz * mz)
                if sweep == 0 and not _solved_first(gram, p):
                    break
                # the facet is the origin, whose row is (1, 0, ...): its leverage is the first entry
                leverage = gram[0, p]
                if sweep == 1 and leverage < 0.9:
                    if p == 3:
                        ru = normals[me, 0] * ux + normals[me, 1] * uy + normals[me, 2] * uz - fitted_u
                        rv = normals[me, 0] * vx + normals[me, 1] * vy + normals[me, 2] * vz - fitted_v
                        slope[i] = math.sqrt((ru * ru + rv * rv) / (1.0 - leverage))
                    else:
                        height[i] = -level / math.sqrt(1.0 - leverage)


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def _places(middles: FloatArray, slope: FloatArray, near: IntArray, threshold: float) -> tuple[Place, ...]:
    """Clusters of facets over the threshold that are each other's neighbours."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    over = np.flatnonzero(np.nan_to_num(slope) > threshold)
    if not len(over) or threshold <= 0:
        return ()
    number = np.full(len(slope), -1)
    number[over] = np.arange(len(over))
    close = near[over][:, : NEIGHBOURS // 2]
    rows, columns = np.repeat(np.arange(len(over)), close.shape[1]), number[close].ravel()
    linked = columns >= 0
    graph = coo_matrix((np.ones(linked.sum()), (rows[linked], columns[linked])), shape=(len(over), len(over)))
    count, label = connected_components(graph, directed=False)
    found = []
    for k in range(count):
        mine = over[label == k]
        low, high = middles[mine].min(axis=0), middles[mine].max(axis=0)
        x, y, z = (float(c) for c in 0.5 * (low + high))
        found.append(Place((x, y, z), float(np.linalg.norm(high - low)), math.degrees(float(slope[mine].max())), len(mine)))
    return tuple(sorted(found, key=lambda place: (-place.facets, -place.peak_deg)))


@dataclass(frozen=True)
class Outline:
    """Agreement of the surface's silhouette with a scan's valid cells, in that scan's own view.

    missing_share: valid cells where the surface is not seen; extra_share: cells the surface covers where nothing returned, outside
    holes; both as shares of the valid cells. worst_px: how far the worst valid cell lies from the surface's picture, among patches of
    valid cells of which the surface shows at least half: strays that meshing left out are missing, but no part of its outline."""

    missing_share: float
    extra_share: float
    worst_px: float


def outline_of(surface: Surface, scan: RangeScan, caster: Caster | None = None) -> Outline:
    """Compare the surface's picture from the scan's camera with what the scan saw; `caster` of the surface is built when not given."""
    import cv2

    maps = trace_maps(surface, scan.camera, scan.world_from_scan, caster, allow_inside=True)
    valid, hit = scan.valid, maps.hit
    count = max(1, int(valid.sum()))
    away = cv2.distanceTransform((~hit).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # dropouts inside the scan are holes, not outline: only what is not enclosed by valid cells counts as extra
    outside = _reached_from_border(~valid)
    return Outline(
        missing_share=float((valid & ~hit).sum()) / count,
        extra_share=float((hit & outside).sum()) / count,
        worst_px=float(away[_shown_patches(valid, hit)].max(initial=0.0)) if hit.any() else math.inf,
    )


def _shown_patches(valid: BoolArray, hit: BoolArray) -> BoolArray:
    """Valid cells of those connected patches in which the surface shows at least half of the cells."""
    import cv2

    count, label = cv2.connectedComponents(valid.astype(np.uint8), connectivity=8)
    cells = np.bincount(label[valid], minlength=count)
    shown = np.bincount(label[valid & hit], minlength=count) >= 0.5 * np.maximum(cells, 1)
    patches: BoolArray = valid & shown[label]
    return patches


def _reached_from_border(free: BoolArray) -> BoolArray:
    import cv2

    padded = np.pad(free.astype(np.uint8), 1, constant_values=1)
    _, label = cv2.connectedComponents(padded, connectivity=4)
    return (label == label[0, 0])[1:-1, 1:-1]


@dataclass(frozen=True)
class Verdict:
    """Whether a surface is accurate enough for a bust of some height at some printer, in one sentence with its numbers."""

    fit: bool
    sentence: str


def verdict_for(
    consistency: Consistency, surface_height_mm: float, bust_height_mm: float, layer_mm: float, pixel_mm: float
) -> Verdict:
    """Noise, scaled to the bust, against what the printer can show: half of the finer of its layer and pixel."""
    for name, value in (
        ("surface_height_mm", surface_height_mm),
        ("bust_height_mm", bust_height_mm),
        ("layer_mm", layer_mm),
        ("pixel_mm", pixel_mm),
    ):
        if not (math.isfinite(value) and value > 0):
            raise SurfaceError(f"{name} is {value}; it must be a positive length")
    noise = consistency.height_noise_mm * bust_height_mm / surface_height_mm
    shown = 0.5 * min(layer_mm, pixel_mm)
    fit = noise <= shown
    word = "accurate enough" if fit else "not accurate enough"
    return Verdict(
        fit,
        f"{word} for a bust of {bust_height_mm:.4g} mm: its noise of {noise:.3g} mm there is {'within' if fit else 'over'} the "
        f"{shown:.3g} mm that layers of {layer_mm:g} mm and pixels of {pixel_mm:g} mm can show",
    )
