"""What a measurement ran on, so that a number of nanoseconds means something elsewhere."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

from rangecheck.kernels import thread_count

_PACKAGES = ("numpy", "scipy", "numba", "embreex", "trimesh", "manifold3d", "open3d", "pymeshlab", "mitsuba")


def describe_machine() -> dict[str, Any]:
    """Processor, cores, memory, versions and how busy the machine is; values that cannot be had are None."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": thread_count(),
        "memory_gib": _memory_gib(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: version for name in _PACKAGES if (version := _version(name))},
        "load_average_1min": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
    }


def machine_line(machine: dict[str, Any]) -> str:
    """One line for the foot of a chart."""
    load = machine.get("load_average_1min")
    busy = f", load {load:g} at the start" if load is not None else ""
    return f"{machine['processor']}, {machine['cores']} cores, Python {machine['python']}{busy}"


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, ValueError, OSError):
        return None


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
