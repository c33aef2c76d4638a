"""What a picture costs: beside the bare casting of its rays, beside an outside renderer (Mitsuba 3), and with its number of pixels.

Errors are root mean squares over the pixels that see the object, relative to their mean radiance, each renderer's against its own
converged picture. That picture is taken in two independent halves: the mean of the product of the two differences holds the error of
the picture that is judged and nothing of the noise of the halves, so that they need not be endless: halves that are off by three times
the goal leave, over sixty thousand pixels, less than 3 % of doubt about an error.

`DRJIT_LIBLLVM_PATH` says where Mitsuba finds LLVM; without it its scalar variant, half as fast, takes part.
"""

from __future__ import annotations

import resource
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from multiprocessing import get_context
from typing import Any

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.errors import DependencyMissing
from rangecheck.optics import PinholeCamera
from rangecheck.reflectance import GREY_UM, Material, load_material
from rangecheck.scene import Scene, constant, gradient
from rangecheck.studies.scenes import LAMPS, bust_relief, view
from rangecheck.study import Line, LineChart, Part, study_of_parts
from rangecheck.surface import Surface
from rangecheck.transport import DIRECT, Settings, Tracer, render_to
from rangecheck.transport.benchmark import cast_ratio
from rangecheck.transport.outside import OutsideRenderer, outside_variants

PLASTER = Material("plaster", K_lm=0.9, wavelengths_um=GREY_UM)
#: the rough limit without a spike, which is what Mitsuba's rough conductor is
ROUGH_STEEL = Material("rough steel", K_s=0.6, sigma_um=2.0, correlation_um=20.0, bounded=False, wavelengths_um=GREY_UM)
#: the lobe and one interreflection
ONE_MORE = Settings(centre=True, shadow_rays=0, diffuse=False, depth=2, backdrop=False)
#: the error that both renderers are timed to
GOAL = 0.01
#: samples a pixel up to which the outside renderer is followed; beyond, its error falls as fast as it did before, and at least as
#: independent samples let it fall
_MOST_OUTSIDE = 256
#: degrees that the race's pictures span, which the bust fills; points of its scan, whose faces are then about as large as pixels
_FIELD_DEG, _POINTS = 22.0, (320, 384)
#: samples in one call of the outside renderer; more need gigabytes
_AT_ONCE = 64
#: samples a pixel of each half of a converged picture
_HALF = 64


def _bust(quick: bool) -> Surface:
    return bust_relief(100, 120) if quick else bust_relief(480, 576)


def _race_bust(quick: bool) -> Surface:
    return bust_relief(60, 72) if quick else bust_relief(*_POINTS)


def _ratios(quick: bool) -> Part:
    """A frame's time over that of casting its very rays."""
    surface = _bust(quick)
    rows: list[dict[str, Any]] = []
    camera, pose = view(64 if quick else 720)
    plaster = Tracer(Scene(surface, (PLASTER,), sources=LAMPS, smooth=True))
    steel = Tracer(
        Scene(surface, (load_material("steel").at(GREY_UM),), sources=LAMPS[:1], surroundings=gradient(0.05, 0.5), smooth=True)
    )
    satin = Tracer(replace(steel.scene, materials=(load_material("steel_satin").at(GREY_UM),)))
    cases = (
        ("plaster, light straight from two sources", plaster, DIRECT),
        ("plaster, soft shadows, 2 samples a pixel", plaster, replace(DIRECT, centre=False, each=2, shadow_rays=1)),
        ("polished steel, lobe and one interreflection", steel, ONE_MORE),
        ("satin steel, lobe and one interreflection", satin, ONE_MORE),
    )
    for name, tracer, settings in cases:
        found = cast_ratio(tracer, camera, pose, settings, repeats=3 if quick else 15)
        rows.append({"picture": name, "frame_s": found.frame_s, "cast_s": found.cast_s, "rays": found.rays, "ratio": found.ratio})
    said = [
        f"{row['picture']}: {1e3 * row['frame_s']:.0f} ms, {row['ratio']:.2f} times the bare cast of its {row['rays']:,} rays"
        for row in rows
    ]
    return Part((), said, {"cast_ratios": rows})


