"""A range finder that measures a known surface: what it would have returned, and the truth beside it.

Active triangulation: a camera and a light source at a baseline from it. A cell returns a distance only where the camera sees the
surface, the source lights it, and the surface is not too oblique to either. The error of range is

    sigma(r, theta) = noise_mm (r / working_distance_mm)^2 / cos theta,

the square because range goes as the inverse of disparity (dr = r^2 d(disparity) / (f b); Besl, *Active, optical range imaging
sensors*, 1988), the cosine because a spot on an oblique surface is stretched in the picture. Depth is then rounded to `step_mm`.

World frame and millimetres; the scan's camera frame is x right, y down, z forward; angles are from the surface normal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Protocol

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray, require, unit_vectors
from rangecheck.errors import SettingError
from rangecheck.kernels import in_chunks
from rangecheck.optics import Camera
from rangecheck.raycast.embree import Hits
from rangecheck.scan.range_scan import RangeScan

CHUNK = 16384
#: why a cell holds no distance
MEASURED, NOTHING_THERE, IN_SHADOW, TOO_OBLIQUE, LOST = range(5)
REASONS = ("measured", "nothing there", "source's shadow", "too oblique", "lost at random")


class Caster(Protocol):
    """What rays are cast against: `EmbreeCaster`, `BruteCaster` or `ImplicitCaster`."""

    skin_mm: float

    def closest(self, origins_mm: FloatArray, directions: FloatArray) -> Hits: ...

    def occluded(self, origins_mm: FloatArray, directions: FloatArray, reach_mm: FloatArray | float = ...) -> BoolArray: ...


@dataclass(frozen=True)
class RangeFinder:
    """The instrument.

    source_mm            where the light source is, in the camera's frame; its distance from the camera is the baseline
    working_distance_mm  range at which `noise_mm` holds
    noise_mm             standard deviation of range there, at normal incidence
    fade_deg, limit_deg  cells are lost at random between these angles of incidence (the more oblique of camera and source),
                         with a chance that rises from 0 to 1 as a smooth step; all are lost beyond
    lost_share           share of cells lost at random besides
    step_mm              depth (range, where the camera has no depth axis) is rounded to multiples of this; 0 = not rounded
    nearest_mm, farthest_mm  ranges outside are not returned
    """

    source_mm: tuple[float, float, float] = (150.0, 0.0, 0.0)
    working_distance_mm: float = 600.0
    noise_mm: float = 0.2
    fade_deg: float = 65.0
    limit_deg: float = 82.0
    lost_share: float = 0.0
    step_mm: float = 0.02
    nearest_mm: float = 0.0
    farthest_mm: float = math.inf

    def __post_init__(self) -> None:
        if len(self.source_mm) != 3 or not all(math.isfinite(c) for c in self.source_mm):
            raise SettingError(f"source_mm is {self.source_mm}; it must be three finite coordinates", key="source_mm")
        for key, low, high in (
            ("working_distance_mm", 1e-9, math.inf),
            ("noise_mm", 0.0, math.inf),
            ("fade_deg", 0.0, 90.0),
            ("limit_deg", 0.0, 90.0),
            ("lost_share", 0.0, 1.0),
            ("step_mm", 0.0, math.inf),
            ("nearest_mm", 0.0, math.inf),
            ("farthest_mm", 0.0, math.inf),
        ):
            value = getattr(self, key)
            if not low <= value <= high:
                raise SettingError(f"{key} is {value}; it must lie between {low:g} and {high:g}", key=key, value=value)
        if self.fade_deg > self.limit_deg:
            raise SettingError(
                f"fade_deg {self.fade_deg} exceeds limit_deg {self.limit_deg}; cells fade before the limit", key="fade_deg"
            )

    def noise_at(self, range_mm: FloatArray, cos_camera: FloatArray) -> FloatArray:
        """Standard deviation of range in mm at these ranges and cosines of the angle between normal and camera ray."""
        return self.noise_mm * (range_mm / self.working_distance_mm) ** 2 / cos_camera


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """A scan and the truth behind it, all on the camera's grid.

    scan           what the instrument returned
    true_range_mm  (h, w) float64 range of the surface, NaN where the ray meets nothing
    true_normal    (h, w, 3) float64 outward unit normal in the world frame, NaN there too
    noise_mm       (h, w) float64 standard deviation of the error that was drawn, before rounding
    reason         (h, w) uint8 index into REASONS: MEASURED, NOTHING_THERE, IN_SHADOW, TOO_OBLIQUE or LOST
    """

    scan: RangeScan
    true_range_mm: FloatArray = field(repr=False)
    true_normal: FloatArray = field(repr=False)
    noise_mm: FloatArray = field(repr=False)
    reason: IntArray = field(repr=False)


def simulate_scan(
    caster: Caster,
    camera: Camera,
    world_from_scan: FloatArray,
    finder: RangeFinder,
    seed: int,
    *,
    scan_index: int = 0,
    name: str = "scan",
    with_brightness: bool = False,
) -> SimulatedScan:
    """One scan of the surface behind `caster` by `finder`, whose camera stands at `world_from_scan` (4, 4).

    Random numbers come from (seed, scan_index) alone. `with_brightness` adds the camera's picture of the surface under the source,
    white and Lambertian, 1 where it faces the source at the working distance. Raises SettingError or ArrayError."""
    pose = rigid.checked(world_from_scan, "world_from_scan")
    shape = (camera.height, camera.width)
    local_origins, local_rays = camera.pixel_rays()
    origins = np.ascontiguousarray(rigid.move_points(pose, local_origins).reshape(-1, 3))
    rays = np.ascontiguousarray(rigid.move_directions(pose, local_rays).reshape(-1, 3))
    source = rigid.move_points(pose, np.asarray(finder.source_mm))

    distance, normals = _first_surface(caster, origins, rays)
    seen = np.isfinite(distance)
    points = origins + np.where(seen, distance, 0.0)[:, None] * rays
    cos_camera = np.where(seen, -(normals * rays).sum(axis=1), np.nan)
    to_source = source - points
    source_distance = np.linalg.norm(to_source, axis=1)
    cos_source = (normals * to_source).sum(axis=1) / source_distance
    lit = seen & (cos_source > 0)
    lit[lit] = ~_blocked(caster, points[lit], normals[lit], source)

    random = np.random.Generator(np.random.Philox(key=np.array([seed, scan_index], dtype=np.uint64)))
    error, chance, chance_besides = random.standard_normal(len(rays)), random.random(len(rays)), random.random(len(rays))
    with np.errstate(invalid="ignore"):
        oblique_deg = np.degrees(np.arccos(np.clip(np.minimum(cos_camera, cos_source), -1.0, 1.0)))
        away = seen & ((cos_camera <= 0) | (chance < _lost_at(oblique_deg, finder)))
        noise = np.where(seen, finder.noise_at(distance, np.maximum(cos_camera, 1e-3)), np.nan)
    measured = distance + np.where(seen, noise * error, 0.0)
    measured = _rounded(measured.reshape(shape), local_origins[..., 2], local_rays[..., 2], camera, finder.step_mm).ravel()

    reason = np.full(len(rays), MEASURED, np.uint8)
    outside = (distance < finder.nearest_mm) | (distance > finder.farthest_mm) | ~(measured > 0)
    reason[(chance_besides < finder.lost_share) | outside] = LOST
    reason[away] = TOO_OBLIQUE
    reason[seen & ~lit] = IN_SHADOW
    reason[~seen] = NOTHING_THERE
    brightness = None
    if with_brightness:
        light = np.where(lit, cos_source * (finder.working_distance_mm / source_distance) ** 2, 0.0)
        brightness = np.clip(light, 0.0, 1.0).astype(np.float32).reshape(shape)
    scan = RangeScan(
        np.where(reason == MEASURED, measured, np.nan).astype(np.float32).reshape(shape),
        camera,
        pose,
        brightness=brightness,
        name=name,
        noise_mm=finder.noise_mm if finder.noise_mm > 0 else None,
    )
    truth = np.where(seen, distance, np.nan).reshape(shape)
    return SimulatedScan(scan, truth, normals.reshape(*shape, 3), noise.reshape(shape), reason.reshape(shape))


def ring_of_poses(
    count: int,
    distance_mm: float,
    *,
    target_mm: Sequence[float] = (0.0, 0.0, 0.0),
    elevations_deg: Sequence[float] = (0.0,),
    first_deg: float = 0.0,
) -> list[FloatArray]:
    """`count` poses (4, 4) around the world's y axis through `target_mm`, all at `distance_mm` from it and looking at it.

    Azimuth 0 stands on +z and grows towards +x; elevations are taken in turn. Raises SettingError."""
    if count < 1 or not distance_mm > 0 or not elevations_deg or not all(-90 <= e <= 90 for e in elevations_deg):
        raise SettingError(
            f"a ring needs at least one pose, a positive distance and elevations between -90 and 90 degrees; "
            f"here {count}, {distance_mm} mm, {tuple(elevations_deg)}",
            key="count",
        )
    target = require("target_mm", target_mm, (3,), finite=True)
    poses = []
    for index in range(count):
        azimuth = math.radians(first_deg + 360.0 * index / count)
        elevation = math.radians(elevations_deg[index % len(elevations_deg)])
        outward = [math.sin(azimuth) * math.cos(elevation), math.sin(elevation), math.cos(azimuth) * math.cos(elevation)]
        poses.append(rigid.look_at(target + distance_mm * np.array(outward), target))
    return poses


def _first_surface(caster: Caster, origins: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance (n,) to the first hit, inf where missed, and outward normal (n, 3) there, NaN where missed."""
    n = len(rays)
    distance, normals = np.empty(n), np.full((n, 3), np.nan)
    exact = getattr(caster, "normals", None)
    corners = None if exact else _corners(caster)

    def work(start: int, end: int) -> None:
        hits = caster.closest(origins[start:end], rays[start:end])
        distance[start:end] = hits.distance_mm
        hit = np.isfinite(hits.distance_mm)
        if exact:
            found = exact(origins[start:end][hit] + hits.distance_mm[hit, None] * rays[start:end][hit])
        else:
            assert corners is not None
            a, b, c = (corners[0][corners[1][hits.face[hit], k]] for k in range(3))
            found = unit_vectors(np.cross(b - a, c - a))
        normals[start:end][hit] = found

    in_chunks(work, n, CHUNK)
    return distance, normals


