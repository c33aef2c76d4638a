"""Lights calibrated from photographs of a sphere under parallel view: x right, y up, z to the camera.

A chrome sphere mirrors each lamp at the place whose normal lies half way between lamp and camera. On a matt sphere the brightness is an
albedo times the cosine to the lamp; of rough matt surfaces, which send more light back where it came from, it is that of Oren & Nayar,
*Generalization of Lambert's reflectance model*, 1994 (its simple form, one slope for all pictures). Directions are unit vectors from
the sphere to the lamp.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import FloatArray, IntArray, require
from rangecheck.errors import SceneError
from rangecheck.recover.sight import Sight, sphere_sight

#: share of the picture's brightest from which a pixel belongs to the highlight; lens and sphere blur it, but evenly
_HIGHLIGHT = 0.5
#: cosine to the lamp below which a pixel is left out: interreflection from the table and the limb's blur count there
_LEAST_COSINE = 0.0
_OUTLYING = 0.02


class Outline(NamedTuple):
    """A sphere's middle (column, row) and radius in a picture, pixels."""

    centre_px: tuple[float, float]
    radius_px: float


class MattFit(NamedTuple):
    """directions (k, 3);  gains (k,) albedo times irradiance / pi of each picture, parts of full scale;  slope (rms, rad) of the rough
    matt surface, 0 for Lambert;  rms: residual of all pixels used, parts of full scale."""

    directions: FloatArray
    gains: FloatArray
    slope: float
    rms: float


def outline_of(mask: FloatArray) -> Outline:
    """The circle that a mask (h, w) fills: its middle, and the radius that has its area. Raises SceneError where it is no disc."""
    inside = np.asarray(mask) > 0
    count = int(inside.sum())
    if count < 100:
        raise SceneError(f"the sphere's mask holds {count} pixels; at least 100 are needed")
    rows, columns = np.nonzero(inside)
    across, high = np.ptp(columns) + 1, np.ptp(rows) + 1
    if abs(across - high) > 0.05 * across or abs(count / (math.pi / 4 * across * high) - 1.0) > 0.05:
        raise SceneError(f"the sphere's mask is {across} x {high} pixels with {count} inside; that is no disc", pixels=count)
    centre = 0.5 * (int(columns.min()) + int(columns.max())), 0.5 * (int(rows.min()) + int(rows.max()))
    return Outline(centre, 0.25 * float(across + high))


def light_from_chrome(picture: FloatArray, outline: Outline) -> FloatArray:
    """(3,) direction of the brightest lamp that a mirror sphere shows. Raises SceneError where it shows none."""
    values = require("picture", picture, (None, None))
    sight = sphere_sight(outline.centre_px, outline.radius_px, (values.shape[0], values.shape[1]), 1.0)
    seen = np.nan_to_num(values.reshape(-1)[sight.pixel])
    if not seen.max() > 0.0:
        raise SceneError("the sphere is dark; no lamp is mirrored in it")
    from scipy.ndimage import label

    bright = sight.spread((seen >= _HIGHLIGHT * seen.max()).astype(float), 0.0) > 0
    spots, count = label(bright, np.ones((3, 3)))
    size = np.bincount(spots.reshape(-1), np.where(bright, np.nan_to_num(values), 0.0).reshape(-1), minlength=count + 1)
    rows, columns = np.nonzero(spots == 1 + int(np.argmax(size[1:])))
    x = (columns.mean() - outline.centre_px[0]) / outline.radius_px
    y = (outline.centre_px[1] - rows.mean()) / outline.radius_px
    normal = np.array([x, y, math.sqrt(max(0.0, 1.0 - x * x - y * y))])
    return 2.0 * normal[2] * normal - [0.0, 0.0, 1.0]


def rough_matt(normals: FloatArray, views: FloatArray, direction: FloatArray, slope: float) -> FloatArray:
    """Brightness (n,) of a rough matt surface of albedo 1 that faces a lamp of irradiance pi; Lambert's cosine for slope 0."""
    c_i, c_r = normals @ direction, (normals * views).sum(1)
    lit = np.maximum(c_i, 0.0)
    s2 = slope * slope
    level, bonus = 1.0 - 0.5 * s2 / (s2 + 0.33), 0.45 * s2 / (s2 + 0.09)
    together = views @ direction - c_i * c_r
    return lit * (level + bonus * np.maximum(together, 0.0) / np.maximum(np.maximum(lit, c_r), 1e-3))


