"""What meshing takes: time and memory by the number of points, each in a process of its own, so that peaks do not hide each other."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from rangecheck.studies.bust_scans import bust_ring, sample_scans
from rangecheck.studies.meshing_methods import methods
from rangecheck.study import Line, LineChart, Part, peak_memory_mb

#: share of the cells of a view of the bust that hold a distance
_VALID = 0.183


def alone(work: Callable[..., dict[str, Any]], *arguments: object) -> dict[str, Any]:
    """The result of `work(*arguments)` in a fresh process."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def fused_alone(points: int) -> dict[str, Any]:
    """Fuse about `points` points of the bust twice; how long that took and how much memory the process held, the scans included.

    The first time the system hands out memory as well, which on a virtual machine can take seconds a gigabyte."""
    import resource

    from rangecheck.surface.meshing import fuse

    scans = bust_ring(width=round(math.sqrt(points / (8 * _VALID * 0.75))), in_triangles=True)
    fuse(bust_ring(2, width=64))  # kernels are loaded
    before = peak_memory_mb()
    seconds, system = [], []
    for _ in range(2):
        begin, kernel = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF).ru_stime
        surface = fuse(scans)
        seconds.append(time.perf_counter() - begin)
        system.append(resource.getrusage(resource.RUSAGE_SELF).ru_stime - kernel)
    return {
        "points": sum(int(s.valid.sum()) for s in scans), "seconds": seconds[1], "first_seconds": seconds[0], "system_seconds": system[1],
        "first_system_seconds": system[0], "faces": len(surface.faces), "peak_memory_mb": peak_memory_mb(), "before_mb": before,
    }  # fmt: skip


def growth(quick: bool) -> Part:
    """Fusing more and more points of the same bust, up to five million."""
    ladder = (5_000, 20_000) if quick else (150_000, 500_000, 1_600_000, 5_000_000)
    rows = [alone(fused_alone, points) for points in ladder]
    points, seconds, first = ([float(r[key]) for r in rows] for key in ("points", "seconds", "first_seconds"))
    power, first_power = (float(np.polyfit(np.log(points), np.log(times), 1)[0]) for times in (seconds, first))
    linear = [seconds[-1] * p / points[-1] for p in points]
    chart = LineChart(
        "growth", "Fusing grows with the number of points", "points", "seconds",
        [Line("fuse", points, seconds, marked=True), Line("fuse, memory first handed out", points, first, marked=True),
         Line("in proportion", points, linear)], log="xy",
    )  # fmt: skip
    last = rows[-1]
    findings = [
        f"fusing {last['points']:,} points takes {last['seconds']:.1f} s and at most {last['peak_memory_mb'] / 1000:.2f} GB, the scans and their "
        f"making included; time grows as points^{power:.3f}",
        f"the first time in a process, {last['first_seconds']:.1f} s, of which the system takes {last['first_system_seconds']:.1f} of processors' time, "
        f"mostly to hand out memory: points^{first_power:.3f}",
        *(
            f"  {r['points']:,} points: {1e6 * r['seconds'] / r['points']:.2f} us each, {1e6 * r['first_seconds'] / r['points']:.2f} the first time"
            for r in rows
        ),
    ]
    return Part([chart], findings, {"growth": rows})


def meshed_alone(name: str, setting: str, quick: bool) -> dict[str, Any]:
    """Mesh the sample bust by one method; the memory that this took, beyond the scans and the packages."""
    scans = bust_ring(width=96) if quick else list(sample_scans())
    make = methods((6,) if quick else (8, 9))[name, setting]
    make(bust_ring(3, width=64))
    before = peak_memory_mb()
    make(scans)
    return {"method": name, "setting": setting, "peak_memory_mb": peak_memory_mb(), "added_mb": peak_memory_mb() - before}


def memory(quick: bool) -> Part:
    """Peak memory of every method on the sample bust."""
    wanted = [("fuse", "")] if quick else list(methods((8, 9)))
    rows = [alone(meshed_alone, name, setting, quick) for name, setting in wanted]
    findings = [
        f"memory, {r['method']} {r['setting']}: {r['peak_memory_mb']:.0f} MB, {r['added_mb']:.0f} of them to mesh" for r in rows
    ]
    return Part(findings=findings, tables={"memory": rows})
