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
#: how many numbers a picture has, and a ball
LAMP_NUMBERS, BODY_NUMBERS = 6, 3
#: numbers of the ball: slope of its rough matt surface, strength of its gloss, ln of the gloss's rms slope
SLOPE, GLOSS, WIDTH = range(3)

#: sine of the angle to the camera that a lamp's may reach
_FARTHEST = 0.999
#: cosines, of lamp or camera and of gloss, below which no smaller is divided by
_LEAST, _LEAST_VIEW = 1e-3, 0.05


class Surface(NamedTuple):
    """rms slope of the matt body;  share and rms slope of a gloss, 0 where there is none."""

    slope: float
    gloss: float = 0.0
    width: float = 0.35


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n,) scalar products of (n, 3) vectors: a sum along rows of three takes numpy several times as long."""
    return np.asarray(np.einsum("nx,nx->n", a, b))


def rough_matt(normals: FloatArray, views: FloatArray, directions: FloatArray, slope: float, around: float = 0.0) -> FloatArray:
    """Brightness (n,) of a rough matt surface of albedo 1 under a lamp of irradiance pi at `directions`, (3,) or (n, 3); Lambert's cosine for slope 0.

    around: what the room sends back of the lamp, evenly from all sides, as share of the lamp's own."""
    towards = np.broadcast_to(directions, normals.shape)
    c_i, c_r = _dot(normals, towards), _dot(normals, views)
    lit = np.maximum(c_i, 0.0)
    s2 = slope * slope
    level, bonus = 1.0 - 0.5 * s2 / (s2 + 0.33), 0.45 * s2 / (s2 + 0.09)
    together = _dot(views, towards) - c_i * c_r
    return np.asarray(around + lit * (level + bonus * np.maximum(together, 0.0) / np.maximum(np.maximum(lit, c_r), _LEAST)))


def glossy(normals: FloatArray, views: FloatArray, directions: FloatArray, width: float) -> FloatArray:
    """Brightness (n,) of a gloss of rms slope `width` under a lamp of irradiance pi."""
    towards = np.broadcast_to(directions, normals.shape)
    half = towards + views
    cos_h = _dot(half, normals) / np.maximum(np.linalg.norm(half, axis=1), 1e-9)
    cos_h = np.clip(cos_h, _LEAST, 1.0)
    density = np.exp((1.0 - 1.0 / cos_h**2) / width**2) / (width**2 * cos_h**4)
    lit = _dot(normals, towards) > 0.0
    return np.asarray(lit * density / (4.0 * np.maximum(_dot(normals, views), _LEAST_VIEW)))


def turned(direction: FloatArray, turn: FloatArray) -> FloatArray:
    """(3,) `direction` moved by two small numbers along x and y."""
    x, y = direction[0] + turn[0], direction[1] + turn[1]
    across = math.hypot(x, y)
    if across > _FARTHEST:
        x, y = x * _FARTHEST / across, y * _FARTHEST / across
    return np.array([x, y, math.sqrt(1.0 - x * x - y * y)])


def turned_slopes(direction: FloatArray, turn: FloatArray) -> FloatArray:
    """(3, 2) derivative of `turned` by the two numbers."""
    lamp, aside = turned(direction, turn), direction[:2] + turn
    across = math.hypot(*aside)
    if across > _FARTHEST:
        # at the rim of what is in front a lamp moves along it
        along = np.eye(2) - np.outer(aside, aside) / across**2
        return np.vstack([along * _FARTHEST / across, np.zeros(2)])
    return np.vstack([np.eye(2), -lamp[:2] / lamp[2]])


def shown(
    normals: FloatArray, views: FloatArray, direction: FloatArray, numbers: FloatArray, surface: Surface
) -> tuple[FloatArray, FloatArray]:
    """(matt at albedo 1, gloss), (n,) each, of a picture whose lamp began at `direction` and has these `numbers`."""
    lamp = turned(direction, numbers[TURN])
    towards = np.broadcast_to(lamp, normals.shape)
    field = math.exp(numbers[STRENGTH]) * (1.0 + normals[:, :2] @ numbers[UNEVEN])
    if numbers[CLOSENESS] != 0.0:
        rays = lamp - numbers[CLOSENESS] * normals
        squared = _dot(rays, rays)
        towards, field = rays / np.sqrt(squared)[:, None], field / squared
    matt = field * rough_matt(normals, views, towards, surface.slope)
    if surface.gloss == 0.0:
        return matt, np.zeros(len(matt))
    return matt, field * surface.gloss * glossy(normals, views, towards, surface.width)


