"""Places whose slope departs from its smooth surroundings, found in the pictures of a turntable alone: no sound surface is needed.

The surface is pictured from each pose as it is, by a noisy sensor, and as it would look if its normals were those of its own
surroundings, averaged over twice the half width of what is looked for. Smooth shape cancels: the averaged normals keep linear and
cubic changes of slope (twice the mean less the mean of the mean). How far the pictures depart from each other, in standard deviations of
the sensor's noise, is gathered on the surface from all poses that see a place, as stripes and highlights pass over each place in
some of them only; its mean magnitude is proportional to the slope that departs, as long as a stripe moves by less than its width.

A place stands out by the ratio of this to the strongest of SECTORS sectors of a ring around it: the nearer of two, which knows its
clutter best, or the farther, into which a deep defect does not spill (what it does to the averaged normals reaches 6 half widths). Ordered statistics keep the rate of
false alarms where clutter is uneven (Rohling, Radar CFAR thresholding in clutter and multiple target situations, 1983). Folds and
edges go on into the ring and do not stand out; a dent ends before it. Of places like all others one in SECTORS + 1 passes 1; how
their number falls with the ratio is told from the surface's own places, and says how many would reach a ratio by chance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.maps import Maps, trace_maps
from rangecheck.optics import PinholeCamera, Sensor
from rangecheck.scene import Scene
from rangecheck.surface import Surface
from rangecheck.surface.topology import boundary_edges
from rangecheck.transport import Settings, Tracer

#: half widths of what is looked for, mm
HALF_WIDTHS_MM = (1.0, 2.0)
#: in half widths: normals are averaged over SMOOTH, departures over SPOT (standard deviations); where the rings begin and end; and how
#: far places lie APART
SMOOTH, SPOT, RINGS, APART = 2.0, 0.5, ((3.0, 6.0), (6.0, 9.0)), 2.0
ORDER = 2
SECTORS, FILLED = 12, 9
#: surfaces turned further away than this are not judged
LEAST_COSINE = math.cos(math.radians(65.0))
#: standard deviations of the sensor's noise that are added to both sides of a ratio: noise alone does not stand out of noise
QUIET = 4.0
#: places that stand out by chance, expected of a whole surface
FALSE_PLACES = 0.05
#: largest share of the places beyond 1 that do not tell how fast their number falls: they may be defects; fewest that tell it
DEFECTS, FEWEST = 0.05, 10

_MEAN_MAGNITUDE = math.sqrt(2 / math.pi)


@dataclass(frozen=True, eq=False)
class Look:
    """The places of a surface, looked at for one half width.

    points_mm (k, 3); ratios (k,) by how many times each exceeds all around; beyond: how many exceed 1; rate: mean of ln(ratio) beyond 1;
    looks: with how many half widths the surface was looked at"""

    half_width_mm: float
    points_mm: FloatArray = field(repr=False)
    ratios: FloatArray = field(repr=False)
    beyond: int
    rate: float
    looks: int = 1

    def expected(self, ratio: float) -> float:
        """How many places of the whole surface reach this ratio by chance, for all half widths together; infinite where too few tell."""
        if not math.isfinite(self.rate):
            return math.inf
        return self.looks * self.beyond * max(ratio, 1.0) ** (-1 / self.rate)

    @property
    def threshold(self) -> float:
        """The ratio that FALSE_PLACES places are expected to reach by chance; infinite where too few tell."""
        if not math.isfinite(self.rate):
            return math.inf
        return max(self.looks * self.beyond / FALSE_PLACES, 1.0) ** self.rate


@dataclass(frozen=True)
class Spot:
    """Where pictures depart from their surroundings: middle and half width, mm; how many times the strongest departure around; what
    it takes to be named; and how many places of the surface would reach this by chance."""

    centre_mm: tuple[float, float, float]
    half_width_mm: float
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
    along = _Along(surface)
    rest = np.asarray(surface.vertex_normals, np.float64)
    normals = rest.copy()
    for _ in range(ORDER):
        rest = rest - along.averaged(rest, length_mm)
    normals -= rest
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def look_at_places(
    scene: Scene,
    camera: PinholeCamera,
    poses: Sequence[FloatArray],
    settings: Settings,
    sensor: Sensor,
    *,
    half_widths_mm: Sequence[float] = HALF_WIDTHS_MM,
    seed: int = 0,
) -> list[Look]:
    """The scene of one wavelength pictured from each pose by `sensor`, exposed so that hardly anything saturates, and held against what
    the normals around lead to expect: a look for each half width."""
    surface = scene.surface
    seen = Tracer(scene)
    smooth = [Tracer(replace(scene, vertex_normals=normals_around(surface, SMOOTH * w))) for w in half_widths_mm]
    departed, pixels = np.zeros((len(smooth), len(surface.vertices))), np.zeros(len(surface.vertices))
    for k, pose in enumerate(poses):
        maps = trace_maps(surface, camera, pose, seen.caster, allow_inside=True)
        judged = maps.hit & (np.cos(np.nan_to_num(maps.incidence_rad, nan=3.0)) > LEAST_COSINE)
        corner = _nearest_corner(surface, maps, judged)
        pixels += np.bincount(corner, minlength=len(pixels))
        picture = _grey(seen, camera, pose, settings, seed + k)
        white = float(np.quantile(picture[maps.hit], 0.98)) if maps.hit.any() else 1.0
        level = 0.8 / white if white > 0 else 1.0
        exposed = replace(sensor, electrons_per_unit=sensor.full_well * level)
        said = exposed.linearise(exposed.expose(picture, seed=seed + k))
        for tracer, total in zip(smooth, departed):
            share = np.clip(_grey(tracer, camera, pose, settings, seed + k) * level, 0.0, 1.0)
            total += np.bincount(corner, (np.abs(said - share) / _noise(exposed, share))[judged], len(pixels))
    return [_look(surface, w, total, pixels, len(smooth)) for w, total in zip(half_widths_mm, departed)]


def _grey(tracer: Tracer, camera: PinholeCamera, pose: FloatArray, settings: Settings, seed: int) -> FloatArray:
    return tracer.render(camera, pose, settings, seed=seed).radiance[..., 0].astype(np.float64)


def _nearest_corner(surface: Surface, maps: Maps, judged: BoolArray) -> IntArray:
    """(k,) the vertex nearest to what each judged pixel sees."""
    corners = surface.faces[maps.face[judged]]
    away = ((surface.vertices[corners] - maps.points_mm()[judged][:, None, :]) ** 2).sum(axis=2)
    return np.take_along_axis(corners, away.argmin(axis=1)[:, None], axis=1)[:, 0]


def _noise(sensor: Sensor, share: FloatArray) -> FloatArray:
    """Standard deviation, in shares of full well, of what a pixel says: shot, read and rounding."""
    steps = 2.0**sensor.bits - 1
    level = np.rint(sensor.respond(share) * steps)
    step = sensor.linearise(np.minimum(level + 1, steps) if sensor.bits else level) - sensor.linearise(level)
    return np.sqrt(share / sensor.full_well + (sensor.read_noise / sensor.full_well) ** 2 + step**2 / 12)


def _look(surface: Surface, half_width_mm: float, departed: FloatArray, pixels: FloatArray, looks: int) -> Look:
    """From the sums, at each vertex, of the departures' magnitudes in standard deviations of the noise, and of the pixels."""
    along, spot_mm = _Along(surface), SPOT * half_width_mm
    density = along.averaged(pixels, spot_mm)
    level = np.maximum(along.averaged(departed, spot_mm) / np.maximum(density, 1e-9) - _MEAN_MAGNITUDE, 0.0)
    judged = (density > 1.0) & ~_near_border(surface, 2 * SMOOTH * half_width_mm)
    level[~judged] = 0.0
    places = _highest_around(surface, level, APART * half_width_mm)
    if not len(places):
        return look_of(half_width_mm, np.empty((0, 3)), np.empty(0), looks)
    around = _sectors_around(surface, level, judged, places, np.multiply(RINGS, half_width_mm))
    whole = (around >= 0).sum(axis=2) >= FILLED
    strongest = np.where(whole, around.max(axis=2, initial=0.0), np.inf).min(axis=1)
    places, strongest = places[np.isfinite(strongest)], strongest[np.isfinite(strongest)]
    # magnitudes of n pixels' noise average to a standard deviation of sqrt((1 - 2 / pi) / n)
    area = float(surface.face_areas.sum()) / len(surface.vertices)
    averaged = float(np.median(density[judged])) / area * 4 * math.pi * spot_mm**2
    quiet = QUIET * math.sqrt((1 - 2 / math.pi) / max(averaged, 1.0))
    ratios = (level[places] + quiet) / (strongest + quiet)
    return look_of(half_width_mm, surface.vertices[places], ratios, looks)


