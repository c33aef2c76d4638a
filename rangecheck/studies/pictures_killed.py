"""Turntables and data sets that are killed, spread and threaded give the bytes of one undisturbed run.

A turntable shows the sample bust in plaster and steel side by side. It is killed after frames drawn from a seed, each time taken up
again; made on one thread and on two; and on a cluster of two workers of which one is killed midway. `kills` is a small one; `whole-kills`
is that of the printed bars, 72 frames of 720x720, and takes a quarter of an hour. A data set is treated alike. What is compared are the
SHA-256 of the film and every frame, or of every file of the set.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.errors import DependencyMissing
from rangecheck.studies.whole_commands import command, killed_at, on_cluster_of_two, sample_mesh
from rangecheck.study import Part

KILLS = 5
FRAMES, SIZE = 24, 180
WHOLE_FRAMES, WHOLE_SIZE = 72, 720
PICTURES = 60
_SEED = 6
_CELL_MM = 1.5


def digests(files: Sequence[Path], folder: Path) -> dict[str, str]:
    """SHA-256 by name within `folder`."""
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def frames_done(folder: Path) -> int:
    """Frames that the manifests in the folder, and in those within it, know as finished."""
    done = 0
    for manifest in folder.rglob("frames.json"):
        try:
            done += len(json.loads(manifest.read_text())["done"])
        except (OSError, ValueError, KeyError):
            continue
    return done


def _lines(path: Path) -> int:
    try:
        return path.read_bytes().count(b"\n")
    except OSError:
        return 0


class _Turntable:
    """The same turntable again and again, each time in a folder of its own."""

    def __init__(self, mesh: Path, frames: int, size: int) -> None:
        self.what, self.steps = f"film and {2 * frames} frames", 2 * frames
        self._arguments = [
            "turntable", str(mesh), "--unit", "mm", "--material", "plaster", "--material", "steel", "--frames", str(frames),
            "--size", f"{size}x{size}",
        ]  # fmt: skip

    def arguments(self, folder: Path) -> list[str]:
        return [*self._arguments, "-o", str(folder / "turn.mp4")]

    def done(self, folder: Path) -> int:
        return frames_done(folder)

    def content(self, folder: Path) -> dict[str, str]:
        return digests([folder / "turn.mp4", *sorted(folder.rglob("frame_*.png"))], folder)


class _Dataset:
    """The same data set again and again."""

    def __init__(self, mesh: Path, pictures: int) -> None:
        self.what, self.steps = f"all files of {pictures} pictures", pictures
        self._arguments = ["dataset", str(mesh), "--unit", "mm", "--count", str(pictures), "--size", "96x96"]

    def arguments(self, folder: Path) -> list[str]:
        return [*self._arguments, "-o", str(folder / "set")]

    def done(self, folder: Path) -> int:
        return _lines(folder / "set" / "underway.jsonl")

    def content(self, folder: Path) -> dict[str, str]:
        return digests([path for path in sorted((folder / "set").rglob("*")) if path.is_file()], folder)


def _killed(work: _Turntable | _Dataset, kills: int, folder: Path) -> str:
    """Killed at so many random steps, then left to finish."""
    places = sorted(np.random.default_rng(_SEED).choice(np.arange(1, work.steps), kills, replace=False).tolist())
    left = []
    for place in places:
        at = min(max(place, work.done(folder) + 1), work.steps - 1)
        left.append(killed_at(work.arguments(folder), partial(work.done, folder), at))
    command(*work.arguments(folder))
    return f"killed {kills} times, after {', '.join(map(str, left))} of {work.steps}, and taken up again"


def _on_cluster(work: _Turntable | _Dataset, folder: Path) -> str:
    at = on_cluster_of_two(work.arguments(folder), partial(work.done, folder), work.steps // 3)
    return f"on a cluster of two workers, one killed after {at} of {work.steps}"


def _threads(work: _Turntable | _Dataset, count: int, folder: Path) -> str:
    command(*work.arguments(folder), "--threads", str(count))
    return f"on {count} thread{'s'[: count - 1]}"


def _compared(make: Callable[[Path], _Turntable | _Dataset], kills: int, threads: Sequence[int], cell_mm: float | None) -> Part:
    findings: list[str] = []
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        work = make(sample_mesh(folder, cell_mm))
        (folder / "undisturbed").mkdir()
        command(*work.arguments(folder / "undisturbed"))
        undisturbed = work.content(folder / "undisturbed")
        ways: dict[str, Callable[[Path], str]] = {"killed": partial(_killed, work, kills)}
        ways |= {f"{count} threads": partial(_threads, work, count) for count in threads}
        ways["cluster"] = partial(_on_cluster, work)
        for way, disturb in ways.items():
            place = folder / way.replace(" ", "-")
            place.mkdir()
            try:
                said = disturb(place)
            except DependencyMissing as missing:
                rows.append({"way": way, "same": None, "files": 0, "said": str(missing)})
                findings.append(f"{way}: not tried; {missing}")
                continue
            content = work.content(place)
            same = content == undisturbed
            rows.append({"way": way, "same": same, "files": len(content), "said": said})
            findings.append(f"{said}: {work.what} {'the same bytes as undisturbed' if same else 'DIFFER from those undisturbed'}")
    return Part(findings=findings, tables={"kills": rows})


def kills_part(quick: bool) -> Part:
    """A turntable of the sample bust, killed, threaded and spread."""
    frames, size, kills = (5, 48, 1) if quick else (FRAMES, SIZE, KILLS)
    cell = 4.0 if quick else _CELL_MM
    return _compared(lambda mesh: _Turntable(mesh, frames, size), kills, () if quick else (1, 2), cell)


def whole_kills_part(quick: bool) -> Part:
    """The same at the size that people make, of the bust meshed as fine as its scans."""
    if quick:
        return kills_part(True)
    return _compared(lambda mesh: _Turntable(mesh, WHOLE_FRAMES, WHOLE_SIZE), KILLS, (1, 2), None)


def killed_dataset_part(quick: bool) -> Part:
    """A data set of the sample bust, killed, threaded and spread."""
    pictures, kills = (6, 1) if quick else (PICTURES, KILLS)
    cell = 4.0 if quick else _CELL_MM
    return _compared(lambda mesh: _Dataset(mesh, pictures), kills, () if quick else (1, 2), cell)
