"""The lobe: what each form costs and how wrong it is, where it breaks, and what masking and bound change of the published model.

Truth is the sum over scattering orders in forty decimal digits, every order from the first. Lengths in micrometres, lambda 0.555.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from decimal import Decimal, localcontext
from functools import partial
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.kernels import kernel, threads
from rangecheck.reflectance import Material, directional_albedo, lobe_brdf, spike_reflectance
from rangecheck.reflectance.energy import lobe_albedo, visibility_of, visibility_table
from rangecheck.reflectance.fast import FAST_ERROR, lobe_fast, lobe_table
from rangecheck.reflectance.lobe import MASKINGS, SMITH, two_numbers
from rangecheck.reflectance.many import fill_fast
from rangecheck.reflectance.series import lobe_rough, lobe_series, lobe_smooth
from rangecheck.reflectance.tables import lobe_value
from rangecheck.study import Candidate, Edge, EdgeChart, Line, LineChart, Part, SpeedChart, find_edge, measure, study_of_parts

GREEN_UM = 0.555
#: smooth, intermediate, rough: the roughness that light sees
REGIMES = {"smooth": (1e-6, 1e-2), "intermediate": (0.1, 10.0), "rough": (1e2, 1e3)}
#: a lobe is judged down to e^-4 of its peak: a up to this many times (1 + g)
_WITHIN = 4.0
#: surfaces of physics that span mirror to ground metal, sigma and T
SURFACES = ((0.02, 3.0), (0.1, 3.0), (0.2, 3.0), (1.0, 10.0), (2.0, 6.0))


def forty_digits(g: float, a: float) -> Decimal:
    """S(g, a) from every order, in forty digits. Meant for g up to some thousands: it adds about g + 30 sqrt(g + sqrt(a)) terms."""
    with localcontext() as context:
        context.prec = 40
        context.Emin, context.Emax = -999999999, 999999999
        big_g, big_a = Decimal(g), Decimal(a)
        weight = (-big_g).exp()
        total = Decimal(0)
        m = 0
        while True:
            m += 1
            weight *= big_g / m
            term = weight / m * (-big_a / m).exp()
            total += term
            if m > g and term < total * Decimal("1e-25") and weight * 4 < total * Decimal("1e-20"):
                return total


@kernel
def _by_series(g, a, out):
    for n in range(g.size):
        out[n] = lobe_series(g[n], a[n])


@kernel
def _by_smooth(g, a, out):
    for n in range(g.size):
        out[n] = lobe_smooth(g[n], a[n])


@kernel
def _by_rough(g, a, out):
    for n in range(g.size):
        out[n] = lobe_rough(g[n], a[n])


@kernel
def _by_table(table, g, a, out):
    for n in range(g.size):
        out[n] = lobe_fast(table, g[n], a[n])


@kernel
def _by_plain_sum(orders, g, a, out):
    for n in range(g.size):
        weight, total = math.exp(-g[n]), 0.0
        for m in range(1, orders + 1):
            weight *= g[n] / m
            total += weight / m * math.exp(-a[n] / m)
        out[n] = total


def _evaluators() -> dict[tuple[str, str], Callable[[FloatArray, FloatArray, FloatArray], None]]:
    table = lobe_table()
    found: dict[tuple[str, str], Callable[[FloatArray, FloatArray, FloatArray], None]] = {
        ("smooth form (6)", ""): _by_smooth,
        ("rough form (7)", ""): _by_rough,
        ("fast: one table", ""): partial(_by_table, table),
        ("series, stable", ""): _by_series,
    }
    for orders in (4, 16, 64):
        found["plain sum", f"{orders} orders"] = partial(_by_plain_sum, orders)
    return found


def _points(low: float, high: float, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    g = np.exp(rng.uniform(np.log(low), np.log(high), count))
    return g, rng.uniform(0.0, _WITHIN, count) * (1.0 + g)


def _forms(points: int, evaluations: int, rounds: int) -> tuple[list[SpeedChart], list[dict[str, Any]]]:
    charts, rows = [], []
    for number, (regime, (low, high)) in enumerate(REGIMES.items()):
        judged_g, judged_a = _points(low, high, points if regime != "rough" else max(12, points // 8), 31 + number)
        truth = [forty_digits(float(g), float(a)) for g, a in zip(judged_g, judged_a)]
        timed_g, timed_a = _points(low, high, evaluations, 41 + number)
        candidates, error_by_result = [], {}
        for (method, setting), evaluate in _evaluators().items():
            judged, out = np.empty(len(judged_g)), np.empty(evaluations)
            evaluate(judged_g, judged_a, judged)
            error_by_result[method, setting] = max(abs(float(Decimal(float(v)) / t - 1)) for v, t in zip(judged, truth))

            run = partial(_timed, evaluate, timed_g, timed_a, out, (method, setting))
            candidates.append(Candidate(method, setting, run))
        measured = measure(candidates, error_by_result.__getitem__, rounds=rounds)
        charts.append(
            SpeedChart(
                f"forms-{regime}",
                f"Forms of the lobe, {regime} surface: g from {low:g} to {high:g}",
                f"largest relative error of S(g, a), a up to {_WITHIN:g} (1 + g)",
                "ns per evaluation, one core",
                measured,
                work=evaluations,
                scale=1e9,
            )
        )
        rows += [
            {"regime": regime, "method": m.method, "setting": m.setting, "ns": m.seconds / evaluations * 1e9, "error": m.error}
            for m in measured
        ]
    return charts, rows


def _whole(evaluations: int, rounds: int) -> tuple[SpeedChart, list[dict[str, Any]]]:
    """The lobe itself from three angles, as notebooks call it, checks and cosines included; by its kernel alone; and as the tracer calls it,
    from cosines, masked, bounded, with Fresnel's share. Errors against the series at the same angles, within e^-30 of the peak."""
    rng = np.random.default_rng(7)
    theta_i = rng.uniform(0.0, 1.5, evaluations)
    theta_r = np.clip(theta_i + rng.normal(0.0, 0.1, evaluations), 0.0, 1.55)
    angles = (theta_i, theta_r, rng.normal(0.0, 0.2, evaluations))
    candidates, errors = [], {}
    for sigma, correlation in ((0.02, 3.0), (0.1, 3.0), (1.0, 10.0)):
        surface: dict[str, Any] = {"sigma_um": sigma, "correlation_um": correlation, "wavelength_um": GREEN_UM}
        exact = lobe_brdf(*angles, form="series", **surface)
        seen = exact > math.exp(-30.0) * exact.max()
        for form in ("fast", "series"):
            key = (f"lobe_brdf, {form}", f"σ {sigma:g} T {correlation:g}")
            errors[key] = float(np.abs(lobe_brdf(*angles, form=form, **surface)[seen] / exact[seen] - 1.0).max())
            candidates.append(Candidate(*key, partial(_called, lobe_brdf, angles, {"form": form, **surface}, key)))
        key = ("fast kernel, from angles", f"σ {sigma:g} T {correlation:g}")
        alone = np.empty(evaluations)
        numbers = [np.array([value]) for value in two_numbers(sigma, correlation, GREEN_UM)]
        given = (lobe_table(), *angles, *numbers, 0, evaluations, alone, *([np.empty(0)] * 3))
        fill_fast(*given)
        errors[key] = float(np.abs(alone[seen] / exact[seen] - 1.0).max())
        candidates.append(Candidate(*key, partial(_called, fill_fast, given, {}, key)))
        key = ("tracer's lobe_value", f"σ {sigma:g} T {correlation:g}")
        material = Material("surface", K_s=1.0, sigma_um=sigma, correlation_um=correlation, wavelengths_um=(GREEN_UM,))
        cosines = [np.cos(theta_i), np.cos(theta_r)]
        aside = (np.sin(theta_i) - np.sin(theta_r)) ** 2
        aside += 4.0 * np.sin(theta_i) * np.sin(theta_r) * np.sin(0.5 * angles[2]) ** 2
        out = np.empty(evaluations)
        _by_tracer(*material.tables(), *cosines, aside, out)
        masked = lobe_brdf(*angles, form="series", masking="smith", bounded=True, **surface)
        errors[key] = float(np.abs(out[seen] / np.maximum(masked[seen], 1e-300) - 1.0).max())
        candidates.append(Candidate(*key, partial(_called, _by_tracer, (*material.tables(), *cosines, aside, out), {}, key)))
    with threads(1):
        measured = measure(candidates, errors.__getitem__, rounds=rounds)
    chart = SpeedChart(
        "whole-lobe",
        "The whole lobe: from angles, and as the tracer evaluates it",
        "largest relative error, down to e^-30 of the peak",
        "ns per evaluation, one core",
        measured,
        work=evaluations,
        scale=1e9,
    )
    return chart, [
        {"method": m.method, "setting": m.setting, "ns": m.seconds / evaluations * 1e9, "error": m.error} for m in measured
    ]


