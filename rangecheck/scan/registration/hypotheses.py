"""Motions that could bring one scan onto another, without a guess.

Points that look alike in both scans are paired; any two such pairs, with their normals, fix a motion, if lengths and angles between
them agree (Drost et al., *Model globally, match locally*, 2010, use the same four numbers). The motion that most of the pairs
support wins. Trials are drawn from a generator of our own, so that a seed gives the same motions everywhere.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import kernel
from rangecheck.scan.registration.features import BINS, Features

#: each point is paired with its most similar ones, if it is among theirs too
_ALIKE = 3
#: what lengths (in sizes of the object) and cosines may differ by between two pairs of one motion
_LENGTH_SLACK = 0.08
_ANGLE_SLACK = 0.25
#: shortest useful distance between the two points that fix a motion, in sizes of the object
_BASE = 0.4
#: pairs farther apart after the motion (in sizes of the object) do not support it
_SUPPORT = 0.12
#: motions whose points lie closer than this (in sizes of the object) are one motion
SAME = 0.2


def alike(a: Features, b: Features) -> IntArray:
    """(k, 2) indices of points of a and b that are among each other's most similar."""
    good_a, good_b = (np.flatnonzero(np.isfinite(f.descriptions).all(axis=1)) for f in (a, b))
    if len(good_a) == 0 or len(good_b) == 0:
        return np.zeros((0, 2), np.int64)
    x, y = np.ascontiguousarray(a.descriptions[good_a]), np.ascontiguousarray(b.descriptions[good_b])
    of_x, of_y = np.full((len(x), _ALIKE), -1, np.int64), np.full((len(y), _ALIKE), -1, np.int64)
    _most_alike(x, y, of_x, of_y)
    i, j = np.repeat(np.arange(len(x)), _ALIKE), of_x.ravel()
    mutual = (j >= 0) & (of_y[j] == i[:, None]).any(axis=1)
    return np.stack([good_a[i[mutual]], good_b[j[mutual]]], axis=1)


@kernel
def _most_alike(x, y, of_x, of_y):
    """The nearest rows of y to each row of x, and of x to each of y; sums in a fixed order, so the same on any number of threads."""
    best_x, best_y = np.full(of_x.shape, np.inf), np.full(of_y.shape, np.inf)
    for i in range(len(x)):
        for j in range(len(y)):
            far = max(best_x[i, -1], best_y[j, -1])
            total = 0.0
            for first in range(0, x.shape[1], BINS):
                for k in range(first, first + BINS):
                    d = x[i, k] - y[j, k]
                    total += d * d
                if total >= far:
                    break
            _insert(best_x[i], of_x[i], total, j)
            _insert(best_y[j], of_y[j], total, i)


@kernel
def _insert(values, places, value, place):
    """Keep the smallest values in ascending order; of equal ones the first to come."""
    k = len(values) - 1
    if value >= values[k]:
        return
    while k > 0 and values[k - 1] > value:
        values[k], places[k] = values[k - 1], places[k - 1]
        k -= 1
    values[k], places[k] = value, place


