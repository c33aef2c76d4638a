"""A study's outcome: charts of numbers, the numbers themselves, the machine. It is written as SVG, PNG and one JSON document."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rangecheck.files import write_bytes, write_json
from rangecheck.study.charts import Chart, EdgeChart, LineChart, SpeedChart
from rangecheck.study.drawing import draw
from rangecheck.study.machine import describe_machine
from rangecheck.study.speed import pareto_front

SCHEMA = "rangecheck/study/1"


@dataclass(frozen=True)
class Study:
    """`findings` are sentences with numbers; `tables` are lists of rows by name; `pictures` are PNG files by slug."""

    name: str
    title: str
    charts: Sequence[Chart]
    findings: Sequence[str] = ()
    tables: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    machine: dict[str, Any] = field(default_factory=describe_machine)
    pictures: dict[str, bytes] = field(default_factory=dict, repr=False)

    def document(self) -> dict[str, Any]:
        """The study as plain JSON values, with null for what is not a number."""
        return _plain(
            {
                "schema": SCHEMA,
                "name": self.name,
                "title": self.title,
                "machine": self.machine,
                "findings": list(self.findings),
                "charts": [_chart_document(chart) for chart in self.charts],
                "tables": self.tables,
            }
        )


def _chart_document(chart: Chart) -> dict[str, Any]:
    values = asdict(chart)
    if isinstance(chart, SpeedChart):
        front = {(m.method, m.setting) for m in pareto_front(chart.measurements)}
        values["measurements"] = [
            {
                **asdict(m),
                "time": chart.times(m)[1],
                "time_quartiles": [chart.times(m)[0], chart.times(m)[2]],
                "on_front": (m.method, m.setting) in front,
            }
            for m in chart.measurements
        ]
    elif isinstance(chart, EdgeChart):
        for row, edge in zip(values["edges"], chart.edges):
            row["in_words"] = edge.in_words
    kind = {SpeedChart: "speed", EdgeChart: "edge", LineChart: "line"}[type(chart)]
    return {"kind": kind, **values}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_study(study: Study, folder: str | Path, *, force: bool = True) -> list[Path]:
    """Write <name>.json and every chart as <name>-<slug>.svg and .png into `folder`; returns the paths, the JSON first.

    Raises OutputError where the folder cannot be written, or a file exists and `force` is False."""
    folder = Path(folder)
    written = [folder / f"{study.name}.json"]
    write_json(written[0], study.document(), force=force)
    for chart in study.charts:
        for kind in ("svg", "png"):
            path = folder / f"{study.name}-{chart.slug}.{kind}"
            write_bytes(path, draw(chart, study.machine, kind), force=force)
            written.append(path)
    for slug, picture in study.pictures.items():
        written.append(folder / f"{study.name}-{slug}.png")
        write_bytes(written[-1], picture, force=force)
    return written
