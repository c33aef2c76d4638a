"""Residuals of photographs against a model's state, in units of their noise.

A pixel at saturation says only that the light was at least so much: its probability is that of the noise carrying the model's light past
saturation (Tobin 1958), and its residual r is the one whose r^2/2 is minus the logarithm of that.

Where noise is cut off at black, the dark is on average too bright, by how much depends on how noisy the dark is, and that is often not as noisy as what is
lit. What is within noise of black there tells nothing of ambient light.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.recover.problem import Photograph, Problem

#: Huber's bend and the limit beyond which a pixel counts as an outlier, in standard deviations of its noise
BEND, OUTLIER = 2.5, 6.0
#: noise, parts of full scale, of a pixel that tells nothing
UNTOLD = 1.0
#: noises above the floor up to which a pixel should be for its noise to be cut off (of a Gaussian 0.0004 of a deviation is lost there)
_CUT_OFF = 3.0


def residuals(problem: Problem, theta: FloatArray, which: int, *, slopes: bool = True) -> tuple[FloatArray, FloatArray]:
    """(predicted - measured) / noise (n,) of one picture, and its derivatives (n, p)."""
    photo = problem.photographs[which]
    shown = problem.predict(theta, which, slopes=slopes)
    residual = (shown.values - photo.values) / photo.noise
    jacobian = shown.slopes / photo.noise[:, None]
    full = np.flatnonzero(photo.values >= photo.saturation)
    if len(full):
        residual[full], steep = at_least(residual[full])
        jacobian[full] *= steep[:, None]
    return residual, jacobian


def at_least(excess: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residual of a pixel known only to lie above saturation, and its slope by `excess`, (model - saturation) / noise."""
    from scipy.special import log_ndtr

    log_chance = log_ndtr(excess)
    residual = -np.sqrt(np.maximum(-2.0 * log_chance, 1e-300))
    hazard = np.exp(-0.5 * excess**2 - log_chance) / np.sqrt(2.0 * np.pi)
    return residual, -hazard / residual


def undarkened(problem: Problem) -> Problem:
    """The problem with the pixels telling nothing that at its state are within noise of a picture's floor, where ambient light is looked for: all else
    multiplies light, of which the dark has none. What is an outlier there, as light where a state has none, still counts."""
    if not problem.unknowns.ambient:
        return problem
    return replace(problem, photographs=tuple(_undarkened(problem, k) for k in range(len(problem.photographs))))


def _undarkened(problem: Problem, which: int) -> Photograph:
    photo = problem.photographs[which]
    if not np.isfinite(photo.floor):
        return photo
    shown = problem.predict(problem.start(), which, slopes=False).values
    dark = (shown < photo.floor + _CUT_OFF * photo.noise) & (photo.values < photo.floor + OUTLIER * photo.noise)
    return replace(photo, noise=np.where(dark, np.hypot(photo.noise, UNTOLD), photo.noise))


def robust_cost(problem: Problem, theta: FloatArray) -> float:
    """Huber's minus log likelihood of all pictures."""
    total = 0.0
    for k in range(len(problem.photographs)):
        r = np.abs(residuals(problem, theta, k, slopes=False)[0])
        total += float(np.where(r < BEND, 0.5 * r * r, BEND * r - 0.5 * BEND**2).sum())
    return total


def moved_sights(state: Problem, poses: FloatArray) -> Problem:
    """The state with each picture's sight moved by its pose's small turn and shift (first order)."""
    photographs = []
    for photo, pose in zip(state.photographs, poses):
        if pose.any():
            photo = replace(photo, sight=photo.sight.moved(pose))
        photographs.append(photo)
    return replace(state, photographs=tuple(photographs))
