"""Scanned sculptures as truth: the error of every method, and whether the error that a vertex expects is the error it has.

Scans of each sculpture are simulated at three noises; the true error of a vertex is its distance from the sculpture. Of a normal law
68.3 % lie within one standard deviation and 95.4 % within two. Millimetres.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rangecheck.errors import InputError
from rangecheck.studies.bust_scans import Subject, real_data, ring_around, subject_of
from rangecheck.study import Line, LineChart, Part
from rangecheck.surface.distance import SurfaceDistance
from rangecheck.surface.meshing import fuse, pivot, poisson
from rangecheck.surface.surface import MEASURED, Surface

FILES = {"Nefertiti": "nefertiti.obj", "Max Planck": "max_planck.obj", "Laurana": "Laurana50k.ply"}
NOISES_MM = (0.05, 0.2, 0.5)
METHODS: dict[str, Callable[..., Surface]] = {"fuse": fuse, "Poisson": poisson, "pivot": pivot}


def errors_of(surface: Surface, truth: SurfaceDistance) -> dict[str, float]:
    """RMS and median error of the vertices of measured faces, and the shares within one and two expected errors."""
    seen = np.unique(surface.faces[surface.origin_of_face == MEASURED])
    true = truth.distance_mm(surface.vertices[seen])[0]
    row = {"rms_mm": float(np.sqrt(np.mean(true**2))), "median_mm": float(np.median(true)), "counted": float(len(seen))}
    if surface.vertex_error_mm is not None:
        expected = surface.vertex_error_mm[seen]
        row |= {"within_one": float((true <= expected).mean()), "within_two": float((true <= 2 * expected).mean())}
        row["expected_rms_mm"] = float(np.sqrt(np.mean(expected**2)))
    return row


def measured(subject: Subject, truth: SurfaceDistance, noise_mm: float, width: int, names: list[str]) -> list[dict[str, Any]]:
    """A row for each method on eight views of one sculpture."""
    scans = ring_around(subject, views=8, width=width, noise_mm=noise_mm, seed=11)
    return [
        {"bust": subject.name, "noise_mm": noise_mm, "method": name, **errors_of(METHODS[name](scans), truth)} for name in names
    ]


def busts(quick: bool) -> Part:
    """Error table and calibration on three sculptures at three noises."""
    try:
        folder = real_data("busts")
    except InputError as error:
        return Part(findings=[f"busts: not measured; {error}"])
    rows: list[dict[str, Any]] = []
    for name, file in list(FILES.items())[: 1 if quick else 3]:
        subject = subject_of(name, folder / file)
        truth = SurfaceDistance(subject.surface)
        for noise in NOISES_MM[1:2] if quick else NOISES_MM:
            rows += measured(subject, truth, noise, 128 if quick else 320, ["fuse"] if quick else list(METHODS))
    fused = [r for r in rows if r["method"] == "fuse"]
    findings = [
        f"{r['bust']}, noise {r['noise_mm']:g} mm: fuse {r['rms_mm']:.4f} mm RMS; {100 * r['within_one']:.1f} % within one expected error, {100 * r['within_two']:.1f} % within two"
        for r in fused
    ]
    others = [r for r in rows if r["method"] != "fuse"]
    findings += [f"  {r['bust']}, noise {r['noise_mm']:g} mm: {r['method']} {r['rms_mm']:.4f} mm RMS" for r in others]
    kept = sum(abs(r["within_one"] - 0.68) <= 0.05 and abs(r["within_two"] - 0.95) <= 0.03 for r in fused)
    findings.append(f"calibrated (68 +- 5 % and 95 +- 3 %) in {kept} of {len(fused)} cases")
    lines = [
        Line(f"{name}: {words}", [r["noise_mm"] for r in fused if r["bust"] == name], [r[key] for r in fused if r["bust"] == name], marked=True)
        for name in dict.fromkeys(r["bust"] for r in fused) for key, words in (("within_one", "one"), ("within_two", "two"))
    ]  # fmt: skip
    chart = LineChart(
        "busts",
        "Share of vertices within one and two expected errors",
        "noise of a range, mm",
        "share",
        lines,
        log="x",
        level=0.683,
    )
    return Part([chart], findings, {"busts": rows})
