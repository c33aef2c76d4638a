"""Compiled kernels and the threads that run them.

`kernel` is the one decorator: compiled on first call, cached on disk, without the interpreter lock, and never with fastmath,
which would let the compiler assume that inf and nan do not exist, while here they mean "nothing returned". Numba's own cache
looks only at the file that a kernel stands in; a kernel also holds the code of kernels, and the values of constants, that it
imports, so the cache is keyed here by all of these files.

Threads come from one place, `in_chunks`: it cuts 0..n into chunks whose size does not depend on the number of threads, so the
same input gives the same bytes on any number of them. Kernels and Embree both release the lock, so plain threads scale, and no
threading layer of numba is ever entered.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import local
from typing import Any, TypeVar

import numba
from numba.core import caching, config, event

from rangecheck import progress

T = TypeVar("T")
_PACKAGE = Path(__file__).resolve().parent
_IMPORT = re.compile(r"^(?:from (\.*)([\w.]*) import ([^#\n(]+|\([^)]*\))|import (rangecheck[\w.]*))", re.MULTILINE)


def _imported(file: Path, text: str) -> list[Path]:
    """Files of this package that the module in `file` imports at its top."""
    found = []
    for dots, dotted, names, plain in _IMPORT.findall(text):
        path = dotted or plain
        if dots:
            base = file.parents[len(dots) - 1]
        elif path.split(".")[0] == _PACKAGE.name:
            base = _PACKAGE.parent
        else:
            continue
        base = base.joinpath(*filter(None, path.split(".")))
        modules = [base, *(base / name for name in re.findall(r"\w+", names))]
        found += [
            candidate
            for module in modules
            for candidate in (module.with_suffix(".py"), module / "__init__.py")
            if candidate.is_file()
        ]
    return found


@functools.cache
def sources_of(file: Path) -> dict[str, bytes]:
    """Digest by path of every source that a kernel in `file` may hold code or constants of: the file, what it imports from this
    package, and what those import that hold kernels themselves."""
    sources: dict[str, bytes] = {}
    waiting = [(file, True)]
    while waiting:
        current, follow = waiting.pop()
        if str(current) in sources:
            continue
        text = current.read_text(encoding="utf-8")
        sources[str(current)] = hashlib.sha256(text.encode()).digest()
        if follow:
            waiting += [(imported, _holds_kernels(imported)) for imported in _imported(current, text)]
    return sources


@functools.cache
def _holds_kernels(file: Path) -> bool:
    return file.name == "__init__.py" or "kernels import" in file.read_text(encoding="utf-8")


class _ByAllSources:
    """A cache locator of numba whose stamp is that of every source a kernel is made of."""

    _py_file: str

    def get_source_stamp(self) -> str:
        sources = sources_of(Path(self._py_file).resolve())
        return hashlib.sha256(b"".join(sources[path] for path in sorted(sources))).hexdigest()


class GivenFolder(_ByAllSources, caching.UserProvidedCacheLocator):
    """In NUMBA_CACHE_DIR, where that is set."""


class BesideSource(_ByAllSources, caching.InTreeCacheLocator):
    """In __pycache__ beside the source, where that can be written."""


class UserCache(_ByAllSources, caching.UserWideCacheLocator):
    """In the user's cache folder."""


_LOCATORS = ",".join(f"{__name__}.{locator.__name__}" for locator in (GivenFolder, BesideSource, UserCache))


def _compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    def decorate(function: Callable[..., Any]) -> Any:
        before = config.CACHE_LOCATOR_CLASSES
        config.CACHE_LOCATOR_CLASSES = _LOCATORS
        try:
            return numba.njit(cache=True, error_model="numpy", nogil=True, **options)(function)
        except RuntimeError:  # no folder for compiled kernels can be written: every start compiles anew
            return numba.njit(error_model="numpy", nogil=True, **options)(function)
        finally:
            config.CACHE_LOCATOR_CLASSES = before

    return decorate


kernel = _compiled()
#: the same, but pasted into its callers: for a few lines that are called billions of times
inline_kernel = _compiled(inline="always")
#: the same, for kernels that create no arrays: without them numba need not count references, which in a loop over rays that hands
#: arrays to smaller kernels costs more than the work itself
stage_kernel = _compiled(_nrt=False)
#: the same, pasted by the compiler's back end, which costs less to compile: for what would hand whole queues over, ray by ray
pasted_kernel = _compiled(_nrt=False, forceinline=True)

_threads = 0
_here = local()


class _FirstCompile(event.Listener):
    """Tells that kernels are being compiled, which takes long and happens once on a machine."""

    def on_start(self, event: event.Event) -> None:
        tell, progress.on_first_compile = progress.on_first_compile, None
        if tell is not None:
            tell()

    def on_end(self, event: event.Event) -> None:
        pass


event.register("numba:compile", _FirstCompile())


def thread_count() -> int:
    """Threads that `in_chunks` uses: what `set_threads` said, else the cores this process may run on; one where work goes `alone`."""
    if getattr(_here, "alone", False):
        return 1
    return _threads or len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else _threads or os.cpu_count() or 1


def set_threads(count: int) -> None:
    """Use `count` threads from now on; 0 means all cores."""
    global _threads
    _threads = max(0, int(count))


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Within this block, use `count` threads."""
    before = _threads
    set_threads(count)
    try:
        yield
    finally:
        set_threads(before)


@contextmanager
def alone() -> Iterator[None]:
    """Within this block, and of this thread only, use one thread: others do other such work beside it."""
    before = getattr(_here, "alone", False)
    _here.alone = True
    try:
        yield
    finally:
        _here.alone = before


def in_chunks(work: Callable[[int, int], T], n: int, chunk: int) -> list[T]:
    """[work(0, chunk), work(chunk, 2 chunk), ...] over 0..n, in order, on `thread_count()` threads.

    `work` must touch only its own slice of shared arrays. An exception of the first failing chunk is raised."""
    starts = range(0, n, chunk)
    if thread_count() == 1 or len(starts) <= 1:
        return [work(start, min(start + chunk, n)) for start in starts]
    with ThreadPoolExecutor(min(thread_count(), len(starts))) as pool:
        return list(pool.map(lambda start: work(start, min(start + chunk, n)), starts))
