"""A small job for tests of the report: a vase, scanned from four sides, made into a part whose bottom nobody saw."""

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from rangecheck_cli.main import exit_status

from rangecheck.export.meshes import write_mesh
from rangecheck.surface import Surface


def vase(around: int = 48, up: int = 40) -> Surface:
    """A closed surface of revolution, 100 mm high."""
    t = np.linspace(0, np.pi, up)[1:-1]
    radius, height = 30 * np.sin(t) * (1 + 0.3 * np.cos(3 * t)), -50 * np.cos(t)
    a = np.linspace(0, 2 * np.pi, around, endpoint=False)
    rings = np.stack([radius[:, None] * np.sin(a), np.repeat(height[:, None], around, 1), radius[:, None] * np.cos(a)], axis=-1)
    vertices = np.concatenate([rings.reshape(-1, 3), [[0, -50, 0], [0, 50, 0]]])
    i, j = np.meshgrid(np.arange(up - 3), np.arange(around), indexing="ij")
    here, beside = i * around + j, i * around + (j + 1) % around
    first, following = np.arange(around), (np.arange(around) + 1) % around
    top = (up - 3) * around
    faces = np.concatenate(
        [
            np.stack([here, beside, beside + around], -1).reshape(-1, 3),
            np.stack([here, beside + around, here + around], -1).reshape(-1, 3),
            np.stack([following, first, np.full(around, len(vertices) - 2)], -1),
            np.stack([top + first, top + following, np.full(around, len(vertices) - 1)], -1),
        ]
    )
    return Surface(vertices, faces.astype(np.int32))


@cache
def job_of_a_vase() -> Path:
    """The finished job, made once; its verdict says no, because nothing invented is allowed in it."""
    folder = Path(tempfile.mkdtemp(prefix="report-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    write_mesh(vase(), folder / "vase.ply")
    simulate = ["simulate", str(folder / "vase.ply"), "--unit", "mm", "--views", "3", "--size", "100x75", "-q"]
    assert exit_status([*simulate, "-o", str(folder / "scans")]) == 0
    run = ["run", str(folder / "scans"), "--out", str(folder / "job"), "--frames", "4", "--size", "96x96", "-q"]
    assert exit_status([*run, "--set", "checking.max_invented_percent=0"]) == 1
    return folder / "job"
