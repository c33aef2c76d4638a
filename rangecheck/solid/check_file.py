"""The complete check of a mesh file: the file, its topology, its geometry, other programs' opinions, and printing where it is solid."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy.typing as npt

from rangecheck import memory
from rangecheck.arrays import mm_per
from rangecheck.solid.engine import needed_mb
from rangecheck.solid.findings import Finding, Verdict, finding, verdict
from rangecheck.solid.opinions import Judges, Opinion, disagreements
from rangecheck.solid.printer import Printer
from rangecheck.solid.printing import UP, check_printing
from rangecheck.solid.shape import shape_findings
from rangecheck.solid.solid import Solid, check_solid, engine_refuses
from rangecheck.surface.edges import forget_edges
from rangecheck.surface.mesh_files import MeshFile, open_mesh

#: faces up to which MeshLab is asked for its own count of faces that cross
MESHLAB_CROSSINGS = 500_000


@dataclass(frozen=True)
class FileCheck:
    """A file's verdict, what was read, and what other programs say of the same bytes."""

    verdict: Verdict
    file: MeshFile
    opinions: tuple[Opinion, ...]


def check_mesh_file(
    path: str | Path,
    unit: str | None = None,
    *,
    opinions: bool = False,
    printer: Printer | None = None,
    up: npt.ArrayLike = UP,
    severities: Mapping[str, str] | None = None,
) -> FileCheck:
    """Everything that can be found out about a mesh file. `opinions` asks trimesh, MeshLab and manifold3d too; with `printer`, a solid is
    also judged for printing as it stands along `up`. Raises InputError for what cannot be read, UnitMissing where the unit is not said."""
    read = open_mesh(path, unit)
    found: list[Finding] = []
    answers: list[Opinion] = []
    takes_mb = needed_mb(len(read.surface.faces))
    fits = takes_mb <= memory.left_mb()
    with ExitStack() as stack:
        # the others think in processes of their own while the surface is judged here, or afterwards where memory is bounded
        judges = stack.enter_context(_asked(path, read)) if opinions and not memory.bounded() else None
        judged = check_solid(read.surface, severities=severities, engine=fits and not opinions)
        facts: dict[str, Any] = dict(judged.facts)
        found += judged.findings
        found += [finding("trailing-bytes", 1, note, severities=severities) for note in read.notes if "bytes follow" in note]
        found += shape_findings(read.surface, severities=severities)
        if opinions:
            if memory.bounded():
                forget_edges(read.surface)
            answers = (judges or stack.enter_context(_asked(path, read))).answers()
    if answers:
        found += disagreements(read.surface, answers, mm_per(read.unit), severities, judged.findings)
        facts["opinions"] = [a.to_dict() for a in answers]
        if facts["closed"] and answers[-1].closed is False:
            found.append(engine_refuses(answers[-1].facts["status"], severities))
        facts["engine_asked"] = answers[-1].closed is not None
    left_out = [] if fits else ["manifold3d"] * (not opinions) + ["printing"] * (printer is not None)
    if left_out:
        words = f"not judged: {' and '.join(left_out)}, which takes about {takes_mb:,.0f} MB, more than memory_mb leaves"
        found.append(finding("left-out", len(left_out), words, severities=severities))
    if printer is not None and judged.fit and fits:
        printed = check_printing(Solid.from_surface(read.surface), printer, up=up, severities=severities)
        found += printed.findings
        facts["printing"] = dict(printed.facts)
    return FileCheck(verdict(found, facts), read, tuple(answers))


def _asked(path: str | Path, read: MeshFile) -> Judges:
    """The others, asked. Faces that cross are found here, exactly; MeshLab counts them too where that costs little beside all else."""
    return Judges(
        path,
        read.surface,
        records=read.file_vertices if read.records else None,
        intersections=len(read.surface.faces) <= MESHLAB_CROSSINGS,
    )
