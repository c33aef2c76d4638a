"""Speed against accuracy: every method at every setting, timed in turns, its error taken against the truth.

Methods are timed interleaved, one run of each per round and every other round backwards, so that a machine that slows down or a
neighbour that wakes up touches all alike. Warm-up runs come first and are not counted; without any, the first round's results are judged.
The garbage collector waits. The median over the rounds is the time, the quartiles say how far to trust it.
"""

from __future__ import annotations

import gc
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rangecheck.errors import SettingError


@dataclass(frozen=True)
class Candidate:
    """A method at one setting: `run()` does the whole work and returns its result."""

    method: str
    setting: str
    run: Callable[[], Any]


@dataclass(frozen=True)
class Timed:
    """What a run returns that was timed where it was done, in another process: its result, None and nan seconds where that crashed."""

    result: Any
    seconds: float


@dataclass(frozen=True)
class Measurement:
    """`error` in the study's own measure (nan: it gave no answer); seconds for the whole work: median and quartiles over `rounds`."""

    method: str
    setting: str
    error: float
    seconds: float
    quartiles: tuple[float, float]
    rounds: int


def measure(
    candidates: Sequence[Candidate],
    error_of: Callable[[Any], float],
    *,
    rounds: int = 9,
    warmups: int = 1,
    clock: Callable[[], float] = time.perf_counter,
) -> list[Measurement]:
    """Time every candidate in turns and take the error of its result, in the order given.

    warmups  runs before the clock starts; 0 where whoever calls has warmed up on something smaller
    Raises SettingError without candidates, with rounds < 1 or warmups < 0, or when two share method and setting."""
    names = [(c.method, c.setting) for c in candidates]
    if not names or rounds < 1 or warmups < 0:
        raise SettingError(
            f"{len(names)} candidates, {rounds} rounds, {warmups} warm-ups; the first two must be at least 1, the last at least 0"
        )
    if len(set(names)) < len(names):
        raise SettingError(f"two candidates are called {next(n for n in names if names.count(n) > 1)}; name each setting once")
    errors = [math.nan] * len(candidates)
    for index, candidate in enumerate(candidates if warmups else []):
        for _ in range(warmups):
            result = candidate.run()
        if isinstance(result, Timed):
            result = result.result
        errors[index] = float(error_of(result))
        del result
    seconds: list[list[float]] = [[] for _ in candidates]
    collecting = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        for turn in range(rounds):
            order = range(len(candidates)) if turn % 2 == 0 else reversed(range(len(candidates)))
            for index in order:
                start = clock()
                result = candidates[index].run()
                seconds[index].append(clock() - start)
                if isinstance(result, Timed):
                    result, seconds[index][-1] = result.result, result.seconds
                if turn == 0 and not warmups:
                    errors[index] = float(error_of(result))
                del result
    finally:
        if collecting:
            gc.enable()
    return [
        Measurement(c.method, c.setting, error, _median(times), _quartiles(times), rounds)
        for c, error, times in zip(candidates, errors, seconds)
    ]


def _median(times: list[float]) -> float:
    """nan where one run gave no time: what crashed once is not to be compared."""
    return math.nan if any(map(math.isnan, times)) else statistics.median(times)


def _quartiles(times: list[float]) -> tuple[float, float]:
    if len(times) < 2 or any(map(math.isnan, times)):
        return times[0], times[0]
    low, _, high = statistics.quantiles(times, n=4, method="inclusive")
    return low, high


def pareto_front(measurements: Sequence[Measurement]) -> list[Measurement]:
    """Those that no other beats in both time and error, fastest first. What gave no answer is never on it."""
    front: list[Measurement] = []
    for m in sorted(measurements, key=lambda m: (m.seconds, m.error)):
        if not math.isnan(m.error) and (not front or m.error < front[-1].error):
            front.append(m)
    return front
