"""How far a fit's numbers lie from the truth, beside how far it says they may, by number of pictures, noise and roughness; and where it ends to be possible.

Errors and stated deviations are told apart: an error is measured against the truth of each scene, and its standard deviation over scenes taken from their
median (a normal law's is 1.48 times it), so that one stray scene does not make it; what is stated is the median over the same scenes. Both are shown where at
least half of the scenes determine the number within a factor of two: elsewhere there is a gap.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rangecheck.recover.fit import Fitted, fit
from rangecheck.recover.lights import Light
from rangecheck.recover.problem import Guess, Photograph, Problem, Unknowns
from rangecheck.recover.sight import sphere_sight
from rangecheck.studies.fit_scenes import FAR_MM, NOISE, WAVE_UM, error_against_truth, random_scene, stated_deviation
from rangecheck.study import Line, LineChart

SHOWN = ("K_lm", "K_lobe", "sigma_um", "correlation_um")
_WORDS = {"K_lm": "K_lm", "K_lobe": "K_lobe", "sigma_um": "sigma", "correlation_um": "T"}
_DEVIATION = "standard deviation, share of the true value"
_NORMAL = 1.482602218505602
_GAPS = "solid: errors against the truth; dashed: as the fit states; gaps: most scenes do not determine it within a factor of two"
#: a lamp that is found ends within this of the truth, degrees
_FOUND_DEG = 1.0

Part = tuple[list[Any], list[str], list[dict[str, Any]]]


def row_of(found: Fitted, at_truth: Problem) -> dict[str, Any]:
    """What one fit states and how wrong it is, of each number that is shown."""
    row: dict[str, Any] = {"converged": found.converged}
    for name in SHOWN:
        row |= {f"{name} stated": stated_deviation(found, name), f"{name} error": error_against_truth(found, at_truth, name)}
    return row


def sweep(knob: str, settings: Sequence[float], scenes: int, put: Callable[[int, Any], tuple[Problem, Problem]]) -> list[dict[str, Any]]:  # fmt: skip
    """Every scene (numbered from 0) fitted at every setting."""
    rows = []
    for setting in settings:
        for seed in range(scenes):
            problem, at_truth = put(seed, setting)
            rows.append({knob: setting, "seed": seed} | row_of(fit(problem), at_truth))
    return rows


def middle(rows: Sequence[dict[str, Any]], name: str) -> tuple[float, float, float]:
    """(standard deviation of the errors, stated deviation, share of the scenes that determine it) over rows of one setting; nan where less than half do."""
    stated = np.array([row[f"{name} stated"] for row in rows])
    error = np.array([row[f"{name} error"] for row in rows])
    known = np.isfinite(stated)
    share = float(known.mean())
    if share < 0.5:
        return math.nan, math.nan, share
    return _NORMAL * float(np.median(np.abs(error[known]))), float(np.median(stated[known])), share


def _lines(knob: str, settings: Sequence[float], rows: Sequence[dict[str, Any]]) -> tuple[list[Line], list[Line], list[str]]:
    """Errors and what is stated; shares of scenes that determine each number, and that converge; both in words."""
    at = [[row for row in rows if row[knob] == setting] for setting in settings]
    errors, shares, said = [], [], []
    for k, name in enumerate(SHOWN):
        found = [middle(group, name) for group in at]
        errors.append(Line(_WORDS[name], settings, [f[0] for f in found], True, colour=k))
        errors.append(Line(f"{_WORDS[name]}, as stated", settings, [f[1] for f in found], True, dashed=True, colour=k))
        shares.append(Line(_WORDS[name], settings, [f[2] for f in found], True, colour=k))
        said.append(
            f"  {_WORDS[name]}: errors {', '.join(_percent(f[0]) for f in found)} (stated {', '.join(_percent(f[1]) for f in found)}), "
            f"determined in {', '.join(f'{100 * f[2]:.0f}' for f in found)} % of the scenes"
        )
    settled = [float(np.mean([row["converged"] for row in group])) for group in at]
    shares.append(Line("fits that converge", settings, settled, True, dashed=True, colour=len(SHOWN)))
    said.append(f"  fits that converge: {', '.join(f'{100 * s:.0f}' for s in settled)} %")
    return errors, shares, said


def _percent(value: float) -> str:
    return "not determined" if math.isnan(value) else f"{100 * value:.2g} %"


def _determined(shares: Sequence[Line], settings: Sequence[float], unit: str, all_of: Sequence[str] = ("sigma", "T")) -> str:
    """Where most scenes determine all of these, in words."""
    by = {line.label: line.y for line in shares}
    good = [s for k, s in enumerate(settings) if all(by[name][k] >= 0.5 for name in all_of)]
    names = " and ".join(all_of)
    return (
        f"most scenes determine {names} {_range(good)}{unit} of those tried" if good else f"most scenes never determine {names}"
    )


def _range(good: Sequence[float]) -> str:
    return f"at {good[0]:g}" if len(good) == 1 else f"from {good[0]:g} to {good[-1]:g}"


def pictures(quick: bool) -> Part:
    """The part `pictures` of the study `fit`."""
    counts = [1, 2] if quick else [1, 2, 4, 8]
    scenes = 4 if quick else 24
    rows = sweep("pictures", counts, scenes, lambda seed, k: random_scene(2000 + seed, 48, pictures=k))
    errors, _, said = _lines("pictures", counts, rows)
    chart = LineChart(
        "pictures", f"Error by number of pictures, each under a lamp of its own ({scenes} scenes of 48 x 48 pixels, {100 * NOISE:g} % noise)",
        "number of pictures", _DEVIATION, errors, log="xy", whole=True, note=_GAPS,
    )  # fmt: skip
    return [chart], [f"with {counts} pictures", *said], rows


def noise(quick: bool) -> Part:
    """The part `noise` of the study `fit`."""
    levels = [0.003, 0.03] if quick else [0.001, 0.003, 0.01, 0.03, 0.1]
    scenes = 4 if quick else 24
    rows = sweep("noise", levels, scenes, lambda seed, level: random_scene(3000 + seed, 64, noise=level))
    errors, shares, said = _lines("noise", levels, rows)
    edge = _determined(shares, levels, " of full scale")
    axis = "standard deviation of a pixel's noise, parts of full scale"
    charts = [
        LineChart("noise", f"Error by noise of one picture ({scenes} scenes of 64 x 64 pixels)", axis, _DEVIATION, errors, log="xy", note=f"{_GAPS}; {edge}"),
        LineChart("noise-determined", f"What one picture still determines, by its noise ({scenes} scenes of 64 x 64 pixels)", axis, "share of the scenes", shares, log="x", level=0.5, note=edge, level_name="half"),
    ]  # fmt: skip
    return charts, [f"at noise {levels}; {edge}", *said], rows


def limits(quick: bool) -> Part:
    """The part `limits` of the study `fit`: where height and length stop being told apart (from smooth to rough), and how far off a lamp's guess may be."""
    charts, said, rows = _roughness(quick)
    lamp = _lamp(quick)
    return charts + lamp[0], said + lamp[1], rows + lamp[2]


