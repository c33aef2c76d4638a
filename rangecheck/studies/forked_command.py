"""A command in processes that have everything loaded, so that hundreds of them can be killed.

One process runs the command once, which imports, compiles and loads all that it needs; then every run is a fork of it: a process of its own,
with its own files, that begins where the command's work begins. SIGKILL strikes it from outside, after so many seconds, or a moment after
so many operations on files: what opens a file to write, renames, removes, and makes folders is counted as it is asked of the system.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

from rangecheck.errors import RangecheckError

_CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link", "os.symlink", "os.chmod")


@dataclass(frozen=True)
class Forked:
    """How a run ended: exit status (-9 where it was killed), seconds it took, operations on files by then, its last words."""

    status: int
    seconds: float
    operations: int
    complaint: str


@dataclass(frozen=True)
class Moment:
    """When a run is killed: after so many seconds, or `then_s` after the operation on files of that number; otherwise never."""

    seconds: float | None = None
    operation: int | None = None
    then_s: float = 0.0


NEVER = Moment()


class ForkedCommand:
    """The command, already loaded; each call of `run` is a process."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def run(self, arguments: Sequence[str], killed: Moment = NEVER) -> Forked:
        """The command to its end, or to that moment. Raises RangecheckError when it fails."""
        assert self._process.stdin is not None and self._process.stdout is not None
        asked = {"arguments": [*arguments], "killed": asdict(killed)}
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise RangecheckError(f"the process that runs are forked from ended with {self._process.wait()}")
        ended = Forked(**json.loads(answer))
        if ended.status not in (0, 1, -signal.SIGKILL):
            raise RangecheckError(f"rangecheck {arguments[0]} ended with {ended.status}: {ended.complaint[-400:]}")
        return ended


@contextmanager
def forked_command(arguments: Sequence[str]) -> Iterator[ForkedCommand]:
    """Runs the command once and keeps what it loaded; what it wrote is the caller's."""
    line = [sys.executable, "-m", __name__]
    with subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        command = ForkedCommand(process)
        try:
            command.run(arguments)
            yield command
        finally:
            assert process.stdin is not None
            process.stdin.close()


def _serve() -> None:
    # what commands print goes nowhere; answers go where standard output went
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    exit_status = importlib.import_module("rangecheck_cli.main").exit_status
    for k, line in enumerate(sys.stdin):
        asked: dict[str, Any] = json.loads(line)
        begin = time.perf_counter()
        if k == 0:
            status, operations, complaint = exit_status([*asked["arguments"], "-q"]), 0, ""
        else:
            status, operations, complaint = _forked(exit_status, asked["arguments"], Moment(**asked["killed"]))
        told = {"status": status, "seconds": time.perf_counter() - begin, "operations": operations, "complaint": complaint}
        answers.write(json.dumps(told) + "\n")
        answers.flush()


def _forked(exit_status: Any, arguments: list[str], killed: Moment) -> tuple[int, int, str]:
    counted, count = os.pipe()
    with tempfile.TemporaryFile() as complaint:
        child = os.fork()
        if child == 0:
            os.dup2(complaint.fileno(), 2)
            os.close(counted)
            sys.addaudithook(lambda event, what: _tell(count, event, what))
            os._exit(exit_status([*arguments, "-q"]))
        os.close(count)
        # a child that is not yet waited for keeps its number, so no other process is ever struck
        timer = threading.Timer(killed.seconds or 0.0, os.kill, (child, signal.SIGKILL))
        if killed.seconds is not None:
            timer.start()
        operations = 0
        while os.read(counted, 1):
            operations += 1
            if operations == killed.operation:
                time.sleep(killed.then_s)
                os.kill(child, signal.SIGKILL)
        os.close(counted)
        if killed.seconds is not None:
            timer.cancel()
            timer.join()
        _, status = os.waitpid(child, 0)
        complaint.seek(0)
        return os.waitstatus_to_exitcode(status), operations, complaint.read().decode(errors="replace")


def _tell(pipe: int, event: str, what: tuple[Any, ...]) -> None:
    if event in _CHANGES or (event == "open" and isinstance(what[2], int) and what[2] & (os.O_WRONLY | os.O_RDWR)):
        os.write(pipe, b".")


if __name__ == "__main__":
    _serve()
