"""What a camera and a light source see of a surface: hits, angles, shadows, and the light that comes back.

World frame, millimetres; arrays are flat, one entry per ray. A moving subject is met in its own frame: rays and source are moved back
to where the subject stood at time 0, which changes no distance and no angle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from rangecheck.errors import SettingError
from rangecheck.kernels import in_chunks
from rangecheck.raycast.embree import Hits

CHUNK = 16384


class Caster(Protocol):
    """What rays are cast against: `EmbreeCaster` or `ImplicitCaster`."""

    skin_mm: float

    def closest(self, origins_mm: FloatArray, directions: FloatArray) -> Hits: ...

    def occluded(self, origins_mm: FloatArray, directions: FloatArray, reach_mm: FloatArray | float = ...) -> BoolArray: ...


@dataclass(frozen=True)
class Motion:
    """The subject drifts at a steady velocity and turns at a steady rate about an axis; at time 0 it stands where the caster has it."""

    velocity_mm_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg_s: float = 0.0
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)
    centre_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*self.velocity_mm_s, self.turn_deg_s, *self.axis, *self.centre_mm))) or not any(self.axis):
            raise SettingError(f"{self} needs finite numbers and an axis that is not zero", key="motion")

    def back(self, points_mm: FloatArray, time_s: FloatArray) -> FloatArray:
        """Points (n, 3) at times (n,) as seen from the subject."""
        centre = np.asarray(self.centre_mm)
        drifted = points_mm - np.asarray(self.velocity_mm_s) * time_s[:, None]
        return centre + self.turn_back(drifted - centre, time_s)

    def turn_back(self, directions: FloatArray, time_s: FloatArray) -> FloatArray:
        """Directions (n, 3) at times (n,) as seen from the subject (Rodrigues)."""
        axis = np.asarray(self.axis) / np.linalg.norm(self.axis)
        angle = -np.radians(self.turn_deg_s) * time_s[:, None]
        along = (directions @ axis)[:, None] * axis
        return along + np.cos(angle) * (directions - along) + np.sin(angle) * np.cross(axis, directions)


@dataclass(frozen=True)
class Finish:
    """How the subject gives light back: a matt share and a lobe about the mirror direction, both relative to a white matt surface.

    rms_slope is the root mean square slope of its roughness (2 sigma / T): 0.05 is polished steel, 0.3 blasted. The lobe is
    Beckmann's, D G / (4 cos i cos r), with the masking of V-grooves (Torrance & Sparrow, 1967)."""

    diffuse: float = 1.0
    specular: float = 0.0
    rms_slope: float = 0.2

    def __post_init__(self) -> None:
        if not (0 <= self.diffuse <= 1 and 0 <= self.specular <= 1 and self.diffuse + self.specular <= 1 and self.rms_slope > 0):
            raise SettingError(
                f"finish gives back {self.diffuse} matt and {self.specular} in a lobe of slope {self.rms_slope}; "
                "shares lie between 0 and 1 and together do not exceed 1, and the slope is positive",
                key="finish",
            )

    def response(self, normals: FloatArray, to_source: FloatArray, to_camera: FloatArray) -> FloatArray:
        """(n,) radiance towards the camera over that of a white matt surface facing the same light; unit vectors (n, 3)."""
        cos_i = np.maximum((normals * to_source).sum(axis=1), 0.0)
        result = self.diffuse * cos_i
        if self.specular > 0:
            cos_r = np.maximum((normals * to_camera).sum(axis=1), 0.0)
            half = unit_vectors(to_source + to_camera)
            cos_h = (normals * half).sum(axis=1)
            cos_d = (half * to_camera).sum(axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                tan2 = 1.0 / cos_h**2 - 1.0
                density = np.exp(-tan2 / self.rms_slope**2) / (math.pi * self.rms_slope**2 * cos_h**4)
                masking = np.minimum(1.0, 2.0 * cos_h * np.minimum(cos_i, cos_r) / cos_d)
                lobe = density * masking / (4.0 * cos_i * cos_r) * cos_i * math.pi
            result = result + self.specular * np.where((cos_i > 0) & (cos_r > 0) & (cos_h > 0), lobe, 0.0)
        return result


MATT = Finish()


@dataclass(frozen=True, eq=False)
class View:
    """What n camera rays meet; entries are NaN (False) where a ray meets nothing.

    distance_mm (n,) inf where nothing is met;  normals (n, 3) and points_mm (n, 3) in the subject's frame
    cos_camera, cos_source (n,) cosines of incidence;  source_mm (n,) distance to the source
    lit (n,) whether the source reaches the point;  response (n,) see `Finish.response`, without shadow and distance
    """

    distance_mm: FloatArray = field(repr=False)
    points_mm: FloatArray = field(repr=False)
    normals: FloatArray = field(repr=False)
    cos_camera: FloatArray = field(repr=False)
    cos_source: FloatArray = field(repr=False)
    source_mm: FloatArray = field(repr=False)
    lit: BoolArray = field(repr=False)
    response: FloatArray = field(repr=False)

    @property
    def seen(self) -> BoolArray:
        return np.isfinite(self.distance_mm)

    def signal(self, working_distance_mm: float) -> FloatArray:
        """(n,) light that comes back, 1 for white matt facing the source at the working distance; 0 in its shadow."""
        with np.errstate(invalid="ignore"):
            return np.where(self.lit, self.response * (working_distance_mm / self.source_mm) ** 2, 0.0)


def look(
    caster: Caster,
    origins_mm: FloatArray,
    rays: FloatArray,
    source_mm: FloatArray,
    *,
    finish: Finish = MATT,
    motion: Motion | None = None,
    time_s: FloatArray | None = None,
) -> View:
    """Rays (n, 3) and a source (3,) at times (n,), in the world, against the subject."""
    source = np.broadcast_to(source_mm, rays.shape)
    if motion is not None and time_s is not None:
        origins_mm, source = motion.back(origins_mm, time_s), motion.back(source, time_s)
        rays = motion.turn_back(rays, time_s)
    distance, normals = _first_surface(caster, np.ascontiguousarray(origins_mm), np.ascontiguousarray(rays))
    n, seen = len(rays), np.isfinite(distance)
    hit = np.nonzero(seen)[0]
    here = origins_mm[hit] + distance[hit, None] * rays[hit]
    reach = np.linalg.norm(source[hit] - here, axis=1)
    to_source = (source[hit] - here) / reach[:, None]
    facing = (normals[hit] * to_source).sum(axis=1)
    reached = facing > 0
    if not np.array_equal(source[hit], origins_mm[hit]):
        reached[reached] = ~_blocked(caster, here[reached], normals[hit][reached], source[hit][reached])
    lit = np.zeros(n, bool)
    lit[hit] = reached

    def spread(values: FloatArray) -> FloatArray:
        full = np.full((n, *values.shape[1:]), np.nan)
        full[hit] = values
        return full

    return View(
        distance,
        spread(here),
        normals,
        spread(-(normals[hit] * rays[hit]).sum(axis=1)),
        spread(facing),
        spread(reach),
        lit,
        spread(finish.response(normals[hit], to_source, -rays[hit])),
    )


def camera_rays(pose: FloatArray, local: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """A camera's rays (h, w, 3) as flat world rays (n, 3)."""
    origins = rigid.move_points(pose, local[0]).reshape(-1, 3)
    return np.ascontiguousarray(origins), np.ascontiguousarray(rigid.move_directions(pose, local[1]).reshape(-1, 3))


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
