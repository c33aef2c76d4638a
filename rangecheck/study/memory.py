"""How much memory a command and all processes that it starts hold together.

Linux counts pages that several processes share once, in equal parts (PSS). Where it cannot be read, the peak is nan.
"""

from __future__ import annotations

import math
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

_PROC = Path("/proc")
#: seconds between two looks
_PERIOD_S = 0.1


def run_watched(command: Sequence[str]) -> tuple[int, float]:
    """Runs a command, its output left aside; its exit status, and the most memory held by it and its descendants, in megabytes (10^6 bytes)."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    peak = math.nan
    while process.poll() is None:
        held = held_mb(process.pid)
        if not math.isnan(held):  # it may have ended meanwhile
            peak = held if math.isnan(peak) else max(peak, held)
        time.sleep(_PERIOD_S)
    return process.returncode, peak


def held_mb(pid: int) -> float:
    """Memory that a process and its descendants hold now, in megabytes; nan where the system does not say."""
    own = _pss_mb(pid)
    below = (held_mb(child) for child in _children(pid))
    return own + sum(x for x in below if not math.isnan(x))


def _pss_mb(pid: int) -> float:
    try:
        lines = (_PROC / str(pid) / "smaps_rollup").read_text().splitlines()
    except OSError:  # ended meanwhile, or no Linux
        return math.nan
    return next((int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("Pss:")), math.nan)


def _children(pid: int) -> list[int]:
    found: list[int] = []
    for task in (_PROC / str(pid) / "task").glob("*/children"):
        try:
            found += map(int, task.read_text().split())
        except OSError:  # the thread has ended
            continue
    return found
