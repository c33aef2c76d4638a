"""Sample points: scrambled (0, 2)-sequences, so that the samples of one pixel are spread evenly however many are taken.

Each point is a pure function of (seed, pixel, branch of the path, purpose, number): the same on any number of threads. Sobol' points with nested
uniform (Owen) scrambling by hashing: Laine & Karras, *Stratified sampling for stochastic transparency*, 2011; the hash constants are
those of Burley, *Practical hash-based Owen scrambling*, 2020.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.kernels import inline_kernel, stage_kernel

#: what a key is for; a path's branch is BRANCH plus its kind, a source SHADOW or CHECK plus its number
PIXEL, LOBE_WAY, DIFFUSE_WAY, CHOICE, ORDER, SHADOW, CHECK, BRANCH = 1, 2, 3, 4, 5, 1 << 16, 1 << 17, 1 << 24

_TO_UNIT = 1.0 / 4294967296.0


@stage_kernel
def _mixed(x):
    """A good 32-bit hash (lowbias32)."""
    x = np.uint32(x)
    x = np.uint32((x ^ (x >> np.uint32(16))) * np.uint32(0x7FEB352D))
    x = np.uint32((x ^ (x >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.uint32(x ^ (x >> np.uint32(16)))


@stage_kernel
def stream_of(seed, pixel):
    """The 32-bit number from which all chance along one pixel's path comes."""
    return _mixed(np.uint32(_mixed(np.uint32(seed) + np.uint32(0x9E3779B9)) ^ np.uint32(pixel)) + np.uint32(0x85EBCA6B))


@stage_kernel
def key_of(stream, purpose):
    """Which sequence serves `purpose`; also the stream of a path's branch, with the branch's number as purpose."""
    return _mixed(np.uint32(np.uint32(stream) ^ np.uint32(purpose)) + np.uint32(0xC2B2AE35))


@stage_kernel
def _reversed_bits(x):
    x = np.uint32(x)
    x = np.uint32((x << np.uint32(16)) | (x >> np.uint32(16)))
    x = np.uint32(((x & np.uint32(0x00FF00FF)) << np.uint32(8)) | ((x & np.uint32(0xFF00FF00)) >> np.uint32(8)))
    x = np.uint32(((x & np.uint32(0x0F0F0F0F)) << np.uint32(4)) | ((x & np.uint32(0xF0F0F0F0)) >> np.uint32(4)))
    x = np.uint32(((x & np.uint32(0x33333333)) << np.uint32(2)) | ((x & np.uint32(0xCCCCCCCC)) >> np.uint32(2)))
    return np.uint32(((x & np.uint32(0x55555555)) << np.uint32(1)) | ((x & np.uint32(0xAAAAAAAA)) >> np.uint32(1)))


@stage_kernel
def _hashed(x, key):
    """The scramble of a fraction whose 32 bits are given, and returned, in reverse."""
    x = np.uint32(x ^ (x * np.uint32(0x3D20ADEA)))
    x = np.uint32(x + np.uint32(key))
    x = np.uint32(x * ((np.uint32(key) >> np.uint32(16)) | np.uint32(1)))
    x = np.uint32(x ^ (x * np.uint32(0x05526C56)))
    return np.uint32(x ^ (x * np.uint32(0x53A22864)))


@stage_kernel
def point(key, number):
    """The `number`-th point (two numbers in [0, 1)) of the sequence `key`."""
    # the first dimension of Sobol's points is the index with its bits reversed, which is how the hash leaves it
    index = _reversed_bits(_hashed(_reversed_bits(number), key))
    # the second is Pascal's triangle modulo 2 times the index (Lucas 1878: odd where the bits of one index hold those of the other)
    second = index ^ ((index >> np.uint32(1)) & np.uint32(0x55555555))
    second = second ^ ((second >> np.uint32(2)) & np.uint32(0x33333333))
    second = second ^ ((second >> np.uint32(4)) & np.uint32(0x0F0F0F0F))
    second = second ^ ((second >> np.uint32(8)) & np.uint32(0x00FF00FF))
    second = np.uint32(second ^ (second >> np.uint32(16)))
    a = _reversed_bits(_hashed(index, _mixed(np.uint32(key) ^ np.uint32(0xA511E9B3))))
    b = _reversed_bits(_hashed(second, _mixed(np.uint32(key) ^ np.uint32(0x63D83595))))
    return a * _TO_UNIT, b * _TO_UNIT


@inline_kernel
def turned(share):
    """(cos, sin) of `share` in [0, 1] of a full turn, within 1e-12: series on an eighth of a turn, the same on every machine."""
    quarter = np.int64(4.0 * share + 0.5)
    x = (4.0 * share - quarter) * (0.5 * math.pi)
    y = x * x
    c = 1.0 - y * (1 / 2 - y * (1 / 24 - y * (1 / 720 - y * (1 / 40320 - y * (1 / 3628800 - y * (1 / 479001600))))))
    s = x * (1.0 - y * (1 / 6 - y * (1 / 120 - y * (1 / 5040 - y * (1 / 362880 - y * (1 / 39916800))))))
    if quarter & 1:
        c, s = -s, c
    return (-c, -s) if quarter & 2 else (c, s)


@stage_kernel
def fill_points(streams, numbers, purpose, start, count, first, second):
    """Points number numbers[start + k] of the sequences for `purpose` of streams[start + k], into first[k] and second[k]: a loop of
    nothing else, which the compiler makes of eight points at a time."""
    for k in range(count):
        first[k], second[k] = point(key_of(streams[start + k], purpose), numbers[start + k])


@stage_kernel
def fill_disc(count, first, second):
    """Points of the unit square become points of the unit disc, evenly spread; in place."""
    for k in range(count):
        radius = math.sqrt(first[k])
        cos_turn, sin_turn = turned(second[k])
        first[k], second[k] = radius * cos_turn, radius * sin_turn
