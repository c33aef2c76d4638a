"""Compiled kernels and the threads that run them.

`kernel` is the one decorator: compiled on first call, cached on disk, without the interpreter lock, and never with fastmath,
which would let the compiler assume that inf and nan do not exist, while here they mean "nothing returned".

Threads come from one place, `in_chunks`: it cuts 0..n into chunks whose size does not depend on the number of threads, so the
same input gives the same bytes on any number of them. Kernels and Embree both release the lock, so plain threads scale, and no
threading layer of numba is ever entered.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import numba

kernel = numba.njit(cache=True, error_model="numpy", nogil=True)
#: the same, but pasted into its callers: for a few lines that are called billions of times
inline_kernel = numba.njit(cache=True, error_model="numpy", nogil=True, inline="always")

#: the same, for kernels that create no arrays: without them numba need not count references, which in a loop over rays that hands
#: arrays to smaller kernels costs more than the work itself
stage_kernel = numba.njit(cache=True, error_model="numpy", nogil=True, _nrt=False)

T = TypeVar("T")
_threads = 0


def thread_count() -> int:
    """Threads that `in_chunks` uses: what `set_threads` said, else the cores this process may run on."""
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


def in_chunks(work: Callable[[int, int], T], n: int, chunk: int) -> list[T]:
    """[work(0, chunk), work(chunk, 2 chunk), ...] over 0..n, in order, on `thread_count()` threads.

    `work` must touch only its own slice of shared arrays. An exception of the first failing chunk is raised."""
    starts = range(0, n, chunk)
    if thread_count() == 1 or len(starts) <= 1:
        return [work(start, min(start + chunk, n)) for start in starts]
    with ThreadPoolExecutor(min(thread_count(), len(starts))) as pool:
        return list(pool.map(lambda start: work(start, min(start + chunk, n)), starts))