@dataclass(frozen=True)
class Racer:
    """picture(effort, seed) (h, w); `efforts` of growing quality; `halves` are its converged picture, twice; extends: whether more
    samples than were tried may be reckoned with."""

    name: str
    picture: Callable[[float, int], FloatArray]
    efforts: Sequence[float]
    halves: tuple[FloatArray, FloatArray]
    ready_s: float
    unit: str
    extends: bool = False


def crossed(picture: FloatArray, halves: tuple[FloatArray, FloatArray], where: BoolArray) -> float:
    """Root mean square error over `where`, relative to the mean there, free of the noise of the two halves."""
    first, second = (picture[where].astype(np.float64) - half[where] for half in halves)
    mean = float(halves[0][where].mean(dtype=np.float64) + halves[1][where].mean(dtype=np.float64)) / 2
    return float(np.sqrt(max(float((first * second).mean()), 0.0))) / mean


@dataclass(frozen=True)
class Reached:
    """effort that meets the goal, how many times as long as the run that is timed, and the efforts tried on the way (rows)."""

    effort: float
    more: float
    rows: list[dict[str, Any]]


def run_to(racer: Racer, where: BoolArray, goal: float) -> Reached:
    """Tries efforts up to the first below the goal; the effort that meets it lies between the last two, on a straight line in logarithms.
    Where none does, a racer that extends is reckoned on by the slope of its last two, at least the inverse square root; else NaN."""
    rows: list[dict[str, Any]] = []
    for effort in racer.efforts:
        begin = time.perf_counter()
        picture = racer.picture(effort, 1000)
        error = crossed(picture, racer.halves, where)
        rows.append({"renderer": racer.name, "effort": effort, "error": error, "seconds": time.perf_counter() - begin})
        if error <= goal:
            break
    if len(rows) == 1:
        return Reached(rows[0]["effort"], 1.0, rows)
    (e0, x0), (e1, x1) = ((row["error"], row["effort"]) for row in rows[-2:])
    if e1 > goal:
        slope = max(0.5, float(np.log(e0 / e1) / np.log(x1 / x0)))
        return Reached(x1, (e1 / goal) ** (1 / slope) if racer.extends else float("nan"), rows)
    share = np.log(goal / e0) / np.log(e1 / e0)
    return Reached(float(x0 * (x1 / x0) ** share), 1.0, rows)


def _outside_racers(scene: Scene, size: int, depth: int, half: int, variants: Sequence[tuple[str, str]]) -> list[Racer]:
    camera, pose = view(size, _FIELD_DEG)
    racers: list[Racer] = []
    reference: tuple[FloatArray, FloatArray] | None = None
    # the evenest sampler comes last: it makes the converged picture of all, which are the same
    for variant, sampler in reversed(variants):
        begin = time.perf_counter()
        outside = OutsideRenderer(scene, camera, pose, depth=depth, variant=variant, sampler=sampler)
        outside.render(4, seed=1)
        ready = time.perf_counter() - begin

        def picture(effort: float, seed: int, outside: OutsideRenderer = outside) -> FloatArray:
            return _in_calls(outside, round(effort), seed)

        if reference is None:
            reference = (picture(half, 50_000), picture(half, 60_000))
        most = _MOST_OUTSIDE if not racers else _AT_ONCE
        efforts = [float(n) for n in (4, 16, 64, 256) if n <= most]
        racers.append(Racer(f"mitsuba {variant} {sampler}", picture, efforts, reference, ready, "samples a pixel", True))
    return racers


