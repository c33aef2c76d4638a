"""Sources of light: spheres of even radiance, and the light they give to a point; equations (20)-(22).

World frame, millimetres. Radiance in W m^-2 sr^-1 or any relative unit that is the same everywhere, one number per wavelength.
The report's solid angle pi r^2/d^2 is kept for irradiance, where it is exact for a sphere wholly above the horizon; the solid angle
itself is 2 pi (1 - sqrt(1 - r^2/d^2)). A sphere that the horizon cuts: Snyder, *Area light sources for real-time graphics*, 1996.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray, require
from rangecheck.errors import SceneError
from rangecheck.kernels import kernel, stage_kernel


@dataclass(frozen=True, eq=False)
class Source:
    """A sphere that shines evenly: centre (3,) mm, radius mm > 0, radiance (c,) >= 0 (a single number serves all wavelengths)."""

    centre_mm: FloatArray
    radius_mm: float
    radiance: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_mm", require("source centre_mm", self.centre_mm, (3,), finite=True))
        object.__setattr__(self, "radiance", checked_radiance("source radiance", self.radiance))
        if not (math.isfinite(self.radius_mm) and self.radius_mm > 0):
            raise SceneError(
                f"a source's radius is {self.radius_mm} mm; it must be positive and finite", radius_mm=self.radius_mm
            )

    @classmethod
    def giving(
        cls, irradiance: npt.ArrayLike, at_mm: npt.ArrayLike, centre_mm: npt.ArrayLike, angular_radius_deg: float
    ) -> Source:
        """The source at `centre_mm` that, `angular_radius_deg` in radius as seen from `at_mm`, gives a surface there that faces
        it the stated irradiance (per wavelength)."""
        if not 0 < angular_radius_deg < 90:
            raise SceneError(f"angular_radius_deg is {angular_radius_deg}; it must lie between 0 and 90 degrees")
        centre = require("source centre_mm", centre_mm, (3,), finite=True)
        distance = float(np.linalg.norm(centre - require("at_mm", at_mm, (3,), finite=True)))
        sine = math.sin(math.radians(angular_radius_deg))
        return cls(centre, distance * sine, np.atleast_1d(np.asarray(irradiance, float)) / (math.pi * sine**2))

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """Distance (...,) of its centre from points (..., 3). Raises SceneError where a point lies inside it."""
        distance = np.linalg.norm(np.asarray(points_mm, float) - self.centre_mm, axis=-1)
        inside = int((distance <= self.radius_mm).sum())
        if inside:
            raise SceneError(
                f"{inside} points lie inside the source at {np.array2string(self.centre_mm, precision=4)} with radius "
                f"{self.radius_mm:g} mm, the nearest {float(distance.min()):.4g} mm from its centre; move the source away or make it smaller",
                inside=inside,
                nearest_mm=float(distance.min()),
            )
        return distance

    def solid_angle(self, points_mm: FloatArray) -> FloatArray:
        """Exact solid angle (...,) sr seen from points outside it."""
        sine2 = (self.radius_mm / self.distance_mm(points_mm)) ** 2
        # 1 - sqrt(1 - x) without cancellation for the small and far
        return 2 * math.pi * sine2 / (1 + np.sqrt(1 - sine2))

    def irradiance(self, points_mm: FloatArray, normals: FloatArray) -> FloatArray:
        """Irradiance (..., c) of unshadowed points (..., 3) with unit normals, exact also where the horizon cuts the sphere."""
        points = np.asarray(points_mm, float)
        distance = self.distance_mm(points)
        cosine = ((self.centre_mm - points) * normals).sum(axis=-1) / distance
        factor = _form_factors(np.ravel(cosine), np.ravel((self.radius_mm / distance) ** 2)).reshape(np.shape(cosine))
        return math.pi * factor[..., None] * self.radiance


@stage_kernel
def form_factor(cosine, sine2):
    """Share of a hemisphere's cosine-weighted light that a sphere fills: pi L times this is its irradiance.

    cosine: of the angle between normal and centre; sine2 = (r/d)^2. Above the horizon cosine r^2/d^2, equation (20)."""
    if cosine * cosine > sine2:
        return sine2 * cosine if cosine > 0.0 else 0.0
    # the horizon cuts it
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    y = math.sqrt(max(0.0, 1.0 / sine2 - 1.0))
    x = max(-1.0, min(1.0, -y * cosine / max(sine, 1e-300)))
    root = sine * math.sqrt(max(0.0, 1.0 - x * x))
    return max(0.0, (cosine * math.acos(x) - y * root) * sine2 + math.atan2(root, y)) / math.pi


@kernel
def _form_factors(cosines, sines2):
    result = np.empty(len(cosines))
    for i in range(len(cosines)):
        result[i] = form_factor(cosines[i], sines2[i])
    return result


def checked_radiance(name: str, radiance: npt.ArrayLike) -> FloatArray:
    """`radiance` as (c,) float64, finite and not negative. Raises SceneError."""
    values = np.atleast_1d(np.asarray(radiance, dtype=float))
    if values.ndim != 1 or not len(values) or not np.isfinite(values).all() or (values < 0).any():
        raise SceneError(f"{name} is {radiance!r}; it must be one finite number >= 0 per wavelength")
    return values