def look_of(half_width_mm: float, points_mm: FloatArray, ratios: FloatArray, looks: int = 1) -> Look:
    """The look, with how fast the number of its places falls beyond 1."""
    beyond = np.sort(np.log(ratios[ratios > 1.0]))
    return Look(half_width_mm, points_mm, ratios, len(beyond), _rate(beyond), looks)


def _rate(beyond: FloatArray) -> float:
    """Mean of an exponential law from sorted values of which the highest count as if they only were no lower than those below them."""
    kept = len(beyond) - math.ceil(DEFECTS * len(beyond))
    if kept < FEWEST:
        return math.inf
    return float(beyond[:kept].sum() + (len(beyond) - kept) * beyond[kept - 1]) / kept


def _near_border(surface: Surface, reach_mm: float) -> BoolArray:
    """(n,) vertices from which it is less than `reach_mm` to where the surface ends."""
    from scipy.spatial import cKDTree

    border = np.unique(boundary_edges(surface))
    if not len(border):
        return np.zeros(len(surface.vertices), bool)
    return np.isfinite(cKDTree(surface.vertices[border]).query(surface.vertices, distance_upper_bound=reach_mm)[0])


def _highest_around(surface: Surface, level: FloatArray, apart_mm: float) -> IntArray:
    """(k,) vertices whose level none exceeds within `apart_mm`."""
    from scipy.spatial import cKDTree

    a, b = surface.faces.ravel(), np.roll(surface.faces, 1, axis=1).ravel()
    around = np.zeros(len(level))
    np.maximum.at(around, a, level[b])
    np.maximum.at(around, b, level[a])
    found = np.flatnonzero((level > 0) & (level >= around))
    tree = cKDTree(surface.vertices[level > 0]) if len(found) else None
    high = level[level > 0]
    chosen = []
    for start in range(0, len(found), 1024):
        some = found[start : start + 1024]
        assert tree is not None
        near = tree.query_ball_point(surface.vertices[some], apart_mm)
        chosen += [vertex for vertex, who in zip(some.tolist(), near) if level[vertex] >= high[who].max()]
    return np.array(chosen, np.int64)


