"""How much a hollow explains of the slopes around each place, beyond what a smooth form and the place's own clutter do.

Around each place the two slopes are fitted by those of a polynomial height of degree DEGREE and of a hollow (or bump) of Gaussian form,
over what is within reach. Smooth shape is in the polynomial. What neither explains is the place's own clutter, and the fit is made again with the
slopes weighed by the inverse of its covariance (2 x 2, and of the noise): a fold bends across itself alone and leaves
the slope along it clean, and there a dent shows that is beside the fold or in it. The statistic is the hollow's share of what the
polynomial leaves unexplained, as a ratio of lengths: the adaptive matched filter (Robey, Fuhrmann, Kelly, Nitzberg, A CFAR
adaptive matched filter detector, 1992), with clutter told from the place itself.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.basis import frame_around
from rangecheck.equations import cholesky
from rangecheck.kernels import inline_kernel, kernel

#: of the polynomial that holds the smooth form
DEGREE = 5
#: fits: the first with slopes weighed alike, the others by what the last left over
FITS = 3
#: normals that lean further than this from the place's mean are of another side
ALIKE = math.cos(math.radians(50.0))
#: a place is judged when each of SECTORS sectors around it holds this share of an even one's normals, and all of them this many for each unknown
SECTORS, FILLED, NORMALS = 8, 0.25, 2.0
#: what is left of the noise when its expected share is taken off, in standard deviations of what is left of it
QUIET = 3.0
#: polynomial terms, and the hollow
_TERMS = DEGREE * (DEGREE + 3) // 2 + 1


@kernel
def _add_moments(a, b, hollow, su, sv, sure, plain, dented, told_u, told_v, ends):
    """Adds one normal to the sums of which all products of two terms' slopes are made, and of terms' slopes and measured ones.

    plain[p, q] of a^p b^q; dented of the same times the hollow's e; told_u, told_v of the same times the measured slopes; ends: of e^2 (aa, ab, bb),
    of e times measured slopes (ua, ub, va, vb), and of the measured slopes' products (uu, uv, vv)."""
    power = sure
    for p in range(2 * DEGREE - 1):
        value = power
        for q in range(2 * DEGREE - 1 - p):
            plain[p, q] += value
            if p + q <= DEGREE:
                dented[p, q] += value * hollow
                if p + q < DEGREE:
                    told_u[p, q] += value * su
                    told_v[p, q] += value * sv
            value *= b
        power *= a
    e, e2 = sure * hollow, sure * hollow * hollow
    ends[0], ends[1], ends[2] = ends[0] + e2 * a * a, ends[1] + e2 * a * b, ends[2] + e2 * b * b
    ends[3], ends[4] = ends[3] + e * su * a, ends[4] + e * su * b
    ends[5], ends[6] = ends[5] + e * sv * a, ends[6] + e * sv * b
    ends[7], ends[8], ends[9] = ends[7] + sure * su * su, ends[8] + sure * su * sv, ends[9] + sure * sv * sv


@kernel
def _products(plain, dented, told_u, told_v, ends, gram_uu, gram_uv, gram_vv, right):
    """Sums over the normals of products of the terms' slopes (uv: of both orders), and of theirs with the measured ones: right[k] =
    (uu, uv, vu, vv), terms' slope first. Terms are a^i b^j with i + j = 1 .. DEGREE, and the hollow, whose slopes are (a, b) e."""
    last = _TERMS - 1
    m = 0
    for degree in range(1, DEGREE + 1):
        for j in range(degree + 1):
            i = degree - j
            n = 0
            for other in range(1, degree + 1):
                for n_b in range(other + 1):
                    k = other - n_b
                    gram_uu[m, n] = i * k * plain[i + k - 2, j + n_b] if i > 0 and k > 0 else 0.0
                    gram_vv[m, n] = j * n_b * plain[i + k, j + n_b - 2] if j > 0 and n_b > 0 else 0.0
                    gram_uv[m, n] = (i * n_b + j * k) * plain[i + k - 1, j + n_b - 1] if i + k > 0 and j + n_b > 0 else 0.0
                    n += 1
            gram_uu[last, m] = i * dented[i, j]
            gram_vv[last, m] = j * dented[i, j]
            gram_uv[last, m] = (i * dented[i - 1, j + 1] if i > 0 else 0.0) + (j * dented[i + 1, j - 1] if j > 0 else 0.0)
            right[m, 0] = i * told_u[i - 1, j] if i > 0 else 0.0
            right[m, 1] = i * told_v[i - 1, j] if i > 0 else 0.0
            right[m, 2] = j * told_u[i, j - 1] if j > 0 else 0.0
            right[m, 3] = j * told_v[i, j - 1] if j > 0 else 0.0
            m += 1
    gram_uu[last, last], gram_uv[last, last], gram_vv[last, last] = ends[0], 2.0 * ends[1], ends[2]
    right[last, 0], right[last, 1], right[last, 2], right[last, 3] = ends[3], ends[5], ends[4], ends[6]


@inline_kernel
def _between(noise, j, ax, ay, az, bx, by, bz):
    """a . covariance . b of normal j."""
    x = noise[j, 0] * bx + noise[j, 1] * by + noise[j, 2] * bz
    y = noise[j, 1] * bx + noise[j, 3] * by + noise[j, 4] * bz
    z = noise[j, 2] * bx + noise[j, 4] * by + noise[j, 5] * bz
    return ax * x + ay * y + az * z


@kernel
def _form(gram, vector):
    """vector . gram . vector, of a symmetric gram known in its lower half."""
    total = 0.0
    for i in range(len(vector)):
        total += gram[i, i] * vector[i] * vector[i]
        for j in range(i):
            total += 2.0 * gram[i, j] * vector[i] * vector[j]
    return total


