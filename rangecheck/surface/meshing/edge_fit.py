"""The local fit of a cell where neighbours are missing or belong to another surface; conventions as in `local_fit`."""

from __future__ import annotations

import math

import numpy as np

from rangecheck.equations import cholesky, substituted
from rangecheck.kernels import inline_kernel, kernel

#: how far, in tangent of slope, the surface may bend within a window before a neighbour is taken for another surface
BEND_TAN = 0.6
#: standard deviations of the Gaussian windows tried, pixels
EDGE_WIDTHS_PX = np.array([0.8])
#: prior of the curvature at the edges: one standard deviation is a pitch / sqrt(RIDGE) per squared cell
RIDGE = 2.0


@inline_kernel
def allowed_step(distance_px, pitch_mm, sigma_mm):
    """Largest departure from the local plane, at `distance_px`, of a sample of the same surface."""
    return 5.0 * sigma_mm + BEND_TAN * pitch_mm * distance_px


@kernel
def edge_fit(ranges, row, col, plane_u, plane_v, pitch_mm, sigma, widths, confidence, a, b, unit, out):
    """Quadratics over the neighbours that belong to the cell's own surface, where some are missing: their curvature is held back by
    a ridge, their width chosen as in `local_fit`. out: value above the cell's own range, slopes, noise gain."""
    height, width = ranges.shape
    centre = ranges[row, col]
    # a curvature of BEND_TAN / 2 per pixel is one standard deviation of the prior
    ridge = RIDGE * (sigma / (pitch_mm + 1e-9)) ** 2 + 1e-3
    low, high = -np.inf, np.inf
    found = False
    for scale in range(len(widths)):
        reach = math.ceil(2.0 * widths[scale])
        falloff = -0.5 / widths[scale] ** 2
        a[:] = 0.0
        b[:] = 0.0
        count = 0
        for dv in range(max(-reach, -row), min(reach, height - 1 - row) + 1):
            for du in range(max(-reach, -col), min(reach, width - 1 - col) + 1):
                z = ranges[row + dv, col + du] - centre - plane_u * du - plane_v * dv
                if not abs(z) <= allowed_step(math.sqrt(du * du + dv * dv), pitch_mm, sigma):
                    continue
                w = math.exp(falloff * (du * du + dv * dv))
                wu, wv = w * du, w * dv
                wuu, wuv, wvv = wu * du, wu * dv, wv * dv
                b[0], b[1], b[2] = b[0] + w * z, b[1] + wu * z, b[2] + wv * z
                b[3], b[4], b[5] = b[3] + wuu * z, b[4] + wuv * z, b[5] + wvv * z
                a[0, 0], a[1, 0], a[2, 0] = a[0, 0] + w, a[1, 0] + wu, a[2, 0] + wv
                a[3, 0], a[4, 0], a[5, 0] = a[3, 0] + wuu, a[4, 0] + wuv, a[5, 0] + wvv
                a[3, 1], a[4, 1], a[5, 1] = a[3, 1] + wuu * du, a[4, 1] + wuu * dv, a[5, 1] + wuv * dv
                a[5, 2] += wvv * dv
                a[3, 3], a[4, 3], a[5, 3] = a[3, 3] + wuu * du * du, a[4, 3] + wuu * du * dv, a[5, 3] + wuu * dv * dv
                a[5, 4], a[5, 5] = a[5, 4] + wuv * dv * dv, a[5, 5] + wvv * dv * dv
                count += 1
        if count < 6:
            continue
        a[1, 1], a[2, 1], a[2, 2] = a[3, 0], a[4, 0], a[5, 0]
        a[3, 2], a[4, 2], a[4, 4] = a[4, 1], a[5, 1], a[5, 3]
        for i in range(3, 6):
            a[i, i] += ridge
        unit[:] = 0.0
        unit[0] = 1.0
        if not cholesky(a, 6, 0.0, 1e-12):
            continue
        substituted(a, 6, b, b)
        substituted(a, 6, unit, unit)
        variance = 0.0
        for dv in range(max(-reach, -row), min(reach, height - 1 - row) + 1):
            for du in range(max(-reach, -col), min(reach, width - 1 - col) + 1):
                z = ranges[row + dv, col + du] - centre - plane_u * du - plane_v * dv
                if not abs(z) <= allowed_step(math.sqrt(du * du + dv * dv), pitch_mm, sigma):
                    continue
                part = unit[0] + unit[1] * du + unit[2] * dv + unit[3] * du * du + unit[4] * du * dv + unit[5] * dv * dv
                variance += (math.exp(falloff * (du * du + dv * dv)) * part) ** 2
        gain = math.sqrt(variance)
        low, high = max(low, b[0] - confidence * gain * sigma), min(high, b[0] + confidence * gain * sigma)
        if found and low > high:
            break
        found = True
        out[0], out[1], out[2], out[3] = b[0], plane_u + b[1], plane_v + b[2], gain
    return found