def _in_calls(outside: OutsideRenderer, samples: int, seed: int) -> FloatArray:
    """(h, w) mean of calls of at most `_AT_ONCE` samples."""
    total, left = np.zeros(1), samples
    for number in count():
        if left <= 0:
            return np.asarray(total / samples)
        now = min(left, _AT_ONCE)
        total = total + now * outside.render(now, seed=seed + number)[..., 0]
        left -= now
    raise AssertionError


def _our_racers(scene: Scene, size: int, settings: Settings, half: int) -> tuple[list[Racer], BoolArray]:
    """The same number of samples everywhere, and samples where they are needed; and which pixels see the object."""
    camera, pose = view(size, _FIELD_DEG)
    begin = time.perf_counter()
    tracer = Tracer(scene)
    tracer.render(camera, pose, settings)
    ready = time.perf_counter() - begin
    films = [tracer.render(camera, pose, replace(settings, each=half), seed=seed) for seed in (91, 92)]

    def evenly(samples: float, seed: int) -> FloatArray:
        return tracer.render(camera, pose, replace(settings, each=round(samples)), seed=seed).radiance[..., 0]

    def where_needed(error: float, seed: int) -> FloatArray:
        return render_to(tracer, camera, pose, settings, error, seed=seed).radiance[..., 0]

    reference = (films[0].radiance[..., 0], films[1].radiance[..., 0])
    where = (films[0].coverage > 0) & (films[1].coverage > 0)
    even = Racer("rangecheck, evenly", evenly, (4, 16, 64, 128, 256), reference, ready, "samples a pixel")
    # of the whole frame's mean, which the dark around the object lowers
    aims = (0.08, 0.04, 0.02, 0.014, 0.01, 0.007, 0.005)
    needed = Racer("rangecheck, where needed", where_needed, aims, reference, ready, "error aimed at")
    return [even, needed], where


def _race(name: str, scene: Scene, settings: Settings, wanted: float, quick: bool) -> Part:
    """Seconds to an error of one percent, in one run, in turns."""
    short = name.split(",")[0]
    size, half, goal = (32, 32, 0.1) if quick else (512, _HALF, GOAL)
    ours, where = _our_racers(scene, size, settings, half)
    variants = [("scalar_rgb", "independent")] if quick else outside_variants()
    racers = [*ours, *_outside_racers(scene, size, settings.depth, half, variants)]
    reached = [run_to(racer, where, goal) for racer in racers]
    table = [row for found in reached for row in found.rows]
    runs: list[list[float]] = [[] for _ in racers]
    for repeat in range(1 if quick else 3):
        for index, racer in enumerate(racers):
            if np.isfinite(reached[index].more):
                begin = time.perf_counter()
                racer.picture(reached[index].effort, repeat)
                runs[index].append(time.perf_counter() - begin)
    seconds = [found.more * statistics.median(t) if t else float("nan") for t, found in zip(runs, reached)]
    said = [
        f"{name}, {size}x{size}: {racer.name} reaches {100 * goal:g} % in {t:.3g} s at {found.effort * found.more:.4g} {racer.unit}"
        f"{f' (timed at {found.effort:g})' if found.more > 1 else ''}; "
        f"made ready, first picture included, in {racer.ready_s:.2g} s"
        if np.isfinite(t)
        else f"{name}, {size}x{size}: {racer.name} does not reach {100 * goal:g} % by {racer.efforts[-1]:g} {racer.unit}"
        for racer, t, found in zip(racers, seconds, reached)
    ]
    best = [
        min((t for t in times if np.isfinite(t)), default=float("nan")) for times in (seconds[: len(ours)], seconds[len(ours) :])
    ]
    said.append(f"{name}: Mitsuba's best setting takes {best[1] / best[0]:.1f} times as long as our best; {wanted:g} was wanted")
    lines = [
        Line(racer.name, [r["seconds"] for r in found.rows], [r["error"] for r in found.rows], marked=True)
        for racer, found in zip(racers, reached)
    ]
    chart = LineChart(
        f"race-{short}", f"{name}: time against error", "seconds", "error over the object", lines, log="xy", level=goal
    )
    return Part((chart,), said, {f"race_{short}": table})


