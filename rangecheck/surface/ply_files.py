"""Reading PLY meshes: ASCII, binary of both byte orders, polygons of any size, properties in any order.

Turk, *The PLY polygon file format*, 1994. Only `vertex` x y z and `face` vertex_indices (or vertex_index) are used, and what rangecheck's own
PLY says in comments and properties: the unit, the part and the origin of each face and whether a picture refined it, the error of each vertex; other elements and properties
are stepped over. Nothing is allocated that the file's size does not warrant.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import MM_PER_UNIT, BoolArray, FloatArray, IntArray
from rangecheck.errors import InputError
from rangecheck.surface.surface import ORIGIN_NAMES

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_LIST_NAMES = ("vertex_indices", "vertex_index")


@dataclass
class _Property:
    name: str
    kind: str
    count_kind: str | None = None  # of a list


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property]


class _Polygons:
    """Corners of all polygons one after another, and how many each has."""

    def __init__(self, corners: IntArray, counts: IntArray) -> None:
        self.corners, self.counts = corners, counts


class Labels(NamedTuple):
    """What a PLY of rangecheck says of its faces, part (m,) with their names, origin (m,) and refined (m,) or None, and of its vertices:
    error_mm (n,) or None."""

    part: IntArray
    names: tuple[str, ...]
    origin: IntArray
    error_mm: FloatArray | None
    refined: BoolArray | None


class PlyMesh(NamedTuple):
    """vertices (n, 3) float64 as the file gives them, triangles (m, 3), what was odd, the unit and the labels or None."""

    vertices: FloatArray
    faces: IntArray
    notes: list[str]
    unit: str | None
    labels: Labels | None


def ply_mesh(path: Path, content: bytes) -> PlyMesh:
    """The mesh in the bytes of a PLY file. Raises InputError."""
    form, elements, body, comments = _header(path, content)
    names = [e.name for e in elements]
    if "vertex" not in names:
        raise InputError(path, "has no vertices; export it again")
    if "face" not in names:
        what = "a range scan, not a mesh" if "range_grid" in names else "points without faces"
        raise InputError(path, f"holds {what}; mesh it first (rangecheck mesh)")
    reader = _AsciiBody(path, bytes(body)) if form == "ascii" else _BinaryBody(path, body, "<" if "little" in form else ">")
    vertices = faces = None
    of_vertex: dict[str, Any] = {}
    of_face: dict[str, Any] = {}
    for element in elements:
        columns = reader.element(element)
        if element.name == "vertex":
            missing = [axis for axis in "xyz" if axis not in columns]
            if missing:
                raise InputError(path, f"its vertices have no {', '.join(missing)}; export it again")
            vertices, of_vertex = np.empty((element.count, 3)), columns
            for k, axis in enumerate("xyz"):
                vertices[:, k] = columns[axis]
        elif element.name == "face":
            name = next((n for n in _LIST_NAMES if n in columns), None)
            if name is None:
                raise InputError(path, "its faces have no vertex_indices; export it again")
            faces, of_face = columns[name], columns
        if vertices is not None and faces is not None:
            break
    assert vertices is not None and faces is not None
    notes = (
        [f"{reader.left} bytes follow the last element; they were left out"] if reader.left and element is elements[-1] else []
    )
    labels = _labels(comments, of_vertex, of_face) if (faces.counts == 3).all() else None
    return PlyMesh(vertices, _triangles(faces, notes), notes, _unit(comments), labels)


def _unit(comments: list[str]) -> str | None:
    """The unit that a comment says, as rangecheck writes it."""
    said = {words[1] for line in comments if len(words := line.split()) == 2 and words[0] == "unit"}
    return said.pop() if len(said) == 1 and said <= set(MM_PER_UNIT) else None


def _labels(comments: list[str], of_vertex: dict[str, Any], of_face: dict[str, Any]) -> Labels | None:
    """Part and origin of each face, where the comments say them as rangecheck writes them and the values agree with the comments."""
    legend = "origin " + " ".join(f"{i} {name}" for i, name in enumerate(ORIGIN_NAMES))
    if legend not in comments or not {"part", "origin"} <= of_face.keys():
        return None
    try:
        parts = [line.split(maxsplit=2) for line in comments if line.startswith("part ")]
        names = tuple(str(json.loads(name)) for _, number, name in sorted(parts, key=lambda words: int(words[1])))
    except ValueError:
        return None
    part, origin = np.asarray(of_face["part"]), np.asarray(of_face["origin"])
    if len(part) and not (part.min() >= 0 and part.max() < len(names) and origin.min() >= 0 and origin.max() < len(ORIGIN_NAMES)):
        return None
    error, refined = of_vertex.get("error_mm"), of_face.get("refined")
    if refined is not None and not np.isin(refined, (0, 1)).all():
        return None
    return Labels(
        part.astype(np.int32),
        names,
        origin.astype(np.uint8),
        None if error is None else np.asarray(error, np.float64),
        None if refined is None else np.asarray(refined, np.bool_),
    )


def _header(path: Path, content: bytes) -> tuple[str, list[_Element], memoryview, list[str]]:
    if content[:3] != b"ply":
        raise InputError(path, "does not begin with 'ply'; it is no PLY file")
    end = content.find(b"end_header", 0, 1 << 20)
    if end < 0:
        raise InputError(path, "its header does not end (no end_header); the file is cut off or damaged")
    stop = content.find(b"\n", end)
    body = memoryview(content)[stop + 1 :] if stop >= 0 else memoryview(b"")
    form, elements = "", []
    comments: list[str] = []
    try:
        for line in content[:end].decode("latin-1").splitlines()[1:]:
            words = line.split()
            if not words or words[0] in ("comment", "obj_info"):
                comments.append(line.strip()[len("comment ") :])
                continue
            if words[0] == "format":
                form = words[1]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[0] == "property" and words[1] == "list":
                elements[-1].properties.append(_Property(words[4], _TYPES[words[3]], _TYPES[words[2]]))
            elif words[0] == "property":
                elements[-1].properties.append(_Property(words[2], _TYPES[words[1]]))
            else:
                raise ValueError(line)
    except (IndexError, KeyError, ValueError):
        raise InputError(path, f"its header line {line.strip()[:60]!r} is not PLY; export it again") from None
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise InputError(
            path, f"its format is {form or 'not stated'!r}; known are ascii, binary_little_endian, binary_big_endian"
        )
    for e in elements:
        names = {p.name for p in e.properties}
        if e.count < 0 or len(names) < max(len(e.properties), 1):
            raise InputError(
                path, f"its header gives {e.name} {e.count} elements of {len(names)} different properties; export it again"
            )
    return form, elements, body, comments


def _triangles(faces: _Polygons, notes: list[str]) -> IntArray:
    """Each polygon as a fan from its first corner."""
    counts = faces.counts
    if (counts == 3).all():
        return faces.corners.reshape(-1, 3)
    if (counts < 3).any():
        notes.append(f"{int((counts < 3).sum())} faces have fewer than three corners; they were left out")
    if (counts > 3).any():
        notes.append(
            f"{int((counts > 3).sum())} faces have more than three corners; each was cut into a fan from its first corner"
        )
    first = np.cumsum(counts) - counts
    fans = np.maximum(counts - 2, 0)
    start = np.repeat(first, fans)
    step = np.arange(len(start)) - np.repeat(np.cumsum(fans) - fans, fans)
    corners = faces.corners
    return np.stack([corners[start], corners[start + step + 1], corners[start + step + 2]], axis=1)


class _AsciiBody:
    def __init__(self, path: Path, body: bytes) -> None:
        self.path = path
        try:
            self.numbers = np.array(body.split(), dtype=np.bytes_).astype(np.float64) if body.strip() else np.empty(0)
        except ValueError as error:
            raise InputError(path, f"holds something that is not a number: {error}; export it again") from None
        self.left = 0
        self.at = 0

    def _need(self, count: int, element: _Element) -> None:
        if self.at + count > len(self.numbers):
            raise InputError(self.path, f"ends within its {element.count} {element.name} elements; the file is cut off")

    def element(self, element: _Element) -> dict[str, Any]:
        if not any(p.count_kind for p in element.properties):
            width = len(element.properties)
            self._need(width * element.count, element)
            table = self.numbers[self.at : self.at + width * element.count].reshape(element.count, width)
            self.at += width * element.count
            return {p.name: table[:, i] for i, p in enumerate(element.properties)}
        alone = len(element.properties) == 1
        self._need(4 * element.count if alone else element.count, element) if element.count and alone else None
        if alone and element.count:
            table = self.numbers[self.at : self.at + 4 * element.count].reshape(-1, 4)
            if (table[:, 0] == 3).all():
                self.at += 4 * element.count
                return {element.properties[0].name: _Polygons(_whole(self.path, table[:, 1:].ravel()), np.full(element.count, 3))}
        return self._row_by_row(element)

    def _row_by_row(self, element: _Element) -> dict[str, Any]:
        pieces: dict[str, list[Any]] = {p.name: [] for p in element.properties}
        counts: dict[str, list[int]] = {p.name: [] for p in element.properties if p.count_kind}
        for _ in range(element.count):
            for p in element.properties:
                self._need(1, element)
                count = 1
                if p.count_kind:
                    count = int(_whole(self.path, self.numbers[self.at : self.at + 1])[0])
                    counts[p.name].append(count)
                    self.at += 1
                    if count < 0:
                        raise InputError(self.path, f"a list of {element.name} has {count} entries; the file is damaged")
                    self._need(count, element)
                pieces[p.name].append(self.numbers[self.at : self.at + count])
                self.at += count
        return _columns(self.path, element, pieces, counts)


class _BinaryBody:
    def __init__(self, path: Path, body: memoryview, order: str) -> None:
        self.path, self.body, self.order, self.at = path, body, order, 0

    @property
    def left(self) -> int:
        return len(self.body) - self.at

    def _need(self, size: int, element: _Element) -> None:
        if size > self.left:
            raise InputError(self.path, f"ends within its {element.count} {element.name} elements; the file is cut off")

    def element(self, element: _Element) -> dict[str, Any]:
        # as if every list had three entries: true of nearly all meshes, and then one view of the bytes serves
        fields = []
        for p in element.properties:
            if p.count_kind:
                fields += [(f"{p.name} count", self.order + p.count_kind), (p.name, self.order + p.kind, 3)]
            else:
                fields.append((p.name, self.order + p.kind))
        row = np.dtype(fields)
        lists = [p for p in element.properties if p.count_kind]
        if not lists:
            self._need(row.itemsize * element.count, element)
        if row.itemsize * element.count <= self.left:
            table = np.frombuffer(self.body, row, element.count, self.at)
            if all((table[f"{p.name} count"] == 3).all() for p in lists):
                self.at += row.itemsize * element.count
                three = np.broadcast_to(3, element.count)
                return {
                    p.name: _Polygons(_whole(self.path, table[p.name].ravel()), three) if p.count_kind else table[p.name]
                    for p in element.properties
                }
        return self._row_by_row(element)

    def _row_by_row(self, element: _Element) -> dict[str, Any]:
        pieces: dict[str, list[Any]] = {p.name: [] for p in element.properties}
        counts: dict[str, list[int]] = {p.name: [] for p in element.properties if p.count_kind}
        kinds = [
            (p, np.dtype(self.order + p.kind), np.dtype(self.order + p.count_kind) if p.count_kind else None)
            for p in element.properties
        ]
        for _ in range(element.count):
            for p, kind, count_kind in kinds:
                count = 1
                if count_kind is not None:
                    self._need(count_kind.itemsize, element)
                    count = int(_whole(self.path, np.frombuffer(self.body, count_kind, 1, self.at))[0])
                    counts[p.name].append(count)
                    self.at += count_kind.itemsize
                    if count < 0:
                        raise InputError(self.path, f"a list of {element.name} has {count} entries; the file is damaged")
                self._need(count * kind.itemsize, element)
                pieces[p.name].append(np.frombuffer(self.body, kind, count, self.at))
                self.at += count * kind.itemsize
        return _columns(self.path, element, pieces, counts)


def _whole(path: Path, numbers: npt.NDArray[Any]) -> IntArray:
    """Numbers of vertices, whatever type the file gives them. Raises InputError for what no vertex can have."""
    if numbers.dtype.kind == "f" and not (np.abs(numbers) < 2**53).all():
        raise InputError(path, "a face names a vertex by what is no whole number; the file is damaged")
    # what always fits is kept narrow: of millions of faces these are the largest array
    return numbers.astype(
        np.int32 if numbers.dtype.kind in "iu" and numbers.dtype.itemsize + (numbers.dtype.kind == "u") <= 4 else np.int64,
        copy=False,
    )


def _columns(path: Path, element: _Element, pieces: dict[str, list[Any]], counts: dict[str, list[int]]) -> dict[str, Any]:
    columns: dict[str, Any] = {}
    for p in element.properties:
        flat = np.concatenate(pieces[p.name]) if pieces[p.name] else np.empty(0)
        columns[p.name] = _Polygons(_whole(path, flat), np.array(counts[p.name], np.int64)) if p.count_kind else flat
    return columns
