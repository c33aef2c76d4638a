"""A description of the surface around a point that does not change when the scan is moved, to find the same place in another scan.

Fast point feature histograms (Rusu, Blodow & Beetz, *Fast point feature histograms for 3D registration*, 2009): for each
neighbour within a radius three angles between both normals and the line that joins them, in 11 bins each, then averaged over the
neighbours. Bins are filled by linear interpolation, so that a small change of an angle is a small change of the description.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.kernels import kernel
from rangecheck.scan.registration.samples import Samples

BINS = 11


@dataclass(frozen=True, eq=False)
class Features:
    """n points of one scan (scan frame), their normals, and their descriptions (n, 33 per radius), each histogram of sum 1.

    A point whose neighbourhood is too empty to describe has a row of NaN."""

    points_mm: FloatArray = field(repr=False)
    normals: FloatArray = field(repr=False)
    descriptions: FloatArray = field(repr=False)


def features_of(samples: Samples, count: int, radii_mm: tuple[float, ...]) -> Features:
    """Descriptions of about `count` points of a scan at each of `radii_mm`."""
    from scipy.spatial import cKDTree

    points, normals = samples.spread(count)
    tree = cKDTree(points)
    parts = []
    for radius in radii_mm:
        pairs = tree.query_pairs(radius, output_type="ndarray")
        # the tree gives the pairs in an order of its own; ours depends on the points alone
        both = np.concatenate([pairs, pairs[:, ::-1]])
        both = both[np.lexsort((both[:, 1], both[:, 0]))]
        starts = np.searchsorted(both[:, 0], np.arange(len(points) + 1))
        neighbours = np.ascontiguousarray(both[:, 1])
        simple = np.zeros((len(points), 3 * BINS))
        _simple_histograms(points, normals, starts, neighbours, simple)
        full = np.zeros_like(simple)
        _neighbours_histograms(points, starts, neighbours, simple, full)
        parts.append(full)
    return Features(points, normals, np.concatenate(parts, axis=1))


@kernel
def pair_angles(p, np_, q, nq):
    """(alpha, phi, theta) in [-1, 1], [-1, 1], [-pi, pi] of two oriented points: Darboux frame of p, as in Rusu et al., section III."""
    dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    d = math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx / d, dy / d, dz / d
    phi = np_[0] * dx + np_[1] * dy + np_[2] * dz
    # v = d x u, w = u x v with u the normal of p
    vx, vy, vz = dy * np_[2] - dz * np_[1], dz * np_[0] - dx * np_[2], dx * np_[1] - dy * np_[0]
    length = math.sqrt(vx * vx + vy * vy + vz * vz)
    if length < 1e-9:
        return 0.0, phi, 0.0
    vx, vy, vz = vx / length, vy / length, vz / length
    wx, wy, wz = np_[1] * vz - np_[2] * vy, np_[2] * vx - np_[0] * vz, np_[0] * vy - np_[1] * vx
    alpha = vx * nq[0] + vy * nq[1] + vz * nq[2]
    theta = math.atan2(wx * nq[0] + wy * nq[1] + wz * nq[2], np_[0] * nq[0] + np_[1] * nq[1] + np_[2] * nq[2])
    return alpha, phi, theta


@kernel
def _fill(histogram, first, share, value):
    """Add `value` between the two bins nearest to `share` of the range."""
    x = min(max(share * BINS - 0.5, 0.0), BINS - 1.0)
    low = min(int(x), BINS - 2)
    histogram[first + low] += value * (1.0 - (x - low))
    histogram[first + low + 1] += value * (x - low)


@kernel
def _simple_histograms(points, normals, starts, neighbours, histograms):
    """Each point's angles with its neighbours; NaN where there are fewer than 5."""
    for i in range(len(points)):
        count = starts[i + 1] - starts[i]
        if count < 5:
            histograms[i, :] = np.nan
            continue
        for k in range(starts[i], starts[i + 1]):
            j = neighbours[k]
            alpha, phi, theta = pair_angles(points[i], normals[i], points[j], normals[j])
            _fill(histograms[i], 0, 0.5 * (alpha + 1.0), 1.0 / count)
            _fill(histograms[i], BINS, 0.5 * (phi + 1.0), 1.0 / count)
            _fill(histograms[i], 2 * BINS, 0.5 * (theta / math.pi + 1.0), 1.0 / count)


@kernel
def _neighbours_histograms(points, starts, neighbours, simple, full):
    """The point's own histogram and its neighbours', these weighted by one over their distance."""
    for i in range(len(points)):
        if not np.isfinite(simple[i, 0]):
            full[i, :] = np.nan
            continue
        total = 0.0
        for k in range(starts[i], starts[i + 1]):
            j = neighbours[k]
            if not np.isfinite(simple[j, 0]):
                continue
            dx, dy, dz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            weight = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
            total += weight
            for b in range(simple.shape[1]):
                full[i, b] += weight * simple[j, b]
        for b in range(simple.shape[1]):
            mean = full[i, b] / total if total > 0.0 else 0.0
            full[i, b] = 0.5 * (simple[i, b] + mean)
