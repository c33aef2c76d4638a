"""The fast form for whole arrays of angles: the same operations as `fast.lobe_fast`, in an order that a processor does several of at once.

One evaluation is a chain of some forty dependent operations, and waiting for it is most of its time. So a block of angles goes through three
loops: cosines and places in the table, which are arithmetic alone and compiled for vector registers; the table's polynomials, whose
loads are independent of each other; and the power of two with the geometry, vectors again. Blocks stay in the first-level cache. S is
that of `lobe_fast` to the last bit; cosines and sines are polynomials good to 1e-10, far below FAST_ERROR, also at grazing angles.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.kernels import inline_kernel, kernel
from rangecheck.reflectance.fast import TOP_G, TOP_X, cell_of, chebyshev, exponent_at, lobe_fast, power_of_two

_BLOCK = 256
#: pi/2 in two parts, so that the cosine keeps its digits where it vanishes
_QUARTER, _QUARTER_REST = 0.5 * math.pi, 6.123233995736766e-17
_points, _fit, _powers = chebyshev(5, 0.0, (0.5 * math.pi) ** 2)
_S0, _S1, _S2, _S3, _S4, _S5 = (float(c) for c in _powers @ _fit @ np.sinc(np.sqrt(_points) / np.pi))
_TURN = 2.0 * math.pi
_ROUND = 1.5 * 2.0**52


@inline_kernel
def _sine(x):
    """sin x for -pi/2 <= x <= pi/2."""
    y = x * x
    y2 = y * y
    return x * ((_S0 + y * _S1) + y2 * ((_S2 + y * _S3) + y2 * (_S4 + y * _S5)))


@inline_kernel
def _take(values, first, count, block):
    """values[first : first + count] into the block; a single value serves all."""
    if values.size > 1:
        for j in range(count):
            block[j] = values[first + j]
    else:
        for j in range(count):
            block[j] = values[0]


@kernel
def _places(blocks, rows, columns, count):
    """Cosines, s_xy^2, g, what multiplies S, and the place in the table; vectors throughout."""
    theta_i, theta_r, phi, roughness, reach, x, w, t, factor = blocks
    for j in range(count):
        s_i, s_r = _sine(theta_i[j]), _sine(theta_r[j])
        c_i, c_r = _sine((_QUARTER - theta_i[j]) + _QUARTER_REST), _sine((_QUARTER - theta_r[j]) + _QUARTER_REST)
        turns = (phi[j] * (1.0 / _TURN) + _ROUND) - _ROUND
        half = _sine(0.5 * (phi[j] - turns * _TURN))
        in_plane = s_i - s_r
        sxy2 = in_plane * in_plane + 4.0 * (s_i * s_r) * (half * half)
        u2 = (c_i + c_r) * (c_i + c_r)
        h2 = u2 + sxy2
        g, a = roughness[j] * u2, reach[j] * sxy2
        factor[j] = reach[j] * (1.0 / (4.0 * math.pi)) * (h2 * h2) / (u2 * (c_i * c_r))
        x[j], w[j], t[j], rows[j], columns[j] = cell_of(g, a)
        # from here on the angles' places hold what masking and the sum need
        theta_i[j], theta_r[j], phi[j], roughness[j], reach[j] = c_i, c_r, sxy2, g, a


@kernel
def _exponents(table, rows, columns, x, w, t, g, y, count):
    """log2(S/g) of each; returns whether all lie inside the table."""
    plain = True
    for j in range(count):
        plain = plain and g[j] < TOP_G and x[j] < TOP_X
        y[j] = exponent_at(table, rows[j], columns[j], w[j], t[j])
    return plain


@kernel
def _values(factor, g, y, out, count):
    for j in range(count):
        out[j] = factor[j] * (g[j] * power_of_two(y[j]))


@kernel
def fill_fast(table, theta_i, theta_r, phi, roughness, reach, start, stop, out, cosines_i, cosines_r, asides):
    """out[n] = the published lobe in sr^-1 for n in start..stop; also what masking needs: both cosines and s_xy^2, where those arrays
    are not empty. An argument of length 1 serves all n. Azimuths within some thousands of turns."""
    blocks = np.empty((10, _BLOCK))
    rows, columns = np.empty(_BLOCK, np.uint64), np.empty(_BLOCK, np.uint64)
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        _take(theta_i, first, count, blocks[0])
        _take(theta_r, first, count, blocks[1])
        _take(phi, first, count, blocks[2])
        _take(roughness, first, count, blocks[3])
        _take(reach, first, count, blocks[4])
        here = (blocks[0], blocks[1], blocks[2], blocks[3], blocks[4], blocks[5], blocks[6], blocks[7], blocks[8])
        _places(here, rows, columns, count)
        c_i, c_r, sxy2, g, a, x, w, t, factor = here
        if _exponents(table, rows, columns, x, w, t, g, blocks[9], count):
            _values(factor, g, blocks[9], out[first:stop], count)
        else:
            for j in range(count):
                out[first + j] = factor[j] * lobe_fast(table, g[j], a[j])
        if cosines_i.size > 0:
            for j in range(count):
                cosines_i[first + j], cosines_r[first + j], asides[first + j] = c_i[j], c_r[j], sxy2[j]
