"""Light that lamps do not send straight to a surface: of the surroundings, and what other parts throw and mirror. It depends on the material looked for.

A fit knows lamps alone; a simulator knows all light, but not the material. They take turns: what the simulator shows of the material beyond the
lamps' straight light is taken off the pictures, and the fit begins again, until it ends where it did:

    picture - (simulated(material) - straight(material)) = straight(material)    =>    picture = simulated(material)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.recover.looks import CameraFound, Look, fit_looking, photographs
from rangecheck.recover.polish import Fitted
from rangecheck.recover.problem import Problem

#: the most turns, and the share of an interval's width by which a number may still move between the last two
_TURNS, _STILL = 8, 0.1


def fit_simulated(
    problem: Problem, look: Look, simulated: Callable[[Problem], FloatArray]
) -> tuple[Fitted, CameraFound | None, bool]:
    """As `fit_looking`, of pictures that hold thrown light too; and whether the turns came to rest. `simulated` gives the picture (h, w) of a state by all
    lamps from where `look` is, in parts of full scale at exposure 1; NaN where nothing is seen."""
    taken = look.pictures
    fitted, camera = fit_looking(problem, look)
    for _ in range(_TURNS):
        thrown = _thrown(fitted, simulated(fitted.problem))
        # what is saturated says only that it is at least full scale, whatever its light came by
        look.pictures = [
            np.where(picture < photo.saturation, picture - photo.exposure * thrown, picture)
            for picture, photo in zip(taken, fitted.problem.photographs)
        ]
        before, lamps = fitted, problem.lights
        seen = photographs(look.see(), look.pictures, lamps, look.noise, look.caster, look.together)
        fitted, camera = fit_looking(replace(problem, photographs=seen), look)
        if _still(before, fitted):
            return fitted, camera, True
    return fitted, camera, False


def _thrown(fitted: Fitted, all_light: FloatArray) -> FloatArray:
    """(h, w) at exposure 1; 0 beside what is seen."""
    state = fitted.problem
    photo = state.photographs[0]
    straight = (state.predict(state.start(), 0, slopes=False).values - photo.ambient) / photo.exposure
    seen = all_light.reshape(-1)[photo.sight.pixel]
    return photo.sight.spread(np.where(np.isnan(seen), 0.0, seen - straight), 0.0)


def _still(before: Fitted, after: Fitted) -> bool:
    """Whether every number that both determine moved by little beside its interval."""
    return all(
        abs(a.value - b.value) <= _STILL * (b.high - b.low)
        for a, b in zip(before.estimates, after.estimates)
        if a.low is not None and b.low is not None and b.high is not None
    )
