"""The lamp and the matt share of a scan's picture on the scan's own surface: what shading needs, and no more.

A single picture of a matt surface fixes the lamp's direction well, its distance and a lobe poorly; a lobe is taken only if it explains
much more. Brightness differs from the model by paint and by light between parts of the surface, in proportion to itself: the residual's assumed spread
is a share of the brightness around, and what differs more is bent down (Huber).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import ScanError
from rangecheck.recover.fit import Fitted, fit
from rangecheck.recover.grid import ScanGrid, sight_of
from rangecheck.recover.lights import Light
from rangecheck.recover.problem import Guess, Photograph, Problem, Unknowns

_SHARE, _LEAST_NOISE = 0.05, 0.01
_LEAST_FACING = 0.3
#: cosine to the lamp of cells that a lamp is fitted to: shadows lie beyond
_LEAST_COSINE = 0.15
#: how much less (minus log likelihood per thousand cells) a lobe must cost to be taken
_WORTH = 30.0
_SIDES = ((0.0, 0.0), (0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))


def lamp_of(grid: ScanGrid, cell: IntArray, normals: FloatArray, *, cells: int = 2500) -> Fitted:
    """Fitted to cells (m,) of the flattened grid with normals (m, 3). Raises ScanError where too few face the camera."""
    rays = grid.rays.reshape(-1, 3)[cell]
    seen = grid.picture.reshape(-1)[cell]
    well = np.flatnonzero((-(normals * rays).sum(1) > _LEAST_FACING) & np.isfinite(seen) & (seen > 0.0) & (seen < 1.0))
    if len(well) < 100:
        raise ScanError(f"{len(well)} cells face the camera and hold brightness; 100 are needed to find the lamp")
    few = well[:: max(1, len(well) // cells)]
    sight = sight_of(grid, cell[few], normals[few])
    values = seen[few]
    middle = np.median(sight.points, axis=0)
    away = float(np.linalg.norm(middle))
    ahead = -middle / away
    noise = np.hypot(_LEAST_NOISE, _SHARE * values)
    best: Fitted | None = None
    for side in _SIDES:
        light = Light(ahead + np.array([*side, 0.0]), math.pi, middle, away, 1.0)
        photo = Photograph(sight, values, noise, np.ones((len(few), 1), bool), (0,))
        matt = fit(Problem((photo,), (light,), Guess(0.5, 0.0, 0.0, 1e-3, 1.0), Unknowns(("K_lm",))), pixels=1000)
        if best is None or matt.cost < best.cost:
            best = matt
    assert best is not None
    # what the lamp found does not reach is dark for another reason than its slope: leave it out
    found = _kept(best.problem, unknowns=Unknowns(("K_lm",), distance=True))
    matt = fit(found, known_noise=False, pixels=2500)
    start = replace(matt.problem, material=replace(matt.problem.material, K_lobe=0.05, sigma_um=0.5, correlation_um=2.0))
    lobed = fit(
        _kept(start, unknowns=Unknowns(("K_lm", "K_lobe", "correlation_um"), distance=True)), known_noise=False, pixels=2500
    )
    gained = (matt.cost - lobed.cost) / len(few) * 1000.0
    return lobed if gained > _WORTH else matt


def _kept(problem: Problem, unknowns: Unknowns) -> Problem:
    photo = problem.photographs[0]
    towards = problem.lights[0].centre_mm - photo.sight.points
    cosine = (photo.sight.normals * towards).sum(1) / np.linalg.norm(towards, axis=1)
    value = problem.predict(problem.start(), 0, slopes=False).values
    keep = (cosine > _LEAST_COSINE) & (photo.values > 0.3 * value)
    return replace(problem, photographs=(photo.only(keep),), unknowns=unknowns)
