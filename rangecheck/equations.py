"""A few symmetric positive definite equations, solved inside kernels by Cholesky's factor. Only lower triangles are read and written.

Where `count` is written out by the caller, the compiler knows it and unrolls the loops."""

from __future__ import annotations

import math

from rangecheck.kernels import pasted_kernel


@pasted_kernel
def cholesky(matrix, count, share, least):
    """The factor of matrix[:count, :count], in its place; False where a pivot is not above `share` of what stood there and `least`."""
    for i in range(count):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = value / matrix[j, j]
            elif not value > max(share * matrix[i, i], least):
                return False
            else:
                matrix[i, i] = math.sqrt(value)
    return True


@pasted_kernel
def substituted(factor, count, right, answer):
    """`answer` (count,), which may be `right` itself, of (factor factor^T) answer = right."""
    for i in range(count):
        value = right[i]
        for k in range(i):
            value -= factor[i, k] * answer[k]
        answer[i] = value / factor[i, i]
    for i in range(count - 1, -1, -1):
        value = answer[i]
        for k in range(i + 1, count):
            value -= factor[k, i] * answer[k]
        answer[i] = value / factor[i, i]