def propose(a: Features, b: Features, size_mm: float, *, seed: int, trials: int, keep: int) -> list[tuple[FloatArray, int]]:
    """Up to `keep` distinct motions a_from_b with the number of pairs that support each, best first.

    size_mm  size of the object (RMS distance from its centre): the tolerances are shares of it"""
    pairs = alike(a, b)
    if len(pairs) < 6:
        return []
    p, np_ = a.points_mm[pairs[:, 0]], a.normals[pairs[:, 0]]
    q, nq = b.points_mm[pairs[:, 1]], b.normals[pairs[:, 1]]
    room = 64 * keep
    motions, support = np.zeros((room, 3, 4)), np.zeros(room, np.int64)
    found = _try_pairs(p, np_, q, nq, size_mm, trials, np.uint64(seed), motions, support)
    order = np.argsort(-support[:found], kind="stable")
    probe = b.points_mm[:: max(1, len(b.points_mm) // 30)]
    kept: list[tuple[FloatArray, int]] = []
    places: list[FloatArray] = []
    for k in order:
        motion = rigid.checked(np.vstack([motions[k], [0.0, 0.0, 0.0, 1.0]]))
        place = rigid.move_points(motion, probe)
        if all(np.sqrt(((place - other) ** 2).sum(axis=1).mean()) > SAME * size_mm for other in places):
            kept.append((motion, int(support[k])))
            places.append(place)
            if len(kept) == keep:
                break
    return kept


@kernel
def _next(state):
    """splitmix64 (Steele, Lea & Flood, 2014): new state and 64 random bits."""
    state = state + np.uint64(0x9E3779B97F4A7C15)
    z = state
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state, z ^ (z >> np.uint64(31))


@kernel
def _frame(ax, ay, az, nx, ny, nz, out):
    """Orthonormal rows: along (a), across it in the plane of the normal (n), and their product; False when a lies along n."""
    length = math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / length, ay / length, az / length
    along = ax * nx + ay * ny + az * nz
    nx, ny, nz = nx - along * ax, ny - along * ay, nz - along * az
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    if length < 0.2:
        return False
    nx, ny, nz = nx / length, ny / length, nz / length
    out[0, 0], out[0, 1], out[0, 2] = ax, ay, az
    out[1, 0], out[1, 1], out[1, 2] = nx, ny, nz
    out[2, 0], out[2, 1], out[2, 2] = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
    return True


@kernel
def _try_pairs(p, np_, q, nq, size, trials, seed, motions, support):
    """Draw two pairs at a time; keep the motions with most support. Returns how many rows of `motions` are filled."""
    n = len(p)
    state = seed
    filled = weakest = 0
    fp, fq, m = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 4))
    reach = (_SUPPORT * size) ** 2
    for _ in range(trials):
        state, bits = _next(state)
        i, j = int((bits >> np.uint64(33)) % np.uint64(n)), int((bits & np.uint64(0x7FFFFFFF)) % np.uint64(n))
        dx, dy, dz = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
        ex, ey, ez = q[j, 0] - q[i, 0], q[j, 1] - q[i, 1], q[j, 2] - q[i, 2]
        d, e = math.sqrt(dx * dx + dy * dy + dz * dz), math.sqrt(ex * ex + ey * ey + ez * ez)
        if d < _BASE * size or e < _BASE * size or abs(d - e) > _LENGTH_SLACK * size:
            continue
        between = np_[i, 0] * np_[j, 0] + np_[i, 1] * np_[j, 1] + np_[i, 2] * np_[j, 2]
        there = nq[i, 0] * nq[j, 0] + nq[i, 1] * nq[j, 1] + nq[i, 2] * nq[j, 2]
        if abs(between - there) > _ANGLE_SLACK:
            continue
        first = (np_[i, 0] * dx + np_[i, 1] * dy + np_[i, 2] * dz) / d - (nq[i, 0] * ex + nq[i, 1] * ey + nq[i, 2] * ez) / e
        second = (np_[j, 0] * dx + np_[j, 1] * dy + np_[j, 2] * dz) / d - (nq[j, 0] * ex + nq[j, 1] * ey + nq[j, 2] * ez) / e
        if abs(first) > _ANGLE_SLACK or abs(second) > _ANGLE_SLACK:
            continue
        if not _frame(dx, dy, dz, np_[i, 0] + np_[j, 0], np_[i, 1] + np_[j, 1], np_[i, 2] + np_[j, 2], fp):
            continue
        if not _frame(ex, ey, ez, nq[i, 0] + nq[j, 0], nq[i, 1] + nq[j, 1], nq[i, 2] + nq[j, 2], fq):
            continue
        for r in range(3):
            for c in range(3):
                m[r, c] = fp[0, r] * fq[0, c] + fp[1, r] * fq[1, c] + fp[2, r] * fq[2, c]
        for r in range(3):
            m[r, 3] = 0.5 * (p[i, r] + p[j, r])
            for c in range(3):
                m[r, 3] -= m[r, c] * 0.5 * (q[i, c] + q[j, c])
        count = 0
        for k in range(n):
            x = m[0, 0] * q[k, 0] + m[0, 1] * q[k, 1] + m[0, 2] * q[k, 2] + m[0, 3] - p[k, 0]
            y = m[1, 0] * q[k, 0] + m[1, 1] * q[k, 1] + m[1, 2] * q[k, 2] + m[1, 3] - p[k, 1]
            z = m[2, 0] * q[k, 0] + m[2, 1] * q[k, 1] + m[2, 2] * q[k, 2] + m[2, 3] - p[k, 2]
            if x * x + y * y + z * z < reach:
                count += 1
        place = filled
        if filled < len(motions):
            filled += 1
        else:
            place = weakest
            if support[place] >= count:
                continue
        for r in range(3):
            for c in range(4):
                motions[place, r, c] = m[r, c]
        support[place] = count
        if filled == len(motions):
            weakest = 0
            for k in range(1, filled):
                if support[k] < support[weakest]:
                    weakest = k
    return filled