def _called(function: Callable[..., Any], given: tuple[Any, ...], named: dict[str, Any], key: tuple[str, str]) -> tuple[str, str]:
    function(*given, **named)
    return key


@kernel
def _by_tracer(surfaces, series, c_i, c_r, aside, out):
    for n in range(out.size):
        out[n] = lobe_value(surfaces, series, 0, 0, c_i[n], c_r[n], aside[n])


def _timed(evaluate: Callable[..., None], g: FloatArray, a: FloatArray, out: FloatArray, key: tuple[str, str]) -> tuple[str, str]:
    evaluate(g, a, out)
    return key


def _largest_error(form: Callable[[float, float], float], within: float, g: float) -> float:
    """Of a form against the series at one g, over a from 0 to `within` times (1 + g)."""
    return max(abs(form(g, a) / lobe_series(g, a) - 1.0) for a in np.linspace(0.0, within * (1.0 + g), 17))


def _limits(samples: int) -> list[EdgeChart]:
    table = lobe_table()

    def fast(g: float, a: float) -> float:
        return lobe_fast(table, g, a)

    edges: list[Edge] = []
    for words, within in (("mirror direction", 0.0), ("within 1 width", 1.0), ("within 2 widths", _WITHIN)):
        for name, form, start, stop in (("smooth (6)", lobe_smooth, 1e-8, 1e4), ("rough (7)", lobe_rough, 1e6, 1e-4)):
            edges.append(
                find_edge(
                    f"{name}, {words}",
                    partial(_largest_error, form, within),
                    start, stop, 0.01, logarithmic=True, samples=samples,
                )
            )  # fmt: skip
    edges.sort(key=lambda edge: edge.method.startswith("rough"))
    whole = find_edge(
        "fast, to e^-30", partial(_largest_error, fast, 30.0), 1e-12, 1e8, FAST_ERROR, logarithmic=True, samples=4 * samples
    )
    return [
        EdgeChart(
            "limits",
            "Where the smooth and the rough form leave 1 %",
            "g, the roughness that the light sees",
            "largest relative error of S(g, a)",
            edges,
        ),
        EdgeChart(
            "table",
            "The tracer's table over the whole range of roughness",
            "g, the roughness that the light sees",
            "largest relative error of S(g, a), a up to 30 (1 + g)",
            [whole],
        ),
    ]


