"""Whole commands for studies: each a process of its own, measured from its start to its last byte, or killed on the way.

Its peak memory is the system's word. Killed means SIGKILL: nothing is told of it, nothing can be tidied up.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rangecheck.errors import DependencyMissing, InputError, RangecheckError
from rangecheck.files import presets_folder

#: without any progress for so long, a command is taken to hang
_PATIENCE_S = 600.0


@dataclass(frozen=True)
class Run:
    """A finished command: wall-clock seconds, processor seconds, peak memory, its JSON document."""

    seconds: float
    cpu_seconds: float
    peak_mb: float
    document: dict[str, Any]


def command(*arguments: str, environment: Mapping[str, str] | None = None) -> Run:
    """`rangecheck ARGUMENTS --json -q`, with more variables in its environment, measured. Raises RangecheckError with its last words when it fails."""
    begin = time.perf_counter()
    with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as complaint:
        process = subprocess.Popen(
            command_line(arguments), stdout=said, stderr=complaint, env={**os.environ, **(environment or {})}
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        seconds = time.perf_counter() - begin
        said.seek(0)
        complaint.seek(0)
        if process.returncode not in (0, 1):
            raise _failed(arguments, complaint.read())
        return Run(seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e6, json.loads(said.read()))


def killed_at(arguments: Sequence[str], steps: Callable[[], int], at: int) -> int:
    """The command, killed as soon as `steps()` has reached `at`; how many steps it left done. It may end before that."""
    process = subprocess.Popen(command_line(arguments), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _wait(process, steps, at)
    process.send_signal(signal.SIGKILL)
    process.wait()
    return steps()


def killed_after(arguments: Sequence[str], seconds: float) -> bool:
    """The command, killed after so many seconds; whether it had ended before. Raises RangecheckError when it failed by then."""
    with tempfile.TemporaryFile() as complaint:
        process = subprocess.Popen(command_line(arguments), stdout=subprocess.DEVNULL, stderr=complaint)
        try:
            status = process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            status = process.wait()
        if status not in (0, 1, -signal.SIGKILL):
            complaint.seek(0)
            raise _failed(arguments, complaint.read())
    return status in (0, 1)


def on_cluster_of_two(arguments: Sequence[str], steps: Callable[[], int], at: int) -> int:
    """The command on a dask scheduler with two workers of one thread each, all processes of this machine; one worker is killed as
    soon as `steps()` has reached `at`. How many steps were done by then. Raises DependencyMissing, or RangecheckError when it fails."""
    with cluster(2) as (address, workers):
        process = subprocess.Popen(
            command_line([*arguments, "--scheduler", address]), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        try:
            _wait(process, steps, at)
            workers[0].kill()
            done = steps()
            _wait(process, steps, sys.maxsize)
            process.kill()
            _, complaint = process.communicate()
        finally:
            process.kill()
    if process.returncode not in (0, 1):
        raise _failed(arguments, complaint)
    return done


@contextmanager
def cluster(count: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A dask scheduler on this machine and `count` workers, started by their own commands: its address, and the workers."""
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise DependencyMissing("distributed", "a cluster on this machine", "pip install 'rangecheck[distributed]'") from None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name, ExitStack() as running:

        def start(*line: str) -> subprocess.Popen[bytes]:
            process = subprocess.Popen(
                [sys.executable, "-m", *line], cwd=name, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            running.callback(process.wait)
            running.callback(process.kill)
            return process

        where = Path(name) / "scheduler.json"
        alone = ("--host", "127.0.0.1", "--no-dashboard")
        start("distributed.cli.dask_scheduler", *alone, "--port", "0", "--scheduler-file", str(where))
        deadline = time.monotonic() + _PATIENCE_S
        while not where.is_file() and time.monotonic() < deadline:
            time.sleep(0.05)
        if not where.is_file():
            raise RangecheckError(f"no dask scheduler started within {_PATIENCE_S:g} s; try `dask scheduler`")
        address = str(json.loads(where.read_text())["address"])
        one = ("--nthreads", "1", "--no-nanny", "--local-directory", name)
        yield address, [start("distributed.cli.dask_worker", address, *alone, *one) for _ in range(count)]


def sample_mesh(folder: Path, cell_mm: float | None = None) -> Path:
    """The sample bust as a mesh file in `folder`, meshed of its eight scans, with cells of `cell_mm` where that is said."""
    coarse = () if cell_mm is None else ("--set", f"meshing.voxel_mm={cell_mm:g}")
    command("mesh", str(_sample_scans(folder)), "-o", str(folder / "bust.ply"), *coarse)
    return folder / "bust.ply"


def _sample_scans(folder: Path) -> Path:
    """The shipped scans; where they are not beside the package they are made again, which takes half a minute."""
    try:
        shipped = presets_folder().parent / "sample_data"
    except InputError:
        shipped = folder
    if (shipped / "scans.json").is_file():
        return shipped
    command("sample", "-o", str(folder / "sample"))
    return folder / "sample"


def command_line(arguments: Sequence[str], *, quiet: bool = True) -> list[str]:
    """The command as a process is given it; quiet, with its JSON document."""
    return [sys.executable, "-m", "rangecheck_cli", *arguments, *(("--json", "-q") if quiet else ())]


def _wait(process: subprocess.Popen[bytes], steps: Callable[[], int], at: int) -> None:
    moved, done = time.monotonic(), steps()
    while process.poll() is None and done < at and time.monotonic() < moved + _PATIENCE_S:
        time.sleep(0.01)
        before, done = done, steps()
        if done != before:
            moved = time.monotonic()


def _failed(arguments: Sequence[str], complaint: bytes) -> RangecheckError:
    return RangecheckError(f"rangecheck {arguments[0]} failed: {complaint[-400:].decode(errors='replace').strip()}")
