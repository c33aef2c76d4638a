"""The form of the sample bust as one signed function: skull, face, ears, neck, chest under a pinned cloak, and socle.

Head frame: one unit is a hundredth of the head's height without hair (UNIT_MM), x to the sitter's left, y up, z to the front;
chin at y = 0, eyes at 50, skull to 100; ear hole near z = 0. The proportions are the canon: eye as wide as a fifth of the head,
brow, nose base and chin at thirds below the hairline. Body frame: the same unit and origin, not turned with the head.
World: millimetres, y up from the flat base of the socle, z to the front. Paired features use |x|, rounded where they meet.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.analytic.bust_hair import hair_height
from rangecheck.analytic.implicit import blend_max, blend_min, bump, disc, ellipsoid, limb, ramp, ring, soft_abs
from rangecheck.arrays import FloatArray
from rangecheck.kernels import kernel

UNIT_MM = 1.26
CHIN_Y_MM = 167.0
# the head turns to the sitter's left and bows a little, about the top of the neck
_YAW, _ROLL, _PITCH = math.radians(13.0), math.radians(-2.5), math.radians(3.0)
PIVOT = (0.0, 14.0, -10.0)
_CY, _SY, _CR, _SR, _CP, _SP = (f(a) for a in (_YAW, _ROLL, _PITCH) for f in (math.cos, math.sin))
# head_from_body, row by row: turn, then roll, then pitch
_R00, _R01, _R02 = _CR * _CY, _SR, -_CR * _SY
_R10, _R11, _R12 = -_CP * _SR * _CY + _SP * _SY, _CP * _CR, _CP * _SR * _SY + _SP * _CY
_R20, _R21, _R22 = _SP * _SR * _CY + _CP * _SY, -_SP * _CR, -_SP * _SR * _SY + _CP * _CY


@kernel
def _skull(x, y, z):
    back = ellipsoid(x, y, z, 0.0, 65.0, -9.0, 33.5, 34.0, 33.5)
    front = ellipsoid(x, y, z, 0.0, 65.0, 10.0, 29.0, 33.0, 34.5)
    dome = ellipsoid(x, y, z, 0.0, 68.0, -5.0, 25.0, 34.5, 29.0)
    return blend_min(blend_min(back, front, 12.0), dome, 10.0)


@kernel
def _face(x, y, z):
    """Skin of the face without eyes, nose and lips."""
    ax = soft_abs(x, 2.0)
    d = ellipsoid(x, y, z, 0.0, 42.0, 12.0, 26.5, 40.0, 29.0)
    d = blend_min(d, ellipsoid(x, y, z, 0.0, 20.0, 27.0, 16.5, 16.0, 17.0), 9.0)
    # jaw from its angle to the chin, cheekbone towards the ear, the cheek between
    d = blend_min(d, limb(ax, y, z, 17.0, 19.0, 3.0, 7.0, 6.5, 31.5, 7.5, 6.0), 12.0)
    d = blend_min(d, limb(ax, y, z, 20.0, 41.0, 25.0, 26.5, 43.0, 4.0, 6.0, 4.5), 12.0)
    d = blend_min(d, limb(ax, y, z, 18.5, 22.0, 3.0, 25.0, 44.0, 0.0, 6.5, 5.0), 12.0)
    d = blend_min(d, ellipsoid(ax, y, z, 15.0, 30.0, 22.5, 11.0, 15.0, 13.5), 10.0)
    d = blend_min(d, ellipsoid(x, y, z, 0.0, 6.8, 37.0, 8.0, 6.8, 7.2), 6.0)
    # brow: a ridge that falls away outwards
    d = blend_min(d, limb(ax, y, z, 5.0, 57.0, 40.0, 15.0, 59.0, 37.3, 3.0, 3.0), 9.0)
    d = blend_min(d, limb(ax, y, z, 15.0, 59.0, 37.3, 23.5, 57.0, 29.0, 3.0, 2.0), 10.0)
    # eye sockets
    d = blend_max(d, -ellipsoid(ax, y, z, 13.4, 50.8, 43.2, 9.8, 5.8, 8.0), 5.0)
    d = blend_max(d, -ellipsoid(ax, y, z, 7.0, 49.5, 45.5, 3.2, 5.5, 6.0), 3.5)
    return d


@kernel
def _eye(x, y, z, d):
    """Eyeball and lids added to the face."""
    ax = abs(x)
    u, v = ax - 14.0, y - 50.0
    if abs(u) > 14.0 or abs(v) > 13.0 or z < 20.0:
        return d
    # the opening: two arcs, the upper one higher and fullest towards the nose, the outer corner a little raised
    tilt = 0.045 * u
    arch = 1.0 - (u / 7.3) * (u / 7.3)
    upper = 3.3 * arch * (1.0 - 0.035 * u) + tilt - 0.25
    lower = -2.3 * arch * (1.0 + 0.03 * u) + tilt - 0.25
    slope = 1.0 / math.sqrt(1.0 + 0.4 * u * u / (u * u + 20.0))
    above, below = (v - upper) * slope, (lower - v) * slope
    opening = blend_max(above, below, 0.5)
    lid = ellipsoid(ax, y, z, 14.3, 50.2, 31.4, 9.6, 6.9, 8.7)
    # rim of the upper lid stands proud, with the crease above it
    rim = 0.4 * bump(above - 0.5, 0.9) * ramp(v, -1.0, 1.0) + 0.25 * bump(below - 0.4, 0.7)
    crease = 0.75 * bump(above - 3.1, 0.8) * ramp(v - 0.2 * u, 1.5, 3.0)
    lid = lid - rim + crease
    lid = blend_max(lid, -opening, 0.5)
    d = blend_min(d, lid, 3.6)
    ball = ellipsoid(ax, y, z, 14.1, 49.7, 32.7, 7.7, 6.5, 6.7)
    d = blend_max(d, -blend_max(opening, ball - 0.05, 0.3), 0.3)
    return blend_min(d, ball, 0.25)


@kernel
def _nose(x, y, z, d):
    ax = soft_abs(x, 0.6)
    if abs(x) > 16.0 or y < 20.0 or y > 66.0 or z < 26.0:
        return d
    bridge = limb(x, y, z, 0.0, 58.0, 40.6, 0.0, 34.6, 50.4, 3.3, 3.3)
    flank = limb(x, y, z, 0.0, 52.0, 37.5, 0.0, 35.0, 42.5, 4.0, 7.0)
    body = blend_min(bridge, flank, 4.5)
    body = blend_min(body, ellipsoid(x, y, z, 0.0, 33.6, 50.3, 3.9, 3.6, 4.3), 3.0)
    d = blend_min(d, body, 4.5)
    wing = ellipsoid(ax, y, z, 5.2, 32.0, 45.0, 2.8, 3.0, 4.8)
    d = blend_min(d, wing, 2.6)
    d = blend_min(d, limb(x, y, z, 0.0, 30.8, 50.2, 0.0, 29.6, 45.5, 1.5, 1.5), 1.6)
    return blend_max(d, -ellipsoid(ax, y, z, 3.1, 29.6, 47.6, 1.55, 2.3, 2.9), 1.0)


@kernel
def _mouth(x, y, z, d):
    if abs(x) > 26.0 or y < 0.0 or y > 34.0 or z < 26.0:
        return d
    ax = soft_abs(x, 0.8)
    # philtrum
    d = d + 0.9 * bump(x, 1.5) * ramp(y, 21.0, 24.0) * (1.0 - ramp(y, 26.5, 31.0)) * ramp(z, 36.0, 42.0)
    upper = limb(ax, y, z, 1.9, 22.1, 42.9, 8.4, 20.0, 38.9, 3.2, 1.6)
    upper = blend_min(upper, ellipsoid(x, y, z, 0.0, 21.0, 43.5, 2.6, 2.2, 2.8), 2.2)
    lower = limb(ax, y, z, 2.2, 16.5, 41.5, 7.8, 18.3, 38.7, 3.4, 1.8)
    d = blend_min(d, upper, 2.0)
    d = blend_min(d, lower, 2.4)
    # line between the lips, and the hollow below them
    line = y - (19.45 - 0.35 * bump(x, 1.8) + 0.25 * bump(ax - 5.0, 2.5))
    width = 1.0 - ramp(ax, 7.4, 10.4)
    d = d + 1.25 * bump(line, 0.7) * width * ramp(z, 33.0, 37.0)
    d = d + 0.9 * bump(ax - 9.8, 1.8) * bump(y - 19.5, 1.8) * ramp(z, 30.0, 34.0)
    return d + 0.7 * bump(y - 12.6, 2.4) * bump(x, 9.0) * ramp(z, 32.0, 38.0)


@kernel
def _ear(x, y, z, d):
    ax = abs(x)
    px, py, pz = ax - 32.3, y - 43.0, z + 4.0
    if px * px + py * py + pz * pz > 27.0 * 27.0:
        return d
    # ear frame: a to the front, b up the ear, c out of it; leaning back and standing off the head
    lean, off = 0.2, 0.34
    a0 = pz * math.cos(lean) + py * math.sin(lean)
    b = py * math.cos(lean) - pz * math.sin(lean)
    a = a0 * math.cos(off) + px * math.sin(off)
    c = px * math.cos(off) - a0 * math.sin(off)
    half = 7.0 + 1.6 * ramp(b, -10.0, 10.0)
    ra, rb = a / half, (b - 0.5) / 13.5
    r = math.sqrt(ra * ra + rb * rb + 1e-6)
    shell = ellipsoid(a, b, c, 0.0, 0.5, 0.0, half, 13.5, 3.2)
    back = ramp(-a, -5.5, 0.5)
    top = ramp(b, -8.0, -2.0)
    # helix, the channel inside it, antihelix, and the deep concha
    relief = 1.5 * bump(r - 0.86, 0.13) * max(back, ramp(b, 3.0, 8.0)) * top
    relief -= 1.3 * bump(r - 0.66, 0.12) * max(back, ramp(b, 4.0, 8.0)) * top
    relief += 0.9 * bump(r - 0.44, 0.13) * back * top
    hollow = 3.4 * math.exp(-(((a - 1.0) / 3.6) ** 2) - ((b + 1.5) / 4.6) ** 2)
    front = ramp(c, -1.0, 1.0)
    shell = shell - (relief - hollow) * front
    d = blend_min(d, shell, 2.2)
    return blend_min(d, ellipsoid(a, b, c, 6.2, -1.5, 0.5, 1.7, 2.8, 1.6), 2.4)


@kernel
def head_function(x, y, z, heights):
    """Signed function of the head in its own frame, without the neck."""
    skull = _skull(x, y, z)
    if skull > 40.0 and y > 40.0:
        return skull - 25.0
    d = blend_min(_face(x, y, z), skull, 7.0)
    if d < 24.0 and z > 20.0:
        d = _nose(x, y, z, d)
        d = _eye(x, y, z, d)
        d = _mouth(x, y, z, d)
    if skull < 40.0:
        mass = blend_min(skull, ellipsoid(x, y, z, 0.0, 44.0, -20.0, 23.5, 25.0, 17.0), 10.0)
        if mass < 26.0:
            hair = (mass - hair_height(x, y, z, heights)) * 0.75
            d = blend_min(d, hair, 1.2)
    return _ear(x, y, z, d)


@kernel
def body_function(x, y, z):
    """Neck, shoulders and chest with their rounded cut, body frame."""
    ax = soft_abs(x, 3.0)
    d = limb(x, y, z, 0.0, -38.0, -17.0, 0.0, 22.0, -8.0, 24.5, 21.5)
    # trapezius, shoulders, rib cage
    d = blend_min(d, limb(ax, y, z, 7.0, 6.0, -20.0, 60.0, -40.0, -19.0, 12.0, 14.0), 22.0)
    d = blend_min(d, limb(x, y, z, 0.0, 0.0, -22.0, 0.0, -60.0, -34.0, 12.0, 20.0), 18.0)
    chest = ellipsoid(x, y, z, 0.0, -74.0, -16.0, 62.0, 50.0, 37.0)
    chest = blend_min(chest, ellipsoid(ax, y, z, 66.0, -56.0, -18.0, 25.0, 32.0, 29.0), 24.0)
    chest = blend_min(chest, ellipsoid(ax, y, z, 28.0, -70.0, 7.0, 31.0, 24.0, 18.0), 14.0)
    chest = blend_min(chest, ellipsoid(x, y, z, 0.0, -48.0, -12.0, 60.0, 16.0, 25.0), 16.0)
    chest = blend_min(chest, ellipsoid(ax, y, z, 26.0, -54.0, -32.0, 26.0, 26.0, 18.0), 18.0)
    chest = blend_min(chest, ellipsoid(x, y, z, 0.0, -70.0, 7.0, 26.0, 26.0, 16.5), 12.0)
    d = blend_min(d, chest, 18.0)
    # sternomastoids from behind the ears to the notch, collar bones
    d = blend_min(d, limb(ax, y, z, 5.0, -33.0, 9.5, 20.0, 27.0, -9.0, 3.6, 5.5), 8.0)
    d = blend_min(d, limb(ax, y, z, 6.0, -36.5, 9.5, 32.0, -33.0, 8.0, 3.4, 3.0), 9.0)
    d = blend_min(d, limb(ax, y, z, 32.0, -33.0, 8.0, 62.0, -31.0, -12.0, 3.0, 4.0), 10.0)
    d = blend_max(d, -ellipsoid(x, y, z, 0.0, -33.5, 16.5, 4.2, 4.5, 6.0), 5.0)
    return _cloak(x, y, z, d)


@kernel
def _fold(u, high, above, below):
    """A fold with its crest at u = 0, steeper below."""
    return high * bump(u, above if u < 0.0 else below)


@kernel
def _cloak(x, y, z, d):
    """A cloak laid around the shoulders and pinned on the right one: u counts from its upper edge down, in units."""
    if d > 12.0 or y > 12.0:
        return d
    fall = y - 4.0 + 0.72 * z + 0.13 * x
    across = x / 1.22
    r = math.sqrt(across * across + fall * fall + 1.0)
    turn = 1.3 * across / r
    u = r - 43.0 + 1.1 * math.sin(2.0 * turn + 0.8) + 0.6 * math.sin(5.0 * turn)
    cloth = 1.9 + _fold(u - 2.4, 2.2, 1.8, 1.8)
    cloth += _fold(u - 8.5 - 1.5 * turn, 1.9 * ramp(turn, -1.4, -0.3), 2.6, 1.6)
    cloth += _fold(u - 12.5 + 2.5 * turn, 2.0 * ramp(-turn, -0.9, 0.4), 3.0, 1.7)
    cloth += _fold(u - 18.0 - 3.5 * turn, 2.3, 3.2, 1.8)
    cloth += _fold(u - 25.5 + 1.5 * turn, 2.1 * ramp(turn, -0.9, 0.3), 3.2, 1.8)
    cloth += _fold(u - 31.0 - 4.0 * turn, 2.4 * ramp(-turn, -0.6, 0.7), 3.6, 1.9)
    cloth += _fold(u - 38.0 + 2.0 * turn, 2.2, 3.8, 2.0)
    cloth += _fold(u - 47.0 - 2.0 * turn, 2.2 * ramp(turn, -0.7, 0.6), 4.0, 2.0)
    edge = ramp(u, -1.2, 0.9)
    d = blend_min(d, 0.8 * (d - edge * (cloth + 1.0) + 1.0), 0.7)
    # the brooch
    px, py, pz = x + 42.0, y + 32.5, z - 12.0
    along = -0.35 * px + 0.35 * py + 0.87 * pz
    out = math.sqrt(max(px * px + py * py + pz * pz - along * along, 0.0) + 0.01)
    pin = disc(out, along, -6.0, 3.0, 6.0, 1.2) - 0.8 * bump(out, 2.6) + 0.7 * bump(out - 4.4, 0.6)
    return blend_min(d, pin, 0.8)


@kernel
def _cut(x, y, z):
    """The rounded edge of a classical bust: what lies outside is cut away."""
    side = ellipsoid(x, y, 0.0, 0.0, -22.0, 0.0, 76.0, 74.0, 60.0)
    return blend_max(side, -z - 49.0, 8.0)


@kernel
def _socle(x, y, z):
    """Moulded foot, millimetres, world frame."""
    r = math.sqrt(x * x + (z + 14.0) * (z + 14.0))
    d = disc(r, y, -6.0, 8.5, 50.0, 1.2)
    d = blend_min(d, ring(r, y, 13.5, 41.0, 5.0), 1.0)
    d = blend_min(d, disc(r, y, 10.0, 52.0, 36.0, 2.0), 1.0)
    d = blend_max(d, -ring(r, y, 31.5, 40.0, 14.0), 1.0)
    d = blend_min(d, ring(r, y, 47.5, 28.0, 3.0), 1.0)
    d = blend_max(d, y - 51.5, 2.0)
    return blend_max(d, -y, 0.6)


@kernel
def bust_function(x, y, z, heights):
    """Signed function of the whole bust at a point in mm."""
    bx, by, bz = x / UNIT_MM, (y - CHIN_Y_MM) / UNIT_MM, z / UNIT_MM
    d = 1e9
    if by > -20.0:
        qx, qy, qz = bx - PIVOT[0], by - PIVOT[1], bz - PIVOT[2]
        hx = _R00 * qx + _R01 * qy + _R02 * qz + PIVOT[0]
        hy = _R10 * qx + _R11 * qy + _R12 * qz + PIVOT[1]
        hz = _R20 * qx + _R21 * qy + _R22 * qz + PIVOT[2]
        d = head_function(hx, hy, hz, heights)
    if by < 55.0:
        body = blend_max(body_function(bx, by, bz), _cut(bx, by, bz), 3.5)
        d = blend_min(d, body, 8.0)
    d *= UNIT_MM
    if y < 75.0:
        d = blend_min(d, _socle(x, y, z), 3.0)
    return d


def mirrored_in_head(point_mm: FloatArray) -> FloatArray:
    """The place (3,) mm on the other side of the head's plane of symmetry, whose features are paired."""
    head_from_body = np.array([[_R00, _R01, _R02], [_R10, _R11, _R12], [_R20, _R21, _R22]])
    pivot_mm = UNIT_MM * np.array(PIVOT) + np.array([0.0, CHIN_Y_MM, 0.0])
    away = head_from_body @ (np.asarray(point_mm, float) - pivot_mm)
    other: FloatArray = head_from_body.T @ (away * np.array([-1.0, 1.0, 1.0])) + pivot_mm
    return other