def pictured(truth: Guess, size: int, seed: int) -> Problem:
    """At its truth: a sphere of `size` pixels under one lamp, its brightest point at 0.9 of full scale."""
    sight = sphere_sight((size / 2, size / 2), 0.47 * size, (size, size))
    n = len(sight)
    light = Light(np.array([0.4, 0.3, 0.8]), 1.0, np.zeros(3), FAR_MM, 0.5)
    photo = Photograph(sight, np.zeros(n), np.full(n, NOISE), np.ones((n, 1), bool), (0,))
    problem = Problem((photo,), (light,), truth, Unknowns())
    clean = problem.predict(problem.start(), 0, slopes=False).values
    scale = 0.9 / float(clean.max())
    grain = np.random.default_rng((7, seed)).normal(0.0, NOISE, n)
    lit = replace(light, irradiance=scale * light.irradiance)
    return replace(problem, photographs=(replace(photo, values=scale * clean + grain),), lights=(lit,))


def _roughness(quick: bool) -> Part:
    size, scenes = (48, 3) if quick else (96, 12)
    heights = [0.05, 0.2, 2.0] if quick else [0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2]

    def put(seed: int, height: float) -> tuple[Problem, Problem]:
        at_truth = pictured(Guess(0.3, 0.0, 0.3, height, max(2.0 * height / 0.15, 1.0), WAVE_UM), size, seed)
        return replace(at_truth, material=Guess(wavelength_um=WAVE_UM)), at_truth

    rows = sweep("sigma_um", heights, scenes, put)
    errors, shares, said = _lines("sigma_um", heights, rows)
    edge = _determined(shares, heights, " um")
    axis = f"sigma, um (wavelength {WAVE_UM} um; T such that the rms slope is 0.15, at least 1 um)"
    title = f"{scenes} pictures of {size} x {size} pixels, {100 * NOISE:g} % noise"
    charts = [
        LineChart("roughness", f"Error by roughness ({title})", axis, _DEVIATION, errors, log="xy", note=f"{_GAPS}; {edge}"),
        LineChart(
            "roughness-determined", f"What a picture determines, from smooth to rough ({title})", axis, "share of the pictures", shares, log="x",
            level=0.5, level_name="half", note=f"{edge}; rougher, only sigma / T acts; smoother, K_lobe and sigma only together",
        ),
    ]  # fmt: skip
    return charts, [f"at sigma {heights} um; {edge}", *said], rows


