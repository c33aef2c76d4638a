"""The check of a mesh file against other people's programs: time side by side on the same bytes, and how it grows with the number of faces.

The subject is a torus of bumps with seeded noise, closed and without crossings, written as binary STL. Programs that are not installed are
left out. Each is timed from the file to its verdict; other programs, and our check with all opinions, with their start: that is what a
person waits for. Memory is that of all processes of a check together.
"""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.errors import InputError
from rangecheck.export.stl import stl_bytes
from rangecheck.solid.check_file import check_mesh_file
from rangecheck.solid.opinions import answer, begin
from rangecheck.solid.solid import check_solid
from rangecheck.studies.bust_scans import real_data
from rangecheck.study import Candidate, Line, LineChart, SpeedChart, measure
from rangecheck.study.memory import run_watched
from rangecheck.study.parts import Part, study_of_parts
from rangecheck.surface.mesh_files import open_mesh
from rangecheck.surface.surface import Surface

#: faces of the large file
LARGE = 1_310_720


def bumpy_torus(faces: int, seed: int = 1) -> Surface:
    """About that many faces: a ring of 100 mm with a tube of 40 mm, bumps on it, and noise of a twentieth of an edge."""
    around = max(8, round(math.sqrt(faces / 2 * 1.6)))
    along = max(6, round(faces / 2 / around))
    u, v = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.arange(along) * 2 * np.pi / along, indexing="ij")
    edge = 2 * np.pi * 40 / along
    noise = 0.05 * edge * np.random.default_rng(seed).uniform(-1, 1, u.shape)
    tube = 40 + 3 * np.sin(9 * u) * np.cos(5 * v) + np.sin(31 * u + 3 * v) + noise
    ring = 100 + tube * np.cos(v)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), tube * np.sin(v)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(around), np.arange(along), indexing="ij")
    a, b = i * along + j, (i + 1) % around * along + j
    c, d = (i + 1) % around * along + (j + 1) % along, i * along + (j + 1) % along
    both = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return Surface(vertices, both)


def _topology(path: Path) -> bool:
    return check_solid(open_mesh(path, "mm").surface, intersections=False, engine=False).fit


def _crossings(path: Path) -> bool:
    return check_solid(open_mesh(path, "mm").surface, engine=False).fit


def _whole_check(path: Path) -> list[str]:
    """The command as it is typed."""
    return [sys.executable, "-m", "rangecheck_cli", "check", str(path), "--unit", "mm", "--opinions", "--json"]


def _other(program: str, path: Path, intersections: bool = False) -> bool:
    return bool(answer(program, begin(program, path, intersections=intersections)).closed)


def _program(*command: str) -> bool:
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def _programs(path: Path) -> dict[tuple[str, str], Callable[[], bool]]:
    found: dict[tuple[str, str], Callable[[], bool]] = {
        ("rangecheck", "file and topology"): partial(_topology, path),
        ("rangecheck", "and self-intersections"): partial(_crossings, path),
        ("rangecheck", "and all opinions"): partial(_program, *_whole_check(path)),
        ("MeshLab", "its reader, topology, self-intersections"): partial(_other, "MeshLab", path, True),
        ("trimesh", "its reader, topology"): partial(_other, "trimesh", path),
    }
    if shutil.which("admesh"):
        found["admesh", ""] = partial(_program, "admesh", str(path))
    if shutil.which("prusa-slicer"):
        found["prusa-slicer", "--info"] = partial(_program, "prusa-slicer", "--info", str(path))
    return found


def _speed(quick: bool) -> Part:
    """Everybody's verdict on one large file."""
    faces = 20_000 if quick else LARGE
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.stl"
        path.write_bytes(stl_bytes(bumpy_torus(2_000)))
        _crossings(path)  # kernels are loaded before the clock starts
        path.write_bytes(stl_bytes(bumpy_torus(faces)))
        candidates = [Candidate(who, what, judge) for (who, what), judge in _programs(path).items()]
        # an error of 0: it calls the torus sound, as it is
        measured = measure(candidates, lambda sound: 0.0 if sound else 1.0, rounds=1 if quick else 3, warmups=0)
        # watching costs time, so it is not done while the clock runs
        peak = run_watched(_whole_check(path))[1]
    seconds = {(m.method, m.setting): m.seconds for m in measured}
    rows = [{"program": m.method, "asked": m.setting, "seconds": m.seconds, "calls_it_sound": m.error == 0.0} for m in measured]
    said = [f"{m.method} {m.setting}: {m.seconds:.2f} s" + ("" if m.error == 0 else ", calls it unsound") for m in measured]
    if ("admesh", "") in seconds:
        ratio = seconds["rangecheck", "file and topology"] / seconds["admesh", ""]
        said.insert(0, f"file and topology of {faces:,} faces take {ratio:.2f} times admesh's time")
    said.append(f"the check with all opinions and the programs it asks held at most {peak:.0f} MB together")
    chart = SpeedChart("speed", f"Verdict on one file of {faces:,} faces", "1 where it is called unsound", "s", measured)
    return Part([chart], said, {"speed": rows, "memory": [{"peak_memory_mb": peak}]})


