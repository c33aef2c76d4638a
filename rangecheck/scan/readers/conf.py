"""Stanford `.conf` files: which range scans make a model, and where each one stands.

    bmesh bun000.ply tx ty tz qx qy qz qw          (also `mesh`; `camera` lines place a viewer and are passed over)

A vertex moves to the world by v_world = R(q)^T v + t, the quaternion's vector part first: the opposite turn of the usual reading.
The turn decides: read so, all ten scans of the bunny lie on its merged mesh; read otherwise, eight of ten lie centimetres off.
Lengths have the unit of the scans, which no file of a set says.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, mm_per
from rangecheck.errors import ArrayError, InputError, UnitMissing
from rangecheck.files import read_bytes
from rangecheck.kernels import in_chunks
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.readers.limits import beside
from rangecheck.scan.readers.range_grid_ply import read_range_grid


def read_conf(path: Path, unit: str | None = None) -> list[RangeScan]:
    """The scans that the file places, in its order. Raises InputError that names the line."""
    if unit is None:
        raise UnitMissing(path)
    placed = _placed(path, mm_per(unit))

    def read(first: int, last: int) -> list[RangeScan]:
        with np.errstate(all="ignore"):  # threads do not inherit it
            scans = [read_range_grid(file, unit)[0] for file, _ in placed[first:last]]
        return [scan.moved(pose @ scan.world_from_scan) for scan, (_, pose) in zip(scans, placed[first:last])]

    return [scan for some in in_chunks(read, len(placed), 1) for scan in some]


def _placed(path: Path, scale: float) -> list[tuple[Path, FloatArray]]:
    """Files and world_from_file."""
    try:
        lines = read_bytes(path, 1 << 20).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise InputError(path, "is not a text file; a .conf lists `bmesh file tx ty tz qx qy qz qw`") from None
    placed = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0].startswith("#") or words[0] == "camera":
            continue
        if words[0] not in ("bmesh", "mesh") or len(words) != 9:
            raise InputError(path, f"line {number} is {line[:60]!r}; it must be `bmesh file tx ty tz qx qy qz qw`", line=number)
        try:
            t, q = [scale * float(w) for w in words[2:5]], [float(w) for w in words[5:]]
            pose = rigid.from_rotation_translation(rigid.rotation_from_quaternion(q).T, t)
        except (ValueError, ArrayError) as error:
            raise InputError(path, f"line {number}: {error}", line=number) from None
        placed.append((beside(path, words[1]), pose))
    if not placed:
        raise InputError(path, "places no scan; it needs lines `bmesh file tx ty tz qx qy qz qw`")
    return placed
