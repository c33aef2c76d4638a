"""The sample bust as an exact surface: signed distance, normals, and rays.

World frame: millimetres, y up from the flat base at y = 0, z to the front, x to the viewer's right; about 300 mm tall. The surface is
the zero set of `bust_form.bust_function`, which is smooth, so what a range finder should have measured is known to rounding.
Rays are marched (Hart, *Sphere tracing*, 1996) by a table of safe distances far away and by the function itself near the
surface, and end at its root.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from rangecheck.analytic.bust_form import bust_function
from rangecheck.analytic.bust_hair import height_map
from rangecheck.arrays import FloatArray, require, unit_vectors
from rangecheck.kernels import in_chunks, kernel

CHUNK = 16384
#: how far `bust_distance_mm` searches where the slope does not lead to the surface
SEARCH_MM = 20.0
_LOW, _HIGH = np.array([-128.0, -8.0, -88.0]), np.array([128.0, 312.0, 100.0])
_STEP = 4.0
#: the table's safe distance starts where the function exceeds this; its slope there lies between 1/4 and 2
_NEAR = 6.0
_DERIVATIVE_STEP = 1e-4


@kernel
def _evaluate(points, heights, out, start, end):
    for i in range(start, end):
        out[i] = bust_function(points[i, 0], points[i, 1], points[i, 2], heights)


@kernel
def gradient(x, y, z, heights):
    """Central differences, accurate to 1e-8."""
    e = _DERIVATIVE_STEP
    return (
        (bust_function(x + e, y, z, heights) - bust_function(x - e, y, z, heights)) / (2 * e),
        (bust_function(x, y + e, z, heights) - bust_function(x, y - e, z, heights)) / (2 * e),
        (bust_function(x, y, z + e, heights) - bust_function(x, y, z - e, heights)) / (2 * e),
    )


@kernel
def _gradients(points, heights, out, start, end):
    for i in range(start, end):
        out[i, 0], out[i, 1], out[i, 2] = gradient(points[i, 0], points[i, 1], points[i, 2], heights)


@kernel
def _onto(x, y, z, heights):
    """A point of the surface near a point, along the slope there: x, y, z, whether it was reached."""
    gx, gy, gz = gradient(x, y, z, heights)
    square = max(gx * gx + gy * gy + gz * gz, 0.04)
    value = bust_function(x, y, z, heights)
    for _ in range(12):
        if abs(value) < 1e-9:
            return x, y, z, True
        step = value / square
        x, y, z = x - step * gx, y - step * gy, z - step * gz
        value = bust_function(x, y, z, heights)
    return x, y, z, abs(value) < 1e-7


@kernel
def _foot(px, py, pz, sx, sy, sz, heights):
    """Distance from p to the surface, walking from the surface point s to the foot of the perpendicular; and whether it was found."""
    best = math.sqrt((px - sx) ** 2 + (py - sy) ** 2 + (pz - sz) ** 2)
    share = 1.0
    for _ in range(40):
        gx, gy, gz = gradient(sx, sy, sz, heights)
        dx, dy, dz = px - sx, py - sy, pz - sz
        along = (dx * gx + dy * gy + dz * gz) / max(gx * gx + gy * gy + gz * gz, 1e-12)
        tx, ty, tz = dx - along * gx, dy - along * gy, dz - along * gz
        if tx * tx + ty * ty + tz * tz < 1e-10:
            return best, True
        while True:
            nx, ny, nz, reached = _onto(sx + share * tx, sy + share * ty, sz + share * tz, heights)
            length = math.sqrt((px - nx) ** 2 + (py - ny) ** 2 + (pz - nz) ** 2)
            if reached and length < best:
                sx, sy, sz, best = nx, ny, nz, length
                share = min(1.0, 2.0 * share)
                break
            share *= 0.5
            if share < 1e-3:
                # no nearer point along the tangent: rounding, or an edge
                return best, tx * tx + ty * ty + tz * tz < 1e-6 * best * best + 1e-8
    return best, False


@kernel
def _search(px, py, pz, reach, heights):
    """Nearest crossing on 26 rays from p, within `reach`: its distance (inf if none) and place."""
    side = bust_function(px, py, pz, heights)
    best, bx, by, bz = np.inf, px, py, pz
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                length = math.sqrt(i * i + j * j + k * k)
                if length == 0.0:
                    continue
                dx, dy, dz = i / length, j / length, k / length
                limit = min(reach, best)
                low = 0.0
                for step in range(1, 13):
                    high = limit * step / 12.0
                    if bust_function(px + high * dx, py + high * dy, pz + high * dz, heights) * side <= 0.0:
                        for _ in range(40):
                            middle = 0.5 * (low + high)
                            if bust_function(px + middle * dx, py + middle * dy, pz + middle * dz, heights) * side <= 0.0:
                                high = middle
                            else:
                                low = middle
                        best, bx, by, bz = high, px + high * dx, py + high * dy, pz + high * dz
                        break
                    low = high
    return best, bx, by, bz


@kernel
def _feet(points, heights, out, start, end):
    for n in range(start, end):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        side = 1.0 if bust_function(px, py, pz, heights) >= 0.0 else -1.0
        sx, sy, sz, found = _onto(px, py, pz, heights)
        nearest, straight = np.inf, 0.0
        if found:
            straight = math.sqrt((px - sx) ** 2 + (py - sy) ** 2 + (pz - sz) ** 2)
            nearest, found = _foot(px, py, pz, sx, sy, sz, heights)
        # where the slope did not lead to the foot, other walls may be nearer
        if not found or nearest < 0.999 * straight - 1e-6:
            length, sx, sy, sz = _search(px, py, pz, min(nearest, SEARCH_MM), heights)
            if length < nearest:
                again, _ = _foot(px, py, pz, sx, sy, sz, heights)
                nearest = min(nearest, again)
        out[n] = side * nearest


@cache
def _safe_table() -> FloatArray:
    """Distances (mm) that a ray may go from each node of a grid without passing the surface."""
    from scipy.ndimage import distance_transform_edt

    axes = [np.arange(low, high + _STEP, _STEP) for low, high in zip(_LOW, _HIGH)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    near = _values(grid.reshape(-1, 3)).reshape(grid.shape[:3]) < _NEAR
    return np.maximum(distance_transform_edt(~near, sampling=_STEP) - 2.0 * _STEP, 0.0)


@kernel
def _first_hit(ox, oy, oz, dx, dy, dz, reach, heights, table):
    """Distance to the first root along a unit direction, or inf. Chords under 0.02 mm may be missed at grazing."""
    # the box around the bust
    enter, leave = 0.0, reach
    for axis in range(3):
        o, d = (ox, dx) if axis == 0 else ((oy, dy) if axis == 1 else (oz, dz))
        low, high = _LOW[axis], _HIGH[axis]
        if abs(d) < 1e-300:
            if o < low or o > high:
                return np.inf
        else:
            a, b = (low - o) / d, (high - o) / d
            enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    t, before = enter, enter
    while t < leave:
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        i, j, k = int((x - _LOW[0]) / _STEP + 0.5), int((y - _LOW[1]) / _STEP + 0.5), int((z - _LOW[2]) / _STEP + 0.5)
        i, j, k = min(max(i, 0), table.shape[0] - 1), min(max(j, 0), table.shape[1] - 1), min(max(k, 0), table.shape[2] - 1)
        safe = table[i, j, k]
        if safe > 0.0:
            before = t
            t += safe
            continue
        value = bust_function(x, y, z, heights)
        if value <= 0.0:
            if t <= enter:
                return t
            return _root(ox, oy, oz, dx, dy, dz, before, t, heights)
        before = t
        t += min(max(0.6 * value, 0.02), 5.0)
    return np.inf


@kernel
def _root(ox, oy, oz, dx, dy, dz, a, b, heights):
    """Root between a (outside) and b (inside), by the Illinois rule."""
    fa = bust_function(ox + a * dx, oy + a * dy, oz + a * dz, heights)
    fb = bust_function(ox + b * dx, oy + b * dy, oz + b * dz, heights)
    for _ in range(60):
        if b - a < 1e-9 or fa == fb:
            break
        c = (a * fb - b * fa) / (fb - fa)
        c = min(max(c, a), b)
        fc = bust_function(ox + c * dx, oy + c * dy, oz + c * dz, heights)
        if abs(fc) < 1e-10:
            return c
        if fc > 0.0:
            a, fa = c, fc
            fb *= 0.5
        else:
            b, fb = c, fc
            fa *= 0.5
    return 0.5 * (a + b)


@kernel
def _trace(origins, directions, reach, heights, table, out, start, end):
    for i in range(start, end):
        out[i] = _first_hit(
            origins[i, 0],
            origins[i, 1],
            origins[i, 2],
            directions[i, 0],
            directions[i, 1],
            directions[i, 2],
            reach[i],
            heights,
            table,
        )


def bust_first_hit(origins_mm: FloatArray, directions: FloatArray, reach_mm: FloatArray | float = math.inf) -> FloatArray:
    """(n,) mm from each origin (n, 3) along its unit direction (n, 3) to the bust, inf where it passes by within `reach_mm`."""
    origins = require("origins_mm", origins_mm, (None, 3), finite=True)
    rays = require("directions", directions, origins.shape, finite=True)
    reach = np.ascontiguousarray(np.broadcast_to(np.asarray(reach_mm, dtype=float), len(origins)))
    out = np.empty(len(origins))
    heights, table = height_map(), _safe_table()
    in_chunks(lambda start, end: _trace(origins, rays, reach, heights, table, out, start, end), len(out), CHUNK)
    return out


def bust_normals(points_mm: FloatArray) -> FloatArray:
    """(n, 3) outward unit normals at points (n, 3) on the surface, or of the level surface through points near it."""
    return unit_vectors(_gradients_at(require("points_mm", points_mm, (None, 3), finite=True)))


def bust_signed_distance(points_mm: FloatArray) -> FloatArray:
    """(n,) signed distance in mm, negative inside: the zero set is exact; next to it the value is the function over its slope,
    right to second order; farther than a few mm only its sign is."""
    points = require("points_mm", points_mm, (None, 3), finite=True)
    slope = np.linalg.norm(_gradients_at(points), axis=1)
    return _values(points) / np.maximum(slope, 0.1)


def bust_distance_mm(points_mm: FloatArray) -> FloatArray:
    """(n,) signed distance in mm, negative inside, of points (n, 3) within a few mm of the surface; inf (-inf) beyond SEARCH_MM.

    The foot of the perpendicular is sought from the root along the gradient, then along tangent planes (Hartmann, *On the
    curvature of curves and surfaces defined by normalforms*, 1999), and where that bends away, from the nearest crossing on 26
    rays. Never less than the true distance."""
    points = require("points_mm", points_mm, (None, 3), finite=True)
    out = np.empty(len(points))
    heights = height_map()
    in_chunks(lambda start, end: _feet(points, heights, out, start, end), len(out), CHUNK)
    return out


def _values(points: FloatArray) -> FloatArray:
    out = np.empty(len(points))
    heights = height_map()
    in_chunks(lambda start, end: _evaluate(points, heights, out, start, end), len(out), CHUNK)
    return out


def _gradients_at(points: FloatArray) -> FloatArray:
    out = np.empty_like(points)
    heights = height_map()
    in_chunks(lambda start, end: _gradients(points, heights, out, start, end), len(out), CHUNK)
    return out
