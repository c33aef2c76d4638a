"""Recovery of material and lamp from photographs: are the stated intervals honest, how long does it take, and where does it stop being possible?

Truth is the model itself: a sphere of random material under a lamp of random direction, pictured with 1 % of full scale of Gaussian noise,
exposed so that its brightest point lies between 0.7 and 1.2 of full scale (what passes 1 is clipped). Lamp and lengths start from elsewhere.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.recover.fit import TWO_SIDED_95, Fitted, fit
from rangecheck.recover.lights import Light, tangents
from rangecheck.recover.problem import Guess, Photograph, Problem, Unknowns
from rangecheck.recover.sight import sphere_sight
from rangecheck.studies.fit_alexander import alexander
from rangecheck.studies.fit_classes import classes
from rangecheck.studies.fit_refine import refinement
from rangecheck.study import Candidate, Line, LineChart, SpeedChart, Study, measure

PARTS = ("coverage", "speed", "pictures", "noise", "limits", "classes", "refine", "alexander")
NOISE = 0.01
#: the first of the seeds on which coverage is judged: none of them was looked at while the method was made
_FRESH = 41000
_FAR_MM, _WAVE_UM = 1e6, 0.555
_TITLE = "Material and lamp from photographs: honesty of the intervals, time, and limits"


def study(quick: bool = False, part: str | None = None) -> Study:
    """The whole study, or one of PARTS; `quick` takes a tenth of the scenes and small pictures. The whole leaves `alexander` out, which needs real data."""
    makers = {
        "coverage": _coverage,
        "speed": _speed,
        "pictures": _pictures,
        "noise": _noise,
        "limits": _limits,
        "classes": classes,
        "refine": refinement,
    }
    charts: list[Any] = []
    findings: list[str] = []
    tables: dict[str, list[dict[str, Any]]] = {}
    pictures: dict[str, bytes] = {}
    for name in makers if part is None else (part,):
        if name == "alexander":
            made, said, rows, pictures = alexander(quick)
        else:
            made, said, rows = makers[name](quick)
        charts += made
        findings += said
        tables[name] = rows
    return Study("fit" if part is None else f"fit-{part}", _TITLE, charts, findings, tables, pictures=pictures)


def random_scene(seed: int, size: int, *, noise: float = NOISE, pictures: int = 1) -> tuple[Problem, Problem]:
    """A problem as it is put, and the same at its truth: sphere of `size` pixels, everything drawn from `seed`."""
    rng = np.random.default_rng(seed)
    slope, height = (math.exp(rng.uniform(math.log(a), math.log(b))) for a, b in ((0.06, 0.3), (0.03, 0.3)))
    truth = Guess(rng.uniform(0.1, 0.5), 0.0, rng.uniform(0.1, 0.4), height, max(2.0 * height / slope, 0.6), _WAVE_UM)
    sight = sphere_sight((size / 2, size / 2), 0.47 * size, (size, size))
    n = len(sight)
    lights, photos = [], []
    for k in range(pictures):
        direction = np.array([rng.uniform(-0.7, 0.7), rng.uniform(-0.7, 0.7), 0.8])
        lights.append(Light(direction, 2.5, np.zeros(3), _FAR_MM, 0.5))
        photos.append(Photograph(sight, np.zeros(n), np.full(n, noise), np.ones((n, 1), bool), (k,)))
    at_truth = Problem(tuple(photos), tuple(lights), truth, Unknowns())
    shown = [at_truth.predict(at_truth.start(), k, slopes=False).values for k in range(pictures)]
    scale = rng.uniform(0.7, 1.2) / max(float(v.max()) for v in shown)
    taken = tuple(
        replace(photo, values=np.minimum(scale * v + rng.normal(0.0, noise, n), 1.0)) for photo, v in zip(photos, shown)
    )
    lights = [replace(light, irradiance=scale * light.irradiance) for light in lights]
    at_truth = replace(at_truth, photographs=taken, lights=tuple(lights))
    begun = tuple(replace(light, direction=light.direction + rng.normal(0.0, 0.1, 3)) for light in lights)
    return replace(at_truth, lights=begun, material=Guess(wavelength_um=_WAVE_UM)), at_truth


def truths(found: Fitted, at_truth: Problem) -> dict[str, float]:
    """The true value of every parameter that was fitted, in the unit of its estimate."""
    known: dict[str, float] = {}
    for p in found.parameters:
        if p.kind in ("strength", "log strength", "length"):
            known[p.name] = float(getattr(at_truth.material, p.name))
        elif p.kind == "direction":
            base, to = found.started.lights[p.owner].direction, at_truth.lights[p.owner].direction
            aside = to - (to @ base) * base
            length = float(np.linalg.norm(aside))
            angle = math.atan2(length, float(to @ base))
            known[p.name] = float(angle * (tangents(base)[p.number] @ aside) / length) if length > 0 else 0.0
    return known


def _coverage(quick: bool) -> tuple[list[Any], list[str], list[dict[str, Any]]]:
    scenes, size = (20, 48) if quick else (200, 64)
    rows: list[dict[str, Any]] = []
    for seed in range(_FRESH, _FRESH + scenes):
        put, at_truth = random_scene(seed, size)
        found = fit(put)
        known = truths(found, at_truth)
        for e in found.estimates:
            stated = e.low is not None and e.high is not None
            inside = bool(e.low <= known[e.name] <= e.high) if e.low is not None and e.high is not None else None
            rows.append(
                {"scene": seed, "parameter": e.name, "truth": known[e.name], "value": e.value, "low": e.low, "high": e.high,
                 "stated": stated, "inside": inside, "converged": found.converged, "statements": list(found.statements)}
            )  # fmt: skip
    stated_rows = [row for row in rows if row["stated"]]
    share = sum(bool(row["inside"]) for row in stated_rows) / len(stated_rows)
    names = list(dict.fromkeys(row["parameter"] for row in rows))
    per = {n: [bool(r["inside"]) for r in stated_rows if r["parameter"] == n] for n in names}
    findings = [
        f"{scenes} random scenes of {size} x {size} pixels, noise {100 * NOISE:.0f} %: the truth lies inside the stated 95 % interval in "
        f"{100 * share:.1f} % of {len(stated_rows)} stated numbers",
        *(f"  {n}: {100 * np.mean(v):.1f} % of {len(v)}" for n, v in per.items() if v),
        f"{len(rows) - len(stated_rows)} of {len(rows)} numbers were said not to be determined; "
        f"{100 * (sum(r['converged'] for r in rows) / len(rows)):.1f} % of the fits converged",
    ]
    chart = LineChart(
        "coverage",
        f"Truth inside the interval, {scenes} scenes",
        "number of the parameter, in the order of the table",
        "share inside the stated 95 % interval",
        [Line("random scenes", list(range(len(names))), [float(np.mean(per[n])) if per[n] else math.nan for n in names], True)],
        level=0.95,
    )
    return [chart], findings, rows


def _speed(quick: bool) -> tuple[list[Any], list[str], list[dict[str, Any]]]:
    sizes = (64, 128) if quick else (64, 256, 512)
    scenes = 3 if quick else 7
    rows: list[dict[str, Any]] = []
    fit(random_scene(0, 64)[0])
    for size in sizes:
        for seed in range(scenes):
            put, at_truth = random_scene(1000 + seed, size)
            begun = time.perf_counter()
            found = fit(put)
            seconds = time.perf_counter() - begun
            wrong = _wrong(found, at_truth)
            rows.append(
                {"size": size, "seed": 1000 + seed, "seconds": seconds, "lengths_off": wrong, "evaluations": found.evaluations}
            )

    def median(size: int, key: str) -> float:
        return float(np.median([r[key] for r in rows if r["size"] == size]))

    lines = [Line("median over scenes", list(sizes), [median(s, "seconds") for s in sizes], True)]
    charts: list[Any] = [
        LineChart("time", "Time of a fit by size of the picture", "pixels along a side", "s", lines, log="xy", level=3.0)
    ]
    findings = [
        f"{s} x {s} pixels: median {median(s, 'seconds'):.2f} s, largest {max(r['seconds'] for r in rows if r['size'] == s):.2f} s"
        for s in sizes
    ]
    put, at_truth = random_scene(1001, sizes[-1] // 2)
    counts = (500, 3000) if quick else (300, 1000, 3000)
    candidates = [Candidate("pixels of the starts", str(c), lambda c=c: fit(put, pixels=c)) for c in counts]  # type: ignore[misc]
    measured = measure(candidates, lambda found: _wrong(found, at_truth), rounds=1 if quick else 3)
    charts.append(
        SpeedChart("starts", "Pixels that the starts are tried on", "error of ln sigma and ln T, rms", "s per fit", measured)
    )
    return charts, findings, rows


def _wrong(found: Fitted, at_truth: Problem) -> float:
    """Root mean square of the errors of ln sigma and ln T."""
    m, t = found.problem.material, at_truth.material
    return math.hypot(math.log(m.sigma_um / t.sigma_um), math.log(m.correlation_um / t.correlation_um)) / math.sqrt(2.0)


def _width(found: Fitted, name: str) -> float:
    """Relative standard deviation of a number as stated; nan where it is not determined."""
    e = found.estimate(name)
    if e.low is None or e.high is None or not e.value > 0.0:
        return math.nan
    return (e.high - e.low) / (2.0 * TWO_SIDED_95 * e.value)


_SHOWN = ("K_lm", "K_lobe", "sigma_um", "correlation_um")


def _median_rows(knob: str, settings: list[Any], scenes: int, put: Any) -> tuple[list[Line], list[dict[str, Any]]]:
    rows: list[dict[str, Any]] = []
    for setting in settings:
        for seed in range(scenes):
            found = fit(put(seed, setting)[0])
            rows.append({knob: setting, "seed": seed} | {n: _width(found, n) for n in _SHOWN})

    def middle(name: str, setting: Any) -> float:
        values = np.array([r[name] for r in rows if r[knob] == setting])
        # where half of the scenes do not determine it there is no median
        return float(np.median(np.where(np.isnan(values), np.inf, values)))

    lines = [Line(n, settings, [v if math.isfinite(v := middle(n, s)) else math.nan for s in settings], True) for n in _SHOWN]
    return lines, rows


def _pictures(quick: bool) -> tuple[list[Any], list[str], list[dict[str, Any]]]:
    counts = [1, 2] if quick else [1, 2, 4, 8]
    lines, rows = _median_rows("pictures", counts, 2 if quick else 6, lambda seed, k: random_scene(2000 + seed, 48, pictures=k))
    chart = LineChart(
        "pictures", "Stated error by number of pictures, 48 x 48 pixels", "pictures", "relative error", lines, log="xy"
    )
    return [chart], [f"{line.label}: {_percents(line.y)} with {counts} pictures" for line in lines], rows


def _noise(quick: bool) -> tuple[list[Any], list[str], list[dict[str, Any]]]:
    levels = [0.003, 0.03] if quick else [0.001, 0.003, 0.01, 0.03, 0.1]
    lines, rows = _median_rows("noise", levels, 2 if quick else 6, lambda seed, level: random_scene(3000 + seed, 64, noise=level))
    chart = LineChart(
        "noise", "Stated error by noise, 64 x 64 pixels; gaps: most scenes do not determine it", "noise, parts of full scale",
        "relative error", lines, log="xy",
    )  # fmt: skip
    return [chart], [f"{line.label}: {_percents(line.y)} at noise {levels}" for line in lines], rows


def _percents(values: Any) -> str:
    return ", ".join("not determined" if math.isnan(v) else f"{100 * v:.2f} %" for v in values)


def _limits(quick: bool) -> tuple[list[Any], list[str], list[dict[str, Any]]]:
    """Where height and length stop being told apart (from smooth to rough), and how far off a lamp's guess may be."""
    rows: list[dict[str, Any]] = []
    size = 48 if quick else 96
    heights = [0.05, 0.2, 2.0] if quick else [0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2]
    sight = sphere_sight((size / 2, size / 2), 0.47 * size, (size, size))
    n = len(sight)
    light = Light(np.array([0.4, 0.3, 0.8]), 1.0, np.zeros(3), _FAR_MM, 0.5)
    widths: dict[str, list[float]] = {name: [] for name in _SHOWN}
    rng = np.random.default_rng(7)
    grain: FloatArray = rng.normal(0.0, NOISE, n)

    def pictured(truth: Guess) -> Problem:
        photo = Photograph(sight, np.zeros(n), np.full(n, NOISE), np.ones((n, 1), bool), (0,))
        problem = Problem((photo,), (light,), truth, Unknowns())
        clean = problem.predict(problem.start(), 0, slopes=False).values
        scale = 0.9 / float(clean.max())
        lit = replace(light, irradiance=scale * light.irradiance)
        return replace(problem, photographs=(replace(photo, values=scale * clean + grain),), lights=(lit,))

    for height in heights:
        truth = Guess(0.3, 0.0, 0.3, height, max(2.0 * height / 0.15, 1.0), _WAVE_UM)
        found = fit(replace(pictured(truth), material=Guess(wavelength_um=_WAVE_UM)))
        for name in _SHOWN:
            widths[name].append(_width(found, name))
        rows.append({"sigma_um": height, "statements": list(found.statements)} | {name: widths[name][-1] for name in _SHOWN})
    apart = [h for h, w in zip(heights, widths["sigma_um"]) if not math.isnan(w)]
    charts: list[Any] = [
        LineChart(
            "roughness", "Stated error by roughness, slope 0.15; gaps: not determined", "sigma, um (wavelength 0.555)",
            "relative error", [Line(name, heights, widths[name], True) for name in _SHOWN], log="xy",
        )
    ]  # fmt: skip
    said = (
        f"sigma and T are told apart for sigma {apart[0]:g} to {apart[-1]:g} um of {heights}"
        if apart
        else f"sigma and T are never told apart in {heights}"
    )
    findings = [said]
    truth = Guess(0.3, 0.0, 0.2, 0.12, 1.6, _WAVE_UM)
    offs = [0.0, 40.0, 80.0] if quick else [0.0, 20.0, 40.0, 60.0, 80.0, 100.0, 120.0]
    misses = []
    put = pictured(truth)
    for off in offs:
        worst = 0.0
        for turn in np.arange(4) * math.pi / 2:
            begun = put.lights[0].turned(math.radians(off) * np.array([math.cos(turn), math.sin(turn)]))
            found = fit(replace(put, lights=(begun,), material=Guess(wavelength_um=_WAVE_UM)))
            to = float(found.problem.lights[0].direction @ light.direction)
            worst = max(worst, math.degrees(math.acos(min(1.0, to))))
        misses.append(worst)
        rows.append({"lamp_off_deg": off, "ends_off_deg": worst})
    good = [o for o, m in zip(offs, misses) if m < 1.0]
    findings.append(f"a lamp guessed up to {good[-1]:g} degrees off is found within 1 degree" if good else "no lamp was found")
    charts.append(
        LineChart(
            "lamp", "Where the lamp ends by how far off it was guessed (worst of four sides)", "guess off by, degrees",
            "result off by, degrees", [Line("worst of four", offs, misses, True)], level=1.0,
        )
    )  # fmt: skip
    return charts, findings, rows
