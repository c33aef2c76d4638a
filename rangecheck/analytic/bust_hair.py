"""The hair of the sample bust: comma-shaped locks, laid in rows like tiles from the whorl to the hairline.

Head frame (see bust_form): one unit is a hundredth of the head's height, x to the sitter's left, y up, z to the front, chin at
y = 0. The hair is a height above the skull, a function of the direction from the skull's centre. It is evaluated once on a
plane map of those directions (azimuthal equidistant about the whorl, so that locks flow along radii) and read back through cubic
B-splines, which makes it twice continuously differentiable.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.kernels import in_chunks, kernel

CENTRE = (0.0, 62.0, -2.0)
WHORL = (0.0, 0.8, -0.6)
#: the map covers angles up to REACH radians from the whorl; beyond there is no hair
REACH = 2.45
NODES = 512
#: height where there is no hair: below the skin
BARE = -7.0
HEAD_RADIUS = 37.0

# hairline: azimuth from the front (rad) against height of the line
_AZIMUTH = np.array([0.0, 0.22, 0.42, 0.62, 0.82, 1.0, 1.13, 1.25, 1.36, 1.47, 1.58, 1.75, 1.9, 2.05, 2.3, 2.7, 3.15])
_LINE_Y = np.array([83.0, 83.0, 82.5, 79.0, 71.5, 63.0, 54.0, 47.0, 46.0, 52.0, 57.0, 57.0, 50.0, 39.0, 27.0, 21.0, 19.0])


def inside_hairline(directions: FloatArray) -> FloatArray:
    """(n,) height in head units by which the skull under each direction lies above the hairline; negative on bare skin."""
    d = directions
    scale = 1.0 / np.sqrt((d[:, 0] / 33.5) ** 2 + (d[:, 1] / 37.0) ** 2 + (d[:, 2] / 43.0) ** 2)
    point = np.asarray(CENTRE) + scale[:, None] * d
    azimuth = np.arctan2(np.abs(point[:, 0]), point[:, 2])
    return point[:, 1] - np.interp(azimuth, _AZIMUTH, _LINE_Y)


def locks() -> FloatArray:
    """(n, 12) root direction, flow direction, length, half width, bend, height, phase, number of strands."""
    e0 = np.array(WHORL)
    e1 = np.array([1.0, 0.0, 0.0])
    e2 = np.cross(e1, e0)  # towards the front
    random = np.random.Generator(np.random.Philox(key=1991))
    found = []
    row, rho = 0, 0.06
    while rho < 2.25:
        around = max(5, round(2 * math.pi * HEAD_RADIUS * math.sin(rho) / 7.4)) if rho < 2.9 else 0
        for i in range(around):
            jitter = random.uniform(-1.0, 1.0, 6)
            angle = 2 * math.pi * (i + 0.5 * (row % 2) + 0.22 * jitter[0]) / around
            here = rho + 0.045 * jitter[1]
            radial = math.cos(angle) * e2 + math.sin(angle) * e1
            root = math.cos(here) * e0 + math.sin(here) * radial
            flow = -math.sin(here) * e0 + math.cos(here) * radial
            # the sweep: over the forehead outwards from a parting left of the middle, at the sides to the back
            side = math.copysign(1.0, root[0] - 0.12)
            bend = side * (0.020 + 0.010 * jitter[2]) * (1.0 if row % 3 else -0.9)
            turned = 0.25 * side * jitter[3]
            across = np.cross(root, flow)
            flow = math.cos(turned) * flow + math.sin(turned) * across
            length = 17.0 + 3.5 * jitter[4]
            tip = root + flow * (length / HEAD_RADIUS)
            tip /= np.linalg.norm(tip)
            at_root, at_tip = inside_hairline(np.stack([root, tip]))
            over_brow = abs(math.atan2(root[0], root[2])) < 0.95 and at_root < 13.0
            if at_root < 2.0 or at_tip < -6.0 or over_brow:
                continue
            found.append([*root, *flow, length, 5.2 + 0.7 * jitter[5], bend, 4.2 + 0.6 * jitter[1], 3.0 * jitter[0], 3.0])
        row += 1
        rho += 0.205
    found.extend(_fringe())
    return np.array(found)


def _fringe() -> list[list[float]]:
    """The row of locks over the forehead, combed apart from a fork above the sitter's right eye."""
    row = []
    for i, azimuth in enumerate(np.linspace(-0.88, 0.88, 13)):
        line = float(np.interp(abs(azimuth), _AZIMUTH, _LINE_Y))
        root = np.array([math.sin(azimuth) * 33.0, line + 9.0 - CENTRE[1], math.cos(azimuth) * 33.0])
        tip = np.array([math.sin(azimuth) * 34.0, line - 3.2 + 1.2 * (i % 2) - CENTRE[1], math.cos(azimuth) * 41.0])
        root, tip = root / np.linalg.norm(root), tip / np.linalg.norm(tip)
        flow = tip - (tip @ root) * root
        side = 1.0 if azimuth > -0.22 else -1.0
        across = np.cross(root, flow / np.linalg.norm(flow))
        flow = flow / np.linalg.norm(flow) - 0.25 * side * across
        flow /= np.linalg.norm(flow)
        row.append([*root, *flow, 16.0 + 1.5 * (i % 2), 4.1, side * 0.034, 4.6 + 0.5 * (i % 2), 0.4 * i, 3.0])
    return row


