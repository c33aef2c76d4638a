"""What this process and all that it starts may hold, where that was bounded, and how much of it is left.

Bounded once, by whoever runs the process. Results do not depend on it; what does not fit and can be left out - the word of another program - is
left out and said. Megabytes (10^6 bytes), resident; nothing is known where there is no /proc.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

_PROC = Path("/proc")
_most_mb = math.inf


def bound(most_mb: float = math.inf) -> None:
    """From now on no more than this, or without bound."""
    global _most_mb
    _most_mb = most_mb


def bounded() -> bool:
    """Whether there is a bound."""
    return _most_mb < math.inf


def left_mb() -> float:
    """What may still be taken; infinite without bound."""
    return max(_most_mb - held_mb(), 0.0) if bounded() else math.inf


def held_mb(*, with_children: bool = True) -> float:
    """What this process holds now, with or without those that it has started."""
    own = _resident_mb(os.getpid())
    return own + sum(map(_resident_mb, descendants())) if with_children else own


def descendants(pid: int | None = None) -> list[int]:
    """The processes that were started by this one, and by these, that still run."""
    found: list[int] = []
    for task in (_PROC / str(pid or os.getpid()) / "task").glob("*/children"):
        try:
            own = [int(child) for child in task.read_text().split()]
        except OSError:  # the thread has ended
            continue
        found += [below for child in own for below in (child, *descendants(child))]
    return found


def _resident_mb(pid: int) -> float:
    try:
        return int((_PROC / str(pid) / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except (OSError, IndexError):  # ended meanwhile, or no Linux
        return 0.0
