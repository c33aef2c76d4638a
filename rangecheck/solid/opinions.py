"""Second opinions on the same bytes: trimesh, MeshLab and manifold3d, each by its own rules, and why they differ.

Rules: rangecheck welds corners whose float32 bits are equal. trimesh merges vertices equal to 8 decimals of the file's unit, drops
faces that closes, and calls a mesh watertight when each edge has two faces, whichever way they run. MeshLab merges equal vertices.
manifold3d takes the welded mesh and asks for two opposite half-edges everywhere. Of faces that cross, MeshLab's test also selects such as
touch without a common corner; rangecheck tells them apart by signs that are exact (surface/intersections.py). Each is asked in a process of its own (judges.py), two
at a time, while the caller goes on. Files are read by trimesh's and MeshLab's own readers, but for binary STL: its records of three
float32 corners leave nothing to interpret, so these are handed over with equal corners welded, as both programs would weld them.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from rangecheck import memory
from rangecheck.arrays import FloatArray
from rangecheck.solid import judges
from rangecheck.solid.findings import Finding, finding
from rangecheck.surface import topology as topo
from rangecheck.surface.surface import Surface
from rangecheck.surface.weld import weld_exactly

#: decimals to which trimesh merges vertices, in the file's unit
TRIMESH_DECIMALS = 8
TIMEOUT_S = 120
#: programs that think at the same time, beside the caller
TOGETHER = 2
#: the error of a program that was given a bound which it passed, and how programs end then, unless by a signal
TOO_LITTLE = "needs more memory than memory_mb leaves for it; a higher memory_mb lets it answer"
#: the error of a program that is not there begins so: judges.py
ABSENT = "not installed"
#: no room for a thread's stack is told as pthread_create's failure, and Python 3.13 may fail to compile a module with no exception set
_STARVED = re.compile("bad_alloc|[Mm]emory|not map|map segment|pthread_create|returned NULL without setting an exception")
_NONE = np.empty(0, np.int64)


@dataclass(frozen=True)
class Opinion:
    """What one program says: whether the mesh is closed (None where it gave no answer), what it counted, and its error if any.

    crossing  (k,) the faces that it says run through others, where it was asked; `faces` is how many it numbers them among."""

    program: str
    closed: bool | None
    facts: Mapping[str, Any] = field(default_factory=dict)
    error: str | None = None
    crossing: tuple[int, ...] = field(default=(), repr=False)
    faces: int = 0

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {"program": self.program, "closed": self.closed, "facts": dict(self.facts), "error": self.error}


class Judges:
    """trimesh, MeshLab and manifold3d, asked and thinking. `answers` waits for them; leaving the context ends whoever still thinks."""

    def __init__(
        self, path: str | Path, surface: Surface, *, records: FloatArray | None = None, intersections: bool = True
    ) -> None:
        """Asks about `surface`, which was read from `path`. Of binary STL, `records` (n, 3) are its vertices as the file has them.

        Where memory is bounded they think one at a time, in what is left; one that finds that too little gives no answer and says so."""
        self._own = Opinion(
            "rangecheck", topo.is_closed(surface), {"vertices": len(surface.vertices), "faces": len(surface.faces)}
        )
        self._folder = tempfile.TemporaryDirectory()
        self._running: list[subprocess.Popen[str]] = []
        self._pool = ThreadPoolExecutor(1 if memory.bounded() else TOGETHER)
        welded = _saved(Path(self._folder.name) / "welded", surface, surface.vertices)
        given = Path(path) if records is None else _saved(Path(self._folder.name) / "records", surface, records)
        meshlab = self._pool.submit(self._ask, "MeshLab", given, intersections)
        others = [self._pool.submit(self._ask, who, source) for who, source in (("trimesh", given), ("manifold3d", welded))]
        self._answers: list[Future[Opinion]] = [others[0], meshlab, others[1]]

    def _ask(self, program: str, source: Path, intersections: bool = False) -> Opinion:
        process = begin(program, source, intersections=intersections)
        self._running.append(process)
        return answer(program, process)

    def answers(self) -> list[Opinion]:
        """Our opinion, then those of trimesh, MeshLab and manifold3d."""
        return [self._own, *(later.result() for later in self._answers)]

    def __enter__(self) -> Judges:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in self._running:
            if process.poll() is None:
                process.kill()
        self._pool.shutdown()
        self._folder.cleanup()


def second_opinions(
    path: str | Path, surface: Surface, *, records: FloatArray | None = None, intersections: bool = True
) -> list[Opinion]:
    """Our opinion of `surface` in mm, which was read from `path`, then those of trimesh, MeshLab and manifold3d."""
    with Judges(path, surface, records=records, intersections=intersections) as judges:
        return judges.answers()


def _saved(folder: Path, surface: Surface, vertices: FloatArray) -> Path:
    folder.mkdir()
    np.save(folder / "vertices.npy", vertices)
    np.save(folder / "faces.npy", surface.faces)
    return folder


def begin(program: str, source: str | Path, *, intersections: bool = False) -> subprocess.Popen[str]:
    """One program's process, begun on a mesh file or a folder of arrays (see judges.py)."""
    command = [
        sys.executable,
        "-P",
        judges.__file__,
        program,
        str(Path(source).resolve()),
        "intersections" if intersections else "-",
    ]
    quiet = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    if memory.bounded():
        command.append(str(memory.left_mb()))
        quiet |= {"MALLOC_ARENA_MAX": "2"}  # each would reserve more than it uses
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=quiet)


