"""Functions of one number in (0, 1], tabulated evenly inside each octave and read without a square root or a logarithm.

The cell and the place inside it are bits of the float64 itself, so that resolution is relative: as fine at a cosine of 0.001 as at 1.
Below the lowest octave the lowest node serves. `first` is where the nodes begin in the last axis of (materials, wavelengths, n).
"""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.kernels import inline_kernel

_BITS = 4
PER_OCTAVE = 1 << _BITS
_SHIFT = 52 - _BITS
_LOW, _ONE = (1 << _SHIFT) - 1, 0x3FF0000000000000


def node_count(octaves: int) -> int:
    """Nodes of a table over `octaves` octaves up to 1; the last is 1 itself, once more so that 1 has a cell of its own."""
    return octaves * PER_OCTAVE + 2


def nodes(octaves: int) -> FloatArray:
    """(node_count,) the numbers at which a table holds its function, rising from 2^-octaves to 1 and 1 + 1/PER_OCTAVE."""
    index = np.arange(node_count(octaves))
    return 2.0 ** (index // PER_OCTAVE - octaves) * (1.0 + (index % PER_OCTAVE) / PER_OCTAVE)


@inline_kernel
def cell_and_share(x, octaves):
    """(cell, share): a table's function at x is (1 - share) of the cell's lower node and `share` of the next; 0 <= x <= 1."""
    bits = np.float64(max(x, 2.0**-octaves)).view(np.int64)
    cell = (bits >> _SHIFT) - ((1023 - octaves) << _BITS)
    share = np.int64(((bits & _LOW) << _BITS) | _ONE).view(np.float64) - 1.0
    return cell, share


@inline_kernel
def value_at(surfaces, material, wave, first, x, octaves):
    """The function tabulated from `first` on, at x."""
    cell, share = cell_and_share(x, octaves)
    at = np.uintp(first + cell)
    below = surfaces[material, wave, at]
    return below + share * (surfaces[material, wave, at + np.uintp(1)] - below)
