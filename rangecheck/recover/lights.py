"""The sources that a fit moves, and how the radiance's derivatives by their places become derivatives by their parameters.

A source is a sphere at `direction` (unit, from the middle of what is seen) and `distance_mm`; its strength is the irradiance that a
surface in the middle, facing it, receives. Irradiance, not radiance, because that is what matt surfaces show: the radius then acts only
on what mirrors. Far sources (distance 1e6 times the scene or so) are the parallel light of outdoor and studio photographs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray, require
from rangecheck.basis import frame_around
from rangecheck.errors import SceneError
from rangecheck.scene import Source

#: nodes on the unit disc (x, y, weight): the middle alone, and the seven of degree 5 (Abramowitz & Stegun 25.4.61)
ONE_NODE = np.array([[0.0, 0.0, 1.0]])
SEVEN_NODES = np.array(
    [[0.0, 0.0, 0.25]]
    + [[math.sqrt(2 / 3) * math.cos(k * math.pi / 3), math.sqrt(2 / 3) * math.sin(k * math.pi / 3), 0.125] for k in range(6)]
)


@dataclass(frozen=True, eq=False)
class Light:
    """A spherical source: unit `direction` and `distance_mm` from `middle_mm`, angular radius there, irradiance (per exposure unit) there.

    Raises SceneError where it would hold its middle, or shine a negative amount."""

    direction: FloatArray
    irradiance: float
    middle_mm: FloatArray
    distance_mm: float
    angular_radius_deg: float = 0.25

    def __post_init__(self) -> None:
        direction = require("light direction", self.direction, (3,), finite=True)
        length = float(np.linalg.norm(direction))
        if not length > 0.0:
            raise SceneError("a light's direction has length 0; it needs a direction")
        object.__setattr__(self, "direction", direction / length)
        object.__setattr__(self, "middle_mm", require("light middle_mm", self.middle_mm, (3,), finite=True))
        for name, value, high in (
            ("irradiance", self.irradiance, math.inf), ("distance_mm", self.distance_mm, math.inf),
            ("angular_radius_deg", self.angular_radius_deg, 90.0),
        ):  # fmt: skip
            if not 0.0 < value < high:
                raise SceneError(f"a light's {name} is {value}; it must be above 0 and below {high}")

    @classmethod
    def of(cls, source: Source, middle_mm: npt.ArrayLike) -> Light:
        """The light that `source` is, seen from `middle_mm`; its first wavelength's radiance."""
        middle = require("middle_mm", middle_mm, (3,), finite=True)
        towards = source.centre_mm - middle
        distance = float(np.linalg.norm(towards))
        sine = source.radius_mm / distance if distance > 0.0 else math.inf
        if not sine < 1.0:
            raise SceneError("the light holds the middle of what it lights; move it away or make it smaller")
        return cls(towards, math.pi * sine**2 * float(source.radiance[0]), middle, distance, math.degrees(math.asin(sine)))

    @property
    def centre_mm(self) -> FloatArray:
        """(3,) its middle, world frame."""
        return self.middle_mm + self.distance_mm * self.direction

    @property
    def radius_mm(self) -> float:
        """Radius of the sphere."""
        return self.distance_mm * math.sin(math.radians(self.angular_radius_deg))

    @property
    def radiance(self) -> float:
        """Of its surface, so that its irradiance at the middle is as stated."""
        return self.irradiance / (math.pi * math.sin(math.radians(self.angular_radius_deg)) ** 2)

    def source(self) -> Source:
        """As a scene takes it."""
        return Source(self.centre_mm, self.radius_mm, np.array([self.radiance]))

    def turned(self, across: FloatArray) -> Light:
        """Moved on its sphere by the two angles `across` (2,) rad along `tangents`."""
        a, b = tangents(self.direction)
        angle = float(np.hypot(*across))
        if angle == 0.0:
            return self
        aside = (across[0] * a + across[1] * b) / angle
        return replace(self, direction=math.cos(angle) * self.direction + math.sin(angle) * aside)


def tangents(z: FloatArray) -> FloatArray:
    """(2, 3) unit vectors across the unit vector z."""
    return np.array(frame_around(*z)).reshape(2, 3)


def tangent_slopes(z: FloatArray) -> FloatArray:
    """(2, 3, 3) derivative of `tangents` by z."""
    sign = 1.0 if z[2] >= 0.0 else -1.0
    a = -1.0 / (sign + z[2])
    by_a = np.array([0.0, 0.0, a * a])
    by_b = np.array([z[1] * a, z[0] * a, z[0] * z[1] * a * a])
    slopes = np.zeros((2, 3, 3))
    slopes[0, 0] = sign * z[0] ** 2 * by_a + [2.0 * sign * z[0] * a, 0.0, 0.0]
    slopes[0, 1] = sign * by_b
    slopes[0, 2] = [-sign, 0.0, 0.0]
    slopes[1, 0] = by_b
    slopes[1, 1] = z[1] ** 2 * by_a + [0.0, 2.0 * z[1] * a, 0.0]
    slopes[1, 2] = [0.0, -1.0, 0.0]
    return slopes


def light_arrays(lights: tuple[Light, ...]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """centres (s, 3), radii (s,), frames (s, 2, 3) and frame_slopes (s, 2, 3, 3) by the centre, as `radiance.shade` takes them."""
    across = np.eye(3)[None] - np.array([np.outer(light.direction, light.direction) for light in lights])
    frames = np.array([tangents(light.direction) for light in lights])
    slopes = np.array([tangent_slopes(light.direction) @ (p / light.distance_mm) for light, p in zip(lights, across)])
    centres = np.array([light.centre_mm for light in lights])
    return centres, np.array([light.radius_mm for light in lights]), frames, slopes
