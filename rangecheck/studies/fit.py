"""Recovery of material and lamp from photographs: are the stated intervals honest, how long does it take, and where does it stop being possible?

The scenes are those of `fit_scenes`; what grows with noise, pictures, roughness and a wrong lamp is in `fit_errors`.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from rangecheck.recover.fit import Fitted, fit
from rangecheck.recover.problem import Problem
from rangecheck.studies.fit_alexander import alexander
from rangecheck.studies.fit_classes import classes
from rangecheck.studies.fit_errors import limits, noise, pictures
from rangecheck.studies.fit_refine import refinement
from rangecheck.studies.fit_scenes import NOISE, random_scene, truths
from rangecheck.study import Candidate, Line, LineChart, Study, measure

PARTS = ("coverage", "speed", "pictures", "noise", "limits", "classes", "refine", "alexander")
#: the first of the seeds on which coverage is judged: none of them was looked at while the method was made
_FRESH = 52000
_TITLE = "Material and lamp from photographs: honesty of the intervals, time, and limits"


def study(quick: bool = False, part: str | None = None) -> Study:
    """The whole study, or one of PARTS; `quick` takes a tenth of the scenes and small pictures. The whole leaves `alexander` out, which needs real data."""
    makers = {
        "coverage": _coverage,
        "speed": _speed,
        "pictures": pictures,
        "noise": noise,
        "limits": limits,
        "classes": classes,
        "refine": refinement,
    }
    charts: list[Any] = []
    findings: list[str] = []
    tables: dict[str, list[dict[str, Any]]] = {}
    drawn: dict[str, bytes] = {}
    for name in makers if part is None else (part,):
        if name == "alexander":
            made, said, rows, drawn = alexander(quick)
        else:
            made, said, rows = makers[name](quick)
        charts += made
        findings += said
        tables[name] = rows
    return Study("fit" if part is None else f"fit-{part}", _TITLE, charts, findings, tables, pictures=drawn)


def _coverage(quick: bool) -> tuple[list[Any], list[str], list[dict[str, Any]]]:
    scenes, size = (20, 48) if quick else (400, 64)
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
        "coverage", f"Truth inside the stated 95 % interval ({scenes} scenes of {size} x {size} pixels, {100 * NOISE:g} % noise)", "number that is fitted",
        "share of the scenes that state it",
        [
            Line("random scenes", list(range(len(names))), [float(np.mean(per[n])) if per[n] else math.nan for n in names], True),
            Line("two standard deviations of chance", *_chance([len(per[n]) for n in names]), True, dashed=True, colour=7),
        ],
        level=0.95, level_name="95 %", names=[_named(n) for n in names],
        note=f"{100 * share:.1f} % of {len(stated_rows)} stated numbers; {len(rows) - len(stated_rows)} were said not to be determined",
    )  # fmt: skip
    return [chart], findings, rows


def _chance(counts: list[int]) -> tuple[list[int], list[float]]:
    """Places and shares of the least and most that 95 % would give of so many cases, two standard deviations from it."""
    known = [k for k, count in enumerate(counts) if count]
    off = [2.0 * math.sqrt(0.95 * 0.05 / counts[k]) for k in known]
    return known + known, [0.95 - o for o in off] + [min(1.0, 0.95 + o) for o in off]


def _named(name: str) -> str:
    return {"sigma_um": "sigma", "correlation_um": "T"}.get(name, name.replace("light 0", "lamp"))


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

    lines = [
        Line("median over scenes", list(sizes), [median(s, "seconds") for s in sizes], True),
        Line("longest", list(sizes), [max(r["seconds"] for r in rows if r["size"] == s) for s in sizes], True, dashed=True),
    ]
    charts: list[Any] = [
        LineChart(
            "time", f"Time of a fit by size of the picture ({scenes} scenes each)", "pixels along a side", "seconds of a fit", lines, log="xy",
            level=3.0, whole=True, level_name="3 s",
        )
    ]  # fmt: skip
    findings = [
        f"{s} x {s} pixels: median {median(s, 'seconds'):.2f} s, largest {max(r['seconds'] for r in rows if r['size'] == s):.2f} s"
        for s in sizes
    ]
    side = 64 if quick else 128
    known = [random_scene(1100 + seed, side) for seed in range(2 if quick else 4)]
    counts = (30, 3000) if quick else (30, 100, 300, 1000, 3000)
    candidates = [
        Candidate("pixels that the starts are tried on", str(c), lambda c=c: [fit(put, pixels=c) for put, _ in known])  # type: ignore[misc]
        for c in counts
    ]

    def off(found: list[Fitted]) -> float:
        return math.sqrt(float(np.mean([_wrong(f, at_truth) ** 2 for f, (_, at_truth) in zip(found, known)])))

    measured = measure(candidates, off, rounds=1 if quick else 3)
    errors = [m.error for m in measured]
    said = f"error of ln sigma and ln T, rms over the pictures: {min(errors):.3g} to {max(errors):.3g}, whatever the pixels"
    if max(errors) > 1.1 * min(errors):
        said = "error of ln sigma and ln T, rms over the pictures: " + ", ".join(
            f"{m.setting} pixels {m.error:.3g}" for m in measured
        )
    charts.append(
        LineChart(
            "starts", f"Time of a fit by how many pixels its starts are tried on ({len(known)} pictures of {side} x {side} pixels)",
            "pixels that the starts are tried on", "seconds of a fit", [Line("median", list(counts), [m.seconds / len(known) for m in measured], True)],
            log="xy", whole=True, note=said,
        )
    )  # fmt: skip
    findings.append(said)
    return charts, findings, rows


def _wrong(found: Fitted, at_truth: Problem) -> float:
    """Root mean square of the errors of ln sigma and ln T."""
    m, t = found.problem.material, at_truth.material
    return math.hypot(math.log(m.sigma_um / t.sigma_um), math.log(m.correlation_um / t.correlation_um)) / math.sqrt(2.0)
