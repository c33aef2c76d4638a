"""Following light: gathering over the lobe, interreflection depth, mirrored sources, the plan against everything, the light budget.

Errors of pictures are root mean squares over the frame, relative to the frame's mean radiance, as the plan's tolerance is.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from rangecheck.reflectance import GREY_UM, Material
from rangecheck.scene import Scene, Source
from rangecheck.studies.edges import highlights_part, leaks_part
from rangecheck.studies.scenes import RADIUS_MM, ball, scene_named, view
from rangecheck.study import Line, LineChart, Part, study_of_parts
from rangecheck.transport import Film, Settings, Tracer, make_plan, render
from rangecheck.transport.even import render_evenly
from rangecheck.transport.settings import FULL

#: scenes that the plan is tried on, and the pixels along a side of their pictures: where light is reflected many times, path tracing to
#: half a percent takes so long that the pictures are small
SCENES = {
    "ball plaster dark": 96, "ball plaster sky": 128, "table plaster dark": 20, "table plaster even": 48, "bowl plaster dark": 16,
    "bowl plaster sky": 32, "ball steel sky": 96, "ball satin sky": 32, "table steel stripes": 32, "table satin even": 16,
    "bowl steel sky": 20, "bowl satin stripes": 20, "table plaster+steel sky": 16, "bust plaster sky": 128, "bust steel stripes": 96,
}  # fmt: skip


def _relative(film: Film, reference: Film) -> float:
    gap = film.radiance.astype(np.float64) - reference.radiance
    return math.sqrt(float((gap**2).mean())) / reference.mean_radiance


def _gathering(quick: bool) -> Part:
    """Rays against error, at the surface seen, light from surroundings and floor alone; truth is the same gathering converged."""
    size, most, converged = (16, 16, 256) if quick else (48, 256, 16384)
    charts, rows, said = [], [], []
    for name in ("table satin stripes", "table ground stripes"):
        tracer = Tracer(scene_named(name))
        camera, pose = view(size)
        base = Settings(centre=True, depth=1, spike=False, diffuse=False, backdrop=False)
        passes = converged // 64
        truth = tracer.render(camera, pose, replace(base, passes=passes, lobe_rays=64, gather="order"), seed=91)
        lines = []
        methods: list[tuple[str, dict[str, Any], Sequence[int]]] = [
            (f"rings {step:g}° apart", {"gather": "fan", "fan_step_deg": step}, range(1, 17)) for step in (5.0, 2.0, 1.0)
        ]
        methods.append(("drawn by scattering order", {"gather": "order"}, [4**k for k in range(6)]))
        for method, settings, counts in methods:
            xs, ys = [], []
            for count in counts:
                rays = 1 + 3 * count * (count + 1) if "fan_step_deg" in settings else count
                reach = count * float(settings.get("fan_step_deg", 0.0))
                if rays > most or reach > 45.0 or count not in (1, 2, 3, 4, 6, 8, 12, 16, 64, 256):
                    continue
                begin = time.perf_counter()
                film = tracer.render(camera, pose, replace(base, lobe_rays=count, **settings), seed=5)
                seconds = time.perf_counter() - begin
                xs.append(float(rays))
                ys.append(_relative(film, truth))
                rows.append({"scene": name, "method": method, "rays": rays, "error": ys[-1], "seconds": seconds})
            lines.append(Line(method, xs, ys, marked=True))
            best = int(np.argmin(ys))
            said.append(
                f"{name}, {method}: least error {100 * ys[best]:.3g} % with {xs[best]:.0f} rays a pixel, 1 ray {100 * ys[0]:.3g} %"
            )
        noise = truth.standard_error() / truth.mean_radiance
        said.append(f"{name}: the reference, {converged} drawn rays a pixel, is known to {100 * noise:.2g} %")
        charts.append(
            LineChart(
                f"gathering-{name.split()[1]}",
                f"Gathering over the lobe: {name}",
                "rays per surface point",
                "error relative to the mean radiance",
                [*lines, Line("noise of the reference", [1.0, float(most)], [noise, noise])],
                log="xy",
            )
        )
    return Part(charts, said, {"gathering": rows})


_DEPTHS = (1, 2, 3, 4, 6, 10, 16)


def _depth(quick: bool) -> Part:
    """What reflections beyond a number carry: the same chance at every depth, so that the difference is theirs alone."""
    size, passes = (16, 8) if quick else (48, 64)
    lines, rows, said = [], [], []
    for name in (
        "bowl plaster dark",
        "bowl plaster sky",
        "table plaster even",
        "bowl steel sky",
        "bowl satin stripes",
        "bust plaster sky",
    ):
        tracer = Tracer(scene_named(name))
        camera, pose = view(size)
        base = Settings(passes=passes, each=4, depth=32, roulette_from=0)
        truth = tracer.render(camera, pose, base, seed=3)
        errors = []
        for depth in _DEPTHS:
            begin = time.perf_counter()
            film = tracer.render(camera, pose, replace(base, depth=depth), seed=3)
            errors.append(_relative(film, truth))
            rows.append({"scene": name, "depth": depth, "error": errors[-1], "seconds": time.perf_counter() - begin})
        lines.append(Line(name, [float(d) for d in _DEPTHS], [max(e, 1e-7) for e in errors], marked=True))
        enough = next((d for d, e in zip(_DEPTHS, errors) if e <= 0.005), None)
        said.append(
            f"{name}: half a percent needs {enough or f'more than {_DEPTHS[-1]}'} reflections; one leaves {100 * errors[0]:.3g} %"
        )
    chart = LineChart(
        "depth",
        "Interreflection: what is left out beyond a number of reflections (32 followed)",
        "reflections followed",
        "error relative to the mean radiance",
        lines,
        log="xy",
        level=0.005,
    )
    return Part([chart], said, {"depth": rows})


def _spikes(quick: bool) -> Part:
    """Image-integrated light of a small source mirrored by a ball, from coarse to fine pixels; truth: rays spread over the
    highlight alone."""
    sizes = (64, 128) if quick else (64, 128, 256, 512, 1024)
    surface = ball(5)
    mirror = Material("mirror", K_ss=0.8, wavelengths_um=GREY_UM)
    lamp = Source(np.array([180.0, 160.0, 260.0]), 2.0, np.array([1e4]))
    tracer = Tracer(Scene(surface, (mirror,), sources=(lamp,), smooth=True, vertex_normals=surface.vertices / RADIUS_MM))
    base = Settings(centre=True, depth=1, lobe=False, diffuse=False, backdrop=False)

    def energy(size: int, settings: Settings) -> float:
        camera, pose = view(size, 22.0)
        return float(tracer.render(camera, pose, settings).radiance.mean(dtype=np.float64))

    truth = _highlight_light(tracer, base, passes=4 if quick else 16)
    lines, rows, said = [], [], []
    for method in ("ray", "corners", "fraction"):
        shares = [energy(size, replace(base, glints=method)) / truth for size in sizes]
        rows += [{"method": method, "size": size, "energy": share} for size, share in zip(sizes, shares)]
        lines.append(Line(method, [float(s) for s in sizes], [max(abs(share - 1.0), 1e-5) for share in shares], marked=True))
        spread = (max(shares) - min(shares)) / shares[-1] if shares[-1] > 0 else math.inf
        said.append(
            f"mirrored source by {method}: {shares[0]:.4g} of its light at {sizes[0]}x{sizes[0]}, {shares[-1]:.4g} at {sizes[-1]}x{sizes[-1]}; "
            f"varies by {100 * spread:.3g} %"
        )
    chart = LineChart(
        "spikes",
        "A small source in a mirror: error of the highlight's light",
        "pixels along a side of the picture",
        "error of the light, share of the truth",
        lines,
        log="xy",
        level=0.01,
    )
    return Part([chart], said, {"spikes": rows})


def _highlight_light(tracer: Tracer, base: Settings, passes: int) -> float:
    """Mean radiance of the whole picture if it held the highlight alone: a window around it, 32 times finer than 1024 pixels a side."""
    side, finer, window = 1024, 32, 192
    camera, pose = view(side, 22.0)
    found = tracer.render(camera, pose, base).radiance[..., 0]
    rows, columns = np.nonzero(found > 0.01 * found.max())
    near = replace(
        camera, width=window, height=window, fx=camera.fx * finer, fy=camera.fy * finer,
        cx=(camera.cx - columns.mean()) * finer + (window - 1) / 2, cy=(camera.cy - rows.mean()) * finer + (window - 1) / 2,
    )  # fmt: skip
    film = tracer.render(near, pose, replace(base, centre=False, passes=passes, each=16, glints="ray"))
    return float(film.radiance.sum(dtype=np.float64)) / (side * finer) ** 2


def crossed_error(film: Film, one: Film, other: Film) -> tuple[float, float]:
    """(error, two standard errors above it) of `film` against two independent references, whose noise drops out of the mean product of the
    two differences; relative to the references' mean radiance."""
    product = (film.radiance.astype(np.float64) - one.radiance) * (film.radiance.astype(np.float64) - other.radiance)
    mean = 0.5 * (one.mean_radiance + other.mean_radiance)
    squared = float(product.mean())
    sure = float(product.std()) / math.sqrt(product.shape[0] * product.shape[1])
    return math.sqrt(max(squared, 0.0)) / mean, math.sqrt(max(squared + 2.0 * sure, 0.0)) / mean


