"""What can be told of a surface's slopes: noise planted and measured, the smallest dent that pictures show in plaster and in steel, and
whether the places that are named on a scanned bust are faults of it."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.analytic.bust import bust_normals
from rangecheck.animation import measure_consistency
from rangecheck.studies.consistency_dents import dent_part
from rangecheck.studies.whole_commands import sample_mesh
from rangecheck.study import Line, LineChart, Part, study_of_parts
from rangecheck.surface import Surface
from rangecheck.surface.mesh_files import read_mesh

PLANTED_DEG = (0.2, 0.5, 1.0, 2.0)
#: a measured slope noise may be off by this share
_SHARE = 0.15
#: facets that are judged for places, and places that are held against the truth: as many as a run names
JUDGED, _NAMED = 40_000, 10


def roughened(surface: Surface, slope_deg: float, seed: int) -> Surface:
    """The surface with independent heights at its vertices, scaled until its facets lean by `slope_deg` RMS."""
    heights = np.random.default_rng(seed).normal(size=len(surface.vertices))[:, None] * surface.vertex_normals
    scale = 1e-3
    for _ in range(12):
        rough = Surface(surface.vertices + scale * heights, surface.faces)
        cosine = np.clip((rough.face_normals * surface.face_normals).sum(axis=1), -1, 1)
        scale *= math.radians(slope_deg) / math.sqrt(float(np.average(np.arccos(cosine) ** 2, weights=surface.face_areas)))
    return rough


def _slopes_part(quick: bool) -> Part:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=5 if quick else 6, radius=50.0)
    surface = Surface(ball.vertices, ball.faces)
    rows, measured = [], []
    for planted in PLANTED_DEG:
        found = measure_consistency(roughened(surface, planted, seed=int(10 * planted)))
        measured.append(found.slope_noise_deg)
        rows.append({"planted_deg": planted, "measured_deg": found.slope_noise_deg, "share": found.slope_noise_deg / planted - 1})
    worst = max(abs(float(row["share"])) for row in rows)
    findings = [
        f"slope noise planted {row['planted_deg']:g} degrees, measured {row['measured_deg']:.3f} ({100 * row['share']:+.1f} %)"
        for row in rows
    ]
    findings.append(f"slope noise is measured within {100 * worst:.1f} % (bar {100 * _SHARE:.0f} %)")
    lines = [Line("measured", PLANTED_DEG, measured, marked=True), Line("planted", PLANTED_DEG, PLANTED_DEG)]
    chart = LineChart(
        "slopes",
        "Slope noise planted in a ball of 50 mm, and measured",
        "planted, degrees",
        "measured, degrees",
        lines,
        log="xy",
    )
    return Part([chart], findings, {"slopes": rows})


def _places_part(quick: bool) -> Part:
    """Whether the places that are named by their slopes on the sample bust are faults of what was meshed: its truth is known."""
    with tempfile.TemporaryDirectory() as name:
        surface = read_mesh(sample_mesh(Path(name), 4.0 if quick else None), "mm")
    found = measure_consistency(surface, most=JUDGED)
    middles = surface.triangles.mean(axis=1)
    off_deg = np.degrees(np.arccos(np.clip((bust_normals(middles) * surface.face_normals).sum(axis=1), -1, 1)))
    usual = float(np.median(off_deg))
    rows: list[dict[str, Any]] = []
    for place in found.places[:_NAMED]:
        here = np.linalg.norm(middles - np.array(place.centre_mm), axis=1) < place.size_mm / 2 + 0.5
        rows.append(
            {
                "centre_mm": place.centre_mm,
                "width_mm": place.size_mm,
                "facets": int(here.sum()),
                "off_deg": float(np.median(off_deg[here])),
            }
        )
    worse = sum(row["off_deg"] > 2 * usual for row in rows)
    findings = [
        f"{len(found.places)} places of the sample bust stand out by their slopes; at {worse} of the first {len(rows)} the median slope of what was meshed is off "
        f"the true bust's by more than twice the {usual:.1f} degrees of all facets, at the median place by {np.median([r['off_deg'] for r in rows] or [0.0]):.1f}"
    ]
    return Part([], findings, {"places": rows})


_PARTS: dict[str, Any] = {"slopes": _slopes_part, "dent": dent_part, "places": _places_part}
PARTS = tuple(_PARTS)
study = study_of_parts("consistency", "Slope noise and dents: what is measured of them, and what pictures show", _PARTS)
