"""Where a fit begins: states of smooth, intermediate and rough surfaces on a few thousand pixels, each with its best strengths, and where they end."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.recover.lights import Light
from rangecheck.recover.problem import LEAST_LOBE, LENGTHS, STRENGTHS, WIDEST_DEG, Parameter, Photograph, Problem
from rangecheck.recover.residuals import BEND, moved_sights, residuals, robust_cost

#: starts: widths of the lobes (rms slope of the rough limit) and roughness (2 pi sigma/lambda)^2
_START_WIDTHS, _START_ROUGHNESS = (0.03, 0.08, 0.2, 0.5), (0.03, 0.6, 10.0)
#: and the lamps' radii, by that given: a highlight is as wide as its lamp and its lobe together, and many pairs look alike from afar
_START_RADII = (0.3, 0.6, 1.7, 3.0)


def thin(problem: Problem, pixels: int) -> Problem:
    """The problem with about `pixels` pixels of all pictures together."""
    each = pixels // len(problem.photographs)
    return replace(problem, photographs=tuple(_thinned(photo, each) for photo in problem.photographs))


def _thinned(photo: Photograph, count: int) -> Photograph:
    """About `count` pixels: half spread over the picture, half over its brightest tenth, where highlights are.

    Bright is judged by the surroundings of a pixel without itself: chosen by their own noise, the bright would be too bright."""
    if len(photo.sight) <= count:
        return photo
    every, bright, _ = _chosen(photo, count)
    return photo.only(np.unique(np.concatenate([every, bright])))


def _chosen(photo: Photograph, count: int) -> tuple[IntArray, IntArray, IntArray]:
    """Pixels of all, pixels of the brightest tenth, and that tenth."""
    from scipy.ndimage import uniform_filter

    n = len(photo.sight)
    every = np.arange(0, n, max(1, 2 * n // count))
    seen = photo.sight.spread(np.ones(n), 0.0)
    light = photo.sight.spread(photo.values, 0.0)
    ring = uniform_filter(light, 5) * 25.0 - light
    members = uniform_filter(seen, 5) * 25.0 - seen
    around = (ring / np.maximum(members, 0.5)).reshape(-1)[photo.sight.pixel]
    order = np.argsort(around, kind="stable")[-max(1, n // 10) :]
    return every, np.sort(order)[:: max(1, 2 * len(order) // count)], order


def standing_for_all(problem: Problem, pixels: int) -> Problem:
    """As `thin`, the noise of each pixel lessened so that those chosen weigh as much as all that they stand for."""
    each = pixels // len(problem.photographs)
    return replace(problem, photographs=tuple(_weighed(photo, each) for photo in problem.photographs))


def _weighed(photo: Photograph, count: int) -> Photograph:
    n = len(photo.sight)
    if n <= count:
        return photo
    every, bright, order = _chosen(photo, count)
    chance = np.full(n, len(every) / n)
    chance[order] += len(bright) / len(order)
    both = np.unique(np.concatenate([every, bright]))
    few = photo.only(both)
    return replace(few, noise=few.noise * np.sqrt(np.minimum(chance[both], 1.0)))


def families(problem: Problem) -> list[list[Problem]]:
    """Starts where lengths are unknown: smooth, intermediate and rough surfaces, of which pictures can often not tell one from another
    without having tried it; in each family the widths of the lobe differ."""
    guess, wave = problem.material, problem.material.wavelength_um
    names = set(LENGTHS) & set(problem.unknowns.material)
    families = []
    for roughness in _START_ROUGHNESS if names else ():
        family = []
        for width in _START_WIDTHS:
            # one order spreads by lambda/(2 pi T), and of about 4 roughness orders the rough limit's 2 sigma/T remains
            correlation = math.sqrt(max(1.0, 4.0 * roughness)) * wave / (2.0 * math.pi * width)
            lengths = {"sigma_um": math.sqrt(roughness) * wave / (2.0 * math.pi), "correlation_um": max(correlation, 0.6 * wave)}
            family.append(replace(problem, material=guess.but(**{n: v for n, v in lengths.items() if n in names})))
        families.append(family)
    return families


def mirrors(problem: Problem) -> list[Problem]:
    """Starts as mirrors without a lobe, where a spike is looked for: beside a lobe, which is fitted to the highlight too, it would begin with nothing."""
    wanted = problem.unknowns.material
    if not {"K_spike", "sigma_um"} <= set(wanted):
        return []
    polished = problem.material.but(
        K_lobe=LEAST_LOBE, sigma_um=math.sqrt(_START_ROUGHNESS[0]) * problem.material.wavelength_um / (2.0 * math.pi)
    )
    alone = replace(problem.unknowns, material=tuple(name for name in wanted if name != "K_lobe"))
    states = [with_best_strengths(replace(lit, material=polished, unknowns=alone)) for lit in lamps(problem)]
    return [replace(state, unknowns=problem.unknowns) for state in states]


def lamps(problem: Problem) -> list[Problem]:
    """The same state under other lamps, where they are unknown: where the brightest spots mirror them, and of other radii."""
    places = [problem]
    if problem.unknowns.direction and all(len(photo.lights) == 1 for photo in problem.photographs):
        lights = list(problem.lights)
        for photo in problem.photographs:
            lights[photo.lights[0]] = _mirrored(photo, lights[photo.lights[0]])
        places.append(replace(problem, lights=tuple(lights)))
    return [sized for place in places for sized in (place, *(_radii(place) if problem.unknowns.radius else []))]


def _mirrored(photo: Photograph, light: Light) -> Light:
    """The lamp where the brightest spot of a picture mirrors it."""
    sight = photo.sight
    from scipy.ndimage import uniform_filter

    members, total = (uniform_filter(sight.spread(v, 0.0), 3) for v in (np.ones(len(sight)), photo.values))
    around = (total / np.maximum(members, 1e-9)).reshape(-1)[sight.pixel]
    spot = around >= np.quantile(around, 1.0 - 4.0 / max(len(around), 5))
    normal, view, point = (getattr(sight, name)[spot].mean(axis=0) for name in ("normals", "views", "points"))
    normal, view = normal / np.linalg.norm(normal), view / np.linalg.norm(view)
    along = 2.0 * (normal @ view) * normal - view
    return replace(light, direction=point - light.middle_mm + light.distance_mm * along)


def _radii(problem: Problem) -> list[Problem]:
    return [
        replace(problem, lights=tuple(
            replace(light, angular_radius_deg=min(times * light.angular_radius_deg, WIDEST_DEG)) for light in problem.lights))
        for times in _START_RADII
    ]  # fmt: skip


def cheapest(family: list[Problem]) -> Problem:
    """The best of some starts, each with its best strengths."""
    ready = [with_best_strengths(p) for p in family]
    return min(ready, key=lambda p: robust_cost(p, p.start()))


def with_best_strengths(problem: Problem) -> Problem:
    """The same state with those unknown strengths that fit the pictures best, all else held; they enter linearly."""
    from scipy.optimize import nnls

    names = [name for name in STRENGTHS if name in problem.unknowns.material]
    if not names:
        return problem
    alone = replace(problem, unknowns=replace(problem.unknowns, material=STRENGTHS, direction=False, irradiance=False, distance=False,
                                              radius=False, exposure=False, ambient=False, pose=False))  # fmt: skip
    columns, rest = [], []
    asked = [STRENGTHS.index(name) for name in names]
    now = np.array([problem.material.K_lm, problem.material.K_spike, max(problem.material.K_lobe, LEAST_LOBE)])[asked]
    for k, photo in enumerate(problem.photographs):
        shown, slopes = alone.predict(alone.start(), k)
        slopes[:, STRENGTHS.index("K_lobe")] /= max(problem.material.K_lobe, LEAST_LOBE)
        used = photo.values < photo.saturation
        mine = slopes[:, asked]
        columns.append((mine / photo.noise[:, None])[used])
        rest.append(((photo.values - shown + mine @ now) / photo.noise)[used])
    best, _ = nnls(np.concatenate(columns), np.concatenate(rest))
    return replace(problem, material=problem.material.but(**{n: max(float(b), LEAST_LOBE) for n, b in zip(names, best)}))


def solve(problem: Problem, parameters: list[Parameter]) -> tuple[Problem, float]:
    """The best state from one start, on the pixels that `problem` holds, and its cost."""
    from scipy.optimize import least_squares

    low, high = np.array([p.low for p in problem.parameters()]), np.array([p.high for p in problem.parameters()])
    start = np.clip(problem.start(), low + 1e-4, high - 1e-9)
    memory: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def both(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        key = theta.tobytes()
        if key not in memory:
            memory.clear()
            parts = [residuals(problem, theta, k) for k in range(len(problem.photographs))]
            memory[key] = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
        return memory[key]

    found = least_squares(
        lambda t: both(t)[0], start, lambda t: both(t)[1], bounds=(low, high), loss="huber", f_scale=BEND,
        x_scale=np.array([p.unit for p in parameters]), max_nfev=40, ftol=1e-6, xtol=1e-6, gtol=1e-6,
    )  # fmt: skip
    state, poses = problem.at(found.x)
    return moved_sights(state, poses), float(found.cost)
