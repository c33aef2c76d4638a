"""S(g, a) from one table of cubics and quartics: what the tracer evaluates per ray.

The table holds log2(S/g) over the whole domain at once, so it belongs to no material and is made once per process. A cell is
found from the bits of two float64 numbers, without a logarithm:

    row    the octave of g, and inside it w = (m - sqrt 2)/(m + sqrt 2) of the mantissa m, which is ln m to 0.3 %
    column z = a/(4 + g), which is the exponent that remains in the rough limit; 32 columns to an octave of x = z/2 + 1

and holds a polynomial of degree 4 in w and 2 in x, fitted to the reference series at Chebyshev points; the two smallest of its 15 terms
are left out. Measured against the
reference: within FAST_ERROR wherever S exceeds 1e-290 (g 2^-40 to 2^27, a 0 to 1e8). Below that range of g the shape of S
is frozen, above it the rough form (7) serves; both are exact there to far better than FAST_ERROR wherever S/S(g, 0) > 1e-20.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.kernels import in_chunks, inline_kernel, kernel
from rangecheck.reflectance.series import lobe_rough, log_lobe_series

#: bound of the relative error of `lobe_fast`, as tested
FAST_ERROR = 1e-3

_FIRST_OCTAVE, _LAST_OCTAVE = -40, 27
_G_MIN, TOP_G = 2.0**_FIRST_OCTAVE, 2.0**_LAST_OCTAVE
_ROW_OF_EXPONENT = 1023 + _FIRST_OCTAVE
_COLUMN_BITS, _COLUMN_OCTAVES = 5, 14
_COLUMNS = _COLUMN_OCTAVES << _COLUMN_BITS
_COLUMN_OF_BITS = 1023 << _COLUMN_BITS
_Z_SCALE, _Z_OFFSET = 2.0, 4.0
TOP_X = 2.0**_COLUMN_OCTAVES
_G_LAST, _X_LAST = float(np.nextafter(TOP_G, 0.0)), float(np.nextafter(TOP_X, 0.0))
_DEGREE_W, _DEGREE_X = 4, 2
#: the terms w^i t^j that a cell keeps, as (i, j), in the order of the table's last axis, which is padded to whole cache lines
_TERMS = [(i, 0) for i in range(5)] + [(i, 1) for i in range(5)] + [(i, 2) for i in range(3)]
_PADDED = 16
_MANTISSA = 0xFFFFFFFFFFFFF
_ONE = 0x3FF0000000000000
_SHIFT, _LOW = 52 - _COLUMN_BITS, (1 << (52 - _COLUMN_BITS)) - 1
_SQRT2 = math.sqrt(2.0)
_W_MAX = (_SQRT2 - 1.0) / (_SQRT2 + 1.0)


def chebyshev(degree: int, low: float, high: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Chebyshev points (degree + 1,) of low..high, the matrix from values there to coefficients of Chebyshev's polynomials, and the
    matrix from those to coefficients of 1, x, x^2 ..."""
    unit = np.cos((2 * np.arange(degree + 1) + 1) / (2 * degree + 2) * np.pi)
    fit = np.linalg.inv(np.polynomial.chebyshev.chebvander(unit, degree))
    powers = np.zeros((degree + 1, degree + 1))
    for i in range(degree + 1):
        basis = np.polynomial.Chebyshev.basis(i, domain=[low, high]).convert(kind=np.polynomial.Polynomial)
        powers[: i + 1, i] = basis.coef
    return 0.5 * (low + high) + 0.5 * (high - low) * unit, fit, powers


_LOG2_E = 1.0 / math.log(2.0)
_ROUND = 1.5 * 2.0**52
_points, _fit, _powers = chebyshev(4, -0.5, 0.5)
_P0, _P1, _P2, _P3, _P4 = (float(c) for c in _powers @ _fit @ np.exp2(_points))


@inline_kernel
def power_of_two(y):
    """2^y for -1000 <= y <= 1000, relative error 4e-6, without a call: adding 1.5 2^52 leaves round(y) in the low bits."""
    shifted = y + _ROUND
    f = y - (shifted - _ROUND)
    f2 = f * f
    p = (_P0 + f * _P1) + f2 * ((_P2 + f * _P3) + f2 * _P4)
    return np.int64(np.float64(p).view(np.int64) + (np.float64(shifted).view(np.int64) << 52)).view(np.float64)


