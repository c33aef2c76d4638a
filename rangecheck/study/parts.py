"""A study made of parts that can also run alone; each says how long it took and how much memory the process had used by then."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rangecheck.errors import SettingError
from rangecheck.study.charts import Chart
from rangecheck.study.machine import describe_machine
from rangecheck.study.result import Study


@dataclass(frozen=True)
class Part:
    """What one part of a study found: charts, sentences with numbers, tables of rows by name."""

    charts: Sequence[Chart] = ()
    findings: Sequence[str] = ()
    tables: Mapping[str, list[dict[str, Any]]] = field(default_factory=dict)


def peak_memory_mb() -> float:
    """The most memory that this process has held so far, in megabytes (10^6 bytes)."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def study_of_parts(name: str, title: str, parts: Mapping[str, Callable[[bool], Part]]) -> Callable[..., Study]:
    """`study(quick=False, part=None) -> Study`: all parts in their order, or one; each is called with `quick`.

    The study of one part is called name-part, so that its files stand beside those of the others."""

    def study(quick: bool = False, part: str | None = None) -> Study:
        if part is not None and part not in made:
            raise SettingError(f"the study {name} has no part {part!r}; its parts are {', '.join(made)}", key=part)
        chosen = list(made) if part is None else [part]
        machine = describe_machine()
        charts: list[Chart] = []
        findings: list[str] = []
        tables: dict[str, list[dict[str, Any]]] = {"parts": []}
        for one in chosen:
            begin = time.perf_counter()
            found = made[one](quick)
            charts += found.charts
            findings += found.findings
            tables.update(found.tables)
            seconds = time.perf_counter() - begin
            tables["parts"].append({"part": one, "seconds": seconds, "peak_memory_mb": peak_memory_mb()})
        return Study(name if part is None else f"{name}-{part}", title, charts, findings, tables, machine)

    made = dict(parts)
    return study
