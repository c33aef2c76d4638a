"""The lobe: what each form costs and how wrong it is, where it breaks, and what masking and bound change of the published model."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from rangecheck.reflectance.fast import FAST_ERROR, lobe_fast, lobe_table
from rangecheck.reflectance.series import lobe_rough, lobe_series, lobe_smooth
from rangecheck.studies import reflectance_energy, reflectance_forms
from rangecheck.study import Edge, EdgeChart, Part, find_edge, study_of_parts


def largest_error(form: Callable[[float, float], float], within: float, g: float) -> float:
    """Of a form against the series at one g, over a from 0 to `within` times (1 + g)."""
    return max(abs(form(g, a) / lobe_series(g, a) - 1.0) for a in np.linspace(0.0, within * (1.0 + g), 17))


def _limits(samples: int) -> list[EdgeChart]:
    table = lobe_table()

    def fast(g: float, a: float) -> float:
        return lobe_fast(table, g, a)

    edges: list[Edge] = []
    for words, within in (("mirror direction", 0.0), ("within 1 width", 1.0), ("within 2 widths", reflectance_forms.WITHIN)):
        for name, form, start, stop in (("smooth (6)", lobe_smooth, 1e-8, 1e4), ("rough (7)", lobe_rough, 1e6, 1e-4)):
            edges.append(
                find_edge(
                    f"{name}, {words}",
                    partial(largest_error, form, within),
                    start, stop, 0.01, logarithmic=True, samples=samples,
                )
            )  # fmt: skip
    edges.sort(key=lambda edge: edge.method.startswith("rough"))
    whole = find_edge(
        "fast, to e^-30", partial(largest_error, fast, 30.0), 1e-12, 1e8, FAST_ERROR, logarithmic=True, samples=4 * samples
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


def limits(quick: bool) -> Part:
    charts = _limits(25 if quick else 81)
    return Part(charts, [edge.in_words for chart in charts for edge in chart.edges])


_PARTS = {
    "forms": reflectance_forms.forms,
    "limits": limits,
    "grazing": reflectance_energy.grazing,
    "bound": reflectance_energy.bound,
}
PARTS = tuple(_PARTS)
study = study_of_parts("reflectance", "Forms of the specular lobe: speed, accuracy, and where each breaks", _PARTS)
