"""Lamps calibrated from photographs of a matt sphere under parallel view: x right, y up, z to the camera, one lamp a picture.

Brightness is albedo times the cosine to the lamp; of rough matt surfaces, which send more light back where it came from, it is that of Oren & Nayar,
*Generalization of Lambert's reflectance model*, 1994 (its simple form, one slope for all pictures). No painted sphere is of one albedo: a stain pulls
every lamp to its other side. Where three pictures or more show each pixel, each has an albedo of its own, drawn from a normal law about 1 whose spread
is found with the rest (empirical Bayes), so that a clean sphere's pixels share theirs. Albedos are eliminated from the least squares (Kaufman 1975).

Left out are pixels seen or lit at grazing angles, where outline, blur and light from around count for more than the lamp. Directions are unit
vectors from the sphere to the lamp.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.errors import SceneError
from rangecheck.recover.sight import Sight, sphere_sight
from rangecheck.recover.spheres import Outline

#: cosines to camera and lamp below which a pixel says nothing of its lamp
_LEAST_FACING, _LEAST_COSINE = 0.3, 0.15
#: residual, parts of full scale, from which a pixel counts less
_OUTLYING = 0.02
#: pictures from which pixels have albedos of their own;  spread of these at first, and the least
_PAINTED, _SPREAD, _LEAST_SPREAD = 3, 0.1, 1e-3
_ROUNDS, _STEPS, _SETTLED = 8, 12, 1e-5
_PIXELS, _STEEPEST, _MOST_AROUND = 3000, 0.8, 0.3


class MattFit(NamedTuple):
    """directions (k, 3);  gains (k,) mean albedo times irradiance / pi of each picture, parts of full scale;  slope (rms, rad) of the rough
    matt surface, 0 for Lambert;  paint (h, w) albedo of each pixel over the mean, NaN off the sphere;  spread: its standard deviation;  rms: residual of all
    pixels of the sphere, parts of full scale."""

    directions: FloatArray
    gains: FloatArray
    slope: float
    paint: FloatArray
    spread: float
    rms: float


def rough_matt(normals: FloatArray, views: FloatArray, direction: FloatArray, slope: float, around: float = 0.0) -> FloatArray:
    """Brightness (n,) of a rough matt surface of albedo 1 that faces a lamp of irradiance pi; Lambert's cosine for slope 0. around: what the room sends back of
    the lamp, evenly from all sides, as share of the lamp's own."""
    c_i, c_r = normals @ direction, (normals * views).sum(1)
    lit = np.maximum(c_i, 0.0)
    s2 = slope * slope
    level, bonus = 1.0 - 0.5 * s2 / (s2 + 0.33), 0.45 * s2 / (s2 + 0.09)
    together = views @ direction - c_i * c_r
    return around + lit * (level + bonus * np.maximum(together, 0.0) / np.maximum(np.maximum(lit, c_r), 1e-3))


