"""Which motions the overlap of two scans leaves free: a plane slides in three ways, a sphere turns in three.

The mean of J J^T over the overlap (J: how the distance along the normal answers a small motion) has an eigenvalue near zero for each
motion that costs nothing (Gelfand et al., *Geometrically stable sampling for the ICP algorithm*, 2003). Noise in the normals alone
lifts such an eigenvalue to about its own variance, so that is what "near zero" is measured against.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.arrays import FloatArray

#: times the variance of the normals that an eigenvalue must exceed
_OVER_NOISE = 9.0
#: and in any case a mean square of this much: below, a millimetre of motion shows as less than 0.03 mm of distance
_LEAST = 1e-3


def free_motions(points_mm: FloatArray, normals: FloatArray, normal_noise: float) -> tuple[str, ...]:
    """Motions that points (n, 3) with unit normals (n, 3) do not determine, in words with the frame of the points; empty when all are.

    normal_noise  standard deviation of a normal, radians"""
    if len(points_mm) < 6:
        return ("everything: fewer than 6 points",)
    values, vectors, centre, length = stiffness(points_mm, normals)
    threshold = max(_OVER_NOISE * normal_noise**2, _LEAST)
    free = vectors[:, values < threshold]
    # of all bases of what is free, the one that tells slides from turns: a plane slides twice and turns once
    _, _, across = np.linalg.svd(free[:3]) if free.shape[1] else (None, None, np.zeros((0, 0)))
    return tuple(_in_words(motion, centre, length) for motion in (free @ across.T).T[::-1])


def stiffness(points_mm: FloatArray, normals: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Eigenvalues (6,) ascending and eigenvectors (6, 6) in columns of the mean J J^T about the points' centre, that centre,
    and the RMS distance from it, which is the length that turns are counted in."""
    centre = points_mm.mean(axis=0)
    length = max(float(np.sqrt(((points_mm - centre) ** 2).sum(axis=1).mean())), 1e-12)
    j = np.concatenate([np.cross((points_mm - centre) / length, normals), normals], axis=1)
    values, vectors = np.linalg.eigh(j.T @ j / len(j))
    return values, vectors, centre, length


def _in_words(motion: FloatArray, centre: FloatArray, length: float) -> str:
    turn, shift = motion[:3], motion[3:]
    angle = float(np.linalg.norm(turn))
    # a turn about a far axis is a slide: further away than three times the size of the overlap nobody could tell
    if angle < 0.3:
        return f"sliding along ({_numbers(shift / np.linalg.norm(shift))})"
    axis = turn / angle
    point = centre + length * np.cross(turn, shift) / angle**2
    return f"turning about the axis ({_numbers(axis)}) through ({', '.join(f'{round(float(x)) + 0}' for x in point)}) mm"


def _numbers(direction: FloatArray) -> str:
    # an axis has no sign: its largest component is shown positive, so that the same motion reads the same
    direction = direction * math.copysign(1.0, direction[np.argmax(np.abs(direction))])
    return ", ".join(f"{round(float(x), 2) + 0.0:.2f}" for x in direction)
