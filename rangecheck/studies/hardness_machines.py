"""The whole job as another machine would do it: the same programs told that this processor is one of 2008, without AVX and fused multiply-adds.

numba, numpy, OpenBLAS, OpenCV and the C library then take other paths, which round otherwise. Embree asks the processor itself, and is not told.
"""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.files import presets_folder
from rangecheck.studies.hardness_jobs import FINISHED
from rangecheck.studies.whole_commands import command
from rangecheck.study import Part

#: what makes them take an old processor's paths
OLDER = {
    "NUMBA_CPU_NAME": "nehalem",
    "NUMBA_CPU_FEATURES": "+sse4.2,+popcnt",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3",
    "OPENBLAS_CORETYPE": "Nehalem",
    "OPENCV_CPU_DISABLE": "AVX,AVX2,FMA3,FP16",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-AVX,-FMA,-FMA4",
}
#: the whole job, with few small pictures
_FEW = ("--frames", "2", "--size", "128x128")
#: a key is the hash of what goes in, transforms to the last digit among it
_NOT_COMPARED = ("seconds", "peak_memory_mb", "key", "sha256")


@dataclass(frozen=True)
class Difference:
    """How a file differs: the largest difference of a number from its like, as a share of the largest number beside it, or inf where
    the files differ in anything that is no number."""

    file: str
    relative: float


def differences(one: Path, other: Path) -> list[Difference]:
    """The files of one job's folder that have other bytes in the other's. report.html tells how long the job took, and is left out."""
    found = []
    for path in sorted(one.rglob("*")):
        name = str(path.relative_to(one))
        if not path.is_file() or path.name.startswith(".") or path.name == "report.html":
            continue
        beside = other / name
        if not beside.is_file() or path.read_bytes() != beside.read_bytes():
            apart = max(_apart(path, beside), default=0.0) if beside.is_file() else np.inf
            if path.name != FINISHED or apart > 0:
                found.append(Difference(name, float(apart)))
    return found


def _apart(one: Path, other: Path) -> Iterator[float]:
    if one.suffix == ".json":
        yield from _of_trees(json.loads(one.read_bytes()), json.loads(other.read_bytes()))
    elif one.suffix == ".npz":
        ours, theirs = (np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) for path in (one, other))
        yield from (_of_trees(dict(ours), dict(theirs)))
    elif one.suffix == ".txt":
        yield from _of_trees(*([_number(word) for word in path.read_text().split()] for path in (one, other)))
    elif one.suffix in (".ply", ".stl"):
        yield from _of_trees(_mesh(one), _mesh(other))
    elif one.suffix == ".png":
        from rangecheck.export.pictures import read_png

        yield from _of_trees(read_png(one), read_png(other))
    else:
        yield np.inf


def _number(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word


def _mesh(path: Path) -> dict[str, Any]:
    from rangecheck.surface.mesh_files import read_mesh

    surface = read_mesh(path, "mm")
    return {"vertices": surface.vertices, "faces": surface.faces, "origin": surface.origin_of_face}


def _of_trees(one: Any, other: Any) -> Iterator[float]:
    """Of numbers beside each other - in one array, or one list of a document - the largest is their measure."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        for key in one:
            if not any(word in key for word in _NOT_COMPARED):
                yield from _of_trees(one[key], other[key])
        return
    numbers = np.ndarray if isinstance(one, np.ndarray) else int | float
    if (
        isinstance(one, list)
        and isinstance(other, list)
        and len(one) == len(other)
        and not all(isinstance(x, int | float) for x in one)
    ):
        for mine, theirs in zip(one, other):
            yield from _of_trees(mine, theirs)
        return
    if isinstance(one, list | numbers) and isinstance(other, list | numbers):
        mine, theirs = np.asarray(one), np.asarray(other)
        if mine.shape == theirs.shape and mine.dtype.kind in "biuf" and theirs.dtype.kind in "biuf":
            if not np.array_equal(mine, theirs, equal_nan=True):
                mine, theirs = mine.astype(float), theirs.astype(float)
                both = np.isfinite(mine) & np.isfinite(theirs)
                apart = float(np.max(np.abs(mine - theirs)[both], initial=0.0))
                same_gaps = np.array_equal(np.where(both, 0.0, mine), np.where(both, 0.0, theirs), equal_nan=True)
                yield apart / float(np.max(np.abs(mine)[both], initial=1e-300)) if same_gaps else np.inf
            return
    if isinstance(one, np.ndarray) and one.dtype.kind == "U":
        one, other = str(one), str(other)
    if isinstance(one, str) and isinstance(other, str) and one.startswith("{"):
        yield from _of_trees(json.loads(one), json.loads(other))
    elif one != other:
        yield np.inf


def machines_part(quick: bool) -> Part:
    """The sample job, by this machine's and by an older machine's arithmetic."""
    few = (*_FEW, "--preset", "quick") if quick else _FEW
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sample = str(presets_folder().parent / "sample_data")
        command("run", sample, "--out", str(folder / "here"), *few)
        command("run", sample, "--out", str(folder / "there"), *few, environment=OLDER)
        apart = differences(folder / "here", folder / "there")
        files = sum(path.is_file() and not path.name.startswith(".") for path in (folder / "here").rglob("*"))
    largest = max(apart, key=lambda one: one.relative, default=Difference("none", 0.0))
    alike = {one.file for one in apart if one.relative == 0}
    films = [name for name in ("plaster.mp4", "steel.mp4", "stripes.mp4") if name not in {one.file for one in apart}]
    finding = (
        f"without AVX and fused multiply-adds {files - len(apart)} of {files} files of the sample job have the same bytes ({len(films)} of 3 films "
        f"among them), {len(alike)} the same numbers{' (bust.stl too)' if 'bust.stl' in alike else ''}; "
        f"numbers in the others differ by at most {largest.relative:.1e} of the largest beside them ({largest.file})"
    )
    return Part(findings=[finding], tables={"machines": [{"file": one.file, "relative": one.relative} for one in apart]})
