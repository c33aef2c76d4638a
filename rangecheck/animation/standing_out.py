"""Places whose slope departs from its smooth surroundings, found in pictures alone: no picture of a sound surface is needed.

The surface is pictured twice from each pose: as it is, by a noisy sensor, and as it would look if its normals were those of its own
surroundings, averaged over SMOOTH_MM. Where both agree to the sensor's noise the slope is smooth; where they differ by more than what
they differ by all around, something is there. Smooth shape cancels: the averaged normals keep linear and cubic changes of slope
(twice the mean less the mean of the mean), and what remains of it shifts shades and stripes about as far here as all around, which the
measure divides by. Only how far the light's change stands out of its surroundings is told, so materials can be compared: a mirror
among stripes turns a change of slope into more light than matt plaster does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.maps import Maps, trace_maps
from rangecheck.optics import PinholeCamera, Sensor
from rangecheck.scene import Scene
from rangecheck.surface import Surface
from rangecheck.transport import Settings, Tracer

#: normals are averaged over this length (one standard deviation), mm: wider than what is looked for
SMOOTH_MM, ORDER = 2.0, 2
#: pictures are averaged over this length, mm, and compared with a ring around from RING_MM[0] to RING_MM[1]
SPOT_MM, RING_MM = 0.5, (4.0, 8.0)
#: surfaces turned further away than this are not judged
LEAST_COSINE = float(np.cos(np.radians(65.0)))
#: a ring counts where this share of it is on the surface
WHOLE = 0.9
#: places that stand out by chance, expected in all pictures of a sound surface together
FALSE_PLACES = 0.05
#: share of the places that the tail is told from, and the fewest of them that tell it
TAIL, FEWEST = 0.01, 5


@dataclass(frozen=True, eq=False)
class Departure:
    """What one picture says: sigmas (h, w), how many times its surroundings' departure each spot departs, NaN where not judged."""

    sigmas: FloatArray = field(repr=False)
    maps: Maps = field(repr=False)


@dataclass(frozen=True)
class Spot:
    """Where pictures depart from their surroundings: middle, mm, and by how many sigmas."""

    centre_mm: tuple[float, float, float]
    sigmas: float


def normals_around(surface: Surface, length_mm: float = SMOOTH_MM) -> FloatArray:
    """(n, 3) unit normals that the surroundings of each vertex suggest, averaged along the surface over `length_mm`."""
    from scipy.sparse import coo_matrix, diags

    faces, count = surface.faces, len(surface.vertices)
    rows, columns = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
    ones = np.ones(2 * len(rows))
    near = coo_matrix((ones, (np.r_[rows, columns], np.r_[columns, rows])), shape=(count, count)).tocsr()
    near.data[:] = 1.0
    degree = np.maximum(np.asarray(near.sum(axis=1)).ravel(), 1.0)
    edges = surface.vertices[rows] - surface.vertices[columns]
    step2 = float((edges * edges).sum(axis=1).mean())
    mean = diags(0.5 / degree) @ near + diags(np.full(count, 0.5))
    # each sweep spreads by half the mean square of an edge, over two axes
    sweeps = max(1, round(length_mm**2 / (step2 / 4)))

    def averaged(values: FloatArray) -> FloatArray:
        for _ in range(sweeps):
            values = mean @ values
        return values

    rest = np.asarray(surface.vertex_normals, np.float64)
    normals = rest.copy()
    for _ in range(ORDER):
        rest = rest - averaged(rest)
    normals -= rest
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def departure_in(
    scene: Scene, camera: PinholeCamera, world_from_camera: FloatArray, settings: Settings, sensor: Sensor, *, seed: int = 0
) -> Departure:
    """`departures_in` of one picture."""
    return departures_in(scene, camera, [world_from_camera], settings, sensor, seed=seed)[0]


def departures_in(
    scene: Scene, camera: PinholeCamera, poses: Sequence[FloatArray], settings: Settings, sensor: Sensor, *, seed: int = 0
) -> list[Departure]:
    """The scene of one wavelength pictured from each pose by `sensor`, exposed so that hardly anything saturates, and held against what
    the normals around lead to expect."""
    tracers = Tracer(scene), Tracer(replace(scene, vertex_normals=normals_around(scene.surface)))
    return [_departure(tracers, camera, pose, settings, sensor, seed + k) for k, pose in enumerate(poses)]


def _departure(
    tracers: tuple[Tracer, Tracer],
    camera: PinholeCamera,
    world_from_camera: FloatArray,
    settings: Settings,
    sensor: Sensor,
    seed: int,
) -> Departure:
    maps = trace_maps(tracers[0].scene.surface, camera, world_from_camera, tracers[0].caster, allow_inside=True)
    seen, expected = (
        one.render(camera, world_from_camera, settings, seed=seed).radiance[..., 0].astype(np.float64) for one in tracers
    )
    white = float(np.quantile(seen[maps.hit], 0.98)) if maps.hit.any() else 1.0
    level = 0.8 / white if white > 0 else 1.0
    exposed = replace(sensor, electrons_per_unit=sensor.full_well * level)
    picture = exposed.linearise(exposed.expose(seen, seed=seed))
    share = np.clip(expected * level, 0.0, 1.0)
    return departure_of(picture, share, _noise(exposed, share), maps)


def _noise(sensor: Sensor, share: FloatArray) -> FloatArray:
    """Standard deviation, in shares of full well, of what a pixel says: shot, read and rounding."""
    steps = 2.0**sensor.bits - 1
    level = np.rint(sensor.respond(share) * steps)
    step = sensor.linearise(np.minimum(level + 1, steps) if sensor.bits else level) - sensor.linearise(level)
    return np.sqrt(share / sensor.full_well + (sensor.read_noise / sensor.full_well) ** 2 + step**2 / 12)


