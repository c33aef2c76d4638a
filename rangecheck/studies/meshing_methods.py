"""The methods that the study of meshing compares: ours, and the engines with all their threads, which ours never give them.

Engines run in a process of their own, which is kept from run to run: the first run of a process is slower, and an engine that crashes
must not take the study with it (open3d's Poisson on all threads does so now and then). They are timed there."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import DependencyMissing
from rangecheck.scan import RangeScan
from rangecheck.study import Timed
from rangecheck.surface.meshing import fuse, pivot
from rangecheck.surface.meshing.engine_tasks import TASKS
from rangecheck.surface.meshing.oriented import oriented_points
from rangecheck.surface.meshing.poisson import BOX_SCALE
from rangecheck.surface.surface import Surface


class _Here:
    """Engines in this process, which is one of their own already, and where what is timed is they alone."""

    def ask(self, task: str, **given: Any) -> dict[str, Any]:
        return TASKS[task](**given)


def open3d_poisson(scans: Sequence[RangeScan], depth: int) -> Surface:
    """open3d's screened Poisson on all threads, its normals included."""
    return _poisson("poisson_open3d", scans, depth, threads=-1)


def meshlab_poisson(scans: Sequence[RangeScan], depth: int) -> Surface:
    """MeshLab's screened Poisson on all threads, the normals included."""
    return _poisson("poisson_meshlab", scans, depth, threads=os.cpu_count() or 1)


def _poisson(task: str, scans: Sequence[RangeScan], depth: int, threads: int) -> Surface:
    points, normals = oriented_points(scans, _Here())
    made = TASKS[task](points, normals, depth, BOX_SCALE, threads)
    return _surface(made["vertices"], made["faces"])


def _surface(vertices: FloatArray, faces: IntArray) -> Surface:
    surface = Surface(np.array(vertices, float), np.asarray(faces).astype(np.int32))
    return surface.with_faces(np.arange(len(surface.faces)))


Method = Callable[[Sequence[RangeScan]], Surface]
#: what foreign methods' names begin with
FOREIGN = "Poisson"
_held: Sequence[RangeScan] = ()


def _hold(scans: Sequence[RangeScan]) -> None:
    global _held
    _held = scans


def _timed(make: Method, scans: Sequence[RangeScan] | None) -> Timed:
    begin = time.perf_counter()
    surface = make(_held if scans is None else scans)
    return Timed((surface.vertices, surface.faces), time.perf_counter() - begin)


class Apart:
    """A process that holds `scans` and runs methods on them; `close` ends it. Where it crashed, the next run has a new one."""

    def __init__(self, scans: Sequence[RangeScan]) -> None:
        self.scans = scans
        self._pool: ProcessPoolExecutor | None = None

    def run(self, make: Method, scans: Sequence[RangeScan] | None = None) -> Timed:
        """The surface of `scans`, else of those held, and the seconds that took; None and nan where the process ended over it.
        Raises DependencyMissing where the method's engine is not installed."""
        if self._pool is None:
            self._pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_hold, initargs=(self.scans,))
        try:
            found = self._pool.submit(_timed, make, scans).result()
        except BrokenProcessPool:
            self.close()
            return Timed(None, math.nan)
        except ImportError as absent:
            engine = absent.name or "an engine"
            raise DependencyMissing(engine, "comparison of meshing methods", "pip install 'rangecheck[engines]'") from None
        return Timed(Surface(*found.result), found.seconds)

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def __enter__(self) -> Apart:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def methods(depths: Sequence[int]) -> dict[tuple[str, str], Method]:
    """Every method that takes several scans, by name and setting."""
    found: dict[tuple[str, str], Method] = {("fuse", ""): fuse}
    for depth in depths:
        found["Poisson, open3d", f"depth {depth}"] = partial(open3d_poisson, depth=depth)
        found["Poisson, MeshLab", f"depth {depth}"] = partial(meshlab_poisson, depth=depth)
    return found | {("pivot", ""): pivot}
