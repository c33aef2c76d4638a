"""The kinds of charts a study has: numbers with units, drawn by `drawing`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rangecheck.study.speed import Measurement
from rangecheck.study.stability import Edge


@dataclass(frozen=True)
class SpeedChart:
    """Error against time. `work` divides the seconds (evaluations, rays, pixels ...), `scale` turns them into `time_label`'s unit."""

    slug: str
    title: str
    error_label: str
    time_label: str
    measurements: Sequence[Measurement]
    work: float = 1.0
    scale: float = 1.0

    def times(self, m: Measurement) -> tuple[float, float, float]:
        """(lower quartile, median, upper quartile) in the chart's unit."""
        by = self.scale / self.work
        return m.quartiles[0] * by, m.seconds * by, m.quartiles[1] * by


@dataclass(frozen=True)
class EdgeChart:
    """Error against a knob, with the bound and the edges found. `log` names the logarithmic axes: any of x and y."""

    slug: str
    title: str
    knob_label: str
    error_label: str
    edges: Sequence[Edge]
    log: str = "xy"


@dataclass(frozen=True)
class Line:
    """A named curve; `marked` points are drawn as dots; lines that share a `colour` number belong together, one of them `dashed`."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    marked: bool = False
    dashed: bool = False
    colour: int | None = None


@dataclass(frozen=True)
class LineChart:
    """Curves that belong to neither of the other two kinds. `level` draws a horizontal line at a value that matters, which `level_name` says.

    names: of the cases that stand at x = 0, 1, 2 ..., drawn as points that no line joins;  whole: x counts things;  note: what the reader should know,
    below the title."""

    slug: str
    title: str
    x_label: str
    y_label: str
    lines: Sequence[Line]
    log: str = ""
    level: float | None = None
    names: Sequence[str] = ()
    whole: bool = False
    note: str = ""
    level_name: str = ""


Chart = SpeedChart | EdgeChart | LineChart
