"""Drawing of a study's charts: axes with units, one colour per method, the machine at the foot. Same numbers, same bytes."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Sequence
from typing import Any

from rangecheck.study.charts import Chart, EdgeChart, LineChart, SpeedChart
from rangecheck.study.machine import machine_line
from rangecheck.study.speed import pareto_front

#: Okabe and Ito's eight colours, told apart by nearly everybody; black last
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D1F", "#000000")
_MARKERS = "osD^vPX*"
#: letters of a line of the title, and of the note below it
_TITLE, _NOTE = 90, 118
#: counts up to which each has its tick
_FEW = 12
#: logarithmic axes within these are numbered plainly
_EVERYDAY = (1e-4, 1e5)


def draw(chart: Chart, machine: dict[str, Any], kind: str = "svg") -> bytes:
    """The chart as the bytes of an SVG or PNG picture."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    style: Any = {
        "svg.hashsalt": "rangecheck", "svg.fonttype": "path", "font.family": "DejaVu Sans", "font.size": 9.5, "axes.grid": True,
        "grid.alpha": 0.3, "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False,
    }  # fmt: skip
    with mpl.rc_context(style):
        figure = Figure(figsize=(8.0, 5.2), dpi=120, layout="constrained")
        axes = figure.add_subplot()
        if isinstance(chart, SpeedChart):
            _draw_speed(axes, chart)
        elif isinstance(chart, EdgeChart):
            _draw_edges(axes, chart)
        else:
            _draw_lines(axes, chart)
        note = "\n".join(textwrap.wrap(getattr(chart, "note", ""), _NOTE))
        axes.set_title(textwrap.fill(chart.title, _TITLE), loc="left", fontsize=11, pad=6.0 + 12.0 * len(note.splitlines()))
        axes.annotate(
            note, (0.0, 1.0), xycoords="axes fraction", xytext=(0.0, 4.0), textcoords="offset points", fontsize=8.5, color="0.3"
        )
        figure.supxlabel(machine_line(machine), fontsize=7, color="0.45", x=0.99, ha="right")
        with io.BytesIO() as stream:
            metadata = {"Date": None} if kind == "svg" else {"Software": None}
            figure.savefig(stream, format=kind, metadata=metadata)
            return stream.getvalue()


def _draw_speed(axes: Any, chart: SpeedChart) -> None:
    methods = list(dict.fromkeys(m.method for m in chart.measurements))
    drawn = [m for m in chart.measurements if math.isfinite(m.error)]
    positive = [m.error for m in drawn if m.error > 0]
    floor = 0.3 * min(positive) if positive else 1e-17
    for index, method in enumerate(methods):
        own = [m for m in drawn if m.method == method]
        colour, marker = _COLOURS[index % len(_COLOURS)], _MARKERS[index % len(_MARKERS)]
        x = [chart.times(m)[1] for m in own]
        y = [max(m.error, floor) for m in own]
        spread = [[chart.times(m)[1] - chart.times(m)[0] for m in own], [chart.times(m)[2] - chart.times(m)[1] for m in own]]
        axes.errorbar(x, y, xerr=spread, fmt=marker, color=colour, capsize=2, label=method, linewidth=1)
        for m, px, py in zip(own, x, y):
            if m.setting:
                axes.annotate(m.setting, (px, py), textcoords="offset points", xytext=(6, 5), fontsize=8, color=colour)
    front = pareto_front(chart.measurements)
    axes.step(
        [chart.times(m)[1] for m in front], [max(m.error, floor) for m in front],
        where="post", color="0.5", linewidth=1, linestyle="--", zorder=0, label="not beaten in both",
    )  # fmt: skip
    _scales(axes, "xy")
    axes.set_xlabel(f"time, {chart.time_label} (median; bars are quartiles)")
    axes.set_ylabel(chart.error_label)
    axes.legend(loc="best", fontsize=8.5)


