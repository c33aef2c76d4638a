"""Reading STL, both kinds, told apart by what the file holds and not by its first word.

Binary: 80 bytes of anything, a little-endian count, then 50 bytes per face: normal, three corners, two bytes of attribute. Many
writers begin a binary file with "solid". The normals are not read: the corners' order says the same, and cannot contradict itself.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import InputError
from rangecheck.files import read_bytes

_HEADER = 84
#: bytes by which the kind is told, and faces that are read at once
_LOOKED_AT, _AT_ONCE = 4096, 1 << 18
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_NUMBER = rb"([^\s]+)"
_VERTEX = re.compile(rb"vertex\s+" + _NUMBER + rb"\s+" + _NUMBER + rb"\s+" + _NUMBER, re.IGNORECASE)


def stl_corners(path: Path) -> tuple[FloatArray, list[str], bool]:
    """(m, 3, 3) float32 corners of an STL file's faces, what was odd about it, and whether it is binary; of a binary file the corners are all that
    is held. Raises InputError."""
    head, size = read_bytes(path, _LOOKED_AT), path.stat().st_size
    looks_ascii = head[:512].lstrip()[:5].lower() == b"solid" and b"facet" in head.lower()
    stated = int.from_bytes(head[80:84], "little") if len(head) >= _HEADER else None
    fits = stated is not None and size == _HEADER + _RECORD.itemsize * stated
    if looks_ascii and not fits:
        return *_ascii(path, read_bytes(path)), False
    if stated is None:
        if head[:512].lstrip()[:5].lower() == b"solid":
            raise InputError(path, "holds no faces; export it again")
        raise InputError(path, f"is {size} bytes long, too short for STL; export it again")
    return *_binary(path, head, size, stated), True


def _binary(path: Path, head: bytes, size: int, stated: int) -> tuple[FloatArray, list[str]]:
    notes = []
    room = (size - _HEADER) // _RECORD.itemsize
    if stated > room:
        raise InputError(
            path,
            f"its header counts {stated} faces, its {size} bytes have room for {room}: the file is cut off or no STL; "
            "copy or export it again",
            stated=stated,
            room=room,
        )
    extra = size - _HEADER - _RECORD.itemsize * stated
    if extra:
        notes.append(f"{extra} bytes follow the last of the {stated} faces that its header counts; they were left out")
    if head[:5].lower() == b"solid":
        notes.append('it begins with "solid" like an ASCII file, and is binary')
    corners = np.empty((stated, 3, 3), np.float32)
    with path.open("rb") as stream:
        stream.seek(_HEADER)
        for first in range(0, stated, _AT_ONCE):
            piece = corners[first : first + _AT_ONCE]
            records = stream.read(_RECORD.itemsize * len(piece))
            if len(records) < _RECORD.itemsize * len(piece):
                raise InputError(path, "became shorter while it was read; try again")
            piece[:] = np.frombuffer(records, _RECORD)["corners"]
    return corners, notes


def _ascii(path: Path, content: bytes) -> tuple[FloatArray, list[str]]:
    lowered = content.lower()
    faces = lowered.count(b"endfacet")
    begun = lowered.count(b"facet") - faces
    words = _VERTEX.findall(content)
    if begun != faces or len(words) != 3 * faces or b"endsolid" not in lowered[-4096:]:
        raise InputError(
            path,
            f"it begins {begun} faces, ends {faces} and gives {len(words)} corners where {3 * begun} are due, "
            f"{'and' if b'endsolid' in lowered[-4096:] else 'without'} endsolid: the file is cut off or damaged; export it again",
            begun=begun,
            ended=faces,
        )
    try:
        corners = np.array(words, dtype=np.bytes_).astype(np.float64)
    except ValueError as error:
        comma = " (a comma stands where a point is due)" if any(b"," in word for row in words for word in row) else ""
        raise InputError(path, f"a corner is not a number{comma}: {error}; export it again") from None
    with np.errstate(over="ignore"):
        return corners.astype(np.float32).reshape(-1, 3, 3), ["it is an ASCII file; its numbers were taken to float32"]
