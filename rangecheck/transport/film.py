"""What a camera collected: mean radiance per pixel, how sure it is, and where the light came from."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import CameraError
from rangecheck.kernels import in_chunks, stage_kernel
from rangecheck.optics import Camera
from rangecheck.transport.queues import KIND_NAMES


@dataclass(frozen=True, eq=False)
class Film:
    """A rendered picture, linear.

    radiance  (h, w, c) float32, as of the scene's sources
    coverage  (h, w) float32, share of the pixel's samples that met a surface
    variance  (h, w, c) float32 of `radiance`, estimated from the spread of the pixel's observations as if they were independent
              (they are spread evenly, so that it is an upper estimate); NaN where a single one was made
    samples   (h, w) int32 rays per pixel, with those that are known to meet nothing and were not cast
    budget    (first reflection, number of reflections, light): radiance summed over samples and wavelengths, divided by pixels x passes
    lights    names of the lights, the surroundings last
    """

    radiance: FloatArray = field(repr=False)
    coverage: FloatArray = field(repr=False)
    variance: FloatArray = field(repr=False)
    samples: IntArray = field(repr=False)
    budget: FloatArray = field(repr=False)
    lights: tuple[str, ...] = ()

    def _repr_png_(self) -> bytes:
        """A notebook's look at the picture, at an exposure of its own."""
        from rangecheck.quick_look import radiance_png

        return radiance_png(self.radiance)

    @property
    def mean_radiance(self) -> float:
        """Over the frame and its wavelengths."""
        return float(self.radiance.mean(dtype=np.float64))

    def standard_error(self) -> float:
        """Root mean square over the frame of each pixel's standard error, from `variance`; NaN when a pixel has a single sample."""
        return float(np.sqrt(self.variance.mean(dtype=np.float64)))

    def in_channels(self, channels: int) -> Film:
        """A grey film as one of `channels` equal wavelengths."""
        if self.radiance.shape[2] == channels:
            return self
        shape = (*self.radiance.shape[:2], channels)
        radiance, variance = (np.ascontiguousarray(np.broadcast_to(a, shape)) for a in (self.radiance, self.variance))
        return replace(self, radiance=radiance, variance=variance, budget=self.budget * channels)

    def shares(self) -> dict[str, dict[str, float]]:
        """The light budget: share (0..1) of the frame's radiance by source, by number of reflections, by first reflection."""
        total = float(self.budget.sum())
        if not total > 0:
            return {"light": {}, "reflections": {}, "reflection": {}}
        reflections = {str(count): float(light) for count, light in enumerate(self.budget.sum(axis=(0, 2)))}
        parts: dict[str, dict[str, float]] = {
            "light": dict(zip(self.lights, self.budget.sum(axis=(0, 1)).tolist())),
            "reflections": reflections,
            "reflection": dict(zip(KIND_NAMES, self.budget.sum(axis=(1, 2)).tolist())),
        }
        return {name: {key: value / total for key, value in part.items()} for name, part in parts.items()}

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready summary, without the picture."""
        return {
            "mean_radiance": self.mean_radiance,
            "covered": float(self.coverage.mean()),
            "samples_per_pixel": float(self.samples.mean()),
            "shares": self.shares(),
        }


def image_irradiance(film: Film, camera: Camera, lens_diameter_mm: float, focal_length_mm: float) -> FloatArray:
    """(h, w, c) irradiance of the image plane, equation (15): L (pi/4) (d/f)^2 cos^4 gamma, gamma the ray's angle to the axis."""
    if not (lens_diameter_mm > 0 and focal_length_mm > 0):
        raise CameraError(f"lens diameter is {lens_diameter_mm} mm and focal length {focal_length_mm} mm; both must be positive")
    cosine = camera.pixel_rays()[1][..., 2]
    falloff = 0.25 * np.pi * (lens_diameter_mm / focal_length_mm) ** 2 * cosine**4
    return (film.radiance * falloff[..., None]).astype(np.float32)


class Plate:
    """The film while it is exposed: running mean and squared deviations per pixel (Welford 1962)."""

    def __init__(self, height: int, width: int, channels: int) -> None:
        self.shape = (height, width)
        n = height * width
        self.mean = np.zeros((n, channels), np.float32)
        self.spread = np.zeros((n, channels), np.float32)
        self.covered = np.zeros(n, np.float32)
        self.count = np.zeros(n, np.int32)

    def erase(self, pixels: IntArray) -> None:
        """Forget what these pixels have seen."""
        for array in (self.mean, self.spread, self.covered, self.count):
            array[pixels] = 0

    def develop(self, budget: FloatArray, lights: tuple[str, ...], rays: IntArray | None = None) -> Film:
        """The film; `rays` per pixel where they differ from the observations."""
        variance, coverage = np.empty_like(self.spread), np.empty_like(self.covered)

        def rows(start: int, stop: int) -> None:
            own = slice(start, stop)
            _develop(self.spread[own], self.covered[own], self.count[own], variance[own], coverage[own])

        in_chunks(rows, len(self.count), 1 << 17)
        return Film(
            radiance=self.mean.reshape(*self.shape, -1),
            coverage=coverage.reshape(self.shape),
            variance=variance.reshape(*self.shape, -1),
            samples=(self.count if rays is None else rays).reshape(self.shape),
            budget=budget,
            lights=lights,
        )


@stage_kernel
def expose(pixels, each, sample, face, mean, spread, covered, count):
    """Add one observation of each pixel, the mean of `each` rays; `face` says whether a ray met a surface."""
    for i in range(len(pixels)):
        pixel = pixels[i]
        met = np.int64(0)
        for j in range(each):
            met += face[i * each + j] >= 0
        covered[pixel] += np.float32(met / each)
        count[pixel] += 1
        if count[pixel] == 1:
            for c in range(sample.shape[1]):
                mean[pixel, c], spread[pixel, c] = sample[i, c], 0.0
            continue
        for c in range(sample.shape[1]):
            before = sample[i, c] - mean[pixel, c]
            mean[pixel, c] += before / count[pixel]
            spread[pixel, c] += before * (sample[i, c] - mean[pixel, c])


@stage_kernel
def _develop(spread, covered, count, variance, coverage):
    """Variance of each pixel's mean, NaN where a single observation tells nothing of it, and the share of them that met a surface."""
    for i in range(len(count)):
        n = count[i]
        coverage[i] = covered[i] / np.float32(n) if n > 0 else np.float32(0)
        for c in range(spread.shape[1]):
            variance[i, c] = spread[i, c] / (np.float32(n) * np.float32(n - 1)) if n > 1 else np.float32(np.nan)