def answer(program: str, process: subprocess.Popen[str]) -> Opinion:
    """What the program says, when it is done."""
    try:
        out, errors = process.communicate(timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return Opinion(program, None, error=f"gave no answer in {TIMEOUT_S} s")
    if process.returncode != 0:
        crashed = process.returncode < 0
        how = f"ended by {signal.Signals(-process.returncode).name}" if crashed else f"ended with status {process.returncode}"
        last = how if crashed else (errors.strip().splitlines() or [how])[-1]
        starved = crashed or _STARVED.search(last)
        return Opinion(program, None, error=TOO_LITTLE if memory.bounded() and starved else last[:200])
    said = json.loads(out.strip().splitlines()[-1])
    return Opinion(
        program,
        said.get("closed"),
        said.get("facts", {}),
        TOO_LITTLE if memory.bounded() and _STARVED.search(said.get("error") or "") else said.get("error"),
        tuple(said.get("crossing", ())),
        said.get("faces", 0),
    )


def disagreements(
    surface: Surface,
    opinions: list[Opinion],
    unit_mm: float,
    severities: Mapping[str, str] | None = None,
    judged: Sequence[Finding] = (),
) -> list[Finding]:
    """One finding per program that judges closedness, or which faces cross, otherwise than rangecheck, with the cause as far as it can be
    proved, or that is there and gave no answer. `judged` are rangecheck's findings about the same surface."""
    ours = opinions[0].closed
    found = []
    for other in opinions[1:]:
        found += _about_crossings(surface, other, judged, severities)
        if other.error and not other.error.startswith(ABSENT):
            found.append(finding("no-opinion", 1, f"{other.program} gave no opinion: {other.error}", None, None, severities))
        if other.closed is None or other.closed == ours:
            continue
        cause = _cause(surface, other, unit_mm)
        message = f"{other.program} calls it {'closed' if other.closed else 'not closed'}, rangecheck {'closed' if ours else 'not closed'}: {cause}"
        edges = topo.boundary_edges(surface)
        found.append(
            finding("opinions-differ", 1, message, surface.vertices[edges].mean(axis=1), None, severities, program=other.program)
        )
    return found


def _about_crossings(
    surface: Surface, other: Opinion, judged: Sequence[Finding], severities: Mapping[str, str] | None
) -> list[Finding]:
    """A finding where the other's faces that cross are not ours, with what ours say of those it names."""
    if "self_intersecting_faces" not in other.facts:
        return []
    mine = {f.code: f.faces for f in judged if f.code in ("self-intersections", "overlapping-faces", "touching-faces")}
    cross = np.union1d(mine.get("self-intersections", _NONE), mine.get("overlapping-faces", _NONE))
    count = int(other.facts["self_intersecting_faces"])
    theirs = np.array(other.crossing, np.int64)
    comparable = other.faces == len(surface.faces)
    if np.array_equal(theirs, cross) if comparable else count == len(cross):
        return []
    message = f"{other.program} says {count} faces run through others, rangecheck {len(cross)}"
    touching = mine.get("touching-faces", _NONE)
    places = None
    if comparable:
        more, less = np.setdiff1d(theirs, cross), np.setdiff1d(cross, theirs)
        only = int(np.isin(more, touching).sum())
        if only:
            message += f": {only} of those it names touch others in a point or along a line and go through none, by exact signs"
        if len(more) - only:
            message += f"; {len(more) - only} of those it names meet none by exact signs"
        if len(less):
            message += f"; it does not name {len(less)} that cross or overlap by exact signs"
        places = surface.triangles[np.concatenate([more, less])].mean(axis=1)
    else:
        message += f": it reads {other.faces} faces where there are {len(surface.faces)}"
    return [finding("opinions-differ", 1, message, places, None, severities, program=other.program)]


def _cause(surface: Surface, other: Opinion, unit_mm: float) -> str:
    table = topo.edge_table(surface)
    if other.closed and not len(topo.boundary_edges(surface)) and not len(topo.non_manifold_edges(surface)):
        return f"winding: {len(topo.inconsistent_edges(surface))} edges have two faces that run the same way, which it does not look at"
    rounded = np.round(surface.vertices / unit_mm, TRIMESH_DECIMALS)
    first, number = weld_exactly(rounded)
    faces = number[surface.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    merged = topo.edge_table(faces[whole])
    gone = len(surface.vertices) - len(first)
    if other.closed and gone and len(merged.uses) and (merged.uses % 2 == 0).all():
        return (
            f"merge rule: it merges vertices equal to {TRIMESH_DECIMALS} decimals, which joins {gone} vertices that differ in their "
            f"bits and closes {int((table.uses == 1).sum())} edges"
        )
    flat = topo.degenerate_faces(surface)
    if len(flat):
        kept = np.ones(len(surface.faces), bool)
        kept[flat] = False
        if topo.is_closed(surface.faces[kept]) == other.closed:
            return f"degenerate faces: it leaves out {len(flat)} faces without area"
    if topo.is_closed(surface) and not other.closed:
        return "its reader merges or drops what rangecheck keeps apart"
    if other.closed and len(topo.non_manifold_edges(surface)):
        return f"non-manifold edges: {int((table.uses > 2).sum())} edges have more than two faces, which it pairs up"
    return "its merge rule differs; no single step of ours reproduces it"
