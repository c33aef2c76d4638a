"""PLY files (Turk, "The PLY polygon file format", 1994): ascii or binary of either byte order, LF or CRLF line ends.

Every element is read as the header describes it: scalar columns as arrays, lists as lengths and one flat array. Counts in the
header are compared with the size of the file before anything is made.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import InputError
from rangecheck.files import read_bytes
from rangecheck.kernels import kernel
from rangecheck.scan.readers.limits import check_holds
from rangecheck.scan.readers.text_numbers import parse_numbers

MAGIC = b"ply"
_TYPES = {
    name: code
    for code, names in {
        "i1": ("char", "int8"),
        "u1": ("uchar", "uint8"),
        "i2": ("short", "int16"),
        "u2": ("ushort", "uint16"),
        "i4": ("int", "int32"),
        "u4": ("uint", "uint32"),
        "f4": ("float", "float32"),
        "f8": ("double", "float64"),
    }.items()
    for name in names
}


@dataclass(frozen=True)
class Property:
    """One column: its numpy type code and, for a list, the type of its length."""

    name: str
    code: str
    length_code: str = ""


@dataclass
class Element:
    """`rows` of one kind. columns: scalars (rows,) float64 or as stored; lists: lengths (rows,) and their flat items."""

    name: str
    rows: int
    properties: list[Property] = field(default_factory=list)
    columns: dict[str, FloatArray] = field(default_factory=dict)
    lists: dict[str, tuple[IntArray, FloatArray]] = field(default_factory=dict)

    def least_bytes(self, ascii_text: bool) -> int:
        if ascii_text:
            return 2 * self.rows * len(self.properties) - 1
        return self.rows * sum(np.dtype(p.length_code or p.code).itemsize for p in self.properties)


@dataclass
class Ply:
    """A PLY file: elements by name, `info` from obj_info and comment lines (the first word is the key)."""

    path: Path
    elements: dict[str, Element]
    info: dict[str, str]

    def need(self, element: str, *columns: str) -> Element:
        """The element, with these scalar columns. Raises InputError that says what is missing."""
        if element not in self.elements:
            raise InputError(self.path, f"has no element {element}; it has {', '.join(self.elements) or 'none'}")
        missing = [c for c in columns if c not in self.elements[element].columns]
        if missing:
            raise InputError(self.path, f"its element {element} has no property {missing[0]}; export it again")
        return self.elements[element]


def announced(path: Path) -> dict[str, int]:
    """Rows of each element as the header announces them, in its order; none where there is no whole header. What lies behind is not looked at."""
    head = read_bytes(path, 1 << 20)
    end = head.find(b"end_header")
    if not head.startswith(MAGIC) or end < 0:
        return {}
    lines = [line.split() for line in head[:end].decode("latin-1").splitlines()]
    return {
        words[1]: int(words[2][:18]) for words in lines if len(words) == 3 and words[0] == "element" and words[2][:18].isdecimal()
    }


def read_ply(path: Path) -> Ply:
    """All elements of `path`. Raises InputError for a damaged header, counts that the file cannot hold, and truncation."""
    content = read_bytes(path)
    order, ply, start = _header(path, content)
    needed = sum(max(e.least_bytes(order == ""), 0) for e in ply.elements.values())
    counts = ", ".join(f"{e.rows} {e.name}" for e in ply.elements.values())
    check_holds(path, needed, len(content) - start, counts)
    if order == "":
        _read_text(ply, content, start)
    else:
        _read_binary(ply, content, start, order)
    return ply


def _header(path: Path, content: bytes) -> tuple[str, Ply, int]:
    end = content.find(b"end_header", 0, 1 << 20)
    newline = content.find(b"\n", end)
    if not content.startswith(MAGIC) or end < 0 or newline < 0:
        raise InputError(path, "is not a PLY file: it has no header from `ply` to `end_header`; export it again")
    order: str | None = None
    elements: dict[str, Element] = {}
    info: dict[str, str] = {}
    for number, line in enumerate(content[:end].decode("latin-1").splitlines()[1:], 2):
        words = line.split()
        try:
            match words:
                case []:
                    pass
                case ["format", kind, "1.0"]:
                    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
                case ["comment" | "obj_info", *rest]:
                    if rest:
                        info[rest[0]] = " ".join(rest[1:])
                case ["element", name, rows] if rows.isdecimal() and len(rows) < 19 and name not in elements:
                    elements[name] = Element(name, int(rows))
                case ["property", "list", length, item, name] if _TYPES[length][0] in "iu":
                    list(elements.values())[-1].properties.append(Property(name, _TYPES[item], _TYPES[length]))
                case ["property", kind, name]:
                    list(elements.values())[-1].properties.append(Property(name, _TYPES[kind]))
                case _:
                    raise KeyError
        except (KeyError, IndexError):
            raise InputError(
                path, f"line {number} of its header is {line[:60]!r}, which PLY does not have; export it again"
            ) from None
    if order is None:
        raise InputError(path, "its header does not say its format; it needs a line `format ascii 1.0` or a binary one")
    elements = {e.name: e for e in elements.values() if e.properties or e.rows == 0}
    return order, Ply(path, elements, info), newline + 1


@kernel
def _walk_text(values, position, is_list, rows, scalars, lengths, starts):
    """Where each row's items lie in `values`; returns the position after the last row, or -1 when they do not suffice."""
    for row in range(rows):
        n_scalar, n_list = 0, 0
        for p in range(is_list.size):
            if position >= values.size:
                return -1
            if is_list[p]:
                length = values[position]
                if not (0 <= length <= values.size - position - 1) or length != int(length):
                    return -1
                lengths[row, n_list] = int(length)
                starts[row, n_list] = position + 1
                position += 1 + int(length)
                n_list += 1
            else:
                scalars[row, n_scalar] = values[position]
                position += 1
                n_scalar += 1
    return position


