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


def _opinions(path: Path, peaks: list[float]) -> bool:
    """The command as it is typed; the memory it needed is added to `peaks`."""
    status, peak = run_watched(
        [sys.executable, "-m", "rangecheck_cli", "check", str(path), "--unit", "mm", "--opinions", "--json"]
    )
    peaks.append(peak)
    return status == 0


def _other(program: str, path: Path, intersections: bool = False) -> bool:
    return bool(answer(program, begin(program, path, intersections=intersections)).closed)


def _program(path: Path, *command: str) -> bool:
    return subprocess.run([*command, str(path)], capture_output=True, check=False).returncode == 0


def _programs(path: Path, peaks: list[float]) -> dict[tuple[str, str], Callable[[], bool]]:
    found: dict[tuple[str, str], Callable[[], bool]] = {
        ("rangecheck", "file and topology"): partial(_topology, path),
        ("rangecheck", "and self-intersections"): partial(_crossings, path),
        ("rangecheck", "and all opinions"): partial(_opinions, path, peaks),
        ("MeshLab", "its reader, topology, self-intersections"): partial(_other, "MeshLab", path, True),
        ("trimesh", "its reader, topology"): partial(_other, "trimesh", path),
    }
    if shutil.which("admesh"):
        found["admesh", ""] = partial(_program, path, "admesh")
    if shutil.which("prusa-slicer"):
        found["prusa-slicer", "--info"] = partial(_program, path, "prusa-slicer", "--info")
    return found


def _speed(quick: bool) -> Part:
    """Everybody's verdict on one large file."""
    faces = 20_000 if quick else LARGE
    peaks: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.stl"
        path.write_bytes(stl_bytes(bumpy_torus(2_000)))
        _crossings(path)  # kernels are loaded before the clock starts
        path.write_bytes(stl_bytes(bumpy_torus(faces)))
        candidates = [Candidate(who, what, judge) for (who, what), judge in _programs(path, peaks).items()]
        # an error of 0: it calls the torus sound, as it is
        measured = measure(candidates, lambda sound: 0.0 if sound else 1.0, rounds=1 if quick else 3, warmups=0)
    seconds = {(m.method, m.setting): m.seconds for m in measured}
    rows = [{"program": m.method, "asked": m.setting, "seconds": m.seconds, "calls_it_sound": m.error == 0.0} for m in measured]
    said = [f"{m.method} {m.setting}: {m.seconds:.2f} s" + ("" if m.error == 0 else ", calls it unsound") for m in measured]
    if ("admesh", "") in seconds:
        ratio = seconds["rangecheck", "file and topology"] / seconds["admesh", ""]
        said.insert(0, f"file and topology of {faces:,} faces take {ratio:.2f} times admesh's time")
    said.append(f"the check with all opinions and the programs it asks held at most {max(peaks):.0f} MB together")
    chart = SpeedChart("speed", f"Verdict on one file of {faces:,} faces", "1 where it is called unsound", "s", measured)
    return Part([chart], said, {"speed": rows, "memory": [{"peak_memory_mb": peak} for peak in peaks]})


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
            # the smallest file warms up for all
            one, two = measure(candidates, float, rounds=1 if quick else 3, warmups=1 if count == counts[0] else 0)
            rows.append({"faces": count, "topology_s": one.seconds, "with_crossings_s": two.seconds})
            path.unlink()
    faces = np.array([row["faces"] for row in rows], float)
    law = faces * np.log2(faces)
    said, lines = [], []
    for key, words in (("topology_s", "file and topology"), ("with_crossings_s", "with self-intersections")):
        seconds = np.array([row[key] for row in rows])
        lines.append(Line(words, faces.tolist(), seconds.tolist(), marked=True))
        upper = faces >= faces[-1] / 35
        power = float(np.polyfit(np.log(faces[upper]), np.log(seconds[upper] / law[upper]), 1)[0])
        said.append(
            f"{words}: from {faces[upper][0]:,.0f} to {faces[-1]:,.0f} faces the time grows as n log n times n^{power:+.2f}"
        )
    lines.append(Line("n log n, through the last point", faces.tolist(), (law * lines[-1].y[-1] / law[-1]).tolist()))
    chart = LineChart("growth", "Check of a binary STL by its number of faces", "faces", "s", lines, log="xy")
    return Part([chart], said, {"growth": rows})


def _dirty(quick: bool) -> Part:
    """A collection of broken meshes, each as judged here; needs real data."""
    folder = real_data("dirty")
    rows: list[dict[str, Any]] = []
    for path in sorted(p for p in folder.rglob("*") if p.suffix.lower() in (".stl", ".ply", ".obj")):
        row: dict[str, Any] = {"file": str(path.relative_to(folder))}
        try:
            checked = check_mesh_file(path, "mm", opinions=not quick)
        except InputError as refusal:
            rows.append(row | {"verdict": "refused", "why": refusal.args[0].split(": ", 1)[-1]})
            continue
        verdict = checked.verdict
        count = {f.code: f.count for f in verdict.findings}
        crossing = verdict.get("self-intersections").measured["faces_involved"] if verdict.has("self-intersections") else 0
        differ = "; ".join(f.message for f in verdict.findings if f.code == "opinions-differ")
        row |= {
            "verdict": "fit" if verdict.fit else "not fit", "open_edges": count.get("open-edges", 0),
            "non_manifold_edges": count.get("non-manifold-edges", 0), "non_manifold_vertices": count.get("non-manifold-vertices", 0),
            "shells": verdict.facts["shells"], "faces_crossing": crossing, "errors": ", ".join(f.code for f in verdict.errors), "differ": differ,
        }  # fmt: skip
        rows.append(row)
    said = [
        f"{r['file']}: {r['verdict']}"
        + (
            f", {r['why']}" if r["verdict"] == "refused"
            else f", open {r['open_edges']}, non-manifold edges {r['non_manifold_edges']} vertices {r['non_manifold_vertices']}, "
            f"shells {r['shells']}, crossing {r['faces_crossing']}" + (f"; {r['errors']}" if r["errors"] else "") + (f"; {r['differ']}" if r["differ"] else "")
        )
        for r in rows
    ]  # fmt: skip
    return Part((), said, {"dirty": rows})


_PARTS = {"speed": _speed, "growth": _growth, "dirty": _dirty}
PARTS = tuple(_PARTS)


def study(quick: bool = False, part: str | None = None) -> Any:
    """All parts, or one; `dirty` is made only where it is asked for, because it needs real data."""
    chosen = _PARTS if part else {name: made for name, made in _PARTS.items() if name != "dirty"}
    return study_of_parts("checking", "The check of mesh files beside other programs", chosen)(quick, part)
