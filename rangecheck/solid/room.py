"""Where a shape leaves no room for a cavity: the proof that a place of its outside stays farther than `reach` from any cavity whose wall is
nowhere thinner than `wall`, whoever makes it.

A cavity with such a wall holds only deep places: those at least `wall` from the outside. So a place p of the outside is limited by the shape
where no deep place lies within `reach` of it, and that can be decided without any cavity. p itself is outside, so a deep place x near it has
wall <= |x - p| <= reach: only this layer of a ball is searched, in sectors: r u for directions u in a triangle, r from low to high. A sector
holds no deep place where

- a place in it is less deep than `wall` by more than the way from there to any other (depth changes by at most 1 mm per mm); or
- one place q of the outside is nearer than `wall` to all of it. Nearer than that to r u means 2 r u (q - p) > |q - p|^2 + r^2 - wall^2.
  For |q - p|^2 <= wall (wall + high) the right side over r is largest at r = high, so the three outer corners decide: what holds for them holds
  for all directions between. For other q the six corners must be nearer by what the sector stands out of their hull.

Others are cut: the triangle in four, and the layer in two where the nearest place is of the second kind. What is left after LEVELS cuts is
not proved, and counts as room.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.surface.distance import SurfaceDistance

#: cuts of a triangle of 63 degrees: the last ones are a sixtieth of a degree wide
LEVELS = 12
#: places whose directions are searched together
_TOGETHER = 8192


def proved_without_room(outside: SurfaceDistance, places_mm: FloatArray, wall_mm: float, reach_mm: float) -> BoolArray:
    """(n,) whether it is proved that no place at least `wall_mm` inside a closed surface lies within `reach_mm` of each of `places_mm` (n, 3)
    of it."""
    proved = np.empty(len(places_mm), bool)
    for first in range(0, len(places_mm), _TOGETHER):
        last = first + _TOGETHER
        proved[first:last] = _searched(outside, places_mm[first:last], wall_mm, reach_mm)
    return proved


def _searched(outside: SurfaceDistance, places: FloatArray, wall: float, reach: float) -> BoolArray:
    # what rounding can add to a distance
    wall -= 64 * np.finfo(np.float64).eps * outside.surface.extent_mm
    faces = _icosahedron()
    at: IntArray = np.repeat(np.arange(len(places)), len(faces))
    sector = _Sectors(np.tile(faces, (len(places), 1, 1)), np.full(len(at), wall), np.full(len(at), reach))
    room = np.zeros(len(places), bool)
    for level in range(LEVELS + 1):
        held, deep, layered = _judged(outside, places[at], sector, wall)
        room[at[deep]] = True
        left = ~held & ~room[at]
        if not left.any() or level == LEVELS:
            room[at[left]] = True
            break
        at, sector = _cut(at[left], _Sectors(*(part[left] for part in sector)), layered[left])
    return ~room


class _Sectors(NamedTuple):
    """corners (n, 3, 3) unit directions of each one's triangle; low, high (n,) its layer."""

    corners: FloatArray
    low: FloatArray
    high: FloatArray


def _judged(
    outside: SurfaceDistance, places: FloatArray, sector: _Sectors, wall: float
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Whether each sector about a place holds no deep place, whether its outer middle is one, and whether the layer is to be cut."""
    corners, low, high = sector
    middle = corners.sum(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    signed, found = outside.signed_nearest(places + high[:, None] * middle)
    foot = found.place_mm - places
    wide = high * np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    held = wide + (high - low) - signed < wall
    outer = np.linalg.norm(high[:, None, None] * corners - foot[:, None], axis=2).max(axis=1)
    inner = np.linalg.norm(low[:, None, None] * corners - foot[:, None], axis=2).max(axis=1)
    layered = np.einsum("ij,ij->i", foot, foot) > wall * (wall + high)
    # a cap of the ball of radius high, as wide as the triangle, stands out of its corners' plane by at most this
    out = 0.5 * wide**2 / high
    held |= np.where(layered, np.maximum(outer, inner) + out, outer) < wall
    return held, -signed >= wall, layered


def _cut(at: IntArray, sector: _Sectors, layered: BoolArray) -> tuple[IntArray, _Sectors]:
    """Sectors about the places `at` with their triangles in four, those of `layered` in two layers besides."""
    at, corners, layered = np.repeat(at, 4), _quartered(sector.corners), np.repeat(layered, 4)
    low, high = np.repeat(sector.low, 4), np.repeat(sector.high, 4)
    middle = 0.5 * (low + high)
    both = np.concatenate([np.arange(len(at)), np.flatnonzero(layered)])
    upper = np.arange(len(both)) < len(at)
    return at[both], _Sectors(
        corners[both],
        np.where(upper & layered[both], middle[both], low[both]),
        np.where(upper, high[both], middle[both]),
    )


def _quartered(corners: FloatArray) -> FloatArray:
    """(4n, 3, 3) each triangle of directions as the four that its sides' middles make of it."""
    between = corners + np.roll(corners, -1, axis=1)
    between /= np.linalg.norm(between, axis=2, keepdims=True)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = between[:, 0], between[:, 1], between[:, 2]
    return np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3, 3)


def _icosahedron() -> FloatArray:
    """(20, 3, 3) unit corners of its faces."""
    golden = (1 + np.sqrt(5.0)) / 2
    corners = np.array([[0, s, t * golden] for s in (-1, 1) for t in (-1, 1)])
    corners = np.concatenate([np.roll(corners, turn, axis=1) for turn in range(3)]) / np.sqrt(1 + golden**2)
    apart = np.linalg.norm(corners[:, None] - corners, axis=2)
    side = apart[apart > 1e-9].min() * (1 + 1e-9)
    touching = apart < side
    faces: IntArray = np.array(
        [(i, j, k) for i in range(12) for j in range(i) for k in range(j) if touching[i, j] and touching[j, k] and touching[k, i]]
    )
    return corners[faces]
