"""Engines that make surfaces of points, in a process of their own: what crashes there takes neither the job nor its folder with it.

An engine that ends by a signal is asked once more, in a new process, and the same question has the same bytes as answer; ending again it is an
error that names the engine, the signal and the other way to go."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import numpy as np

from rangecheck import memory
from rangecheck.errors import DependencyMissing, SurfaceError
from rangecheck.surface.meshing import engine_tasks

#: times that a process may end over one question
TRIES = 2
_INSTEAD = {
    "open3d": "set meshing.poisson_engine=pymeshlab, or another meshing.method",
    "pymeshlab": "set meshing.poisson_engine=open3d, or another meshing.method",
}


class Asked(Protocol):
    """What answers the tasks of engine_tasks.py."""

    def ask(self, task: str, **given: Any) -> dict[str, Any]: ...


class Engine:
    """open3d or pymeshlab, asked in a process that starts with the first question and ends with the context."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._process: subprocess.Popen[str] | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._how = ""

    def ask(self, task: str, **given: Any) -> dict[str, Any]:
        """What a task of engine_tasks.py answers. Raises DependencyMissing without the engine, SurfaceError where it fails or ends."""
        for _ in range(TRIES):
            said = self._said(task, given)
            if said is not None:
                break
        else:
            more = ", or allow it more memory_mb" if memory.bounded() else ""
            raise SurfaceError(f"{self.name} ended {TRIES} times over these points, {self._how}; {_INSTEAD[self.name]}{more}")
        if "absent" in said:
            raise DependencyMissing(
                f"{self.name} ({said['absent']})", "Poisson meshing and ball pivoting", "pip install 'rangecheck[engines]'"
            )
        if "error" in said:
            raise SurfaceError(f"{self.name} could not mesh these points ({said['error']}); {_INSTEAD[self.name]}")
        with np.load(self._place / "out.npz", allow_pickle=False) as made:
            return {name: made[name] for name in made.files}

    def _said(self, task: str, given: dict[str, Any]) -> dict[str, str] | None:
        if self._process is None:
            self._process = self._begin()
        np.savez(self._place / "in.npz", allow_pickle=False, **given)
        process = self._process
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(f"{task}\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if line:
            said: dict[str, str] = json.loads(line)
            return said
        status = process.wait()
        self._how = f"by {signal.Signals(-status).name}" if status < 0 else f"with status {status}"
        self._process = None
        process.stdin.close()
        process.stdout.close()
        return None

    @property
    def _place(self) -> Path:
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory()
        return Path(self._folder.name)

    def _begin(self) -> subprocess.Popen[str]:
        command = [sys.executable, "-P", engine_tasks.__file__, str(self._place)]
        settings = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
        if memory.bounded():
            command.append(str(memory.left_mb()))
            settings |= {"MALLOC_ARENA_MAX": "2"}  # each would reserve more than it uses
        return subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=settings
        )

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
        if self._folder is not None:
            self._folder.cleanup()