def _read_text(ply: Ply, content: bytes, start: int) -> None:
    values, _ = parse_numbers(ply.path, content, start)
    position = 0
    for element in ply.elements.values():
        is_list = np.array([bool(p.length_code) for p in element.properties], bool)
        n_lists = int(is_list.sum())
        if n_lists == 0:
            width, end = len(is_list), position + element.rows * len(is_list)
            _need(ply, element, end <= len(values))
            scalars, position = values[position:end].reshape(element.rows, width), end
        else:
            scalars = np.empty((element.rows, len(is_list) - n_lists))
            lengths, starts = np.empty((2, element.rows, n_lists), np.int64)
            position = _walk_text(values, position, is_list, element.rows, scalars, lengths, starts)
            _need(ply, element, position >= 0)
            for k, p in enumerate(p for p in element.properties if p.length_code):
                element.lists[p.name] = lengths[:, k], _gather(values, starts[:, k], lengths[:, k])
        for k, p in enumerate(p for p in element.properties if not p.length_code):
            element.columns[p.name] = scalars[:, k]
    if position != len(values):
        raise InputError(ply.path, f"holds {len(values) - position} more numbers than its header announces; export it again")


def _need(ply: Ply, element: Element, enough: bool) -> None:
    if not enough:
        raise InputError(
            ply.path, f"is cut short: its {element.rows} rows of {element.name} are not all there; copy or export it again"
        )


@kernel
def _gather(values, starts, lengths):
    out = np.empty(lengths.sum(), values.dtype)
    k = 0
    for row in range(lengths.size):
        for i in range(lengths[row]):
            out[k] = values[starts[row] + i]
            k += 1
    return out


@kernel
def _walk_binary(data, position, big, length_size, item_size, rows, lengths, starts):
    """Byte where each row's items start, per property (scalars have length 1); -1 when the bytes do not suffice."""
    for row in range(rows):
        for p in range(item_size.size):
            length = 1
            if length_size[p] > 0:
                if position + length_size[p] > data.size:
                    return -1
                length = 0
                for b in range(length_size[p]):
                    shift = 8 * (length_size[p] - 1 - b) if big else 8 * b
                    length |= int(data[position + b]) << shift
                position += length_size[p]
            if length > (data.size - position) // item_size[p]:
                return -1
            lengths[row, p] = length
            starts[row, p] = position
            position += length * item_size[p]
    return position


@kernel
def _gather_bytes(data, starts, lengths, size):
    out = np.empty(lengths.sum() * size, np.uint8)
    k = 0
    for row in range(lengths.size):
        for i in range(lengths[row] * size):
            out[k] = data[starts[row] + i]
            k += 1
    return out


def _read_binary(ply: Ply, content: bytes, start: int, order: str) -> None:
    data = np.frombuffer(content, np.uint8)
    position = start
    for element in ply.elements.values():
        types = [np.dtype(order + p.code) for p in element.properties]
        if not any(p.length_code for p in element.properties):
            row = np.dtype({"names": [str(k) for k in range(len(types))], "formats": types})
            _need(ply, element, position + element.rows * row.itemsize <= len(content))
            table = np.frombuffer(content, row, element.rows, position)
            position += element.rows * row.itemsize
            for k, p in enumerate(element.properties):
                element.columns[p.name] = table[str(k)].astype(types[k].newbyteorder("="))
            continue
        length_size = np.array([np.dtype(p.length_code).itemsize if p.length_code else 0 for p in element.properties])
        item_size = np.array([t.itemsize for t in types])
        lengths, starts = np.empty((2, element.rows, len(types)), np.int64)
        position = _walk_binary(data, position, order == ">", length_size, item_size, element.rows, lengths, starts)
        _need(ply, element, position >= 0)
        for k, p in enumerate(element.properties):
            items = _gather_bytes(data, starts[:, k], lengths[:, k], types[k].itemsize).view(types[k])
            items = items.astype(types[k].newbyteorder("="))
            if p.length_code:
                element.lists[p.name] = lengths[:, k], items
            else:
                element.columns[p.name] = items
    if position != len(content):
        raise InputError(ply.path, f"holds {len(content) - position} more bytes than its header announces; export it again")
