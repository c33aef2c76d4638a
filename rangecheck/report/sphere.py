"""The coverage sphere as drawing instructions: from which directions scans have samples, where they were taken, and the next view.

Two orthographic halves, from the front (+z) and from behind; x to the right and y up seen from the front. Unit radius, y downwards as in SVG.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import IntArray
from rangecheck.report.content import Coverage

#: counts from here on look alike
MANY = 4
_DECIMALS = 3


@dataclass(frozen=True)
class Mark:
    """Where a scan was taken from, on one half: its number (0 for the next view), name and place."""

    number: int
    name: str
    x: float
    y: float


@dataclass(frozen=True)
class Half:
    """One half: `paths[k]` outlines the directions with samples of k scans (the last: MANY or more)."""

    title: str
    paths: list[str]
    marks: list[Mark]


def halves(found: Coverage) -> list[Half]:
    """Front and back."""
    return [_half(found, "from the front", 0.0), _half(found, "from behind", 180.0)]


def seen_share(counts: IntArray) -> float:
    """Share (0..1) of all directions, by solid angle, in which some scan has a sample."""
    edges = np.sin(np.linspace(math.pi / 2, -math.pi / 2, counts.shape[0] + 1))
    weight = (edges[:-1] - edges[1:]) / 2
    return float((weight * (counts > 0).mean(axis=1)).sum())


def _half(found: Coverage, title: str, towards_deg: float) -> Half:
    rows, columns = found.counts.shape
    kinds = np.minimum(found.counts, MANY)
    paths: list[list[str]] = [[] for _ in range(MANY + 1)]
    first = round((towards_deg - 90.0) / 360.0 * columns)
    for row in range(rows):
        top, bottom = (90.0 - 180.0 * r / rows for r in (row, row + 1))
        here = kinds[row, np.arange(first, first + columns // 2) % columns]
        starts = np.flatnonzero(np.diff(here, prepend=-1))
        for start, end in zip(starts, [*starts[1:], len(here)]):
            left, right = (360.0 * (first + c) / columns for c in (start, end))
            corners = [_project(a, e, towards_deg) for a, e in ((left, top), (right, top), (right, bottom), (left, bottom))]
            paths[here[start]].append("M" + "L".join(f"{x:.{_DECIMALS}f} {y:.{_DECIMALS}f}" for x, y in corners) + "Z")
    seats = [(k + 1, name, azimuth, elevation) for k, (name, azimuth, elevation) in enumerate(found.views)]
    if found.next_view is not None:
        seats.append((0, "next view", *found.next_view))
    marks = [
        Mark(number, name, *_project(azimuth, elevation, towards_deg))
        for number, name, azimuth, elevation in seats
        if math.cos(math.radians(azimuth - towards_deg)) * math.cos(math.radians(elevation)) > -1e-9
    ]
    return Half(title, ["".join(parts) for parts in paths], marks)


def _project(azimuth_deg: float, elevation_deg: float, towards_deg: float) -> tuple[float, float]:
    turned, up = math.radians(azimuth_deg - towards_deg), math.radians(elevation_deg)
    return math.sin(turned) * math.cos(up), -math.sin(up)