@kernel
def _lock_heights(directions, above_line, table, out, start, end):
    for n in range(start, end):
        dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
        t = min(1.0, max(0.0, (above_line[n] + 1.5) / 9.0))
        mass = 2.4 * t * t * (3.0 - 2.0 * t)
        height = BARE + (mass + 0.2 - BARE) * (1.0 if above_line[n] > 0.5 else max(0.0, 1.0 + (above_line[n] - 0.5) / 2.5))
        for k in range(table.shape[0]):
            rx, ry, rz = table[k, 0], table[k, 1], table[k, 2]
            if dx * rx + dy * ry + dz * rz < 0.78:
                continue
            fx, fy, fz = table[k, 3], table[k, 4], table[k, 5]
            ax, ay, az = ry * fz - rz * fy, rz * fx - rx * fz, rx * fy - ry * fx
            u = HEAD_RADIUS * (dx * fx + dy * fy + dz * fz)
            v = HEAD_RADIUS * (dx * ax + dy * ay + dz * az)
            length, half, bend, high = table[k, 6], table[k, 7], table[k, 8], table[k, 9]
            s = u / length
            if s <= -0.25 or s >= 1.0:
                continue
            v -= bend * u * u + 0.7 * math.sin(table[k, 10] + 3.0 * s) - 0.7 * math.sin(table[k, 10])
            s0 = max(s, 0.0)
            width = half * math.sqrt(1.0 - s0**3.0) if s0 > 0 else half
            c = v / width
            if abs(c) >= 1.0:
                continue
            body = (1.0 - c * c) ** 0.55 * (0.86 + 0.14 * math.cos(table[k, 11] * math.pi * (c - 0.1)))
            rise = 0.5 + 0.5 * s if s > 0 else 0.5 * (1 + s / 0.25)
            thin = min(1.0, max(0.0, (above_line[n] + 6.0) / 16.0))
            h = 0.8 * mass - 0.6 + high * rise * body * (0.38 + 0.62 * thin)
            g = 0.5 - abs(height - h)
            height = max(height, h) + (g * g * g / 1.5 if g > 0 else 0.0)
        out[n] = height


@cache
def height_map() -> FloatArray:
    """(NODES, NODES) height of the hair above the skull on the map, head units."""
    axis = np.linspace(-REACH, REACH, NODES)
    a, b = (grid.ravel() for grid in np.meshgrid(axis, axis, indexing="ij"))
    rho = np.hypot(a, b)
    share = np.sinc(np.minimum(rho, math.pi) / math.pi)
    e0, e1 = np.array(WHORL), np.array([1.0, 0.0, 0.0])
    directions = np.cos(rho)[:, None] * e0 + (share * a)[:, None] * e1 + (share * b)[:, None] * np.cross(e1, e0)
    above = inside_hairline(directions)
    out = np.empty(len(rho))
    table = locks()
    in_chunks(lambda start, end: _lock_heights(directions, above, table, out, start, end), len(out), 16384)
    out[rho > REACH - 0.05] = BARE
    return out.reshape(NODES, NODES)


@kernel
def hair_height(x, y, z, heights):
    """Height of the hair above the skull in the direction of a point of the head frame."""
    px, py, pz = x - CENTRE[0], y - CENTRE[1], z - CENTRE[2]
    along = py * WHORL[1] + pz * WHORL[2]
    front = py * -WHORL[2] + pz * WHORL[1]
    side = math.sqrt(px * px + front * front)
    rho = math.atan2(side, along)
    if rho > REACH - 0.1:
        return BARE
    scale = rho / side if side > 1e-9 else 0.0
    step = 2.0 * REACH / (NODES - 1)
    ga = (px * scale + REACH) / step
    gb = (front * scale + REACH) / step
    i, j = int(ga), int(gb)
    if i < 1 or j < 1 or i > NODES - 3 or j > NODES - 3:
        return BARE
    s, t = ga - i, gb - j
    total = 0.0
    for m in range(4):
        w = _spline(s, m)
        row = 0.0
        for n in range(4):
            row += _spline(t, n) * heights[i - 1 + m, j - 1 + n]
        total += w * row
    return total


@kernel
def _spline(t, n):
    """Weight of the n-th of four neighbours in a uniform cubic B-spline."""
    if n == 0:
        return (1.0 - t) ** 3 / 6.0
    if n == 1:
        return (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0
    if n == 2:
        return (-3.0 * t * t * t + 3.0 * t * t + 3.0 * t + 1.0) / 6.0
    return t * t * t / 6.0
