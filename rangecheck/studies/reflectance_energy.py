"""Where the published lobe gives out more light than it receives, and what masking and bound take from it.

Lengths in micrometres, lambda 0.555; angles from the surface normal.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np

from rangecheck.reflectance import directional_albedo, spike_reflectance
from rangecheck.reflectance.energy import lobe_albedo, visibility_of, visibility_table
from rangecheck.reflectance.lobe import MASKINGS, SMITH, two_numbers
from rangecheck.study import EdgeChart, Line, LineChart, Part, find_edge

GREEN_UM = 0.555
#: surfaces of physics that span mirror to ground metal, sigma and T
SURFACES = ((0.02, 3.0), (0.1, 3.0), (0.2, 3.0), (1.0, 10.0), (2.0, 6.0))


def excess(sigma: float, correlation: float, degrees: float) -> float:
    """By how much the published model gives out more than it receives."""
    surface = {"sigma_um": sigma, "correlation_um": correlation, "wavelength_um": GREEN_UM}
    return float(directional_albedo(math.radians(degrees), masking="none", bounded=False, **surface)) - 1.0


#: by how much an albedo must pass 1 to count: far above the quadrature's 1e-6
_VISIBLE_EXCESS = 1e-3


def _grazing(samples: int) -> tuple[EdgeChart, list[dict[str, Any]]]:
    edges = [
        find_edge(
            f"σ {sigma:g} µm, T {correlation:g} µm",
            partial(excess, sigma, correlation),
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
                partial(excess, sigma, correlation),
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


def grazing(quick: bool) -> Part:
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


def bound(quick: bool) -> Part:
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