def _sectors_around(surface: Surface, level: FloatArray, judged: BoolArray, places: IntArray, rings_mm: FloatArray) -> FloatArray:
    """(k, rings, SECTORS) the highest level in each sector of the rings around each place, -1 where nothing of it is judged."""
    from scipy.spatial import cKDTree

    where, known = surface.vertices[judged], level[judged]
    tree = cKDTree(where)
    found = np.full((len(places), len(rings_mm), SECTORS), -1.0)
    for start in range(0, len(places), 1024):
        some = places[start : start + 1024]
        for row, (vertex, near) in enumerate(zip(some, tree.query_ball_point(surface.vertices[some], rings_mm.max())), start):
            who = np.array(near, np.int64)
            away = where[who] - surface.vertices[vertex]
            u, v = _tangents(surface.vertex_normals[vertex])
            sector = ((np.arctan2(away @ v, away @ u) / (2 * math.pi) + 1.0) * SECTORS).astype(np.int64) % SECTORS
            reach = np.linalg.norm(away, axis=1)
            for ring, (begins, ends) in zip(found[row], rings_mm):
                inside = (reach > begins) & (reach <= ends)
                np.maximum.at(ring, sector[inside], known[who[inside]])
    return found


def _tangents(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    across = np.eye(3)[int(np.argmin(np.abs(normal)))]
    u = np.cross(normal, across)
    u /= max(float(np.linalg.norm(u)), 1e-12)
    return u, np.cross(normal, u)


def pixel_width_mm(maps: Maps) -> float:
    """Width of a pixel at the median depth."""
    assert isinstance(maps.camera, PinholeCamera)
    return float(np.nanmedian(maps.depth_mm)) / maps.camera.fx if maps.hit.any() else 1.0


def spots(looks: Sequence[Look], false_places: float = FALSE_PLACES) -> list[Spot]:
    """Places of which at most `false_places` are expected by chance, the least likely first, each once within the ring of the wider."""
    found: list[Spot] = []
    for look in looks:
        for point, ratio in zip(look.points_mm, look.ratios):
            by_chance = look.expected(float(ratio))
            if ratio > 1.0 and by_chance <= false_places:
                x, y, z = (float(c) for c in point)
                found.append(Spot((x, y, z), look.half_width_mm, float(ratio), look.threshold, by_chance))
    kept: list[Spot] = []
    for spot in sorted(found, key=lambda spot: (spot.by_chance, spot.centre_mm)):
        reach = RINGS[0][0] * spot.half_width_mm
        if all(math.dist(spot.centre_mm, other.centre_mm) > max(reach, RINGS[0][0] * other.half_width_mm) for other in kept):
            kept.append(spot)
    return kept