def _planner(quick: bool) -> Part:
    """The plan against everything: `--model full` as it is shipped, whose noise is a third of the tolerance, and everything to the very
    tolerance. The plan's own time counts, as it would for a single picture. Both full pictures are path traced evenly; against the two of
    them the plan's true error is taken with their noise dropping out."""
    tolerance, scenes = (0.04, ("ball plaster dark", "ball satin sky")) if quick else (0.005, tuple(SCENES))
    rows: list[dict[str, Any]] = []
    for name, least in (("table satin sky", 0.2), ("bowl plaster sky", 0.02)):
        render(Tracer(scene_named(name)), *view(16), tolerance=least)
    for name in scenes:
        tracer = Tracer(scene_named(name))
        camera, pose = view(12 if quick else SCENES[name])
        full = make_plan(tracer, camera, pose, tolerance=tolerance, model="full")
        full_s, one = _timed(partial(render, tracer, camera, pose, plan=full, seed=101))
        equal_s, other = _timed(partial(render_evenly, tracer, camera, pose, FULL, tolerance, seed=202))
        plan_s, plan = _timed(partial(make_plan, tracer, camera, pose, tolerance=tolerance, seed=7))
        render_s, film = _timed(partial(render, tracer, camera, pose, plan=plan, seed=7))
        error, at_most = crossed_error(film, one, other)
        rows.append(
            {
                "scene": name, "size": camera.width, "error": error, "error_at_most": at_most, "kept": error <= tolerance,
                "speedup": full_s / (plan_s + render_s), "speedup_at_equal_error": equal_s / (plan_s + render_s), "full_s": full_s,
                "equal_s": equal_s, "plan_s": plan_s, "render_s": render_s, "full_samples": float(one.samples.mean()),
                "plan_samples": float(film.samples.mean()), "depth": plan.settings.depth, "forms": " ".join(plan.forms),
                "reasons": plan.explain(),
            }
        )  # fmt: skip
    said = [
        f"{row['scene']}, {row['size']}x{row['size']}: error {100 * row['error']:.3g} % (at most {100 * row['error_at_most']:.3g} %), "
        f"{row['plan_s']:.2g} + {row['render_s']:.2g} s against {row['full_s']:.3g} s of full ({row['speedup']:.3g} times) and "
        f"{row['equal_s']:.3g} s of everything at the same error ({row['speedup_at_equal_error']:.3g} times)"
        for row in rows
    ]
    speedups, equal = ([row[key] for row in rows] for key in ("speedup", "speedup_at_equal_error"))
    said.append(
        f"tolerance {100 * tolerance:g} %: the promise is kept on {sum(r['kept'] for r in rows)} of {len(rows)} scenes; "
        f"median speedup over `--model full` {np.median(speedups):.3g}, least {min(speedups):.3g}; at equal error {np.median(equal):.3g}, "
        f"least {min(equal):.3g}"
    )
    order = [float(k + 1) for k in range(len(rows))]
    charts = [
        LineChart(
            "planner-error", f"The plan's true error, scene by scene; tolerance {100 * tolerance:g} %", "scene", "error relative to the mean radiance",
            [Line("error", order, [row["error"] for row in rows], marked=True), Line("two standard errors above", order, [row["error_at_most"] for row in rows])],
            level=tolerance,
        ),
        LineChart(
            "planner-speed", "How much faster than everything", "scene", "time of full over time of plan and picture",
            [Line("--model full", order, speedups, marked=True), Line("at equal error", order, equal, marked=True)], log="y", level=3.0,
        ),
    ]  # fmt: skip
    return Part(charts, said, {"planner": rows})


