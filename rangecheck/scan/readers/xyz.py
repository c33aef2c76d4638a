"""Plain lists of points: `.xyz`, `.txt`, `.asc`, `.csv`, and PLY and OBJ files with vertices alone.

Columns x y z; three more are taken as normals when all have length 1 (to 1 %), anything else after z is passed over. Lines that start
with # or //, and one line of column names before the numbers, are passed over. A file of triangles is a mesh, not a measurement.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rangecheck.arrays import FloatArray, mm_per
from rangecheck.errors import InputError, UnitMissing
from rangecheck.files import read_bytes
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.scan.readers.ply import Ply
from rangecheck.scan.readers.text_numbers import parse_numbers, plain_text, punctuation


def read_xyz(path: Path, unit: str | None = None) -> list[PointCloud]:
    """The one cloud of a text file. Raises InputError that names the line, UnitMissing without a unit."""
    if unit is None:
        raise UnitMissing(path)
    content = plain_text(read_bytes(path))
    if b"\0" in content[:4096]:
        raise InputError(path, "is not a text file; a list of points holds lines `x y z`")
    start = _after_head(path, content)
    first = content[start : start + 4096].split(b"\n", 1)[0]
    _, separator = punctuation(path, content, start)
    width = len(first.replace(bytes([separator]), b" ").split())
    if width < 3:
        raise InputError(path, f"its first line of numbers is {first[:40]!r}; a point needs x y z")
    numbers, _ = parse_numbers(path, content, start, columns=width)
    return [_cloud(path, numbers.reshape(-1, width), unit)]


def read_obj(path: Path, unit: str | None = None) -> list[PointCloud]:
    """The vertices `v x y z` of an OBJ file without faces. Raises InputError for a mesh, UnitMissing without a unit."""
    if unit is None:
        raise UnitMissing(path)
    lines = plain_text(read_bytes(path)).splitlines()
    if any(line.startswith((b"f ", b"f\t")) for line in lines):
        raise InputError(
            path, "is a mesh without a camera, not a range scan; check it as a mesh, or export the scanner's own files"
        )
    points = [line[2:] for line in lines if line.startswith((b"v ", b"v\t"))]
    if not points:
        raise InputError(path, "holds no vertex; a cloud in OBJ holds lines `v x y z`")
    width = len(points[0].split())
    if width < 3:
        raise InputError(path, f"its first vertex is {points[0][:40]!r}; a point needs x y z")
    numbers, _ = parse_numbers(path, b"\n".join(points), columns=width)
    return [_cloud(path, numbers.reshape(-1, width)[:, :3], unit)]


def read_ply_cloud(ply: Ply, unit: str) -> list[PointCloud]:
    """The vertices of a PLY without faces as a cloud."""
    vertex = ply.need("vertex", "x", "y", "z")
    names = [n for n in ("x", "y", "z", "nx", "ny", "nz") if n in vertex.columns]
    return [_cloud(ply.path, np.stack([vertex.columns[n].astype(np.float64) for n in names], axis=1), unit)]


def _after_head(path: Path, content: bytes) -> int:
    """Byte of the first line that starts with a number, after comments and at most one line of names."""
    position, names = 0, 0
    while position < len(content):
        end = content.find(b"\n", position)
        end = len(content) if end < 0 else end
        line = content[position:end].strip()
        if line and not line.startswith((b"#", b"//")):
            if line[:1] in b"+-.0123456789" or line[:3].lower() == b"nan":
                return position
            names += 1
            if names > 1:
                break
        position = end + 1
    raise InputError(path, "holds no line of numbers; a list of points holds lines `x y z`")


def _cloud(path: Path, table: FloatArray, unit: str) -> PointCloud:
    with np.errstate(over="ignore", invalid="ignore"):
        points = table[:, :3] * mm_per(unit)
        good = np.isfinite(points).all(axis=1) & (np.abs(points) < 1e30).all(axis=1)
        if not good.any():
            raise InputError(path, "holds no point: none is finite; check how it was exported")
        normals = None
        if table.shape[1] >= 6:
            told = table[good, 3:6]
            length = np.sqrt((told * told).sum(axis=1))
            if np.abs(length - 1).max() < 0.01:
                normals = told / length[:, None]
    return PointCloud(points[good], normals, path.stem, unit)
