"""Spots that the model does not explain - a reflection, a fly, a stain - with the soft rims that outliers alone leave in.

Beyond OUTLIER noises a pixel is left out (polish.py). Where a spot fades into its surroundings, what is nearer than that would stay, all of it off to one
side, and pull the fit. So from such pixels on, those are left out too around which what is left of the picture is off to the same side by more than chance
lets it be: means over windows of two sizes, in units of their own spread over the whole picture, which holds what the model's small errors do everywhere.
Pixels scattered singly have no such surroundings, and lose none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.recover.polish import Fitted
from rangecheck.recover.problem import Photograph, Problem
from rangecheck.recover.residuals import BEND, OUTLIER, UNTOLD, residuals

#: sides of the windows, pixels, and how much of one must be seen
_WINDOWS, _SEEN = (5, 11), 0.5
#: deviations of a window's mean from which what is beside an outlier belongs to it
_OFF = 3.0
_NORMAL_MAD = 0.6744897501960817


def without_spots(problem: Problem, fitted: Fitted) -> Problem | None:
    """The problem with the pixels of spots told to say nothing, as seen from the end of a fit of it; None where there are no more than it leaves out."""
    photos = []
    for k, photo in enumerate(problem.photographs):
        off = residuals(fitted.started, fitted.theta, k, slopes=False)[0]
        lost = _rims(photo, off)
        photos.append(replace(photo, noise=np.where(lost, np.hypot(photo.noise, UNTOLD), photo.noise)) if lost.any() else photo)
    same = all(photo is before for photo, before in zip(photos, problem.photographs))
    return None if same else replace(problem, photographs=tuple(photos))


def untold(problem: Problem) -> int:
    """How many pixels say nothing."""
    return sum(int((photo.noise >= UNTOLD).sum()) for photo in problem.photographs)


def _rims(photo: Photograph, off: FloatArray) -> BoolArray:
    """(n,) pixels that belong to spots and still tell something; off (n,): residuals in noises."""
    from scipy.ndimage import binary_propagation

    told = photo.noise < UNTOLD
    outlying = told & (np.abs(off) > OUTLIER)
    if not outlying.any():
        return outlying
    around = np.ones((3, 3), bool)
    lost = np.zeros(len(off), bool)
    means = _means(photo, np.clip(off, -BEND, BEND), told & ~outlying)
    for side in (-1.0, 1.0):
        seeds = photo.sight.spread((outlying & (side * off > 0.0)).astype(float), 0.0) > 0.0
        beside = np.any([side * mean > _OFF for mean in means], axis=0)
        grown = binary_propagation(seeds, around, beside | seeds)
        lost |= grown.reshape(-1)[photo.sight.pixel]
    # outliers count as such
    return lost & told & ~outlying


def _means(photo: Photograph, off: FloatArray, kept: BoolArray) -> list[FloatArray]:
    """(h, w) each: mean of `off` over windows of the pixels kept, in units of its own spread; 0 where too little is seen."""
    from scipy.ndimage import uniform_filter

    members, total = (photo.sight.spread(v, 0.0) for v in (kept.astype(float), np.where(kept, off, 0.0)))
    found = []
    for side in _WINDOWS:
        count = uniform_filter(members, side, mode="constant") * side**2
        mean = uniform_filter(total, side, mode="constant") * side**2 / np.sqrt(np.maximum(count, 1.0))
        enough = count > _SEEN * side**2
        known = enough & (members > 0.0)
        spread = np.median(np.abs(mean[known])) / _NORMAL_MAD if known.any() else 1.0
        found.append(np.where(enough, mean / max(1.0, float(spread)), 0.0))
    return found