def _excess(sigma: float, correlation: float, degrees: float) -> float:
    """By how much the published model gives out more than it receives."""
    surface = {"sigma_um": sigma, "correlation_um": correlation, "wavelength_um": GREEN_UM}
    return float(directional_albedo(math.radians(degrees), masking="none", bounded=False, **surface)) - 1.0


#: by how much an albedo must pass 1 to count: far above the quadrature's 1e-6
_VISIBLE_EXCESS = 1e-3


def _grazing(samples: int) -> tuple[EdgeChart, list[dict[str, Any]]]:
    edges = [
        find_edge(
            f"σ {sigma:g} µm, T {correlation:g} µm",
            partial(_excess, sigma, correlation),
            0.0, 89.9, _VISIBLE_EXCESS, samples=samples, tolerance=1e-4,
        )
        for sigma, correlation in SURFACES
    ]  # fmt: skip
    rows = [
        {"sigma_um": s, "correlation_um": t, "breaks_at_degrees": edge.breaks_at, "in_words": edge.in_words}
        for (s, t), edge in zip(SURFACES, edges)
    ]
    chart = EdgeChart(
        "grazing",
        "The published model gives out more than it receives: first angle by roughness",
        "angle of incidence, degrees from the normal",
        "directional albedo of lobe and spike, minus 1",
        edges,
        log="y",
    )
    return chart, rows


