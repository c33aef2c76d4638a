"""Scenes of mirrors whose every chain of reflections can be written down.

World frame, millimetres, y up. IDs as in maps: 0 where a ray meets nothing, else 1 + the surface's place in the scene.
"""

from __future__ import annotations

import numpy as np

from rangecheck.analytic.shapes import Plane, Sphere
from rangecheck.arrays import BoolArray, FloatArray, IntArray


def box_corner_chain(origins: FloatArray, directions: FloatArray, side_mm: float, bounces: int) -> tuple[IntArray, FloatArray]:
    """Rays (n, 3) in the corner of three mirrors, squares of `side_mm` in the planes x = 0 (1), y = 0 (2), z = 0 (3), seen from x, y, z > 0.

    (bounces + 1, n) IDs that each ray meets one after the other, and how near, mm, any of its hits comes to the edge of a square."""
    o, d = np.array(origins, dtype=float), np.array(directions, dtype=float)
    ids = np.zeros((bounces + 1, len(o)), np.int64)
    clearance = np.full(len(o), np.inf)
    live, last = np.ones(len(o), bool), np.full(len(o), -1)
    others = np.array([[1, 2], [2, 0], [0, 1]])
    for k in range(bounces + 1):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -o / d
        t[(d >= 0) | (last[:, None] == np.arange(3))] = np.inf
        met = o[:, None, :] + np.where(np.isfinite(t), t, 0.0)[:, :, None] * d[:, None, :]
        inside, border = np.ones_like(t, bool), np.full_like(t, np.inf)
        for axis in range(3):
            across = met[:, axis, others[axis]]
            margin = np.minimum(across, side_mm - across).min(axis=1)
            inside[:, axis] = margin >= 0
            border[:, axis] = np.where(np.isfinite(t[:, axis]), np.abs(margin), np.inf)
        clearance = np.where(live, np.minimum(clearance, border.min(axis=1)), clearance)
        t[~inside] = np.inf
        wall = np.argmin(t, axis=1)
        reach = t[np.arange(len(o)), wall]
        live = live & np.isfinite(reach)
        ids[k] = np.where(live, wall + 1, 0)
        o = np.where(live[:, None], o + np.where(live, reach, 0.0)[:, None] * d, o)
        d[np.arange(len(o)), wall] *= np.where(live, -1.0, 1.0)
        last = np.where(live, wall, last)
    return ids, clearance


def ball_on_mirror_ids(origin: FloatArray, directions: FloatArray, radius_mm: float, half_mm: float) -> tuple[IntArray, IntArray]:
    """(...) primary and secondary IDs of a ball (1) that rests at the origin on a square mirror (2) in y = 0, seen along unit directions
    (..., 3) from `origin` (3,)."""
    ball, centre = Sphere(radius_mm), np.array([0.0, radius_mm, 0.0])

    def first(o: FloatArray, d: FloatArray) -> tuple[IntArray, FloatArray]:
        to_ball, to_plane = ball.first_hit(o - centre, d), Plane(half_mm).first_hit(o, d)
        with np.errstate(invalid="ignore"):
            met = o + to_plane[..., None] * d
            to_plane = np.where((np.abs(met[..., [0, 2]]) <= half_mm).all(axis=-1), to_plane, np.inf)
        t = np.minimum(to_ball, to_plane)
        return np.where(np.isinf(t), 0, np.where(to_ball < to_plane, 1, 2)), t

    primary, t = first(np.broadcast_to(origin, directions.shape), directions)
    point = origin + np.where(np.isfinite(t), t, 0)[..., None] * directions
    normal = np.where((primary == 1)[..., None], (point - centre) / radius_mm, [0.0, 1.0, 0.0])
    mirrored = directions - 2 * (directions * normal).sum(-1, keepdims=True) * normal
    secondary, _ = first(point, mirrored)
    return primary, np.where(primary > 0, secondary, 0)


def away_from_borders(ids: IntArray) -> BoolArray:
    """(h, w) pixels of maps (k, h, w) whose eight neighbours have the same k IDs."""
    alike = np.ones(ids.shape[1:], bool)
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            alike &= (np.roll(ids, (dv, du), axis=(1, 2)) == ids).all(axis=0)
    return alike
