"""A film that is encoded while its frames are still being made."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy.typing as npt

from rangecheck.export.video import write_film


class _Abandoned(Exception):
    """The frames will not come."""


class Filming:
    """Used with `with`: the film `path` of pictures picture(0) .. picture(frames - 1), each asked for as soon as `stands` has been told that
    it can be had. The block's end waits for the film, and raises what kept it from being written; where the block fails there is no film."""

    def __init__(self, path: Path, fps: float, frames: int, picture: Callable[[int], npt.NDArray[Any]]) -> None:
        self._path, self._fps, self._frames, self._picture = path, fps, frames, picture
        self._standing: set[int] = set()
        self._news = threading.Condition()
        self._abandoned = False

    def stands(self, index: int) -> None:
        """Picture `index` can be had now. Any thread may say so."""
        with self._news:
            self._standing.add(index)
            self._news.notify_all()

    def finish(self) -> None:
        """Wait for the film."""
        self._writing.result()

    def __enter__(self) -> Filming:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="filming")
        self._writing = self._thread.submit(write_film, self._pictures(), self._path, self._fps)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        with self._news:
            self._abandoned = kind is not None
            self._news.notify_all()
        self._thread.shutdown(wait=True)
        if kind is None:
            self._writing.result()

    def _pictures(self) -> Iterator[npt.NDArray[Any]]:
        for index in range(self._frames):
            with self._news:
                while index not in self._standing and not self._abandoned:
                    self._news.wait()
                if self._abandoned:
                    raise _Abandoned
            yield self._picture(index)
