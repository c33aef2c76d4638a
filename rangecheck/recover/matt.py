"""Lamps calibrated from photographs of a matt sphere under parallel view: x right, y up, z to the camera, one lamp a picture.

Three things pull a lamp that is looked for by shading alone: stains, which three pictures or more tell from light (each pixel has an albedo of its own);
a beam that is not even across the ball, which looks like a lamp elsewhere except at the shadow's edge; and a body that is not Lambert's. All are
fitted jointly (`matt_ball`, `matt_light`). A lamp's strength and its beam say nearly the same: where lamps are known to be of one strength, say so.

Left out are pixels seen or lit at grazing angles, where outline, blur and light from around count for more than the lamp. Directions are unit
vectors from the sphere to the lamp.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import SceneError
from rangecheck.recover.matt_ball import MattBall
from rangecheck.recover.matt_light import CLOSENESS, LAMP_NUMBERS, STRENGTH, UNEVEN, Surface, rough_matt, shown
from rangecheck.recover.sight import Sight, sphere_sight
from rangecheck.recover.spheres import Outline

#: cosine to the camera below which a pixel is not used
_LEAST_FACING = 0.1
#: pixels that lamps are found on, and that a prediction is made from
_PIXELS, _FEW = 2000, 1000
#: cosine to the lamp below which a pixel sees only the room, and how many such tell of it
_DARK, _SEVERAL = -0.1, 100


class MattFit(NamedTuple):
    """directions (k, 3);  gains (k,) mean albedo times irradiance / pi of each picture, parts of full scale;  apart (k,) share by which each picture alone
    would have its gain differ;  uneven (k, 2) change of the irradiance over one radius to the right and up, as share;  closeness (k,) of `matt_light`;
    surface  slope 0 for Lambert, and gloss;  paint (h, w) albedo of each pixel over the mean, NaN off the sphere;  spread: its standard
    deviation;  rms: residual of the lit pixels, parts of full scale."""

    directions: FloatArray
    gains: FloatArray
    apart: FloatArray
    uneven: FloatArray
    closeness: FloatArray
    surface: Surface
    paint: FloatArray
    spread: float
    rms: float

    @property
    def slope(self) -> float:
        """rms slope of the rough matt surface."""
        return self.surface.slope

    @property
    def beams(self) -> FloatArray:
        """(k, 3) unevenness and closeness, as `prediction_errors` takes them."""
        return np.column_stack([self.uneven, self.closeness])


def lights_from_matt(
    pictures: Sequence[FloatArray],
    outline: Outline,
    *,
    rough: bool = True,
    same_strength: bool = False,
    saturation: float = 1.0,
    starts: FloatArray | None = None,
) -> MattFit:
    """Directions and gains of one lamp each from pictures (h, w) of a matt sphere, linear, in parts of full scale.

    All pictures share the surface: `rough` also fits its slope and gloss; with `same_strength` they share the gain, too. Beams and albedos of pixels are
    found from three pictures on. Pixels at `saturation` are left out, outliers weighed down. Raises SceneError where a picture shows no light."""
    shape = (np.shape(pictures[0])[0], np.shape(pictures[0])[1])
    whole = sphere_sight(outline.centre_px, outline.radius_px, shape)
    few = _thinned(whole, _PIXELS)
    values = [np.nan_to_num(np.asarray(p, np.float64)).reshape(-1)[few.pixel] for p in pictures]
    begin = np.array(
        [_brightest(few, v, saturation, k) if starts is None else starts[k] * float(v.max()) for k, v in enumerate(values)]
    )
    ball = MattBall(few, pictures, saturation, begin, rough=rough, same_strength=same_strength)
    ball.solve()
    every = MattBall(whole, pictures, saturation, begin, rough=rough, same_strength=same_strength)
    every.take_over(ball)
    matt, gloss = every.shown()
    weight = every.weights(matt, gloss)
    paint = every.paint(matt, gloss, weight)
    left = (paint * matt + gloss - every.seen)[weight > 0.0]
    # gains are of the mean albedo, which paint is relative to
    mean = float(np.median(paint))
    numbers = ball.numbers
    return MattFit(
        ball.directions(), np.exp(numbers[:, STRENGTH]) * mean, ball.strengths_apart(), numbers[:, UNEVEN], numbers[:, CLOSENESS],
        ball.body(), whole.spread(paint / mean), ball.spread, math.sqrt(float((left**2).mean())),
    )  # fmt: skip


def _thinned(whole: Sight, pixels: int) -> Sight:
    facing = whole.only((whole.normals * whole.views).sum(1) > _LEAST_FACING)
    return facing.only(np.arange(0, len(facing), max(1, len(facing) // pixels)))


def _brightest(sight: Sight, values: FloatArray, saturation: float, picture: int) -> FloatArray:
    """(3,) lamp of a matt sphere by linear least squares over the brighter half: direction times gain. Errors keep the `picture`'s number."""
    used = values > 0.5 * values.max()
    if not values.max() > 0.0 or used.sum() < 10:
        raise SceneError("the sphere is dark; no lamp can be found on it", picture=picture)
    if (values < saturation).sum() < 10 or (values[used] < saturation).sum() < 10:
        raise SceneError("the sphere is saturated where it is lit; no lamp can be found on it: expose less", picture=picture)
    return np.asarray(np.linalg.lstsq(sight.normals[used], values[used], rcond=None)[0])