def _timed(action: Any) -> tuple[float, Any]:
    begin = time.perf_counter()
    made = action()
    return time.perf_counter() - begin, made


def _budget(quick: bool) -> Part:
    """Where the light of a frame came from."""
    rows, said = [], []
    for name in ("table plaster sky", "table satin sky", "bowl plaster dark", "bowl steel sky"):
        tracer = Tracer(scene_named(name))
        film = tracer.render(*view(16 if quick else 64), Settings(passes=4 if quick else 16, each=4))
        for kind, parts in film.shares().items():
            rows += [{"scene": name, "by": kind, "part": part, "share": share} for part, share in parts.items() if share > 0]
        shares = film.shares()
        words = ", ".join(f"{part} {100 * share:.1f} %" for part, share in shares["reflection"].items() if share > 0)
        twice = sum(share for count, share in shares["reflections"].items() if int(count) > 1)
        said.append(f"{name}: {words}; {100 * twice:.1f} % of the light was reflected more than once")
    return Part((), said, {"light_budget": rows})


_PARTS = {
    "gathering": _gathering, "depth": _depth, "spikes": _spikes, "planner": _planner, "budget": _budget,
    "highlights": highlights_part, "leaks": leaks_part,
}  # fmt: skip
PARTS = tuple(_PARTS)
study = study_of_parts("transport", "Following light: what each simplification costs, and where it breaks", _PARTS)
