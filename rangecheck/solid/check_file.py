"""The complete check of a mesh file: the file, its topology, its geometry, other programs' opinions, and printing where it is solid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy.typing as npt

from rangecheck.arrays import mm_per
from rangecheck.solid.findings import Finding, Verdict, finding, verdict
from rangecheck.solid.opinions import Opinion, ask_meshlab, disagreements, opinions_with
from rangecheck.solid.printer import Printer
from rangecheck.solid.printing import UP, check_printing
from rangecheck.solid.shape import shape_findings
from rangecheck.solid.solid import Solid, check_solid, engine_refuses
from rangecheck.surface.mesh_files import MeshFile, open_mesh


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
    # MeshLab thinks in a process of its own while the surface is judged here
    asked = ask_meshlab(path) if opinions else None
    judged = check_solid(read.surface, severities=severities, engine=asked is None)
    found: list[Finding] = list(judged.findings)
    facts: dict[str, Any] = dict(judged.facts)
    extra = [note for note in read.notes if "bytes follow" in note]
    if extra:
        found.append(finding("trailing-bytes", 1, extra[0], severities=severities))
    found += shape_findings(read.surface, severities=severities)
    answers: list[Opinion] = []
    if asked is not None:
        answers = opinions_with(asked, path, read.surface)
        found += disagreements(read.surface, answers, mm_per(read.unit), severities)
        facts["opinions"] = [a.to_dict() for a in answers]
        if facts["closed"] and not answers[-1].closed:
            found.append(engine_refuses(answers[-1].facts["status"], severities))
        facts["engine_asked"] = True
    if printer is not None and judged.fit:
        printed = check_printing(Solid.from_surface(read.surface), printer, up=up, severities=severities)
        found += printed.findings
        facts["printing"] = dict(printed.facts)
    return FileCheck(verdict(found, facts), read, tuple(answers))
