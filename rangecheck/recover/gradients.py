"""Conjugate gradients with the diagonal as preconditioner, compiled, on one core: the same bytes wherever it runs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.kernels import kernel


def solve(matrix: Any, right: FloatArray, start: FloatArray, sigma: FloatArray, tolerance: float = 0.01) -> FloatArray:
    """x of matrix x = right, from `start`; matrix (n, n) sparse, at least diag(1 / sigma^2).

    In units of sigma the matrix is then at least 1, so the residual bounds the error: the root mean square error of x is at most
    `tolerance` sigma."""
    rows = matrix.tocsr()
    return np.asarray(
        _descend(rows.indptr.astype(np.int64), rows.indices.astype(np.int64), rows.data, right, start, sigma, tolerance, 2000)
    )


@kernel
def _times(first, column, value, x, out):
    for i in range(len(out)):
        total = 0.0
        for k in range(first[i], first[i + 1]):
            total += value[k] * x[column[k]]
        out[i] = total


@kernel
def _descend(first, column, value, right, start, sigma, tolerance, most):
    n = len(right)
    x, r, z, p, ap, scale = start.copy(), np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    _times(first, column, value, x, r)
    for i in range(n):
        r[i] = right[i] - r[i]
        for k in range(first[i], first[i + 1]):
            if column[k] == i:
                scale[i] = 1.0 / value[k]
    rho = 0.0
    for i in range(n):
        z[i] = scale[i] * r[i]
        p[i] = z[i]
        rho += r[i] * z[i]
    for _ in range(most):
        size = 0.0
        for i in range(n):
            size += (r[i] * sigma[i]) ** 2
        if math.sqrt(size / n) <= tolerance:
            break
        _times(first, column, value, p, ap)
        curve = 0.0
        for i in range(n):
            curve += p[i] * ap[i]
        step = rho / curve
        last, rho = rho, 0.0
        for i in range(n):
            x[i] += step * p[i]
            r[i] -= step * ap[i]
            z[i] = scale[i] * r[i]
            rho += r[i] * z[i]
        for i in range(n):
            p[i] = z[i] + rho / last * p[i]
    return x
