"""Gray code in pictures to projector coordinates finer than a cell.

Cell k of the projector covers the coordinates k to k + 1; its code is the Gray code of k, most significant bit first. Between cells
k - 1 and k exactly one bit flips, bit f = the number of trailing zeros of k. A picture minus its inverse crosses zero there, and the
place of the crossing between two pixels is found to a small part of a pixel; between crossings the coordinate is linear.

A flip of bit f says more than its own place: on the lower side the binary digits below f are all 1, digit f is 0 and digit f + 1 is
the Gray bit f itself. Reading upwards from there and downwards from the top must agree; where all pictures are there this
catches wrong codes, and where one is missing it restores the digits that the missing bit leaves open. What stays invisible is the
crossings of the missing bit itself.
"""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.kernels import in_chunks, kernel

#: longest stretch between two crossings, in pixels, over which a coordinate is interpolated
MAX_GAP_PX = 40
#: crossings of one boundary to and fro, by noise, lie this close together
FLICKER_PX = 1.5
_MAX_EVENTS = 16384


@kernel
def boundary(lower, flipped, n_bits, missing):
    """Boundary k between cell k - 1, whose Gray code is `lower` (missing bits 0), and cell k, which differs in bit `flipped`.

    -1 where the digits contradict each other, -2 where missing pictures leave them open."""
    # upwards from the flip: digit j + 1 = digit j xor Gray bit j
    digits, known = 0, 0
    digit, sure = 0, True
    for j in range(flipped, n_bits):
        if sure:
            known |= 1 << j
            digits |= digit << j
        if (missing >> j) & 1:
            sure = False
        digit ^= (lower >> j) & 1
    if sure and digit != 0:
        return -1
    # downwards from the top, where the digit above the first is 0
    digit = 0
    for j in range(n_bits - 1, flipped - 1, -1):
        if (missing >> j) & 1:
            break
        digit ^= (lower >> j) & 1
        if (known >> j) & 1:
            if ((digits >> j) & 1) != digit:
                return -1
        else:
            known |= 1 << j
            digits |= digit << j
    for j in range(flipped, n_bits):
        if not (known >> j) & 1:
            return -2
    return digits + (1 << flipped)


@kernel
def _patterns(difference, y, missing, codes):
    """Known bits of the codes of one row's pixels; bit 0 is the last picture."""
    n = difference.shape[0]
    codes[:] = 0
    for b in range(n):
        bit = 1 << (n - 1 - b)
        if missing & bit == 0:
            line = difference[b, y]
            for x in range(codes.size):
                codes[x] |= bit if line[x] > 0 else 0


@kernel
def count_directions(difference, lit, missing, first, last, step):
    """How many crossings fit a coordinate that grows with x, and how many one that falls, among every `step`-th row."""
    n, width = difference.shape[0], difference.shape[2]
    codes = np.empty(width, np.int64)
    up = down = 0
    for y in range(first, last, step):
        _patterns(difference, y, missing, codes)
        for x in range(width - 1):
            if not (lit[y, x] and lit[y, x + 1]):
                continue
            a, b = codes[x], codes[x + 1]
            flips = a ^ b
            if flips == 0 or flips & (flips - 1) != 0:
                continue
            f = 0
            while not (flips >> f) & 1:
                f += 1
            if missing >> f != 0:
                continue  # without redundancy both directions fit
            up += boundary(a, f, n, missing) >= 0
            down += boundary(b, f, n, missing) >= 0
    return up, down


@kernel
def _invisible(low, high, missing):
    """Whether all boundaries between `low` and `high`, both excluded, belong to missing bits."""
    for k in range(low + 1, high):
        f = 0
        while not (k >> f) & 1:
            f += 1
        if not (missing >> f) & 1:
            return False
    return True


@kernel
def _rows(difference, lit, missing, rising, first, last, coordinate):
    """Coordinates of the pixels of rows first..last, NaN where there is none."""
    n, width = difference.shape[0], difference.shape[2]
    place, where = np.empty(_MAX_EVENTS), np.empty(_MAX_EVENTS, np.int64)
    codes = np.empty(width, np.int64)
    for y in range(first, last):
        _patterns(difference, y, missing, codes)
        x = 0
        while x < width:
            # one run of neighbours whose codes follow each other
            events, times = 0, 0
            while x < width and not lit[y, x]:
                x += 1
            before = codes[x] if x < width else 0
            while x + 1 < width and lit[y, x + 1] and events < _MAX_EVENTS:
                after = codes[x + 1]
                flips = before ^ after
                if flips != 0:
                    if flips & (flips - 1) != 0:
                        break
                    f = 0
                    while not (flips >> f) & 1:
                        f += 1
                    forward = boundary(before, f, n, missing) if rising else boundary(after, f, n, missing)
                    back = boundary(after, f, n, missing) if rising else boundary(before, f, n, missing)
                    d0, d1 = float(difference[n - 1 - f, y, x]), float(difference[n - 1 - f, y, x + 1])
                    at = x + d0 / (d0 - d1)
                    near = events > 0 and at - place[events - 1] <= FLICKER_PX
                    if near and (forward == where[events - 1] or back == where[events - 1]):
                        # noise crosses the same boundary to and fro: the mean of an odd number of crossings
                        place[events - 1] = (place[events - 1] * times + at) / (times + 1)
                        times += 1
                    elif forward >= 0 and times % 2 == (1 if events > 0 else 0):
                        place[events], where[events] = at, forward
                        events += 1
                        times = 1
                    else:
                        break
                before = after
                x += 1
            if times % 2 == 0:
                events -= 1  # crossed and crossed back: no boundary
            for e in range(events - 1):
                low, high = min(where[e], where[e + 1]), max(where[e], where[e + 1])
                right_way = (where[e + 1] > where[e]) == rising and low != high
                gap = place[e + 1] - place[e]
                if not (right_way and 0.0 < gap <= MAX_GAP_PX and _invisible(low, high, missing)):
                    continue
                slope = (where[e + 1] - where[e]) / gap
                for p in range(int(np.ceil(place[e])), int(np.floor(place[e + 1])) + 1):
                    coordinate[y, p] = where[e] + (p - place[e]) * slope
            x += 1


def coordinates(difference: FloatArray, lit: BoolArray, missing: int) -> tuple[FloatArray, bool]:
    """Projector coordinate (h, w) float32 along which the code runs, NaN where it is not known, for a code that varies along
    picture rows; and whether it rises to the right. Pass transposed pictures for the other code.

    difference  (bits, h, w) float32, each picture minus its inverse, most significant bit first; zeros where missing
    missing     mask of missing bits, bit 0 = the last picture"""
    height = lit.shape[0]
    up, down = count_directions(difference, lit, missing, 0, height, max(1, height // 200))
    rising = bool(up >= down)
    coordinate = np.full(lit.shape, np.nan, np.float32)
    in_chunks(lambda i, j: _rows(difference, lit, missing, rising, i, j, coordinate), height, 64)
    return coordinate, rising