def _draw_edges(axes: Any, chart: EdgeChart) -> None:
    bounds = sorted({edge.bound for edge in chart.edges})
    for index, edge in enumerate(chart.edges):
        colour = _COLOURS[index % len(_COLOURS)]
        words = _edge_label(edge)
        # what cannot be drawn leaves a gap: a line across it would be a claim
        heights = [e if math.isfinite(e) and (e > 0 or "y" not in chart.log) else math.nan for e in edge.errors]
        axes.plot(edge.knobs, heights, color=colour, linewidth=1.5, marker=".", markersize=3, label=words)
        if edge.breaks_at is not None and edge.holds_at is not None:
            axes.plot([edge.breaks_at], [edge.bound], marker="o", color=colour, markersize=6, zorder=5)
    for bound in bounds:
        axes.axhline(bound, color="#b03030", linewidth=1, linestyle="--")
        axes.annotate(
            f"bound {bound:g}",
            (1.0, bound),
            xycoords=("axes fraction", "data"),
            ha="right",
            va="bottom",
            color="#b03030",
            fontsize=8,
        )
    _scales(axes, chart.log)
    axes.set_xlabel(chart.knob_label)
    axes.set_ylabel(chart.error_label)
    axes.legend(loc="best", fontsize=8.5)


def _edge_label(edge: Any) -> str:
    if edge.breaks_at is None:
        return f"{edge.method}: holds throughout"
    if edge.holds_at is None:
        return f"{edge.method}: broken from the start"
    return f"{edge.method}: breaks at {edge.breaks_at:.4g}"


def _draw_lines(axes: Any, chart: LineChart) -> None:
    for index, line in enumerate(chart.lines):
        number = (index if line.colour is None else line.colour) % len(_COLOURS)
        axes.plot(
            line.x, line.y, color=_COLOURS[number], label=line.label, linewidth=1.5, markersize=6 if chart.names else 4,
            marker=_MARKERS[number] if chart.names else "o" if line.marked else None,
            linestyle="none" if chart.names else "--" if line.dashed else "-",
            markerfacecolor="white" if line.dashed else None,
        )  # fmt: skip
    if chart.level is not None:
        axes.axhline(chart.level, color="#b03030", linewidth=1, linestyle="--")
        axes.annotate(
            chart.level_name, (1.0, chart.level), xycoords=("axes fraction", "data"), xytext=(0.0, 2.0), textcoords="offset points",
            ha="right", color="#b03030", fontsize=8,
        )  # fmt: skip
    _scales(axes, chart.log)
    if chart.names:
        axes.set_xticks(range(len(chart.names)), [textwrap.fill(name, 16) for name in chart.names], fontsize=8.5)
        axes.set_xlim(-0.5, len(chart.names) - 0.5)
    elif chart.whole:
        _number_wholly(axes.xaxis, sorted({x for line in chart.lines for x in line.x}))
    axes.set_xlabel(chart.x_label)
    axes.set_ylabel(chart.y_label)
    axes.legend(loc="best", fontsize=8.5)


def _number_wholly(axis: Any, values: Sequence[float]) -> None:
    """Ticks at the counts themselves where they are few, at whole numbers anyway."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

    axis.set_major_locator(FixedLocator(values) if len(values) <= _FEW else MaxNLocator(integer=True))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _scales(axes: Any, log: str) -> None:
    for name, axis in (("x", axes.xaxis), ("y", axes.yaxis)):
        if name in log:
            axes.set(**{f"{name}scale": "log"})
            _number_plainly(axis)


def _number_plainly(axis: Any) -> None:
    """On a logarithmic axis of everyday numbers ticks read 2 and 0.05, not powers of ten; on a short one there are enough of them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    if not _EVERYDAY[0] <= low < high <= _EVERYDAY[1]:
        return
    decades = math.log10(high / low)
    steps = {0.4: (1, 1.1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9), 1.0: (1, 1.5, 2, 3, 4, 5, 6, 8), 2.5: (1, 2, 5)}
    axis.set_major_locator(LogLocator(subs=next((subs for most, subs in steps.items() if decades < most), (1,))))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
