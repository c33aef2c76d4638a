"""Scenes of the study of recovery, whose truth is the model itself, and how far from it a fit ends.

A sphere of random material under lamps of random directions, one picture each with Gaussian noise, exposed so that its brightest point lies between 0.7 and
1.2 of full scale (what passes 1 is clipped). Lamps and lengths start from elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rangecheck.recover.fit import TWO_SIDED_95, Fitted
from rangecheck.recover.lights import Light, tangents
from rangecheck.recover.problem import Guess, Photograph, Problem, Unknowns
from rangecheck.recover.sight import sphere_sight

#: standard deviation of a pixel where nothing else is said, parts of full scale
NOISE = 0.01
FAR_MM, WAVE_UM = 1e6, 0.555


def random_scene(seed: int, size: int, *, noise: float = NOISE, pictures: int = 1) -> tuple[Problem, Problem]:
    """A problem as it is put, and the same at its truth: sphere of `size` pixels, everything drawn from `seed`."""
    rng = np.random.default_rng(seed)
    slope, height = (math.exp(rng.uniform(math.log(a), math.log(b))) for a, b in ((0.06, 0.3), (0.03, 0.3)))
    truth = Guess(rng.uniform(0.1, 0.5), 0.0, rng.uniform(0.1, 0.4), height, max(2.0 * height / slope, 0.6), WAVE_UM)
    sight = sphere_sight((size / 2, size / 2), 0.47 * size, (size, size))
    n = len(sight)
    lights, photos = [], []
    for k in range(pictures):
        direction = np.array([rng.uniform(-0.7, 0.7), rng.uniform(-0.7, 0.7), 0.8])
        lights.append(Light(direction, 2.5, np.zeros(3), FAR_MM, 0.5))
        photos.append(Photograph(sight, np.zeros(n), np.full(n, noise), np.ones((n, 1), bool), (k,)))
    at_truth = Problem(tuple(photos), tuple(lights), truth, Unknowns())
    shown = [at_truth.predict(at_truth.start(), k, slopes=False).values for k in range(pictures)]
    scale = rng.uniform(0.7, 1.2) / max(float(v.max()) for v in shown)
    taken = tuple(
        replace(photo, values=np.minimum(scale * v + rng.normal(0.0, noise, n), 1.0)) for photo, v in zip(photos, shown)
    )
    lights = [replace(light, irradiance=scale * light.irradiance) for light in lights]
    at_truth = replace(at_truth, photographs=taken, lights=tuple(lights))
    begun = tuple(replace(light, direction=light.direction + rng.normal(0.0, 0.1, 3)) for light in lights)
    return replace(at_truth, lights=begun, material=Guess(wavelength_um=WAVE_UM)), at_truth


def truths(found: Fitted, at_truth: Problem) -> dict[str, float]:
    """The true value of every parameter that was fitted, in the unit of its estimate."""
    known: dict[str, float] = {}
    for p in found.parameters:
        if p.kind in ("strength", "log strength", "length"):
            known[p.name] = float(getattr(at_truth.material, p.name))
        elif p.kind == "direction":
            base, to = found.started.lights[p.owner].direction, at_truth.lights[p.owner].direction
            aside = to - (to @ base) * base
            length = float(np.linalg.norm(aside))
            angle = math.atan2(length, float(to @ base))
            known[p.name] = float(angle * (tangents(base)[p.number] @ aside) / length) if length > 0 else 0.0
    return known


def stated_deviation(found: Fitted, name: str) -> float:
    """Standard deviation of a number as the fit states it, parts of its value; nan where it is not determined within a factor of two.

    An interval over several answers that explain the pictures alike holds the truth, but is no standard deviation around one of them."""
    e = found.estimate(name)
    if e.low is None or e.high is None or not 0.0 < e.high <= 2.0 * e.low:
        return math.nan
    return (e.high - e.low) / (2.0 * TWO_SIDED_95 * e.value)


def error_against_truth(found: Fitted, at_truth: Problem, name: str) -> float:
    """By how much a number of the material is wrong, parts of its true value, with its sign."""
    true = float(getattr(at_truth.material, name))
    return (found.estimate(name).value - true) / true