def departure_of(seen: FloatArray, expected: FloatArray, noise: FloatArray, maps: Maps) -> Departure:
    """From linear pictures (h, w): what was seen, what the surroundings lead to expect, and the standard deviation of the sensor's noise."""
    import cv2

    hit = maps.hit & (np.cos(np.nan_to_num(maps.incidence_rad, nan=3.0)) > LEAST_COSINE)
    pixel_mm = pixel_width_mm(maps)

    def spread(values: FloatArray, length_mm: float) -> FloatArray:
        return np.asarray(cv2.GaussianBlur(values, (0, 0), max(length_mm / pixel_mm, 0.3), borderType=cv2.BORDER_CONSTANT))

    inside = hit.astype(np.float64)
    apart = np.where(hit, (seen - expected) / noise, 0.0)
    spot = spread(apart, SPOT_MM) / np.maximum(spread(inside, SPOT_MM), 1e-9)
    square = np.where(hit, spot * spot, 0.0)
    ring, share = _ring(square, pixel_mm), _ring(inside, pixel_mm)
    level2 = np.maximum(ring, 0.0) / np.maximum(share, 1e-9)
    # a lean of the surroundings shifts what is seen along its gradient: where that is steep, more is to be expected
    down, right = np.gradient(np.where(hit, expected / noise, 0.0))
    edge = cv2.erode(hit.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    steep2 = spread(np.where(edge, down**2 + right**2, 0.0), SPOT_MM)
    # noise of the sensor alone, averaged over the spot
    least2 = 1.0 / (4 * np.pi * max(SPOT_MM / pixel_mm, 0.3) ** 2)
    shift2 = level2 / (np.maximum(_ring(steep2, pixel_mm), 0.0) / np.maximum(share, 1e-9) + least2)
    judged = hit & (share > WHOLE)
    return Departure(np.where(judged, np.abs(spot) / np.sqrt(least2 + level2 + shift2 * steep2), np.nan), maps)


def _ring(values: FloatArray, pixel_mm: float) -> FloatArray:
    """Mean over the ring around each pixel."""
    import cv2

    inner, outer = (length / pixel_mm for length in RING_MM)
    reach = int(np.ceil(outer))
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    away = np.hypot(u, v)
    kernel = ((away >= inner) & (away <= outer)).astype(np.float64)
    return np.asarray(cv2.filter2D(values, -1, kernel / kernel.sum(), borderType=cv2.BORDER_CONSTANT))


def pixel_width_mm(maps: Maps) -> float:
    """Width of a pixel at the median depth."""
    assert isinstance(maps.camera, PinholeCamera)
    return float(np.nanmedian(maps.depth_mm)) / maps.camera.fx if maps.hit.any() else 1.0


@dataclass(frozen=True)
class Threshold:
    """sigmas: a place stands out from here on; places: how many were judged in all pictures."""

    sigmas: float
    places: int


def threshold_of(departures: Sequence[Departure], expected: float = FALSE_PLACES) -> Threshold:
    """From how many sigmas on a place stands out, told from the surface's own places, so that on a surface without defects `expected`
    places do in all pictures together; infinite where there are too few places to tell.

    A place is a square of two SPOT_MM and counts by its highest value, as neighbouring pixels say the same. Folds and edges of the shape
    make the places' tail heavier than a normal law's: its slope is measured, from the share 2 TAIL of the places to the share TAIL, and
    continued exponentially to `expected` places of all. Quantiles do not see how far the few places beyond them lie, so a defect
    does not hide itself while it covers less than TAIL of what is judged. A tail that falls more slowly still than exponentially names
    places in excess of `expected`. Never below what the normal law asks for as many places."""
    from scipy.stats import norm

    found = [_places(one) for one in departures]
    values = np.concatenate([np.empty(0), *found])
    if len(values) * TAIL < FEWEST:
        return Threshold(np.inf, len(values))
    outer, inner = (float(q) for q in np.quantile(values, (1 - TAIL, 1 - 2 * TAIL)))
    share = min(expected / len(values), TAIL)
    reached = outer + (outer - inner) * np.log2(TAIL / share)
    return Threshold(max(float(reached), float(norm.isf(share / 2))), len(values))


def _places(one: Departure) -> FloatArray:
    """The highest value of each place that is judged."""
    side = max(1, round(2 * SPOT_MM / pixel_width_mm(one.maps)))
    h, w = (length // side for length in one.sigmas.shape)
    cells = np.nan_to_num(one.sigmas[: h * side, : w * side], nan=-1.0).reshape(h, side, w, side).max(axis=(1, 3))
    judged: FloatArray = cells[cells >= 0]
    return judged


def spots(departures: Sequence[Departure], threshold: float, apart_mm: float = RING_MM[0]) -> list[Spot]:
    """Places that stand out by `threshold` sigmas in any of the pictures, the most striking first, each once within `apart_mm`."""
    points, sigmas = [], []
    for one in departures:
        over: BoolArray = np.nan_to_num(one.sigmas) > threshold
        points.append(one.maps.points_mm()[over])
        sigmas.append(one.sigmas[over])
    place = np.concatenate([np.empty((0, 3)), *points])
    strength = np.concatenate([np.empty(0), *sigmas])
    found: list[Spot] = []
    while len(place):
        k = int(np.argmax(strength))
        x, y, z = (float(c) for c in place[k])
        found.append(Spot((x, y, z), float(strength[k])))
        far = np.linalg.norm(place - place[k], axis=1) > apart_mm
        place, strength = place[far], strength[far]
    return found
