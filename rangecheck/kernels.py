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
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import local
from typing import Any, TypeVar

import numba
from numba.core import caching, config, event

from rangecheck import progress

try:
    import fcntl
except ImportError:  # Windows: two processes may compile the same kernel
    fcntl = None  # type: ignore[assignment]

T = TypeVar("T")
#: after that long another process that still compiles a kernel is no longer waited for
_LONGEST_COMPILE_S = 120.0
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
    """In the user's cache folder, under the name of this package."""

    _cache_path: str

    def get_cache_path(self) -> str:
        path = Path(self._cache_path)  # .../numba/folder_digest
        return str(path.parents[1] / "rangecheck" / path.name)


class _CompiledOnce(caching.FunctionCache):
    """Numba's cache of one kernel, which one process at a time fills: others that need the same wait for it and load what it saved.

    A kernel waits only for kernels that it calls, so no two processes wait for each other."""

    _lock: int | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super().load_overload(sig, target_context)
        if found is None and self._lock is None:
            self._lock = self._locked()
            found = None if self._lock is None else super().load_overload(sig, target_context)
            if found is not None:
                self.release()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        finally:
            self.release()

    def release(self) -> None:
        """Let others go on: the kernel is saved, or could not be compiled."""
        if self._lock is not None:
            self._lock_path.unlink(missing_ok=True)
            os.close(self._lock)
            self._lock = None

    @property
    def _lock_path(self) -> Path:
        return Path(self.cache_path, f"{self._impl.filename_base}.lock")

    def _locked(self) -> int | None:
        """The lock, or None where the file system has none or another process keeps it for longer than a kernel takes."""
        if fcntl is None:
            return None
        try:
            Path(self.cache_path).mkdir(parents=True, exist_ok=True)
            handle = os.open(self._lock_path, os.O_CREAT | os.O_RDWR)
        except OSError:
            return None
        end = time.monotonic() + _LONGEST_COMPILE_S
        while time.monotonic() < end:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return handle
            except BlockingIOError:
                time.sleep(0.02)
            except OSError:
                break
        os.close(handle)
        return None


#: what is installed must leave nothing behind where it was, so that it keeps out of there while it can; a checkout keeps its own
_PLACES: tuple[type[caching._CacheLocator], ...] = (
    (GivenFolder, BesideSource, UserCache)
    if (_PACKAGE.parent / "pyproject.toml").is_file()
    else (GivenFolder, UserCache, BesideSource)
)
_LOCATORS = ",".join(f"{__name__}.{locator.__name__}" for locator in _PLACES)


def _compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    def decorate(function: Callable[..., Any]) -> Any:
        before = config.CACHE_LOCATOR_CLASSES
        config.CACHE_LOCATOR_CLASSES = _LOCATORS
        try:
            made = numba.njit(error_model="numpy", nogil=True, **options)(function)
            if not config.DISABLE_JIT:  # as cache=True would
                made._cache = _CompiledOnce(function)
            return made
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


def cache_folder(compiled: Any) -> Path | None:
    """Where what is compiled of a kernel is kept; None where nothing can be, or nothing is compiled."""
    path = getattr(getattr(compiled, "_cache", None), "cache_path", None)
    return Path(path) if path else None


_threads = 0
_here = local()


class _Compiling(event.Listener):
    """Tells that kernels are being compiled, which takes long and happens once on a machine; unlocks what could not be."""

    def on_start(self, event: event.Event) -> None:
        tell, progress.on_first_compile = progress.on_first_compile, None
        if tell is not None:
            tell()

    def on_end(self, event: event.Event) -> None:
        made = event.data["dispatcher"]
        # numba's `is_failed` says the opposite
        if tuple(event.data["args"]) not in made.overloads and isinstance(made._cache, _CompiledOnce):
            made._cache.release()


event.register("numba:compile", _Compiling())


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