def _grazing_by_roughness(steps: int) -> tuple[LineChart, list[dict[str, Any]]]:
    rows: list[dict[str, Any]] = []
    lines = []
    heights = np.geomspace(0.01, 3.0, steps)
    for waves_long in (3.0, 10.0, 30.0, 100.0):
        found = []
        for waves_high in heights:
            sigma, correlation = waves_high * GREEN_UM, waves_long * GREEN_UM
            edge = find_edge(
                "published",
                partial(_excess, sigma, correlation),
                0.0, 89.9, _VISIBLE_EXCESS, samples=31, tolerance=1e-3,
            )  # fmt: skip
            found.append(math.nan if edge.breaks_at is None else edge.breaks_at)
            rows.append(
                {"sigma_per_wavelength": waves_high, "correlation_per_wavelength": waves_long, "breaks_at_degrees": found[-1]}
            )
        lines.append(Line(f"T = {waves_long:g} λ", heights.tolist(), found, marked=True))
    chart = LineChart(
        "grazing-by-roughness",
        f"First angle at which the published albedo exceeds 1 by {_VISIBLE_EXCESS:g}",
        "σ/λ",
        "degrees from the normal",
        lines,
        log="x",
    )
    return chart, rows


_DRAWN_UP_TO = 1.5


def _changes(steps: int) -> tuple[list[LineChart], list[dict[str, Any]]]:
    """What masking and bound take from the published model: energy by angle, and the lobe itself in the mirror direction."""
    degrees = np.concatenate([np.linspace(0, 70, steps // 3), np.linspace(70.5, 89.9, steps - steps // 3)])
    theta = np.radians(degrees)
    charts, rows = [], []
    variants = {
        "published: no masking, no bound": ("none", False), "Smith": ("smith", False), "V-groove": ("v-groove", False),
        "Smith and bound": ("smith", True), "V-groove and bound": ("v-groove", True),
    }  # fmt: skip
    for sigma, correlation in ((0.1, 3.0), (1.0, 10.0)):
        roughness, reach = two_numbers(sigma, correlation, GREEN_UM)
        spike = spike_reflectance(theta, sigma_um=sigma, wavelength_um=GREEN_UM)
        lines = []
        for words, (masking, bounded) in variants.items():
            lobe = lobe_albedo(np.cos(theta), roughness, reach, masking=MASKINGS[masking], bounded=bounded)
            lines.append(Line(words, degrees.tolist(), np.where(lobe + spike > _DRAWN_UP_TO, np.nan, lobe + spike).tolist()))
            rows += [
                {"sigma_um": sigma, "correlation_um": correlation, "variant": words, "degrees": float(d), "albedo": float(v)}
                for d, v in zip(degrees, lobe + spike)
            ]
        charts.append(
            LineChart(
                f"albedo-{sigma:g}-{correlation:g}".replace(".", "_"),
                f"Albedo of lobe and spike, σ {sigma:g} µm, T {correlation:g} µm, λ {GREEN_UM:g} µm (drawn up to {_DRAWN_UP_TO:g})",
                "angle of incidence, degrees from the normal",
                "directional albedo",
                lines,
                level=1.0,
            )
        )
    lines = []
    for sigma, correlation in SURFACES:
        table = visibility_table(*two_numbers(sigma, correlation, GREEN_UM), SMITH, True)
        kept = visibility_of(table, np.cos(theta)) ** 2
        lines.append(Line(f"σ {sigma:g} µm, T {correlation:g} µm", degrees.tolist(), kept.tolist()))
    charts.append(
        LineChart(
            "kept",
            "Share of the published lobe that Smith's masking and the bound keep, in the mirror direction",
            "angle of incidence and reflection, degrees from the normal",
            "share kept",
            lines,
        )
    )
    return charts, rows


def _forms_part(quick: bool) -> Part:
    charts, rows = _forms(points=60 if quick else 200, evaluations=5_000 if quick else 50_000, rounds=5 if quick else 15)
    whole, whole_rows = _whole(5_000 if quick else 100_000, 3 if quick else 15)
    said = [
        f"{row['method']}, {row['setting']}: {row['ns']:.3g} ns per evaluation per core, error {row['error']:.2g}"
        for row in whole_rows
    ]
    said += [
        f"{row['regime']} surface, {row['method']}{', ' + row['setting'] if row['setting'] else ''}: "
        f"{row['ns']:.3g} ns per evaluation per core, error {row['error']:.2g}"
        for row in rows
    ]
    return Part([*charts, whole], said, {"forms": rows, "whole_lobe": whole_rows})


def _limits_part(quick: bool) -> Part:
    charts = _limits(25 if quick else 81)
    return Part(charts, [edge.in_words for chart in charts for edge in chart.edges])


def _grazing_part(quick: bool) -> Part:
    grazing, rows = _grazing(24 if quick else 60)
    by_roughness, edges = _grazing_by_roughness(4 if quick else 13)
    said = [f"published model, {row['in_words']}" for row in rows]
    for long in sorted({row["correlation_per_wavelength"] for row in edges}):
        found = ", ".join(
            f"{row['breaks_at_degrees']:.3g} at σ = {row['sigma_per_wavelength']:.3g} λ"
            for row in edges
            if row["correlation_per_wavelength"] == long
        )
        said.append(f"published model, T = {long:g} λ: exceeds albedo 1 from these degrees on (nan: nowhere below 89.9): {found}")
    return Part([grazing, by_roughness], said, {"grazing_edges": rows, "grazing_by_roughness": edges})


def _changes_part(quick: bool) -> Part:
    charts, rows = _changes(30 if quick else 90)
    most: dict[str, tuple[float, float, str]] = {}
    for row in rows:
        where = (row["albedo"], row["degrees"], f"σ {row['sigma_um']:g} µm, T {row['correlation_um']:g} µm")
        most[row["variant"]] = max(most.get(row["variant"], where), where)
    said = [f"{variant}: albedo at most {a:.6g}, at {d:.3g} degrees, {which}" for variant, (a, d, which) in most.items()]
    kept = next(chart for chart in charts if chart.slug == "kept")
    said += [
        f"{line.label}: masking and bound keep {100 * float(np.interp(60.0, line.x, line.y)):.3g} % of the published lobe at 60 degrees, "
        f"{100 * float(np.interp(80.0, line.x, line.y)):.3g} % at 80, {100 * float(np.interp(85.0, line.x, line.y)):.3g} % at 85"
        for line in kept.lines
    ]
    return Part(charts, said, {"masking_and_bound": rows})


_PARTS = {"forms": _forms_part, "limits": _limits_part, "grazing": _grazing_part, "bound": _changes_part}
PARTS = tuple(_PARTS)
study = study_of_parts("reflectance", "Forms of the specular lobe: speed, accuracy, and where each breaks", _PARTS)