def _growth(quick: bool) -> Part:
    """How the check grows with the number of faces."""
    counts = [1_000, 4_000] if quick else [10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000]
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for count in counts:
            path = Path(folder) / f"{count}.stl"
            path.write_bytes(stl_bytes(bumpy_torus(count)))
            candidates = [
                Candidate("topology", "", partial(_topology, path)),
                Candidate("crossings", "", partial(_crossings, path)),
            ]
            # the smallest file warms up for all; small files are quick and noisy, so they are judged more often
            rounds = 1 if quick else max(3, min(25, 1_000_000 // count))
            one, two = measure(candidates, float, rounds=rounds, warmups=1 if count == counts[0] else 0)
            rows.append({"faces": count, "topology_s": one.seconds, "with_crossings_s": two.seconds})
            path.unlink()
    faces = np.array([row["faces"] for row in rows], float)
    law = faces * np.log2(faces)
    said, lines = [], []
    for key, words in (("topology_s", "file and topology"), ("with_crossings_s", "with self-intersections")):
        seconds = np.array([row[key] for row in rows])
        lines.append(Line(words, faces.tolist(), seconds.tolist(), marked=True))
        for first in range(len(faces) - 1) if quick else (0, 2):
            power = float(np.polyfit(np.log(faces[first:]), np.log(seconds[first:] / law[first:]), 1)[0])
            said.append(
                f"{words}: from {faces[first]:,.0f} to {faces[-1]:,.0f} faces the time grows as n log n times n^{power:+.2f}"
            )
    lines.append(Line("n log n, through the last point", faces.tolist(), (law * lines[-1].y[-1] / law[-1]).tolist()))
    chart = LineChart("growth", "Check of a binary STL by its number of faces", "faces", "s", lines, log="xy")
    return Part([chart], said, {"growth": rows})


def _measured(folder: Path) -> dict[str, str]:
    """What trimesh (tm) and MeshLab (ml) were once found to say of each file of the collection, by the file's path."""
    notes = folder / "MEASURED.txt"
    rows = [line.split(maxsplit=1) for line in notes.read_text().splitlines()] if notes.exists() else []
    return {row[0].replace("admesh/block", "admesh_block"): row[1].strip() for row in rows if len(row) == 2}


def _dirty(quick: bool) -> Part:
    """A collection of broken meshes, each as judged here beside what others say, and the cause where they differ; needs real data.

    Of edges with more than two faces the notes count the sides of faces that lie at them: 48 for the 12 edges of not_convex.obj, 4 for the
    one of shared.STL, each with four faces."""
    folder = real_data("dirty")
    noted = _measured(folder)
    rows: list[dict[str, Any]] = []
    for path in sorted(p for p in folder.rglob("*") if p.suffix.lower() in (".stl", ".ply", ".obj")):
        name = path.relative_to(folder).as_posix()
        rows.append({"file": name} | _judged(path, quick) | {"noted": noted.get(name, "")})
    said = [f"{r['file']}: {r['said']}" + (f" [noted: {r['noted']}]" if r["noted"] else "") for r in rows]
    return Part((), said, {"dirty": rows})


def _judged(path: Path, quick: bool) -> dict[str, Any]:
    """One file's verdict in numbers and in one sentence, and why other programs differ."""
    try:
        checked = check_mesh_file(path, "mm", opinions=not quick)
    except InputError as refusal:
        why = refusal.args[0].split(": ", 1)[-1]
        return {"verdict": "refused", "said": f"refused, {why}"}
    verdict = checked.verdict
    count = {f.code: f.count for f in verdict.findings}
    crossing = verdict.get("self-intersections").measured["faces_involved"] if verdict.has("self-intersections") else 0
    row = {
        "verdict": "fit" if verdict.fit else "not fit", "open_edges": count.get("open-edges", 0),
        "non_manifold_edges": count.get("non-manifold-edges", 0), "non_manifold_vertices": count.get("non-manifold-vertices", 0),
        "shells": verdict.facts["shells"], "faces_crossing": crossing, "errors": ", ".join(f.code for f in verdict.errors),
        "differ": "; ".join(f.message for f in verdict.findings if f.code == "opinions-differ"),
    }  # fmt: skip
    numbers = (
        f"{row['verdict']}, open {row['open_edges']}, non-manifold edges {row['non_manifold_edges']} vertices {row['non_manifold_vertices']}, "
        f"shells {row['shells']}, crossing {crossing}"
    )
    theirs = next((o.facts for o in checked.opinions if o.program == "MeshLab" and o.facts), None)
    row["meshlab"] = (
        f"MeshLab: open {theirs['boundary_edges']}, non-manifold edges {theirs['non_two_manifold_edges']} vertices "
        f"{theirs['non_two_manifold_vertices']}, shells {theirs['connected_components_number']}, crossing {theirs['self_intersecting_faces']}"
        if theirs
        else ""
    )
    return row | {"said": "; ".join(filter(None, (numbers, row["errors"], row["differ"], row["meshlab"])))}


_PARTS = {"speed": _speed, "growth": _growth, "dirty": _dirty}
PARTS = tuple(_PARTS)


def study(quick: bool = False, part: str | None = None) -> Any:
    """All parts, or one; `dirty` is made only where it is asked for, because it needs real data."""
    chosen = _PARTS if part else {name: made for name, made in _PARTS.items() if name != "dirty"}
    return study_of_parts("checking", "The check of mesh files beside other programs", chosen)(quick, part)