def lights_from_matt(
    pictures: Sequence[FloatArray],
    outline: Outline,
    *,
    rough: bool = True,
    saturation: float = 1.0,
    starts: FloatArray | None = None,
) -> MattFit:
    """Directions and gains of one lamp each from pictures (h, w) of a matt sphere, linear, in parts of full scale.

    All pictures share the surface: `rough` also fits its slope. Pixels at `saturation` are left out, outliers weighed down. Raises SceneError where a
    picture shows no light."""
    shape = (np.shape(pictures[0])[0], np.shape(pictures[0])[1])
    whole = sphere_sight(outline.centre_px, outline.radius_px, shape)
    facing = whole.only((whole.normals * whole.views).sum(1) > _LEAST_FACING)
    few = _Sphere(facing.only(np.arange(0, len(facing), max(1, len(facing) // _PIXELS))), pictures, saturation)
    begin = [
        _brightest(few.sight, values) if starts is None else starts[k] * float(values.max()) for k, values in enumerate(few.seen)
    ]
    lamps, slope = few.solved(np.array(begin), 0.2 if rough else 0.0, rough)
    gains = np.linalg.norm(lamps, axis=1)
    every = _Sphere(whole, pictures, saturation)
    every.noise, every.spread = few.noise, few.spread
    shown = every.shown(lamps, slope)
    paint = every.paint(shown, every.weights(lamps, shown))
    left = (paint * shown - every.seen)[every.known]
    # gains are of the mean albedo, which paint is relative to
    mean = float(np.median(paint))
    return MattFit(
        lamps / gains[:, None], gains * mean, slope, whole.spread(paint / mean), few.spread, math.sqrt(float((left**2).mean()))
    )


class _Sphere:
    """Pixels of a matt sphere in k pictures: seen (k, n), known (k, n) whether below saturation; `noise` of a pixel and `spread` of albedos, as found."""

    def __init__(self, sight: Sight, pictures: Sequence[FloatArray], saturation: float) -> None:
        values = np.array([np.asarray(p, np.float64).reshape(-1)[sight.pixel] for p in pictures])
        self.sight = sight
        self.known: BoolArray = np.isfinite(values) & (values < saturation)
        self.seen = np.nan_to_num(values)
        self.noise, self.spread = _OUTLYING, _SPREAD if len(values) >= _PAINTED else 0.0

    def shown(self, lamps: FloatArray, slope: float) -> FloatArray:
        """(k, n) brightness at the mean albedo under lamps (k, 3), whose lengths are the gains."""
        gains = np.maximum(np.linalg.norm(lamps, axis=1), 1e-9)
        return np.array([g * rough_matt(self.sight.normals, self.sight.views, b / g, slope) for b, g in zip(lamps, gains)])

    def weights(self, lamps: FloatArray, shown: FloatArray) -> FloatArray:
        """(k, n) weight of each pixel by how far it lies off, 0 where it is not to be used."""
        lit = lamps @ self.sight.normals.T > _LEAST_COSINE * np.linalg.norm(lamps, axis=1)[:, None]
        used = (self.known & lit).astype(float)
        off = (self.paint(shown, used) * shown - self.seen) / _OUTLYING
        return np.asarray(used / np.sqrt(1.0 + off * off))

    def paint(self, shown: FloatArray, weight: FloatArray) -> FloatArray:
        """(n,) albedo over the mean, the most likely by data and spread."""
        if self.spread == 0.0:
            return np.ones(shown.shape[1])
        prior = (self.noise / self.spread) ** 2
        return np.asarray(((weight * shown * self.seen).sum(0) + prior) / ((weight * shown**2).sum(0) + prior))

    def solved(self, lamps: FloatArray, slope: float, rough: bool) -> tuple[FloatArray, float]:
        """Lamps and slope of the least squares; leaves noise and spread as found."""
        for _ in range(_ROUNDS):
            weight = self.weights(lamps, self.shown(lamps, slope))
            moved = 0.0
            for _ in range(_STEPS):
                lamps, slope, step = self._step(lamps, slope, weight, rough)
                moved = max(moved, step)
                if step < _SETTLED:
                    break
            if self.spread > 0.0:
                shown = self.shown(lamps, slope)
                paint, total = self.paint(shown, weight), (weight * shown**2).sum(0)
                left = paint * shown - self.seen
                self.noise = math.sqrt(max(float((weight * left**2).sum() / weight.sum()), 1e-12))
                unsure = self.noise**2 / (total + (self.noise / self.spread) ** 2)
                # the lamps' lengths hold the mean
                away = paint - np.median(paint)
                self.spread = max(math.sqrt(float((away**2 + unsure)[total > 0.0].mean())), _LEAST_SPREAD)
            if moved < 10.0 * _SETTLED:
                break
        return lamps, slope

    def _step(self, lamps: FloatArray, slope: float, weight: FloatArray, rough: bool) -> tuple[FloatArray, float, float]:
        """One step of Gauss and Newton with the albedos eliminated: lamps, slope, and the longest turn or change."""
        k, n = self.seen.shape
        shown = self.shown(lamps, slope)
        paint = self.paint(shown, weight)
        by = np.zeros((k, n, 4))
        for axis in range(3):
            nudge = np.zeros(3)
            nudge[axis] = 1e-5
            by[..., axis] = (self.shown(lamps + nudge, slope) - self.shown(lamps - nudge, slope)) / 2e-5
        if rough:
            # even in the slope: at 0 its own derivative is 0
            below = max(slope - 1e-5, 0.0)
            by[..., 3] = (self.shown(lamps, slope + 1e-5) - self.shown(lamps, below)) / (slope + 1e-5 - below)
        by *= paint[:, None]
        matrix, right = np.zeros((3 * k + 1, 3 * k + 1)), np.zeros(3 * k + 1)
        joint = np.zeros((n, 3 * k + 1))
        off = paint * shown - self.seen
        for j in range(k):
            at = np.array([3 * j, 3 * j + 1, 3 * j + 2, 3 * k])
            weighed = by[j] * weight[j][:, None]
            matrix[np.ix_(at, at)] += by[j].T @ weighed
            right[at] += weighed.T @ off[j]
            joint[:, at] += weighed * shown[j][:, None]
        if self.spread > 0.0:
            total = (weight * shown**2).sum(0) + (self.noise / self.spread) ** 2
            matrix -= joint.T @ (joint / total[:, None])
        free = np.arange(3 * k + 1 if rough else 3 * k)
        held = matrix[np.ix_(free, free)]
        held[np.diag_indices_from(held)] += 1e-6 * np.diag(held).mean()
        step = np.zeros(3 * k + 1)
        step[free] = -np.linalg.solve(held, right[free])
        change = step[:-1].reshape(k, 3)
        longest = max(float((np.linalg.norm(change, axis=1) / np.linalg.norm(lamps, axis=1)).max()), abs(float(step[-1])))
        # no step farther than half a radian: cosines change sign beyond
        step *= min(1.0, 0.5 / max(longest, 1e-12))
        return lamps + step[:-1].reshape(k, 3), float(np.clip(slope + step[-1], 0.0, _STEEPEST)), longest


def _brightest(sight: Sight, values: FloatArray) -> FloatArray:
    """Lambert's lamp by linear least squares over the brighter half, its length the gain."""
    used = values > 0.5 * values.max()
    if not values.max() > 0.0 or used.sum() < 10:
        raise SceneError("the sphere is dark; no lamp can be found on it")
    return np.asarray(np.linalg.lstsq(sight.normals[used], values[used], rcond=None)[0])


def prediction_errors(
    pictures: Sequence[FloatArray], outline: Outline, lights: FloatArray, *, saturation: float = 1.0
) -> FloatArray:
    """(k,) rms error, parts of full scale, with which each picture is predicted by a surface fitted to all others under the lights given (k, 3).

    Albedo of each pixel, slope and the room's light, which shadows show, come from the other pictures under one irradiance; nothing of the predicted picture is
    used but its light's direction."""
    from scipy.optimize import minimize

    shape = (np.shape(pictures[0])[0], np.shape(pictures[0])[1])
    whole = sphere_sight(outline.centre_px, outline.radius_px, shape)
    facing = whole.only((whole.normals * whole.views).sum(1) > _LEAST_FACING)
    few = facing.only(np.arange(0, len(facing), max(1, len(facing) // _PIXELS)))
    errors = []
    for k in range(len(pictures)):
        others = [j for j in range(len(pictures)) if j != k]
        training = [pictures[j] for j in others]
        sphere = _Sphere(few, training, saturation)

        def cost(surface: FloatArray, sphere: _Sphere = sphere, others: list[int] = others) -> float:
            gain, shown, weight = _one_gain(sphere, lights[others], *surface)
            off = (sphere.paint(gain * shown, weight) * gain * shown - sphere.seen) / _OUTLYING
            return float((np.sqrt(1.0 + off[sphere.known] ** 2) - 1.0).mean())

        found = minimize(
            cost, [0.2, 0.02], method="Nelder-Mead", bounds=((0.0, _STEEPEST), (0.0, _MOST_AROUND)),
            options={"xatol": 3e-3, "fatol": 1e-4, "maxfev": 60},
        )  # fmt: skip
        slope, around = (float(x) for x in found.x)
        every = _Sphere(whole, training, saturation)
        gain, shown, weight = _one_gain(every, lights[others], slope, around)
        predicted = every.paint(gain * shown, weight) * gain * rough_matt(whole.normals, whole.views, lights[k], slope, around)
        values = np.asarray(pictures[k], np.float64).reshape(-1)[whole.pixel]
        errors.append(float(np.sqrt(((predicted - values)[values < saturation] ** 2).mean())))
    return np.array(errors)


def _one_gain(sphere: _Sphere, lights: FloatArray, slope: float, around: float) -> tuple[float, FloatArray, FloatArray]:
    """The gain that all pictures share, brightness (k, n) at gain 1, and weights (k, n) of the lit pixels."""
    shown = sphere.shown(lights, slope) + around
    used = (shown > _LEAST_COSINE) & sphere.known
    gain = float(np.median(sphere.seen[used] / shown[used]))
    return gain, shown, sphere.weights(lights, gain * shown)


def gains_under(pictures: Sequence[FloatArray], outline: Outline, lights: FloatArray, *, saturation: float = 1.0) -> FloatArray:
    """(k,) albedo times irradiance / pi of a Lambertian sphere in each picture whose lamp's direction is known: least squares over lit pixels."""
    shape = np.shape(pictures[0])
    sight = sphere_sight(outline.centre_px, outline.radius_px, (shape[0], shape[1]))
    gains = []
    for picture, light in zip(pictures, lights, strict=True):
        values = np.asarray(picture, np.float64).reshape(-1)[sight.pixel]
        cosine = np.maximum(sight.normals @ light, 0.0)
        used = (cosine > 0.0) & (values < saturation)
        gains.append(float(values[used] @ cosine[used]) / float(cosine[used] @ cosine[used]))
    return np.array(gains)
