"""Two pictures of independent chance that tell each other's error: what evenly spread samples gain on random ones is then measured, where
the spread inside a pixel would have them as good as random only.

The mean of two pictures A and B is off by (A - B)/2, root mean square over the frame. Pixels that both see by their middle alone do
not differ by chance; for them the departure from their neighbours stands, undivided.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.optics import Camera
from rangecheck.transport.adaptive import Exposure, unevenness
from rangecheck.transport.film import Film
from rangecheck.transport.settings import Settings
from rangecheck.transport.tracer import Tracer

#: each picture is first asked for this many times the error, as its own samples estimate it
_HOPEFUL = 2.5
#: aim a little below the error asked for, so that a second step is the last
_AIM = 0.97
_STEPS = 8
#: standard errors of the measured squared error that are added to it
_SURE = 2.0
_OTHER = 0x5BD1E995


def render_in_halves(
    tracer: Tracer, camera: Camera, world_from_camera: FloatArray, settings: Settings, error: float, *, seed: int = 0
) -> Film:
    """The picture with a measured error of at most `error` of its mean radiance; chance from `seed` alone."""
    asked = _HOPEFUL * error
    two = [Exposure(tracer, camera, world_from_camera, settings, seed=s) for s in (seed, seed ^ _OTHER)]
    for _ in range(_STEPS):
        for exposure in two:
            exposure.refine(asked)
        one, other = (exposure.film() for exposure in two)
        off = measured_error(one, other)
        if not off > error:
            break
        asked *= max(0.3, _AIM * error / off)
    return replace(
        one,
        radiance=0.5 * (one.radiance + other.radiance),
        coverage=0.5 * (one.coverage + other.coverage),
        variance=0.25 * (one.variance + other.variance),
        samples=one.samples + other.samples,
        budget=0.5 * (one.budget + other.budget),
    )


def measured_error(one: Film, other: Film) -> float:
    """Root mean square error of the mean of two independent pictures and what it may be more, relative to its mean radiance; 0 for a dark
    one."""
    mean = 0.5 * (one.mean_radiance + other.mean_radiance)
    if not mean > 0:
        return 0.0
    squared = 0.25 * ((one.radiance.astype(np.float64) - other.radiance) ** 2).mean(axis=2)
    height, width = squared.shape
    alone = unevenness(np.ascontiguousarray(one.radiance.reshape(height * width, -1)), height, width)
    # whose neighbours are alone too: beside sampled pixels the departure tells of those
    single = np.pad((one.samples == 1) & (other.samples == 1), 1, constant_values=True)
    single = np.logical_and.reduce([single[r : r + height, c : c + width] for r in range(3) for c in range(3)])
    squared = np.where(single, alone.reshape(height, width), squared)
    # few pixels at edges may hold most of it, and then two pictures know it only so well
    return math.sqrt(float(squared.mean()) + _SURE * float(squared.std()) / math.sqrt(height * width)) / mean
