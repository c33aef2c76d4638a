"""Turntables and data sets as whole commands: what they cost, and that nothing is lost when they are killed.

Every run is a process of its own, from its start to the last byte of its film; its peak memory is the system's word. Killed means
SIGKILL, at frames drawn from a seed. Bytes are compared by SHA-256 of the film and of every frame.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.errors import DependencyMissing, RangecheckError
from rangecheck.study import Part, study_of_parts

#: what the turntables are held to: seconds from start to film, and megabytes
BARS = {"plaster": 20.0, "steel": 60.0}
MOST_MB = 1500.0
KILLS = 5
_SEED = 6
_PATIENCE_S = 900.0


@dataclass(frozen=True)
class Run:
    """A finished command: wall-clock seconds, processor seconds, peak memory, its JSON document."""

    seconds: float
    cpu_seconds: float
    peak_mb: float
    document: dict[str, Any]


def command(*arguments: str) -> Run:
    """`rangecheck ARGUMENTS --json -q`, measured. Raises RangecheckError with its last words when it fails."""
    begin = time.perf_counter()
    with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as complaint:
        process = subprocess.Popen(_line(*arguments), stdout=said, stderr=complaint)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        seconds = time.perf_counter() - begin
        said.seek(0)
        complaint.seek(0)
        if process.returncode not in (0, 1):
            raise RangecheckError(f"rangecheck {arguments[0]} failed: {complaint.read()[-400:].decode(errors='replace').strip()}")
        return Run(seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e6, json.loads(said.read()))


def _line(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "rangecheck_cli", *arguments, "--json", "-q"]


def sample_mesh(folder: Path, quick: bool) -> Path:
    """The sample bust as a mesh file, meshed of its eight scans (coarsely where `quick`)."""
    command("sample", "-o", str(folder / "sample"))
    coarse = ("--set", "meshing.voxel_mm=4.0") if quick else ()
    command("mesh", str(folder / "sample"), "-o", str(folder / "bust.ply"), *coarse)
    return folder / "bust.ply"


def digests(film: Path, frames: Path) -> dict[str, str]:
    """SHA-256 by name of the film and of every frame."""
    files = [film, *sorted(frames.glob("frame_*"))]
    return {path.name if path != film else "film": hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _turn(mesh: Path, film: Path, material: str, frames: int, size: int) -> list[str]:
    return [
        "turntable", str(mesh), "--unit", "mm", "--material", material, "--frames", str(frames), "--size", f"{size}x{size}", "-o", str(film),
    ]  # fmt: skip


def _turntable_part(quick: bool) -> Part:
    frames, size = (4, 96) if quick else (72, 720)
    rows, findings = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mesh = sample_mesh(folder, quick)
        for material, bar in BARS.items():
            # compiled kernels are kept on disk: the first run of all makes them
            command(*_turn(mesh, folder / f"warm-{material}.mp4", material, 1, 64))
            run = command(*_turn(mesh, folder / f"{material}.mp4", material, frames, size))
            stages = {stage: round(seconds, 3) for stage, seconds in run.document["seconds"].items()}
            rows.append(
                {
                    "material": material, "frames": frames, "size": size, "seconds": run.seconds, "cpu_seconds": run.cpu_seconds,
                    "peak_mb": run.peak_mb, "bar_seconds": bar, "bar_mb": MOST_MB, "stages": stages,
                }
            )  # fmt: skip
            kept = "kept" if run.seconds <= bar and run.peak_mb <= MOST_MB else "missed"
            findings.append(
                f"{material}: {frames} frames of {size}x{size} and their film in {run.seconds:.1f} s from start to end, {run.cpu_seconds:.1f} s of "
                f"processor time, at most {run.peak_mb:.0f} MB (bar {bar:g} s, {MOST_MB:g} MB: {kept})"
            )
    return Part(findings=findings, tables={"turntables": rows})


def _kills_part(quick: bool) -> Part:
    frames, size, kills = (10, 48, 1) if quick else (36, 256, KILLS)
    findings: list[str] = []
    rows: list[dict[str, Any]] = []
    rng = np.random.default_rng(_SEED)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mesh = sample_mesh(folder, quick)
        for material in ("steel",) if quick else tuple(BARS):
            film = folder / f"{material}.mp4"
            command(*_turn(mesh, film, material, frames, size))
            undisturbed = digests(film, _frames_of(film))
            ways: dict[str, Callable[[Path], str]] = {
                "killed": lambda film, m=material: _killed(_turn(mesh, film, m, frames, size), film, kills, frames, rng),  # type: ignore[misc]
                "cluster": lambda film, m=material: _on_cluster(_turn(mesh, film, m, frames, size), film, frames),  # type: ignore[misc]
            }
            for threads in () if quick else ("1", "2"):
                ways[f"{threads} threads"] = partial(
                    _on_threads, partial(_turn, mesh, material=material, frames=frames, size=size), threads
                )
            for way, make in ways.items():
                film = folder / f"{material}-{way.replace(' ', '-')}.mp4"
                try:
                    said = make(film)
                except DependencyMissing as missing:
                    rows.append({"material": material, "way": way, "same": None, "said": str(missing)})
                    findings.append(f"{material}, {way}: not tried; {missing}")
                    continue
                same = digests(film, _frames_of(film)) == undisturbed
                rows.append({"material": material, "way": way, "same": same, "said": said})
                findings.append(f"{material}, {way}{said}: film and {frames} frames {'the same bytes' if same else 'DIFFER'}")
    return Part(findings=findings, tables={"kills": rows})


def _on_threads(arguments: Callable[..., list[str]], threads: str, film: Path) -> str:
    command(*arguments(film=film), "--threads", threads)
    return ""


def _frames_of(film: Path) -> Path:
    return film.with_name(f"{film.stem}-frames")


def _done(film: Path) -> int:
    try:
        return len(json.loads((_frames_of(film) / "frames.json").read_text())["done"])
    except (OSError, ValueError, KeyError):
        return 0


def _wait_for(process: subprocess.Popen[bytes], film: Path, frames: int) -> None:
    """Until so many frames are done, or the process is."""
    deadline = time.monotonic() + _PATIENCE_S
    while process.poll() is None and _done(film) < frames and time.monotonic() < deadline:
        time.sleep(0.002)


def _killed(arguments: Sequence[str], film: Path, kills: int, frames: int, rng: np.random.Generator) -> str:
    """Kill the command when it has made a random number of frames more, so many times; then let it finish."""
    places = []
    for _ in range(kills):
        done = _done(film)
        if done >= frames - 1:
            break
        wanted = int(rng.integers(done + 1, frames))
        process = subprocess.Popen(_line(*arguments), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        _wait_for(process, film, wanted)
        process.send_signal(signal.SIGKILL)
        process.wait()
        places.append(_done(film))
    command(*arguments)
    return f" {len(places)} times, after frames {', '.join(map(str, places))}"


def _on_cluster(arguments: Sequence[str], film: Path, frames: int) -> str:
    """On a scheduler with two workers of one thread each, of which one is killed when a third of the frames is made."""
    try:
        import distributed
    except ImportError:
        raise DependencyMissing("distributed", "a cluster on this machine", "pip install 'rangecheck[distributed]'") from None
    assert distributed
    with tempfile.TemporaryDirectory() as name, ExitStack() as running:

        def start(*line: str) -> subprocess.Popen[bytes]:
            process = subprocess.Popen(
                [sys.executable, "-m", *line], cwd=name, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            running.callback(process.wait)
            running.callback(process.kill)
            return process

        where = Path(name) / "scheduler.json"
        start(
            "distributed.cli.dask_scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            "0",
            "--no-dashboard",
            "--scheduler-file",
            str(where),
        )
        deadline = time.monotonic() + 60
        while not where.is_file() and time.monotonic() < deadline:
            time.sleep(0.05)
        address = json.loads(where.read_text())["address"]
        options = ("--host", "127.0.0.1", "--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", name)
        workers = [start("distributed.cli.dask_worker", address, *options) for _ in range(2)]
        process = subprocess.Popen(_line(*arguments, "--scheduler", address), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        _wait_for(process, film, frames // 3)
        workers[0].kill()
        at = _done(film)
        _, complaint = process.communicate(timeout=_PATIENCE_S)
        if process.returncode != 0:
            raise RangecheckError(f"the turntable on the cluster failed: {complaint[-400:].decode(errors='replace').strip()}")
    return f" of two workers, one killed after frame {at}"


def _dataset_part(quick: bool) -> Part:
    count = 4 if quick else 1000
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mesh = sample_mesh(folder, quick)
        command("dataset", str(mesh), "--unit", "mm", "-o", str(folder / "warm"), "--count", "4")
        run = command("dataset", str(mesh), "--unit", "mm", "-o", str(folder / "set"), "--count", str(count))
        megabytes = sum(path.stat().st_size for path in (folder / "set").rglob("*") if path.is_file()) / 1e6
    wrong = run.document["wrong"]
    finding = (
        f"{count} pictures of 128x128 with their truth in {run.seconds:.1f} s, {run.cpu_seconds:.1f} s of processor time, at most "
        f"{run.peak_mb:.0f} MB, {megabytes:.0f} MB of files; {count - len(wrong)} agree with every truth map (bar 300 s for 1000)"
    )
    row = {"count": count, "seconds": run.seconds, "cpu_seconds": run.cpu_seconds, "peak_mb": run.peak_mb, "wrong": wrong}
    return Part(findings=[finding], tables={"dataset": [row]})


_PARTS = {"turntable": _turntable_part, "kills": _kills_part, "dataset": _dataset_part}
PARTS = tuple(_PARTS)
study = study_of_parts(
    "pictures", "Turntables and data sets: what whole commands cost, and that killing them loses nothing", _PARTS
)
