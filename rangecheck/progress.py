"""How long work tells what it does. The library only calls these methods; the command line decides what a person sees."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

#: called once, when the first kernel of this process has to be compiled because none was kept
on_first_compile: Callable[[], None] | None = None


class Reporter:
    """Silent; remembers how long each stage took. The command line's reporter derives from it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.notes: list[str] = []

    @contextmanager
    def stage(self, name: str, total: int = 0) -> Iterator[None]:
        """A named piece of work of `total` steps (0: not known). The time of a stage entered twice adds up."""
        began = time.perf_counter()
        self.begin(name, total)
        try:
            yield
        finally:
            took = time.perf_counter() - began
            self.seconds[name] = self.seconds.get(name, 0.0) + took
            self.end(name, took)

    def note(self, text: str) -> None:
        """A decision and its reason, or a fact a person should know."""
        self.notes.append(text)

    def begin(self, name: str, total: int) -> None:
        """A stage begins."""

    def advance(self, done: int) -> None:
        """So many steps of the running stage are done."""

    def end(self, name: str, seconds: float) -> None:
        """A stage ended."""