def slopes(
    normals: FloatArray, views: FloatArray, direction: FloatArray, numbers: FloatArray, surface: Surface
) -> tuple[FloatArray, FloatArray]:
    """Derivatives (n, LAMP_NUMBERS + BODY_NUMBERS) of what `shown` gives, matt and gloss, by the picture's numbers and the ball's.

    Where a maximum in the model changes sides it has none; there it is that of the side where the pixel lies."""
    lamp = turned(direction, numbers[TURN])
    rays = lamp - numbers[CLOSENESS] * normals
    squared = _dot(rays, rays)
    towards = rays / np.sqrt(squared)[:, None]
    strength = math.exp(numbers[STRENGTH]) / squared
    even = 1.0 + normals[:, :2] @ numbers[UNEVEN]
    matt, matt_by_towards, matt_by_slope = _rough_matt_slopes(normals, views, towards, surface.slope)
    gloss, gloss_by_towards, gloss_by_width = _glossy_slopes(normals, views, towards, surface.width)
    # what moves the rays: the lamp's turn to either side, and its closeness
    turn = turned_slopes(direction, numbers[TURN])
    moves = np.stack([np.broadcast_to(turn[:, 0], rays.shape), np.broadcast_to(turn[:, 1], rays.shape), -normals], axis=2)
    along = np.einsum("nx,nxm->nm", rays, moves)
    turns = (moves - towards[:, :, None] * np.einsum("nx,nxm->nm", towards, moves)[:, None, :]) / np.sqrt(squared)[:, None, None]
    found = []
    for value, by_towards, share in ((matt, matt_by_towards, 1.0), (gloss, gloss_by_towards, surface.gloss)):
        by = np.zeros((len(normals), LAMP_NUMBERS + BODY_NUMBERS))
        field = share * strength
        by_ray = np.einsum("nx,nxm->nm", by_towards, turns) - value[:, None] * 2.0 * along / squared[:, None]
        by[:, [0, 1, CLOSENESS]] = (field * even)[:, None] * by_ray
        by[:, STRENGTH] = field * even * value
        by[:, UNEVEN] = (field * value)[:, None] * normals[:, :2]
        found.append(by)
    found[0][:, LAMP_NUMBERS + SLOPE] = strength * even * matt_by_slope
    found[1][:, LAMP_NUMBERS + GLOSS] = strength * even * gloss
    # by the width's logarithm
    found[1][:, LAMP_NUMBERS + WIDTH] = surface.gloss * strength * even * gloss_by_width * surface.width
    return found[0], found[1]


def _rough_matt_slopes(
    normals: FloatArray, views: FloatArray, towards: FloatArray, slope: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`rough_matt` (n,) and its derivatives by the direction to the lamp (n, 3) and by the slope (n,)."""
    c_i, c_r = _dot(normals, towards), _dot(normals, views)
    s2 = slope * slope
    level, bonus = 1.0 - 0.5 * s2 / (s2 + 0.33), 0.45 * s2 / (s2 + 0.09)
    by_level, by_bonus = -0.33 * slope / (s2 + 0.33) ** 2, 0.081 * slope / (s2 + 0.09) ** 2
    together = np.maximum(_dot(views, towards) - c_i * c_r, 0.0)
    larger = np.maximum(np.maximum(c_i, c_r), _LEAST)
    lit = c_i > 0.0
    share = np.where(lit, together / larger, 0.0)
    by_share = np.where(together > 0.0, 1.0 / larger, 0.0)[:, None] * (views - c_r[:, None] * normals)
    by_share -= np.where((c_i > c_r) & (c_i > _LEAST), together / larger**2, 0.0)[:, None] * normals
    by_towards = (level + bonus * share)[:, None] * normals + (bonus * c_i)[:, None] * by_share
    value = np.where(lit, c_i * (level + bonus * share), 0.0)
    return value, np.where(lit[:, None], by_towards, 0.0), np.where(lit, c_i * (by_level + by_bonus * share), 0.0)


def _glossy_slopes(
    normals: FloatArray, views: FloatArray, towards: FloatArray, width: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`glossy` (n,) and its derivatives by the direction to the lamp (n, 3) and by the width (n,)."""
    half = towards + views
    length = np.maximum(np.linalg.norm(half, axis=1), 1e-9)
    cosine = _dot(half, normals) / length
    value = glossy(normals, views, towards, width)
    held = np.clip(cosine, _LEAST, 1.0)
    by_cosine = np.where(held == cosine, value * (2.0 / (held**3 * width**2) - 4.0 / held), 0.0)
    by_towards = (by_cosine / length)[:, None] * (normals - (cosine / length)[:, None] * half)
    return value, by_towards, value * (2.0 * (1.0 / held**2 - 1.0) / width**3 - 2.0 / width)
