"""Meshing: every method on the same points in the same run - error, time, memory, closedness - and where each breaks.

Errors are taken against the truth: the bust's own equation, a published mesh of the same object, or the mesh that was scanned. A vertex
counts where a sample lies within two sample spacings of it, for every method alike. Engines (open3d, MeshLab) are timed with their
normals and nothing else, on all threads. Millimetres.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from rangecheck.analytic.bust import bust_distance_mm
from rangecheck.errors import InputError
from rangecheck.scan import RangeScan
from rangecheck.studies.bust_scans import bust_ring, near_samples, real_data, sample_scans
from rangecheck.studies.meshing_busts import busts
from rangecheck.studies.meshing_edges import KNOBS, knob_part
from rangecheck.studies.meshing_growth import growth, memory
from rangecheck.studies.meshing_methods import FOREIGN, Apart, Method, methods
from rangecheck.study import Candidate, Measurement, Part, SpeedChart, measure, study_of_parts
from rangecheck.surface.meshing import grid_mesh
from rangecheck.surface.meshing.oriented import spacing_of
from rangecheck.surface.surface import Surface
from rangecheck.surface.topology import boundary_edges

#: vertices whose distance from the truth is measured: an RMS over as many is known to 0.3 %
MOST_JUDGED = 60_000


def _compared(
    scans: Sequence[RangeScan],
    wanted: dict[tuple[str, str], Method],
    figures_of: Callable[[Surface], dict[str, float]],
    rounds: int,
) -> tuple[list[Measurement], list[dict[str, object]]]:
    """Every method on the same scans in turns, and a row for each; `figures_of` gives its errors, the chart's first.

    What is slow at the first call (packages, kernels) is called before on a few small scans."""
    figures: list[dict[str, float]] = []

    def error_of(surface: Surface | None) -> float:
        if surface is None:
            figures.append({})
            return math.nan
        figures.append(
            figures_of(surface) | {"open_edges": float(len(boundary_edges(surface.faces))), "faces": float(len(surface.faces))}
        )
        return next(iter(figures[-1].values()))

    small, shallow = bust_ring(3, width=64)[: len(scans)], methods((5,))
    candidates = []
    with Apart(scans) as apart:
        for name in sorted({name for name, _ in wanted}):
            first = next(make for key, make in [*shallow.items(), *wanted.items()] if key[0] == name)
            if name.startswith(FOREIGN):
                apart.run(first, small)
            else:
                first(small)
        for (name, setting), make in wanted.items():
            run = partial(apart.run, make) if name.startswith(FOREIGN) else partial(make, scans)
            candidates.append(Candidate(name, setting, run))
        measured = measure(candidates, error_of, rounds=rounds, warmups=0)
    rows: list[dict[str, object]] = [
        {
            "method": m.method,
            "setting": m.setting,
            "seconds": m.seconds,
            "crashed": math.isnan(m.seconds),
            "watertight": f.get("open_edges") == 0,
            **f,
        }
        for m, f in zip(measured, figures)
    ]
    return measured, rows


def _rms(scans: Sequence[RangeScan], within_mm: float, surface: Surface) -> dict[str, float]:
    """Root mean square distance from the true bust of vertices that samples lie near to, evenly taken."""
    some = surface.vertices[:: max(1, len(surface.vertices) // MOST_JUDGED)]
    seen = some[near_samples(some, scans, within_mm)]
    return {"rms_mm": float(np.sqrt(np.mean(bust_distance_mm(seen) ** 2))), "counted": float(len(seen))}


def sample(quick: bool) -> Part:
    """All methods on the eight views of the sample bust; grid, which takes one scan, on the first."""
    scans = bust_ring(width=96) if quick else list(sample_scans())
    within = 2 * spacing_of(scans)
    wanted = methods((6,) if quick else (8, 9))
    if quick:
        wanted = {key: make for key, make in wanted.items() if key[0] != "Poisson, MeshLab"}
    measured, rows = _compared(scans, wanted, partial(_rms, scans, within), 1)
    alone, more = _compared(scans[:1], {("grid", "one view"): lambda s: grid_mesh(s[0])}, partial(_rms, scans[:1], within), 1)
    ours, poissons = measured[0], [m for m in measured if m.method.startswith(FOREIGN) and not math.isnan(m.seconds)]
    best = min(poissons, key=lambda m: m.error, default=None)
    findings = ["sample bust: every Poisson crashed"] if best is None else [
        f"sample bust, {sum(int(s.valid.sum()) for s in scans):,} points: fuse has an RMS of {ours.error:.4f} mm in {ours.seconds:.2f} s; the best "
        f"Poisson ({best.method[9:]}, {best.setting}) {best.error:.4f} mm in {best.seconds:.2f} s: fuse takes {ours.seconds / best.seconds:.2f} of its time"
    ]  # fmt: skip
    return Part([_chart("sample", "Meshing the sample bust: eight views, noise 0.2 mm", "RMS over what was seen, mm", [*measured, *alone])],
                findings + [_said(r) for r in rows + more], {"sample": rows + more})  # fmt: skip


def bunny(quick: bool) -> Part:
    """All methods on the ten scans of the Stanford bunny, against its published mesh."""
    from rangecheck.scan.readers import read_scans
    from rangecheck.surface.distance import SurfaceDistance
    from rangecheck.surface.mesh_files import read_mesh

    try:
        folder = real_data("stanford_bunny")
    except InputError as error:
        return Part(findings=[f"bunny: not measured; {error}"])
    scans = read_scans(folder / "bun.conf", unit="m")
    published = read_mesh(folder / "bun_zipper.ply", "m")
    vertices = published.vertices[np.unique(published.faces)]

    def figures_of(surface: Surface) -> dict[str, float]:
        distance = SurfaceDistance(surface).distance_mm(vertices)[0]
        return {"median_mm": float(np.median(distance)), "p95_mm": float(np.quantile(distance, 0.95))}

    raced = {key: make for key, make in methods((8,)).items() if key[0] in ("fuse", "Poisson, open3d")}
    measured, rows = _compared(scans, raced, figures_of, 1 if quick else 3)
    theirs = measured[1]
    if not quick:
        others = {key: make for key, make in methods((8, 9)).items() if key not in raced}
        more, more_rows = _compared(scans, others, figures_of, 1)
        measured, rows = [*measured, *more], [*rows, *more_rows]
    beside = (
        f"{measured[0].seconds / theirs.seconds:.2f} of the time of"
        if not math.isnan(theirs.seconds)
        else f"{measured[0].seconds:.2f} s, beside a crash of"
    )
    findings = [
        f"bunny: fuse lies {rows[0]['median_mm']:.4f} mm (median) and {rows[0]['p95_mm']:.4f} mm (95 %) from the published vertices, "
        f"in {beside} open3d's Poisson, depth 8"
    ]
    return Part([_chart("bunny", "Meshing the Stanford bunny: ten scans", "median distance of the published vertices, mm", measured)],
                findings + [_said(r) for r in rows], {"bunny": rows})  # fmt: skip


def _said(row: dict[str, object]) -> str:
    if row["crashed"]:
        return f"  {row['method']} {row['setting']}: crashed"
    figures = ", ".join(
        f"{k[:-3].replace('_', ' ')} {v:.4f} mm"
        for k, v in row.items()
        if k.endswith("_mm") and isinstance(v, float) and math.isfinite(v)
    )
    closed = "watertight" if row["watertight"] else f"{row['open_edges']:.0f} open edges"
    return f"  {row['method']} {row['setting']}: {figures}, {row['seconds']:.2f} s, {closed}"


def _chart(slug: str, title: str, error: str, measured: Sequence[Measurement]) -> SpeedChart:
    return SpeedChart(slug, title, error, "seconds, all threads", measured)


_PARTS = {"sample": sample, "bunny": bunny, "memory": memory, "growth": growth, "busts": busts} | {
    knob: knob_part(knob) for knob in KNOBS
}
PARTS = tuple(_PARTS)
study = study_of_parts("meshing", "Meshing methods: speed, accuracy, and where each breaks", _PARTS)
