"""The folder of a job: one job at a time, resumed when it was stopped, never silently overwritten."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rangecheck.errors import InputError, OutputError
from rangecheck.files import is_part, read_json, sweep_parts, write_json

UNFINISHED = "unfinished.json"
LOCK = ".lock"


def key_of(**content: Any) -> str:
    """Hex digest of everything that determines a result; the same content gives the same key on every machine."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def check_writable(path: str | Path) -> None:
    """Raise OutputError before any work when `path` cannot become a folder or file with content. Creates nothing."""
    path = Path(path)
    existing = path
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if existing != path and not existing.is_dir():
        raise OutputError(path, f"cannot be made because {existing} is a file; choose another place")
    if not os.access(existing, os.W_OK | (os.X_OK if existing.is_dir() else 0)):
        raise OutputError(path, f"cannot be written: {existing} is read-only for you; choose a folder you may write to")


def check_free(path: str | Path, finished: str, *, force: bool) -> None:
    """Raise OutputError when the folder at `path` holds something that a new job would replace and `force` is not given."""
    path = Path(path)
    check_writable(path)
    if path.exists() and not path.is_dir():
        raise OutputError(path, "is a file; the results need a folder")
    # a job that was killed before it could say which it is leaves its lock and a half-written mark, nothing more
    if force or not path.is_dir() or all(one.name == LOCK or is_part(one) for one in path.iterdir()):
        return
    if (path / UNFINISHED).exists():
        return  # stopped on the way, or between its last file and the end: it goes on
    if (path / finished).exists():
        raise OutputError(path, "holds finished results; pass --force to replace them, or choose another folder")
    raise OutputError(path, "is not empty and holds no job of this kind; pass --force, or choose another folder")


@contextmanager
def job_folder(path: str | Path, key: str, finished: str, *, force: bool) -> Iterator[Path]:
    """The folder at `path`, locked against other jobs. While the job runs, `unfinished.json` holds its key; a stopped job of
    the same key goes on. The caller writes `finished` last; then the mark is taken away."""
    path = Path(path)
    check_free(path, finished, force=force)
    with suppress(InputError, AttributeError):
        before = read_json(path / UNFINISHED).get("key")
        if before != key and not force:
            raise OutputError(path, "holds a stopped job with other inputs or settings; pass --force, or choose another folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(path, f"cannot be made ({error.strerror})") from None
    with _lock(path):
        sweep_parts(path)
        write_json(path / UNFINISHED, {"schema": "rangecheck/unfinished/1", "key": key})
        (path / finished).unlink(missing_ok=True)
        yield path
        (path / UNFINISHED).unlink(missing_ok=True)


@contextmanager
def _lock(path: Path) -> Iterator[None]:
    import fcntl

    while True:
        with (path / LOCK).open("w") as handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise OutputError(path, "another job is writing here; wait for it, or choose another folder") from None
            if not _is_still(path / LOCK, handle.fileno()):
                continue  # a job that ended meanwhile has taken its lock away
            try:
                yield
            finally:
                (path / LOCK).unlink(missing_ok=True)
            return


def _is_still(path: Path, handle: int) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False
