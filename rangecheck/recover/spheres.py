"""Lights calibrated from photographs of a chrome sphere under parallel view: x right, y up, z to the camera.

A chrome sphere mirrors each lamp at the place whose normal lies half way between lamp and camera. Directions are unit vectors from the sphere to the lamp.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import FloatArray, require
from rangecheck.errors import SceneError
from rangecheck.recover.sight import sphere_sight

#: share of the picture's brightest from which a pixel belongs to the highlight; lens and sphere blur it, but evenly
_HIGHLIGHT = 0.5
#: share of the sphere beyond which what is bright is no lamp in a mirror
_LARGEST_SPOT = 0.1


class Outline(NamedTuple):
    """A sphere's middle (column, row) and radius in a picture, pixels."""

    centre_px: tuple[float, float]
    radius_px: float


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
    share = len(rows) / len(seen)
    if share > _LARGEST_SPOT:
        raise SceneError(
            f"{100 * share:.0f} % of the sphere is as bright as its brightest place, and a lamp mirrored in chrome is a small spot; the sphere is matt, or the "
            "picture saturated", share=share,
        )  # fmt: skip
    x = (columns.mean() - outline.centre_px[0]) / outline.radius_px
    y = (outline.centre_px[1] - rows.mean()) / outline.radius_px
    normal = np.array([x, y, math.sqrt(max(0.0, 1.0 - x * x - y * y))])
    return 2.0 * normal[2] * normal - [0.0, 0.0, 1.0]