@kernel
def matched(points, normals, noise, weight, first, begins, who, reach, half_width, ratios, depths):
    """Ratio and depth of the hollow at each of the places first, first + 1, ...; `who` are the normals within reach of each."""
    plain, dented = np.empty((2 * DEGREE - 1, 2 * DEGREE - 1)), np.empty((DEGREE + 1, DEGREE + 1))
    told_u, told_v, ends = np.empty((DEGREE, DEGREE)), np.empty((DEGREE, DEGREE)), np.empty(10)
    gram_uu, gram_uv, gram_vv = np.zeros((_TERMS, _TERMS)), np.zeros((_TERMS, _TERMS)), np.zeros((_TERMS, _TERMS))
    gram, products, right, sector = np.empty((_TERMS, _TERMS)), np.empty((_TERMS, 4)), np.empty(_TERMS), np.empty(SECTORS)
    for s in range(len(ratios)):
        me = first + s
        mx, my, mz = 0.0, 0.0, 0.0
        for t in range(begins[s], begins[s + 1]):
            j = who[t]
            if normals[j, 0] * normals[me, 0] + normals[j, 1] * normals[me, 1] + normals[j, 2] * normals[me, 2] > ALIKE:
                mx, my, mz = mx + normals[j, 0], my + normals[j, 1], mz + normals[j, 2]
        length = math.sqrt(mx * mx + my * my + mz * mz)
        if length == 0.0:
            continue
        mx, my, mz = mx / length, my / length, mz / length
        ux, uy, uz, vx, vy, vz = frame_around(mx, my, mz)
        plain[:], dented[:], told_u[:], told_v[:], ends[:], sector[:] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        count, nuu, nuv, nvv = 0, 0.0, 0.0, 0.0
        for t in range(begins[s], begins[s + 1]):
            j = who[t]
            ahead = normals[j, 0] * mx + normals[j, 1] * my + normals[j, 2] * mz
            if ahead < ALIKE:
                continue
            dx, dy, dz = points[j, 0] - points[me, 0], points[j, 1] - points[me, 1], points[j, 2] - points[me, 2]
            x, y = dx * ux + dy * uy + dz * uz, dx * vx + dy * vy + dz * vz
            hollow = math.exp(-0.5 * (x * x + y * y) / half_width**2)
            su = -(normals[j, 0] * ux + normals[j, 1] * uy + normals[j, 2] * uz) / ahead
            sv = -(normals[j, 0] * vx + normals[j, 1] * vy + normals[j, 2] * vz) / ahead
            nuu += weight[j] * _between(noise, j, ux, uy, uz, ux, uy, uz)
            nuv += weight[j] * _between(noise, j, ux, uy, uz, vx, vy, vz)
            nvv += weight[j] * _between(noise, j, vx, vy, vz, vx, vy, vz)
            _add_moments(x / reach, y / reach, hollow, su, sv, weight[j], plain, dented, told_u, told_v, ends)
            sector[int((math.atan2(y, x) / (2.0 * math.pi) + 1.0) * SECTORS) % SECTORS] += 1.0
            count += 1
        if count < NORMALS * _TERMS or sector.min() * SECTORS < FILLED * count:
            continue
        _products(plain, dented, told_u, told_v, ends, gram_uu, gram_uv, gram_vv, products)
        wuu, wuv, wvv = 1.0, 0.0, 1.0
        for _ in range(FITS):
            for i in range(_TERMS):
                right[i] = wuu * products[i, 0] + wuv * (products[i, 1] + products[i, 2]) + wvv * products[i, 3]
                for j in range(i + 1):
                    gram[i, j] = wuu * gram_uu[i, j] + wuv * gram_uv[i, j] + wvv * gram_vv[i, j]
            if not cholesky(gram, _TERMS, 0.0, 1e-13 * gram[0, 0]):
                ratios[s] = np.nan
                break
            total = wuu * ends[7] + 2.0 * wuv * ends[8] + wvv * ends[9]
            rest = total
            for i in range(_TERMS):
                for j in range(i):
                    right[i] -= gram[i, j] * right[j]
                right[i] /= gram[i, i]
                rest -= right[i] * right[i]
            # the hollow is the last term: what it explains beyond all others is the square of its own entry
            # of what is left, the share of the noise is known; it averages out, as clutter does not
            of_noise = wuu * nuu + 2.0 * wuv * nuv + wvv * nvv
            clutter = max(rest - of_noise, 0.0) + QUIET * of_noise / math.sqrt(count)
            ratios[s] = abs(right[_TERMS - 1]) / math.sqrt(max(clutter, 1e-12 * total))
            for i in range(_TERMS - 1, -1, -1):
                for j in range(i + 1, _TERMS):
                    right[i] -= gram[j, i] * right[j]
                right[i] /= gram[i, i]
            depths[s] = right[_TERMS - 1] * half_width**2 / reach
            # what is left of each slope, and of their product: sums of squares about the fit
            cuu, cuv, cvv = (
                ends[7] + _form(gram_uu, right),
                ends[8] + 0.5 * _form(gram_uv, right),
                ends[9] + _form(gram_vv, right),
            )
            for i in range(_TERMS):
                cuu -= 2.0 * right[i] * products[i, 0]
                cuv -= right[i] * (products[i, 1] + products[i, 2])
                cvv -= 2.0 * right[i] * products[i, 3]
            # the noise bounds from below what a slope can be off by
            cuu, cvv = max(cuu, nuu), max(cvv, nvv)
            cuv = math.copysign(min(abs(cuv), 0.999 * math.sqrt(cuu * cvv)), cuv)
            size = (cuu * cvv - cuv * cuv) / plain[0, 0]
            wuu, wuv, wvv = cvv / size, -cuv / size, cuu / size