def _corners(caster: Caster) -> tuple[FloatArray, IntArray]:
    vertices, faces = getattr(caster, "vertices", None), getattr(caster, "faces", None)
    if vertices is None or faces is None:
        raise SettingError(
            "the caster gives neither `normals` nor `vertices` and `faces`; the angle of incidence needs one", key="caster"
        )
    return vertices, faces


def _blocked(caster: Caster, points: FloatArray, normals: FloatArray, source: FloatArray) -> BoolArray:
    """Whether something stands between each point and the source."""
    starts = points + caster.skin_mm * normals
    to_source = source - starts
    reach = np.linalg.norm(to_source, axis=1)
    rays = to_source / reach[:, None]
    blocked = np.empty(len(points), bool)

    def work(start: int, end: int) -> None:
        blocked[start:end] = caster.occluded(starts[start:end], rays[start:end], reach[start:end])

    in_chunks(work, len(points), CHUNK)
    return blocked


def _lost_at(angle_deg: FloatArray, finder: RangeFinder) -> FloatArray:
    """Chance that a cell at this angle of incidence returns nothing."""
    band = finder.limit_deg - finder.fade_deg
    t = np.clip((angle_deg - finder.fade_deg) / band, 0.0, 1.0) if band > 0 else (angle_deg >= finder.limit_deg).astype(float)
    # a chance of exactly 1 must lose every draw in [0, 1)
    return t * t * (3.0 - 2.0 * t)


def _rounded(range_mm: FloatArray, origin_z: FloatArray, ray_z: FloatArray, camera: Camera, step_mm: float) -> FloatArray:
    if step_mm == 0:
        return range_mm
    if camera.model == "cylindrical":
        return np.rint(range_mm / step_mm) * step_mm
    return (np.rint((range_mm * ray_z + origin_z) / step_mm) * step_mm - origin_z) / ray_z


def finder_to_dict(finder: RangeFinder) -> dict[str, object]:
    """The instrument's numbers, ready for JSON."""
    return {item.name: getattr(finder, item.name) for item in fields(finder)}
