"""Kernels of the filters and of the noise estimate: what belongs to the same surface, its slant, its quiet range.

Two neighbouring cells belong to the same surface when the line between their points is not nearly along the ray: `along`, its part
along the ray, is at most `steepest` times its part across, plus what noise does. Points and rays are in the scan frame, (h, w, 3);
NaN where nothing returned. Millimetres.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.equations import cholesky, substituted
from rangecheck.kernels import inline_kernel, kernel


@inline_kernel
def parts(p, q, d):
    """The line from p to q: its component along the unit ray d (negative: q is nearer), and the length across."""
    x, y, z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    along = x * d[0] + y * d[1] + z * d[2]
    square = x * x + y * y + z * z - along * along
    return along, math.sqrt(max(square, 0.0))


@kernel
def support(points, rays, steepest, slack, first, last, friends, nearer, farther):
    """Of the eight neighbours of each cell: how many lie on its surface, how many before it, how many behind it."""
    height, width = points.shape[0], points.shape[1]
    for y in range(first, last):
        for x in range(width):
            if math.isnan(points[y, x, 2]):
                continue
            for j in range(max(y - 1, 0), min(y + 2, height)):
                for i in range(max(x - 1, 0), min(x + 2, width)):
                    if (i == x and j == y) or math.isnan(points[j, i, 2]):
                        continue
                    along, across = parts(points[y, x], points[j, i], rays[y, x])
                    allowed = steepest * across + slack[y, x]
                    if abs(along) <= allowed:
                        friends[y, x] += 1
                    elif along < 0.0:
                        nearer[y, x] += 1
                    else:
                        farther[y, x] += 1


@kernel
def patches(points, rays, steepest, slack, label, size):
    """Connected patches of the same surface (four neighbours): label (h, w) of each cell, -1 where empty; size of each label.
    Returns the number of patches. Union by smaller root, with path halving."""
    height, width = points.shape[0], points.shape[1]
    parent = np.arange(height * width)
    for y in range(height):
        for x in range(width):
            if math.isnan(points[y, x, 2]):
                continue
            for k in range(2):
                j, i = (y, x - 1) if k == 0 else (y - 1, x)
                if i < 0 or j < 0 or math.isnan(points[j, i, 2]):
                    continue
                along, across = parts(points[y, x], points[j, i], rays[y, x])
                if abs(along) > steepest * across + slack[y, x]:
                    continue
                a, b = y * width + x, j * width + i
                while parent[a] != a:
                    parent[a] = parent[parent[a]]
                    a = parent[a]
                while parent[b] != b:
                    parent[b] = parent[parent[b]]
                    b = parent[b]
                if a < b:
                    parent[b] = a
                else:
                    parent[a] = b
    count = 0
    for y in range(height):
        for x in range(width):
            label[y, x] = -1
            if math.isnan(points[y, x, 2]):
                continue
            a = y * width + x
            while parent[a] != a:
                a = parent[a]
            # roots are smaller than their members, so they were labelled before
            if a == y * width + x:
                label[y, x] = count
                count += 1
            else:
                label[y, x] = label[a // width, a % width]
            size[label[y, x]] += 1
    return count


@kernel
def slants(points, rays, steepest, slack, window, first, last, cosine):
    """|normal . ray| of each cell from a plane through its surface's points within `window` cells; NaN where fewer than five."""
    height, width = points.shape[0], points.shape[1]
    for y in range(first, last):
        for x in range(width):
            cosine[y, x] = math.nan
            if math.isnan(points[y, x, 2]):
                continue
            n = su = sv = suu = suv = svv = 0.0
            s0 = s1 = s2 = u0 = u1 = u2 = v0 = v1 = v2 = 0.0
            for j in range(max(y - window, 0), min(y + window + 1, height)):
                for i in range(max(x - window, 0), min(x + window + 1, width)):
                    if math.isnan(points[j, i, 2]):
                        continue
                    along, across = parts(points[y, x], points[j, i], rays[y, x])
                    if abs(along) > steepest * across + slack[y, x]:
                        continue
                    du, dv = float(i - x), float(j - y)
                    p0, p1, p2 = (
                        points[j, i, 0] - points[y, x, 0],
                        points[j, i, 1] - points[y, x, 1],
                        points[j, i, 2] - points[y, x, 2],
                    )
                    n, su, sv, suu, suv, svv = n + 1.0, su + du, sv + dv, suu + du * du, suv + du * dv, svv + dv * dv
                    s0, s1, s2 = s0 + p0, s1 + p1, s2 + p2
                    u0, u1, u2 = u0 + du * p0, u1 + du * p1, u2 + du * p2
                    v0, v1, v2 = v0 + dv * p0, v1 + dv * p1, v2 + dv * p2
            if n < 5.0:
                continue
            xx, xy, yy = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
            det = xx * yy - xy * xy
            if det < 1e-6:
                continue
            a0, a1, a2 = u0 - su * s0 / n, u1 - su * s1 / n, u2 - su * s2 / n
            b0, b1, b2 = v0 - sv * s0 / n, v1 - sv * s1 / n, v2 - sv * s2 / n
            # tangents, times det: only their directions matter
            e0, e1, e2 = yy * a0 - xy * b0, yy * a1 - xy * b1, yy * a2 - xy * b2
            f0, f1, f2 = xx * b0 - xy * a0, xx * b1 - xy * a1, xx * b2 - xy * a2
            m0, m1, m2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
            length = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
            if length > 0.0:
                d = rays[y, x]
                cosine[y, x] = min(abs(m0 * d[0] + m1 * d[1] + m2 * d[2]) / length, 1.0)


