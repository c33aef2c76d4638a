"""Light whose answer is known: spherical sources over Lambertian patches, and Lambertian enclosures.

Radiance L in W m^-2 sr^-1 (or relative units), irradiance E in W m^-2, albedo rho between 0 and 1; all lengths in one unit.
Source: Fujiwara, Nayar, Ikeuchi, *Appearance Simulator for Computer Vision Research*, CMU-RI-TR-91-16, eqs (16)-(22).
Inputs broadcast; results are float64.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray
from rangecheck.errors import SceneError


def solid_angle_of_sphere(radius: npt.ArrayLike, distance: npt.ArrayLike) -> FloatArray:
    """2 pi (1 - sqrt(1 - (radius / distance)^2)) sr. Raises SceneError when the point is not outside the sphere."""
    sine = _sine(radius, distance)
    # 1 - cos written so that small sources keep their digits
    return 2.0 * math.pi * sine**2 / (1.0 + np.sqrt(1.0 - sine**2))


def irradiance_of_sphere(
    radiance: npt.ArrayLike, radius: npt.ArrayLike, distance: npt.ArrayLike, cosine: npt.ArrayLike
) -> FloatArray:
    """Irradiance of a patch from a uniform sphere, `cosine` being that between the patch's normal and the sphere's centre.

    L pi (radius / distance)^2 cosine (20)-(22), exact while the whole sphere is above the patch's horizon, 0 while it is wholly
    below. Where the horizon cuts it, with s = radius / distance and c = cosine:

        E = L (c s^2 acos(-c sqrt(1 - s^2) / (s sqrt(1 - c^2))) + atan(sqrt(s^2 - c^2) / sqrt(1 - s^2)) - sqrt(1 - s^2) sqrt(s^2 - c^2))

    which meets both ends. Raises SceneError when the patch is not outside the sphere or |cosine| exceeds 1."""
    s, c = np.broadcast_arrays(_sine(radius, distance), np.asarray(cosine, dtype=float))
    if (np.abs(c) > 1.0 + 1e-12).any():
        raise SceneError(f"cosine reaches {float(np.abs(c).max()):.6g}; a cosine lies between -1 and 1")
    far = np.sqrt(1.0 - s * s)
    above = np.sqrt(np.maximum(s * s - c * c, 0.0))
    across = np.maximum(s * np.sqrt(np.maximum(1.0 - c * c, 0.0)), np.finfo(float).tiny)
    cut = c * s * s * np.arccos(np.clip(-c * far / across, -1.0, 1.0)) + np.arctan2(above, far) - far * above
    factor = np.where(c >= s, math.pi * s * s * c, np.where(c <= -s, 0.0, cut))
    return np.asarray(radiance, dtype=float) * np.maximum(factor, 0.0)


def lambert_radiance(albedo: npt.ArrayLike, irradiance: npt.ArrayLike) -> FloatArray:
    """Radiance rho E / pi of a Lambertian patch (16), the same in every direction."""
    return np.asarray(albedo, dtype=float) * np.asarray(irradiance, dtype=float) / math.pi


def lit_patch_radiance(
    points: FloatArray,
    normals: FloatArray,
    source_centre: npt.ArrayLike,
    source_radius: float,
    source_radiance: float,
    albedo: float,
) -> FloatArray:
    """(...,) radiance of Lambertian patches at `points` (..., 3) with unit `normals`, lit by one sphere and shadowed by nothing but
    their own horizon: a convex body, or a plane, under one source. Raises SceneError when a point lies inside the source."""
    to_source = np.asarray(source_centre, dtype=float) - points
    distance = np.linalg.norm(to_source, axis=-1)
    cosine = np.clip((normals * to_source).sum(axis=-1) / np.maximum(distance, np.finfo(float).tiny), -1.0, 1.0)
    return lambert_radiance(albedo, irradiance_of_sphere(source_radiance, source_radius, distance, cosine))


def enclosure_radiance(
    albedo: npt.ArrayLike, flux: npt.ArrayLike, radius: npt.ArrayLike, scatterings: int | None = None
) -> FloatArray:
    """Radiance of the wall of a Lambertian sphere of `radius` after all scatterings, or after the first `scatterings` of them, with a
    source of radiant intensity I = flux / (4 pi) in all directions at its centre:

        rho I / (pi r^2 (1 - rho)) (1 - rho^n)

    every scattering spreads light evenly over the whole wall (Goebel, *Generalized integrating-sphere theory*, 1967), so a miscounted
    bounce shows. Raises SceneError unless 0 <= albedo < 1 (<= 1 when `scatterings` is given)."""
    rho, intensity = np.asarray(albedo, dtype=float), np.asarray(flux, dtype=float) / (4.0 * math.pi)
    if not ((rho >= 0) & (rho <= 1)).all() or (scatterings is None and (rho == 1).any()):
        raise SceneError(
            f"albedo reaches {float(rho.max()):g}; an enclosure whose wall absorbs nothing never settles, so it must be below 1",
            albedo=float(rho.max()),
        )
    first = rho * intensity / (math.pi * np.asarray(radius, dtype=float) ** 2)
    if scatterings is None:
        return first / (1.0 - rho)
    # the geometric sum itself where rho is so near 1 that the quotient loses its digits
    with np.errstate(divide="ignore", invalid="ignore"):
        count = np.where(
            rho < 1, -np.expm1(scatterings * np.log(np.where(rho > 0, rho, 1e-300))) / (1.0 - rho), float(scatterings)
        )
    return first * count


def _sine(radius: npt.ArrayLike, distance: npt.ArrayLike) -> FloatArray:
    r, d = np.broadcast_arrays(np.asarray(radius, dtype=float), np.asarray(distance, dtype=float))
    if not ((r > 0) & (d > r)).all():
        raise SceneError(
            f"a point is {float(np.min(d)):g} from the centre of a source of radius {float(np.max(r)):g}; it must lie outside the source",
            distance=float(np.min(d)),
        )
    return r / d
