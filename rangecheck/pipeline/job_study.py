"""study job: the whole job's time against the error of the STL it ends with, by preset and by the fineness of its surface.

The scans are the sample bust's, made anew, so that the truth is a function: `bust_distance_mm` of points spread evenly over what was
measured of the finished part.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rangecheck.analytic.bust import bust_distance_mm
from rangecheck.arrays import FloatArray
from rangecheck.config import load_settings
from rangecheck.pipeline.job import run
from rangecheck.pipeline.preparing import prepared
from rangecheck.pipeline.presets import PRESETS
from rangecheck.pipeline.shape import solid_of
from rangecheck.pipeline.subject import eye_of, read_all_scans, surface_of
from rangecheck.progress import Reporter
from rangecheck.scan.sample import make_sample_data
from rangecheck.study import Measurement, Part, SpeedChart, peak_memory_mb, study_of_parts
from rangecheck.surface import MEASURED, Surface
from rangecheck.surface.mesh_files import read_mesh

#: fusion cells in sample spacings
CELLS = (4.0, 3.0, 2.0, 1.5, 1.0, 0.8)
POINTS = 100_000


@dataclass(frozen=True)
class _Error:
    """How far the finished part's measured faces are from the truth, mm."""

    rms: float
    p99: float


def error_of(surface: Surface, seed: int = 0) -> _Error:
    """RMS and 99 % quantile of the distance from the measured faces of a part made of the sample scans to the bust itself."""
    distance = np.abs(bust_distance_mm(_spread(surface, POINTS, seed)))
    return _Error(float(np.sqrt((distance**2).mean())), float(np.quantile(distance, 0.99)))


def _spread(surface: Surface, count: int, seed: int) -> FloatArray:
    """(count, 3) points on measured faces, even by area."""
    standing = np.array([name not in ("base", "back", "skirt") for name in surface.part_names])[surface.part_of_face]
    areas = np.where((surface.origin_of_face == MEASURED) & standing, surface.face_areas, 0.0)
    rng = np.random.default_rng(seed)
    edges = np.cumsum(areas)
    face = np.searchsorted(edges, (np.arange(count) + rng.random(count)) / count * edges[-1])
    u, v = rng.random((2, count))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    a, b, c = np.moveaxis(surface.triangles[np.minimum(face, len(areas) - 1)], 1, 0)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a)


def _cells(quick: bool) -> Part:
    """From scans to a proved solid at several fusion cells; what comes before fusion is done, and timed, once."""
    silent = Reporter()
    with tempfile.TemporaryDirectory() as folder:
        make_sample_data(folder)
        began = time.perf_counter()
        ready = prepared(read_all_scans([folder], None, silent), load_settings(), silent)
        before = time.perf_counter() - began
    rows, measurements = [], []
    for cells in (3.0, 2.0) if quick else CELLS:
        settings = load_settings(None, (), {"meshing.voxel_in_spacings": cells})
        began = time.perf_counter()
        surface, _, _ = surface_of(ready.scans, settings, silent)
        made, _ = solid_of(surface, settings, silent, eye_of(ready.scans))
        took = before + time.perf_counter() - began
        part = surface if made is None else made.surface
        found = error_of(part)
        measurements.append(Measurement("fuse", f"{cells:g}", found.rms, took, (took, took), 1))
        rows.append(
            {
                "cells_in_spacings": cells, "seconds": took, "solid": made is not None, "faces": len(part.faces), "rms_mm": found.rms,
                "p99_mm": found.p99, "peak_memory_mb": peak_memory_mb(),
            }
        )  # fmt: skip
    chart = SpeedChart(
        "cells", "From scans to a solid: cell of fusion in sample spacings", "RMS error of measured faces / mm", "s", measurements
    )
    said = [
        f"cells of {row['cells_in_spacings']:g} spacings: {row['seconds']:.1f} s to {'a solid' if row['solid'] else 'no solid'} of "
        f"{row['faces']:,} faces, RMS {row['rms_mm']:.4f} mm, 99 % within {row['p99_mm']:.3f} mm"
        for row in rows
    ]  # fmt: skip
    return Part([chart], said, {"cells": rows})


def _whole(preset: str) -> Callable[[bool], Part]:
    """The whole job by a preset: time of each stage, and the error of the STL. One preset a part, so that memory is its own."""

    def part(quick: bool) -> Part:
        with tempfile.TemporaryDirectory() as folder:
            scans, out = Path(folder) / "scans", Path(folder) / "out"
            make_sample_data(scans)
            small = {"turntable.frames": 1, "picture.width": 48, "picture.height": 48} if quick else {}
            settings = load_settings(preset, (), small)
            reporter = Reporter()
            began = time.perf_counter()
            done = run([str(scans)], str(out), settings=settings, unit=None, force=False, reporter=reporter)
            took = time.perf_counter() - began
            found = error_of(read_mesh(out / "surface.ply"))
        row = {
            "preset": preset, "seconds": took, "fit": done.fit, "faces": done.document["faces"], "rms_mm": found.rms,
            "p99_mm": found.p99, "peak_memory_mb": peak_memory_mb(), "stages": dict(reporter.seconds),
        }  # fmt: skip
        said = (
            f"{preset}: {took:.1f} s, {row['faces']:,} faces, RMS {found.rms:.4f} mm, 99 % within {found.p99:.3f} mm, "
            f"{row['peak_memory_mb']:.0f} MB"
        )
        return Part((), [said], {preset: [row]})

    return part


PARTS = {"cells": _cells} | {preset: _whole(preset) for preset in PRESETS}
study = study_of_parts("job", "The whole job: time against the error of the STL", PARTS)
