"""What each form of the lobe costs, and how wrong it is.

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
from rangecheck.reflectance import Material, lobe_brdf
from rangecheck.reflectance.fast import lobe_fast, lobe_table
from rangecheck.reflectance.lobe import two_numbers
from rangecheck.reflectance.many import fill_fast
from rangecheck.reflectance.series import lobe_rough, lobe_series, lobe_smooth
from rangecheck.reflectance.tables import lobe_value
from rangecheck.study import Candidate, Part, SpeedChart, measure

GREEN_UM = 0.555
#: smooth, intermediate, rough: the roughness that light sees
REGIMES = {"smooth": (1e-6, 1e-2), "intermediate": (0.1, 10.0), "rough": (1e2, 1e3)}
#: a lobe is judged down to e^-4 of its peak: a up to this many times (1 + g)
WITHIN = 4.0


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
    return g, rng.uniform(0.0, WITHIN, count) * (1.0 + g)


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
                f"largest relative error of S(g, a), a up to {WITHIN:g} (1 + g)",
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


def forms(quick: bool) -> Part:
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
