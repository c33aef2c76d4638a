"""What a picture costs beside the bare casting of its rays, and how long a picture of a given error takes, beside an outside renderer.

Times are wall-clock seconds of interleaved repeats in one run, medians; the first run of each, which compiles, is not counted.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.kernels import in_chunks
from rangecheck.optics import Camera, PinholeCamera
from rangecheck.transport.outside import OutsideRenderer
from rangecheck.transport.plan import make_plan, render
from rangecheck.transport.settings import DIRECT, Settings
from rangecheck.transport.tracer import Tracer


@dataclass(frozen=True)
class CastRatio:
    """frame_s, cast_s: medians of the picture and of casting its rays alone; rays: how many; ratio of the two."""

    frame_s: float
    cast_s: float
    rays: int
    ratio: float


class _Recorder:
    """A caster that remembers every query it answers."""

    def __init__(self, caster: Any) -> None:
        self._caster = caster
        self.queries: list[tuple[str, tuple[Any, ...], bool]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._caster, name)

    def closest_local(self, *arrays: Any, coherent: bool = False) -> None:
        self.queries.append(("closest_local", tuple(array.copy() for array in arrays), coherent))
        self._caster.closest_local(*arrays, coherent=coherent)

    def occluded_local(self, *arrays: Any, coherent: bool = False) -> None:
        self.queries.append(("occluded_local", tuple(array.copy() for array in arrays), coherent))
        self._caster.occluded_local(*arrays, coherent=coherent)


def cast_ratio(
    tracer: Tracer, camera: Camera, world_from_camera: FloatArray, settings: Settings = DIRECT, *, repeats: int = 9
) -> CastRatio:
    """The time of a picture over that of casting its very rays, primary, shadow and scattered, with the same engine and threads."""
    from copy import copy

    spied = copy(tracer)
    recorder = _Recorder(tracer.caster)
    spied.caster = recorder  # type: ignore[assignment]
    spied.render(camera, world_from_camera, settings)
    queries = recorder.queries
    reaches = [query[1][2].copy() for query in queries]

    def cast() -> None:
        def one(start: int, stop: int) -> None:
            name, arrays, coherent = queries[start]
            getattr(tracer.caster, name)(*arrays, coherent=coherent)

        in_chunks(one, len(queries), 1)

    def frame() -> None:
        tracer.render(camera, world_from_camera, settings)

    frame_s: list[float] = []
    cast_s: list[float] = []
    for repeat in range(repeats + 1):
        # first hits overwrite the reach that they were given
        for (_, arrays, _), reach in zip(queries, reaches):
            arrays[2][:] = reach
        for action, times in ((frame, frame_s), (cast, cast_s)):
            begin = time.perf_counter()
            action()
            if repeat:
                times.append(time.perf_counter() - begin)
    whole, bare = statistics.median(frame_s), statistics.median(cast_s)
    return CastRatio(whole, bare, sum(len(reach) for reach in reaches), whole / bare)


@dataclass(frozen=True)
class TimedError:
    """One setting of one renderer: seconds, and the root mean square error over the object relative to its mean radiance there."""

    renderer: str
    setting: str
    seconds: float
    error: float


def error_over(picture: FloatArray, reference: FloatArray, where: BoolArray) -> float:
    """Root mean square of the difference over the pixels `where` (h, w), relative to the reference's mean there."""
    gap = picture[where].astype(np.float64) - reference[where]
    return float(np.sqrt((gap**2).mean()) / reference[where].mean())


def time_to_error(points: Sequence[TimedError], renderer: str, error: float) -> float:
    """Seconds in which `renderer` reaches `error`: between the measured points on a straight line in logarithms; beyond the last
    point, by the inverse square root that independent samples obey; NaN before the first."""
    mine = sorted((point for point in points if point.renderer == renderer), key=lambda p: p.seconds)
    if not mine:
        return float("nan")
    best: list[TimedError] = []
    for point in mine:
        if not best or point.error < best[-1].error:
            best.append(point)
    if best[-1].error > error:
        return best[-1].seconds * (best[-1].error / error) ** 2
    if best[0].error <= error:
        return best[0].seconds
    logs = np.log([[p.error, p.seconds] for p in best])
    return float(np.exp(np.interp(np.log(error), logs[::-1, 0], logs[::-1, 1])))


def against_outside(
    tracer: Tracer,
    camera: PinholeCamera,
    world_from_camera: FloatArray,
    *,
    depth: int,
    tolerances: Sequence[float] = (0.08, 0.04, 0.02, 0.01),
    samples: Sequence[int] = (4, 16, 64, 256),
    reference_samples: int = 4096,
    repeats: int = 3,
    variant: str = "scalar_rgb",
) -> list[TimedError]:
    """Time and error of our plan at several tolerances and of Mitsuba at several sample counts, each against its own converged
    picture, interleaved in one run. Tolerances are of the whole frame's mean radiance, errors of the object's. Planning counts."""
    outside = OutsideRenderer(tracer.scene, camera, world_from_camera, depth=depth, variant=variant)

    def ours(tolerance: float, seed: int) -> FloatArray:
        plan = make_plan(tracer, camera, world_from_camera, tolerance=tolerance, seed=seed)
        return render(tracer, camera, world_from_camera, plan=plan, seed=seed).radiance

    each = 4
    full = Settings(passes=max(2, reference_samples // each), each=each, depth=depth)
    our_reference = tracer.render(camera, world_from_camera, full, seed=1)
    their_reference = outside.render(reference_samples, seed=1)
    where = our_reference.coverage > 0
    makers: list[tuple[str, str, Callable[[int], FloatArray], FloatArray]] = []
    for tolerance in tolerances:
        makers.append(("rangecheck", f"tolerance {tolerance:g}", partial(ours, tolerance), our_reference.radiance))
    for count in samples:
        makers.append(("mitsuba", f"{count} samples", partial(outside.render, count), their_reference))
    makers[0][2](2)
    times: dict[str, list[float]] = {}
    errors: dict[str, list[float]] = {}
    for repeat in range(repeats):
        for _, setting, make, reference in makers:
            begin = time.perf_counter()
            picture = make(10 + repeat)
            times.setdefault(setting, []).append(time.perf_counter() - begin)
            channels = min(picture.shape[2], reference.shape[2])
            errors.setdefault(setting, []).append(error_over(picture[..., :channels], reference[..., :channels], where))
    return [
        TimedError(renderer, setting, statistics.median(times[setting]), statistics.median(errors[setting]))
        for renderer, setting, _, _ in makers
    ]
