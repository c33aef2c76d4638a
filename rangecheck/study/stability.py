"""Where a method breaks: sweep a knob over its whole range, then corner the first edge by bisection.

An error above the bound, one that is not a number, and an error raised on purpose (RangecheckError) all count as broken.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rangecheck.errors import RangecheckError, SettingError


@dataclass(frozen=True)
class Edge:
    """Where `method` first breaks `bound` as the knob goes from `start` to `stop`.

    holds_at   the last value found to hold; None if it is broken from the start
    breaks_at  the first value found to break, within `tolerance` of holds_at; None if it holds over the whole range
    knobs, errors  the sweep, in the order in which it went
    """

    method: str
    start: float
    stop: float
    bound: float
    holds_at: float | None
    breaks_at: float | None
    knobs: tuple[float, ...]
    errors: tuple[float, ...]

    @property
    def in_words(self) -> str:
        """One line for a person."""
        if self.breaks_at is None:
            return f"{self.method}: holds {self.bound:g} from {self.start:.6g} to {self.stop:.6g}"
        if self.holds_at is None:
            return f"{self.method}: breaks {self.bound:g} from the start, at {self.start:.6g}"
        return f"{self.method}: holds {self.bound:g} up to {self.holds_at:.6g}, breaks it at {self.breaks_at:.6g}"


def find_edge(
    method: str,
    error_at: Callable[[float], float],
    start: float,
    stop: float,
    bound: float,
    *,
    logarithmic: bool = False,
    samples: int = 49,
    tolerance: float = 1e-3,
) -> Edge:
    """Sweep `error_at(knob)` from `start` to `stop` (either way round) and bisect the first step from holding to broken.

    logarithmic  steps and bisection in the knob's logarithm; both ends must then be above 0
    tolerance    of the edge, as a share of the knob (logarithmic) or of the whole range
    A break narrower than one step of the sweep can be missed: `samples` says how wide that is.
    Raises SettingError for a range that is empty or cannot be logarithmic."""
    if (
        samples < 2
        or start == stop
        or not (math.isfinite(start) and math.isfinite(stop))
        or (logarithmic and min(start, stop) <= 0.0)
    ):
        raise SettingError(
            f"a sweep of {method} from {start} to {stop} in {samples} steps is empty; it needs two different ends"
            + (" above 0" if logarithmic else "")
        )
    space = np.geomspace if logarithmic else np.linspace
    knobs = [float(k) for k in space(start, stop, samples)]
    errors = [_error(error_at, k) for k in knobs]
    broken = [not e <= bound for e in errors]
    if not any(broken):
        return Edge(method, start, stop, bound, stop, None, tuple(knobs), tuple(errors))
    first = broken.index(True)
    if first == 0:
        return Edge(method, start, stop, bound, None, start, tuple(knobs), tuple(errors))
    good, bad = knobs[first - 1], knobs[first]
    while abs(bad - good) > tolerance * (max(good, bad) if logarithmic else abs(stop - start)):
        middle = math.sqrt(good * bad) if logarithmic else 0.5 * (good + bad)
        if middle in (good, bad):
            break
        good, bad = (middle, bad) if _error(error_at, middle) <= bound else (good, middle)
    return Edge(method, start, stop, bound, good, bad, tuple(knobs), tuple(errors))


def _error(error_at: Callable[[float], float], knob: float) -> float:
    try:
        return float(error_at(knob))
    except RangecheckError:
        return math.inf