def _plaster(quick: bool) -> Part:
    scene = Scene(_race_bust(quick), (PLASTER,), sources=LAMPS)
    settings = Settings(shadow_rays=1, spike=False, lobe=False, diffuse=False, depth=1)
    return _race("plaster, two spherical sources", scene, settings, 10, quick)


def _steel(quick: bool) -> Part:
    scene = Scene(_race_bust(quick), (ROUGH_STEEL,), sources=LAMPS, surroundings=constant(0.3))
    return _race(
        "steel, one interreflection", scene, Settings(shadow_rays=1, spike=False, diffuse=False, depth=2, backdrop=True), 5, quick
    )


def _scaling(quick: bool) -> Part:
    """Seconds and peak memory of pictures of growing size, each in a process of its own."""
    sizes = (32, 64) if quick else (256, 512, 1024, 2048)
    rows: list[dict[str, Any]] = []
    for name in ("plaster", "steel"):
        for size in sizes:
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                rows.append({"material": name, "size": size, **pool.submit(_one_size, name, size, quick).result()})
    lines = [
        Line(
            name,
            [r["size"] ** 2 for r in rows if r["material"] == name],
            [r["seconds"] for r in rows if r["material"] == name],
            marked=True,
        )
        for name in ("plaster", "steel")
    ]
    said = []
    for line in lines:
        exponent = float(np.polyfit(np.log(line.x), np.log(line.y), 1)[0])
        most = max(row["peak_gb"] for row in rows if row["material"] == line.label)
        said.append(
            f"{line.label}: time grows with the {exponent:.2f}th power of pixels from {sizes[0]}^2 to {sizes[-1]}^2, "
            f"{1e9 * line.y[-1] / line.x[-1]:.0f} ns a pixel at the largest; peak memory {most:.2f} GB"
        )
    chart = LineChart("scaling", "Time against pixels", "pixels", "seconds", lines, log="xy")
    return Part((chart,), said, {"scaling": rows})


def _one_size(name: str, size: int, quick: bool) -> dict[str, float]:
    """In a process of its own: median seconds of a picture, peak memory in GB (10^9 bytes), and that before the picture."""
    scene = (
        Scene(_bust(quick), (PLASTER,), sources=LAMPS, smooth=True)
        if name == "plaster"
        else Scene(_bust(quick), (load_material("steel"),), sources=LAMPS[:1], surroundings=gradient(0.05, 0.5), smooth=True)
    )
    settings = DIRECT if name == "plaster" else ONE_MORE
    tracer = Tracer(scene)
    camera, pose = view(size)
    tracer.render(PinholeCamera.from_field_of_view(64, 64, 26.0), pose, settings)
    before = _peak_gb()
    times = []
    for _ in range(3 if size > 1024 else 7):
        begin = time.perf_counter()
        tracer.render(camera, pose, settings)
        times.append(time.perf_counter() - begin)
    return {"seconds": statistics.median(times), "peak_gb": _peak_gb(), "before_gb": before}


def _peak_gb() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1.0 if sys.platform == "darwin" else 1024.0) / 1e9


def _guarded(part: Callable[[bool], Part], quick: bool) -> Part:
    """The part, or why it cannot be made here."""
    try:
        return part(quick)
    except DependencyMissing as missing:
        return Part((), [str(missing)], {})


_PARTS: dict[str, Callable[[bool], Part]] = {
    "cast": _ratios, "plaster": partial(_guarded, _plaster), "steel": partial(_guarded, _steel), "scaling": _scaling,
}  # fmt: skip
PARTS = tuple(_PARTS)
study = study_of_parts("renderers", "What a picture costs: beside casting, beside Mitsuba, and by its size", _PARTS)