def lights_from_matt(
    pictures: Sequence[FloatArray],
    outline: Outline,
    *,
    rough: bool = True,
    saturation: float = 1.0,
    starts: FloatArray | None = None,
) -> MattFit:
    """Directions and gains of one lamp each from pictures (h, w) of a matt sphere, linear, in parts of full scale.

    All pictures share the surface: `rough` also fits its slope. Pixels at `saturation` are left out, outliers weighed down."""
    from scipy.optimize import least_squares

    shape = np.shape(pictures[0])
    sight = sphere_sight(outline.centre_px, outline.radius_px, (shape[0], shape[1]))
    few = sight.only(np.arange(0, len(sight), max(1, len(sight) // 4000)))

    def of(at: Sight, k: int) -> FloatArray:
        return np.asarray(pictures[k], np.float64).reshape(-1)[at.pixel]

    def solved(k: int, start: FloatArray, slope: float) -> FloatArray:
        values = of(few, k)
        used = np.isfinite(values) & (values < saturation)

        def away(b: FloatArray) -> FloatArray:
            gain = float(np.linalg.norm(b))
            shown = gain * rough_matt(few.normals[used], few.views[used], b / max(gain, 1e-9), slope)
            return (shown - values[used]) / _OUTLYING

        return np.asarray(least_squares(away, start, loss="soft_l1").x)

    begin = [
        _brightest(few, of(few, k)) if starts is None else starts[k] * float(np.nanmax(of(few, k))) for k in range(len(pictures))
    ]

    def all_of(slope: float) -> FloatArray:
        return np.array([solved(k, start, slope) for k, start in enumerate(begin)])

    slope = 0.0
    if rough:
        from scipy.optimize import minimize_scalar

        some = list(range(0, len(pictures), max(1, len(pictures) // 6)))

        def total(slope: float) -> float:
            return sum(_misfit(few, of(few, k), solved(k, begin[k], slope), slope, saturation) for k in some)

        slope = float(minimize_scalar(total, bounds=(0.0, 0.8), method="bounded", options={"xatol": 0.01}).x)
    found = all_of(slope)
    gains = np.linalg.norm(found, axis=1)
    squares, count = 0.0, 0
    for k, b in enumerate(found):
        values = of(sight, k)
        used = np.isfinite(values) & (values < saturation)
        shown = gains[k] * rough_matt(sight.normals[used], sight.views[used], b / gains[k], slope)
        squares += float(((shown - values[used]) ** 2).sum())
        count += int(used.sum())
    return MattFit(found / gains[:, None], gains, slope, math.sqrt(squares / max(1, count)))


def _misfit(sight: Sight, values: FloatArray, b: FloatArray, slope: float, saturation: float) -> float:
    gain = float(np.linalg.norm(b))
    used = np.isfinite(values) & (values < saturation)
    r = (gain * rough_matt(sight.normals[used], sight.views[used], b / gain, slope) - values[used]) / _OUTLYING
    return float((np.sqrt(1.0 + r * r) - 1.0).sum())


def _brightest(sight: Sight, values: FloatArray) -> FloatArray:
    """Lambert's lamp by linear least squares over the brighter half, its length the gain."""
    values = np.nan_to_num(values)
    used = values > 0.5 * values.max()
    if used.sum() < 10:
        raise SceneError("the sphere is dark; no lamp can be found on it")
    return np.asarray(np.linalg.lstsq(sight.normals[used], values[used], rcond=None)[0])


def prediction_errors(
    pictures: Sequence[FloatArray], outline: Outline, lights: FloatArray, *, saturation: float = 1.0
) -> FloatArray:
    """(k,) rms error, parts of full scale, with which each picture is predicted by a surface fitted to all others under the lights given.

    Surface and irradiance are one gain and one slope for all pictures; nothing of the predicted picture is used but its light's direction."""
    from scipy.optimize import least_squares

    shape = np.shape(pictures[0])
    sight = sphere_sight(outline.centre_px, outline.radius_px, (shape[0], shape[1]))
    few = np.arange(0, len(sight), max(1, len(sight) // 3000))
    values = [np.asarray(p, np.float64).reshape(-1)[sight.pixel] for p in pictures]

    def away(numbers: FloatArray, k: int, which: IntArray) -> FloatArray:
        used = which[values[k][which] < saturation]
        return numbers[0] * rough_matt(sight.normals[used], sight.views[used], lights[k], numbers[1]) - values[k][used]

    errors = []
    for k in range(len(pictures)):
        others = [j for j in range(len(pictures)) if j != k]

        def training(numbers: FloatArray, others: list[int] = others) -> FloatArray:
            return np.concatenate([away(numbers, j, few) for j in others])

        found = least_squares(training, [0.5, 0.2], bounds=([0.0, 0.0], [10.0, 0.8]), loss="soft_l1", f_scale=_OUTLYING)
        errors.append(float(np.sqrt((away(found.x, k, np.arange(len(sight))) ** 2).mean())))
    return np.array(errors)


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
