"""Corners that are the same point become one vertex: bit for bit, with no tolerance, numbered in the order they first appear.

STL repeats each vertex in every face; whoever wrote it wrote the same bits each time. 0 and -0 are the same point.
"""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import inline_kernel, kernel


def weld_exactly(points: FloatArray) -> tuple[IntArray, IntArray]:
    """First index of each distinct row of `points` (n, 3) float32 or float64, and for each row the number of its point (n,) int32."""
    rows = np.ascontiguousarray(points)
    bits = rows.view(np.uint32 if rows.dtype == np.float32 else np.uint64).reshape(-1, 3)
    slots = 1 << max(4, int(2 * len(rows) - 1).bit_length())
    return first_of_each(bits, slots, bits.dtype.type(1 << (8 * bits.itemsize - 1)))


@inline_kernel
def _unsigned_zero(bits, i, minus_zero):
    """Row i with the bits of -0 replaced by those of 0."""
    x, y, z = bits[i, 0], bits[i, 1], bits[i, 2]
    zero = minus_zero ^ minus_zero
    return zero if x == minus_zero else x, zero if y == minus_zero else y, zero if z == minus_zero else z


@kernel
def first_of_each(bits, slots, minus_zero):
    """Open addressing with linear steps in a table of `slots` places, a power of two at least twice the rows."""
    table = np.full(slots, -1, np.int32)
    first, number = np.empty(len(bits), np.int32), np.empty(len(bits), np.int32)
    count = 0
    mask = np.uint64(slots - 1)
    for i in range(len(bits)):
        x, y, z = _unsigned_zero(bits, i, minus_zero)
        # products of 32-bit numbers, which 64 bits hold
        h = np.uint64(0)
        for part in (x, y, z):
            wide = np.uint64(part)
            h = (h ^ wide ^ (wide >> np.uint64(32))) & np.uint64(0xFFFFFFFF)
            h *= np.uint64(0x9E3779B1)
            h ^= h >> np.uint64(29)
        place = (h ^ (h >> np.uint64(17))) & mask
        while True:
            known = table[place]
            if known < 0:
                table[place] = count
                first[count], number[i] = i, count
                count += 1
                break
            if _unsigned_zero(bits, first[known], minus_zero) == (x, y, z):
                number[i] = known
                break
            place = (place + np.uint64(1)) & mask
    return first[:count].copy(), number