@inline_kernel
def cell_of(g, a):
    """(x, w, t, row, column): the column's variable, the place inside the cell, and the cell. Outside the table the nearest cell serves."""
    x = a / (_Z_SCALE * _Z_OFFSET + _Z_SCALE * g) + 1.0
    inside_g = g if g > _G_MIN else _G_MIN
    inside_g = inside_g if inside_g < _G_LAST else _G_LAST
    inside_x = x if x < _X_LAST else _X_LAST
    g_bits, x_bits = np.float64(inside_g).view(np.int64), np.float64(inside_x).view(np.int64)
    m = np.int64((g_bits & _MANTISSA) | _ONE).view(np.float64)
    w = (m - _SQRT2) / (m + _SQRT2)
    t = np.int64(((x_bits & _LOW) << _COLUMN_BITS) | _ONE).view(np.float64) - 1.5
    # unsigned, so that no check for negative indices is compiled in
    return x, w, t, np.uintp((g_bits >> 52) - _ROW_OF_EXPONENT), np.uintp((x_bits >> _SHIFT) - _COLUMN_OF_BITS)


@inline_kernel
def exponent_at(table, r, k, w, t):
    """log2(S/g), not below -1000, from a cell. Summed in pairs (Estrin): the time is that of the longest chain of operations."""
    w2 = w * w
    c0 = (table[r, k, 0] + w * table[r, k, 1]) + w2 * ((table[r, k, 2] + w * table[r, k, 3]) + w2 * table[r, k, 4])
    c1 = (table[r, k, 5] + w * table[r, k, 6]) + w2 * ((table[r, k, 7] + w * table[r, k, 8]) + w2 * table[r, k, 9])
    c2 = (table[r, k, 10] + w * table[r, k, 11]) + w2 * table[r, k, 12]
    y = c0 + t * (c1 + t * c2)
    return y if y > -1000.0 else -1000.0


@inline_kernel
def lobe_fast(table, g, a):
    """S(g, a) within FAST_ERROR, from `lobe_table()`; below 1e-290 only known to be as small; NaN for what is no number."""
    x, w, t, row, column = cell_of(g, a)
    if g < TOP_G and x < TOP_X:
        value = g * power_of_two(exponent_at(table, row, column, w, t))
    else:
        value = lobe_rough(g, a) if g >= TOP_G else (0.0 if x >= TOP_X else math.nan)
    return value


@kernel
def _sample_rows(mantissas, fractions, start, stop, out):
    """log2(S/g) at the interpolation points of rows start..stop: out (rows, columns, points in w, points in z)."""
    for row in range(start, stop):
        for i in range(mantissas.size):
            g = math.ldexp(mantissas[i], row + _FIRST_OCTAVE)
            for column in range(_COLUMNS):
                octave = 2.0 ** (column >> _COLUMN_BITS)
                within = column & ((1 << _COLUMN_BITS) - 1)
                for j in range(fractions.size):
                    z = _Z_SCALE * (octave * (1.0 + (within + fractions[j]) / (1 << _COLUMN_BITS)) - 1.0)
                    out[row, column, i, j] = (log_lobe_series(g, z * (_Z_OFFSET + g)) - math.log(g)) * _LOG2_E


@cache
def lobe_table() -> FloatArray:
    """The table of `lobe_fast`: (octaves of g, columns, 20) float64, read-only, the same in every process. 0.2 s on first use."""
    points_w, fit_w, powers_w = chebyshev(_DEGREE_W, -_W_MAX, _W_MAX)
    points_t, fit_t, powers_t = chebyshev(_DEGREE_X, -0.5, 0.5)
    mantissas, fractions = _SQRT2 * (1.0 + points_w) / (1.0 - points_w), points_t + 0.5
    rows = _LAST_OCTAVE - _FIRST_OCTAVE
    values = np.empty((rows, _COLUMNS, _DEGREE_W + 1, _DEGREE_X + 1))
    in_chunks(lambda start, stop: _sample_rows(mantissas, fractions, start, stop, values), rows, 4)
    keep = np.zeros((_DEGREE_W + 1, _DEGREE_X + 1))
    keep[tuple(np.transpose(_TERMS))] = 1.0
    # terms are left out of Chebyshev's polynomials, not of the powers, so that what stays is still the better fit
    fitted = np.einsum("pi,rcij,qj->rcpq", fit_w, values, fit_t) * keep
    powers = np.einsum("pi,rcij,qj->rcpq", powers_w, fitted, powers_t)
    table = np.zeros((rows, _COLUMNS, _PADDED))
    for n, (i, j) in enumerate(_TERMS):
        table[:, :, n] = powers[:, :, i, j]
    table.flags.writeable = False
    return table
