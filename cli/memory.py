"""A bound on what a command may hold: one that passes it ends, says so in one line, and leaves nothing half-written.

Limits of the system make allocations fail, which the engines inside do not survive: Embree and LLVM end the process as they please; and an
exception thrown into whatever is running is lost in their callbacks. So what the process holds, with all that it started, is watched, and past
the bound it ends at once, as if killed: what is finished is kept, and a job goes on where it was.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress

from rangecheck import memory

OUT_OF_MEMORY = "out of memory; try a larger meshing.voxel_mm, smaller pictures, or a higher memory_mb where it was set"
#: seconds between two looks, and looks between two at other processes
_PERIOD_S, _OTHERS = 0.02, 5


def bound_memory(most_mb: float) -> Callable[[], None]:
    """From now on no more than `most_mb` megabytes (10^6 bytes) resident; the function that ends it. Where the system does not tell what is
    held, nothing is bound."""
    ended = threading.Event()
    memory.bound(most_mb)
    threading.Thread(target=_watch, args=(most_mb, ended), daemon=True).start()

    def end() -> None:
        ended.set()
        memory.bound()

    return end


def _watch(most_mb: float, ended: threading.Event) -> None:
    looks, others = 0, 0.0
    while not ended.wait(_PERIOD_S):
        held = memory.held_mb(with_children=False)
        if looks % _OTHERS == 0:
            others = memory.held_mb() - held
        looks += 1
        if held + others > most_mb:
            _end()


def _end() -> None:
    from rangecheck.files import drop_parts

    for process in memory.descendants():
        with suppress(OSError):
            os.kill(process, signal.SIGKILL)
    drop_parts()
    shown = "\x1b[?25h\n" if sys.stderr.isatty() else ""  # a bar hides the cursor
    print(f"{shown}rangecheck: {OUT_OF_MEMORY}", file=sys.stderr, flush=True)  # noqa: T201
    os._exit(2)
