"""What a matt ball shows under one lamp near it, and the numbers that say so.

Frame: x right, y up, z to the camera, the ball's middle at the origin, its radius the unit of length. Brightness is strength times

    field(x) (albedo ci (A + B max(0, cos(phi) sin sin)/max(ci, cr)) + gloss D(h) / 4 cr)                Oren & Nayar 1994; Beckmann's D

with field(x) = (1 + uneven . x) d^2/d(x)^2: a lamp's beam is not even across a ball that is large beside it, by its own profile or by what stands in its
way, and its rays are not parallel. Closeness is the ball's radius over the lamp's distance; it is below 0 where rays converge, or where light
that passes under the surface carries the shading beyond the shadow line.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import FloatArray

#: numbers of one picture: turn to either side of where its lamp began, ln strength, unevenness across x and y, closeness
TURN, STRENGTH, UNEVEN, CLOSENESS = slice(0, 2), 2, slice(3, 5), 5
#: numbers of the ball: slope of its rough matt surface, strength of its gloss, ln of the gloss's rms slope
SLOPE, GLOSS, WIDTH = range(3)


class Surface(NamedTuple):
    """rms slope of the matt body;  share and rms slope of a gloss, 0 where there is none."""

    slope: float
    gloss: float = 0.0
    width: float = 0.35


def rough_matt(normals: FloatArray, views: FloatArray, directions: FloatArray, slope: float, around: float = 0.0) -> FloatArray:
    """Brightness (n,) of a rough matt surface of albedo 1 under a lamp of irradiance pi at `directions`, (3,) or (n, 3); Lambert's cosine for slope 0.

    around: what the room sends back of the lamp, evenly from all sides, as share of the lamp's own."""
    towards = np.broadcast_to(directions, normals.shape)
    c_i, c_r = (normals * towards).sum(1), (normals * views).sum(1)
    lit = np.maximum(c_i, 0.0)
    s2 = slope * slope
    level, bonus = 1.0 - 0.5 * s2 / (s2 + 0.33), 0.45 * s2 / (s2 + 0.09)
    together = (views * towards).sum(1) - c_i * c_r
    return np.asarray(around + lit * (level + bonus * np.maximum(together, 0.0) / np.maximum(np.maximum(lit, c_r), 1e-3)))


def glossy(normals: FloatArray, views: FloatArray, directions: FloatArray, width: float) -> FloatArray:
    """Brightness (n,) of a gloss of rms slope `width` under a lamp of irradiance pi."""
    towards = np.broadcast_to(directions, normals.shape)
    half = towards + views
    cos_h = (half * normals).sum(1) / np.maximum(np.linalg.norm(half, axis=1), 1e-9)
    cos_h = np.clip(cos_h, 1e-3, 1.0)
    density = np.exp((1.0 - 1.0 / cos_h**2) / width**2) / (width**2 * cos_h**4)
    lit = (normals * towards).sum(1) > 0.0
    return np.asarray(lit * density / (4.0 * np.maximum((normals * views).sum(1), 0.05)))


def turned(direction: FloatArray, turn: FloatArray) -> FloatArray:
    """(3,) `direction` moved by two small numbers along x and y."""
    x, y = direction[0] + turn[0], direction[1] + turn[1]
    across = math.hypot(x, y)
    if across > 0.999:
        x, y = x * 0.999 / across, y * 0.999 / across
    return np.array([x, y, math.sqrt(1.0 - x * x - y * y)])


def shown(
    normals: FloatArray, views: FloatArray, direction: FloatArray, numbers: FloatArray, surface: Surface
) -> tuple[FloatArray, FloatArray]:
    """(matt at albedo 1, gloss), (n,) each, of a picture whose lamp began at `direction` and has these `numbers`."""
    lamp = turned(direction, numbers[TURN])
    towards = np.broadcast_to(lamp, normals.shape)
    field = math.exp(numbers[STRENGTH]) * (1.0 + normals[:, :2] @ numbers[UNEVEN])
    if numbers[CLOSENESS] != 0.0:
        rays = lamp - numbers[CLOSENESS] * normals
        squared = (rays * rays).sum(1)
        towards, field = rays / np.sqrt(squared)[:, None], field / squared
    matt = field * rough_matt(normals, views, towards, surface.slope)
    if surface.gloss == 0.0:
        return matt, np.zeros(len(matt))
    return matt, field * surface.gloss * glossy(normals, views, towards, surface.width)
