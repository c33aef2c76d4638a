"""Where meshing methods break, cornered by bisection: noise, lost cells, outliers, coarse steps of range, few views.

A method breaks where its root mean square error over what was seen exceeds twice the noise (what the steps of range add included), or
where its result is no longer watertight. Millimetres.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from rangecheck.analytic.bust import bust_distance_mm
from rangecheck.errors import RangecheckError
from rangecheck.scan import RangeScan
from rangecheck.studies.bust_scans import bust_ring, near_samples
from rangecheck.study import Edge, EdgeChart, Part, find_edge
from rangecheck.surface.meshing import fuse, pivot, poisson
from rangecheck.surface.meshing.oriented import spacing_of
from rangecheck.surface.surface import Surface
from rangecheck.surface.topology import boundary_edges

NOISE_MM = 0.2
#: vertices whose distance from the truth is measured: an RMS over as many is known to 1 %
MOST_JUDGED = 8_000
METHODS: dict[str, Callable[..., Surface]] = {"fuse": fuse, "Poisson": poisson, "pivot": pivot}
#: of the knobs: name, unit, from, to, logarithmic
KNOBS = {
    "noise": ("noise, mm", 0.4, 12.8, True),
    "dropout": ("share of cells lost at random", 0.05, 0.97, False),
    "outliers": ("share of cells that are false", 0.001, 0.3, True),
    "quantisation": ("step of range, mm", 0.05, 25.6, True),
    "views": ("views left out of eight", 0.0, 7.0, False),
}


@lru_cache(maxsize=4)
def scans_at(knob: str, value: float, width: int) -> tuple[tuple[RangeScan, ...], float]:
    """Scans of the bust with one knob turned, and the standard deviation of their errors."""
    match knob:
        case "noise":
            return tuple(bust_ring(width=width, noise_mm=value, step_mm=value / 10)), value
        case "dropout":
            return tuple(bust_ring(width=width, lost_share=value)), NOISE_MM
        case "outliers":
            return tuple(_with_outliers(s, value, k) for k, s in enumerate(bust_ring(width=width))), NOISE_MM
        case "quantisation":
            return tuple(bust_ring(width=width, step_mm=value)), math.hypot(NOISE_MM, value / math.sqrt(12.0))
        case _:
            return tuple(bust_ring(8 - round(value), width=width)), NOISE_MM


def _with_outliers(scan: RangeScan, share: float, seed: int) -> RangeScan:
    """A share of the readings anywhere within the ranges that the scan holds."""
    rng = np.random.default_rng(seed)
    ranges = scan.range_mm.copy()
    false = scan.valid & (rng.random(ranges.shape) < share)
    ranges[false] = rng.uniform(np.nanmin(ranges), np.nanmax(ranges), int(false.sum()))
    return replace(scan, range_mm=ranges)


@lru_cache(maxsize=512)
def outcome(method: str, knob: str, value: float, width: int) -> tuple[float, int]:
    """(RMS error in noises, open edges); infinite and -1 where the method refused."""
    scans, noise = scans_at(knob, value, width)
    try:
        surface = METHODS[method](scans)
    except RangecheckError:
        return math.inf, -1
    some = surface.vertices[:: max(1, len(surface.vertices) // MOST_JUDGED)]
    seen = some[near_samples(some, scans, 2 * spacing_of(scans))]
    rms = float(np.sqrt(np.mean(bust_distance_mm(seen) ** 2))) if len(seen) else math.inf
    return rms / noise, len(boundary_edges(surface.faces))


def knob_part(knob: str) -> Callable[[bool], Part]:
    """The part of the study that turns one knob: where every method breaks, by its error and by its closedness."""
    label, start, stop, logarithmic = KNOBS[knob]

    def part(quick: bool) -> Part:
        width, samples, tolerance = (80, 2, 0.5) if quick else (200, 8 if knob == "views" else 5, 0.08)
        findings, rows = [], []
        found: list[Edge] = []
        for method in ("fuse",) if quick else METHODS:
            limits = ((method, _error, 2.0, "RMS over twice the noise"), (f"{method}, watertight", _open, 0.5, "not watertight"))
            for name, measured, bound, what in limits:
                edge = find_edge(name, partial(measured, method, knob, width), start, stop, bound,
                                 logarithmic=logarithmic, samples=samples, tolerance=tolerance)  # fmt: skip
                found += [edge] if bound == 2.0 else []
                rows.append({"method": method, "limit": what, "holds_at": edge.holds_at, "breaks_at": edge.breaks_at})
                findings.append(f"{method}, {label}: {_in_words(edge, what, start, stop)}")
        chart = EdgeChart(f"edge-{knob}", f"Error of meshing against {label}", label, "RMS over what was seen, in noises", found,
                          log="xy" if logarithmic else "y")  # fmt: skip
        return Part([chart], findings, {f"edges_{knob}": rows})

    return part


def _in_words(edge: Edge, what: str, start: float, stop: float) -> str:
    if edge.breaks_at is None:
        return f"never {what} up to {stop:g}"
    return f"{what} from the start ({start:g})" if edge.holds_at is None else f"{what} at {edge.breaks_at:.3g}"


def _error(method: str, knob: str, width: int, value: float) -> float:
    return outcome(method, knob, value, width)[0]


def _open(method: str, knob: str, width: int, value: float) -> float:
    return abs(float(outcome(method, knob, value, width)[1]))
