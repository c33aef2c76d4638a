"""Time of flight by continuous modulation: phase of the light that returns from everything within a pixel.

Each pixel adds phasors A exp(i 2 pi f L / c) over its footprint, L being the path from source to surface to camera, so that a pixel across an
edge reports a distance between both sides (a flying pixel) or beyond them, and ranges wrap at c / (2 f). Four samples a quarter of a
period apart give the phase, one after the other: a subject that moves between them smears (Lange & Seitz, 2001; Lottner, Sluiter,
Hartmann, Weihs, *Movement artefacts in range images of time-of-flight cameras*, 2007). Light that bounces between
surfaces is not modelled: concave corners come out right here and rounded in reality.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.optics import Camera
from rangecheck.scan.simulate_noise import SPEED_OF_LIGHT_MM_S
from rangecheck.scan.simulate_view import Caster, Finish, Motion, camera_rays, look


@dataclass(frozen=True, eq=False)
class Phases:
    """What n pixels return without noise.

    range_mm (n,) NaN where dark;  amplitude (n,) 1 for white matt facing the source at the working distance
    path_mm (n,) source - surface - camera, within one wrap;  wrap_mm that wrap, c / f;  sub_paths_mm (k, n) of all rays in a pixel
    """

    range_mm: FloatArray
    amplitude: FloatArray
    path_mm: FloatArray
    wrap_mm: float
    sub_paths_mm: FloatArray

    def flying(self, tolerance_mm: FloatArray) -> BoolArray:
        """(n,) whether the range lies farther than the tolerance (n,) from all surface met within the pixel, wraps aside."""
        with np.errstate(invalid="ignore"):
            away = np.remainder(self.path_mm - self.sub_paths_mm, self.wrap_mm)
            away = np.minimum(away, self.wrap_mm - away)
            nearest = np.where(np.isnan(away), np.inf, away).min(axis=0)
            return np.isfinite(self.range_mm) & (0.5 * nearest > tolerance_mm)


def phases(
    caster: Caster,
    camera: Camera,
    pose: FloatArray,
    source_local_mm: FloatArray,
    *,
    modulation_mhz: float,
    working_distance_mm: float,
    subrays: int,
    finish: Finish,
    motion: Motion | None,
    sample_s: float,
) -> Phases:
    """Noise-free answer of every pixel, from subrays x subrays rays in it and four samples `sample_s` apart about time 0."""
    source = pose[:3, :3] @ source_local_mm + pose[:3, 3]
    per_mm = 2.0 * math.pi * modulation_mhz * 1e6 / SPEED_OF_LIGHT_MM_S
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    samples = np.zeros((4, u.size))
    offsets = (np.arange(subrays) + 0.5) / subrays - 0.5
    sub_paths = []
    for dv in offsets:
        for du in offsets:
            origins, rays = camera_rays(pose, camera.rays(u + du, v + dv))
            for step in range(4):
                if step == 0 or motion is not None:
                    time = np.full(u.size, (step - 1.5) * sample_s)
                    view = look(caster, origins, rays, source, finish=finish, motion=motion, time_s=time)
                    amplitude = view.signal(working_distance_mm) / subrays**2
                    path = np.where(view.seen, view.distance_mm + view.source_mm, 0.0)
                    sub_paths.append(np.where(amplitude > 0, path, np.nan))
                samples[step] += amplitude * np.cos(per_mm * path + 0.5 * math.pi * step)
    real, imaginary = 0.5 * (samples[0] - samples[2]), 0.5 * (samples[3] - samples[1])
    amplitude = np.hypot(real, imaginary)
    path = np.remainder(np.arctan2(imaginary, real), 2.0 * math.pi) / per_mm
    centre_rays = camera.pixel_rays()[1].reshape(-1, 3)
    range_mm = range_of_path(path, centre_rays @ source_local_mm, float(source_local_mm @ source_local_mm))
    return Phases(np.where(amplitude > 0, range_mm, np.nan), amplitude, path, 2.0 * math.pi / per_mm, np.stack(sub_paths))


def footprint_mm(camera: Camera, range_mm: FloatArray) -> FloatArray:
    """(n,) width of each pixel on a facing surface at these ranges (n,)."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    (left, left_ray), (right, right_ray) = camera.rays(u - 0.5, v), camera.rays(u + 0.5, v)
    between = (right - left).reshape(-1, 3) + range_mm[:, None] * (right_ray - left_ray).reshape(-1, 3)
    return np.linalg.norm(between, axis=1)


def range_of_path(path_mm: FloatArray, source_along_ray_mm: FloatArray, source_squared_mm2: float) -> FloatArray:
    """Range r from the length of the way source - surface - camera: |r d - s| = path - r squared and solved for r."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return (path_mm**2 - source_squared_mm2) / (2.0 * (path_mm - source_along_ray_mm))