def prediction_errors(
    pictures: Sequence[FloatArray],
    outline: Outline,
    lights: FloatArray,
    *,
    beams: FloatArray | None = None,
    saturation: float = 1.0,
) -> FloatArray:
    """(k,) rms error, parts of full scale, with which each picture is predicted by what all others show under the lights given (k, 3).

    The others alone are fitted, lamps of one strength: the beam of each, the albedo of each pixel, the body, the strength, and the room's light, which
    shadows show. Nothing of the predicted picture is used: its beam is taken to be even, and its lamp as close as the others. With `beams` (k, 3),
    `MattFit.beams`, those are taken to be known, the predicted picture's own too."""
    shape = (np.shape(pictures[0])[0], np.shape(pictures[0])[1])
    whole = sphere_sight(outline.centre_px, outline.radius_px, shape)
    few = _thinned(whole, _FEW)
    unknown = slice(STRENGTH, LAMP_NUMBERS if beams is None else STRENGTH + 1)
    errors = []
    for k in range(len(pictures)):
        others = [j for j in range(len(pictures)) if j != k]
        room = _room(whole, [pictures[j] for j in others], lights[others])
        lit = [np.asarray(pictures[j], np.float64) - room for j in others]
        begin = lights[others] * np.array([[float(p.max())] for p in lit])
        ball, every = (
            MattBall(s, lit, saturation - room, begin, rough=True, same_strength=True, looked_for=unknown) for s in (few, whole)
        )
        if beams is not None:
            ball.numbers[:, UNEVEN], ball.numbers[:, CLOSENESS] = beams[others, :2], beams[others, 2]
        ball.solve()
        every.take_over(ball)
        matt, gloss = every.shown()
        numbers = np.zeros(LAMP_NUMBERS)
        numbers[STRENGTH] = every.numbers[:, STRENGTH].mean()
        numbers[CLOSENESS] = every.numbers[:, CLOSENESS].mean()
        if beams is not None:
            numbers[UNEVEN], numbers[CLOSENESS] = beams[k, :2], beams[k, 2]
        one, shine = shown(whole.normals, whole.views, lights[k], numbers, every.body())
        predicted = every.paint(matt, gloss, every.weights(matt, gloss)) * one + shine + room
        values = np.asarray(pictures[k], np.float64).reshape(-1)[whole.pixel]
        errors.append(float(np.sqrt(((predicted - values)[values < saturation] ** 2).mean())))
    return np.array(errors)


def _room(sight: Sight, pictures: Sequence[FloatArray], lights: FloatArray) -> float:
    """What pixels show that turn away from the lamp, beyond its penumbra: their median over all pictures, 0 where there are hardly any."""
    dark = [np.asarray(p, np.float64).reshape(-1)[sight.pixel][sight.normals @ d < _DARK] for p, d in zip(pictures, lights)]
    level = np.concatenate(dark)
    return float(np.median(level)) if len(level) >= _SEVERAL else 0.0


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


__all__ = ["MattFit", "gains_under", "lights_from_matt", "prediction_errors", "rough_matt"]
