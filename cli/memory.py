"""A bound on what a command may hold: one that passes it ends, says so in one line, and leaves nothing half-written.

Limits of the system make allocations fail, which the engines inside do not survive: Embree and LLVM end the process as they please; and an
exception thrown into whatever is running is lost in their callbacks. So what the process holds is watched, and past the bound it ends at
once, as if killed: what is finished is kept, and a job goes on where it was.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path

OUT_OF_MEMORY = "out of memory; try a larger meshing.voxel_mm, smaller pictures, or a higher memory_mb where it was set"
#: seconds between two looks
_PERIOD_S = 0.02
_STATM = Path("/proc/self/statm")


def bound_memory(most_mb: float) -> Callable[[], None]:
    """From now on no more than `most_mb` megabytes (10^6 bytes) resident; the function that ends it. Where the system does not tell what is
    held, nothing is bound."""
    ended = threading.Event()
    if _STATM.exists():
        threading.Thread(target=_watch, args=(most_mb, ended), daemon=True).start()
    return ended.set


def held_mb() -> float:
    """What this process holds now, megabytes resident."""
    return int(_STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def _watch(most_mb: float, ended: threading.Event) -> None:
    while not ended.wait(_PERIOD_S):
        if held_mb() > most_mb:
            from rangecheck.files import drop_parts

            drop_parts()
            shown = "\x1b[?25h\n" if sys.stderr.isatty() else ""  # a bar hides the cursor
            print(f"{shown}rangecheck: {OUT_OF_MEMORY}", file=sys.stderr, flush=True)  # noqa: T201
            os._exit(2)