def _lamp(quick: bool) -> Part:
    size = 48 if quick else 96
    put = pictured(Guess(0.3, 0.0, 0.2, 0.12, 1.6, WAVE_UM), size, 0)
    truth = put.lights[0]
    offs = [0.0, 40.0, 80.0] if quick else [0.0, 20.0, 40.0, 60.0, 80.0, 100.0, 120.0, 140.0, 160.0]
    rows: list[dict[str, Any]] = []
    for off in offs:
        ends = []
        for turn in np.arange(4) * math.pi / 2:
            begun = truth.turned(math.radians(off) * np.array([math.cos(turn), math.sin(turn)]))
            found = fit(replace(put, lights=(begun,), material=Guess(wavelength_um=WAVE_UM)))
            to = float(found.problem.lights[0].direction @ truth.direction)
            ends.append(math.degrees(math.acos(min(1.0, to))))
        rows.append({"lamp_off_deg": off, "ends_off_deg": ends})
    worst = [max(row["ends_off_deg"]) for row in rows]
    held = [off for k, off in enumerate(offs) if max(worst[: k + 1]) < _FOUND_DEG]
    lost = [off for off in offs if not held or off > held[-1]]
    said = (
        f"a lamp guessed up to {held[-1]:g} degrees off is found within {_FOUND_DEG:g} degree from all four sides"
        if held
        else "no lamp is found from all four sides"
    ) + (f"; from {lost[0]:g} degrees one ends {worst[offs.index(lost[0])]:.2g} degrees off" if lost else ", all that was tried")
    lines = [Line("worst of four sides", offs, worst, True), Line("best of four sides", offs, [min(row["ends_off_deg"]) for row in rows], True)]  # fmt: skip
    chart = LineChart(
        "lamp", f"Where the lamp ends, by how far off it was guessed ({size} x {size} pixels)", "lamp guessed off by, degrees",
        "lamp found off by, degrees", lines, log="y", level=_FOUND_DEG, level_name="found", note=said,
    )  # fmt: skip
    return [chart], [said], rows