@kernel
def third_differences(ranges, points, rays, steepest, slack, response):
    """Immerkaer's mask (1996), which annihilates quadratics: noise of standard deviation s answers with s. NaN near other surfaces."""
    height, width = ranges.shape
    for y in range(height):
        for x in range(width):
            response[y, x] = math.nan
            if not (0 < y < height - 1 and 0 < x < width - 1) or math.isnan(ranges[y, x]):
                continue
            total, whole = 0.0, True
            for j in range(-1, 2):
                for i in range(-1, 2):
                    if math.isnan(ranges[y + j, x + i]):
                        whole = False
                        break
                    along, across = parts(points[y, x], points[y + j, x + i], rays[y, x])
                    if abs(along) > steepest * across + slack[y, x]:
                        whole = False
                        break
                    total += (2.0 - 3.0 * abs(i)) * (2.0 - 3.0 * abs(j)) * ranges[y + j, x + i]
                if not whole:
                    break
            if whole:
                response[y, x] = total / 6.0


def quadratic_window(window: int) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Offsets (k, 2) rows and columns, basis (k, 6) 1 u v uu uv vv, Gaussian weights (k,), and the solution (6, k) of a full window."""
    v, u = np.mgrid[-window : window + 1, -window : window + 1].reshape(2, -1)
    x, y = u / window, v / window
    basis = np.stack([np.ones(u.size), x, y, x * x, x * y, y * y], axis=1)
    weight = np.exp(-(x * x + y * y))
    full = np.linalg.solve((basis * weight[:, None]).T @ basis, (basis * weight[:, None]).T)
    return np.stack([v, u], axis=1), basis, weight, full


@kernel
def smooth(ranges, points, rays, steepest, sigma, offsets, basis, weights, full, first, last, out):
    """Value at each cell of a quadratic through its surface's ranges in the window. Where a range departs by more than 3.5 sigma, the
    fit is made again twice with Tukey's biweight (5 sigma)."""
    height, width = ranges.shape
    count = len(offsets)
    matrix, right, solution = np.empty((6, 6)), np.empty(6), np.empty(6)
    values, member = np.empty(count), np.empty(count, np.bool_)
    spread = np.empty(count)
    for y in range(first, last):
        for x in range(width):
            out[y, x] = ranges[y, x]
            if math.isnan(ranges[y, x]):
                continue
            slack = 4.0 * sigma[y, x]
            n = 0
            for k in range(count):
                j, i = y + offsets[k, 0], x + offsets[k, 1]
                member[k] = False
                values[k] = 0.0
                if not (0 <= j < height and 0 <= i < width) or math.isnan(ranges[j, i]):
                    continue
                along, across = parts(points[y, x], points[j, i], rays[y, x])
                if abs(along) <= steepest * across + slack:
                    member[k] = True
                    values[k] = ranges[j, i] - ranges[y, x]
                    spread[k] = sigma[j, i]
                    n += 1
            if n < 9:
                continue
            good = True
            if n == count:
                for a in range(6):
                    total = 0.0
                    for k in range(count):
                        total += full[a, k] * values[k]
                    solution[a] = total
            else:
                good = fit6(basis, weights, values, member, matrix, right, solution)
            worst = 0.0
            if good:
                for k in range(count):
                    if member[k]:
                        worst = max(worst, abs(departure(basis[k], values[k], solution)) / spread[k])
            if good and worst > 3.5:
                for _ in range(2):
                    robust = weights.copy()
                    for k in range(count):
                        reach = departure(basis[k], values[k], solution) / (5.0 * spread[k]) if member[k] else 1.0
                        robust[k] *= (1.0 - reach * reach) ** 2 if abs(reach) < 1.0 else 0.0
                    good = good and fit6(basis, robust, values, member, matrix, right, solution)
            if good and abs(solution[0]) <= 5.0 * sigma[y, x]:
                out[y, x] = ranges[y, x] + solution[0]


@inline_kernel
def departure(basis, value, solution):
    """What a value is above the fit."""
    for a in range(6):
        value -= solution[a] * basis[a]
    return value


@kernel
def fit6(basis, weights, values, member, matrix, right, solution):
    """Weighted least squares of six unknowns; False where the members do not determine them."""
    matrix[:] = 0.0
    right[:] = 0.0
    for k in range(len(values)):
        if member[k] and weights[k] > 0.0:
            for a in range(6):
                weighted = weights[k] * basis[k, a]
                right[a] += weighted * values[k]
                for b in range(a + 1):
                    matrix[a, b] += weighted * basis[k, b]
    return solved6(matrix, right, solution)


@kernel
def solved6(matrix, right, solution):
    """Solves six positive definite equations; False where they are not."""
    if not cholesky(matrix, 6, 0.0, 1e-12):
        return False
    substituted(matrix, 6, right, solution)
    return True
