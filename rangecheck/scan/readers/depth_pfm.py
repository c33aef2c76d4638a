"""PFM, the float sibling of PGM: three lines of text, then raw floats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.errors import InputError
from rangecheck.files import read_bytes
from rangecheck.scan.readers.limits import check_cells, check_holds

MAGIC = (b"Pf\n", b"Pf\r\n", b"PF")


def read_pfm(path: Path) -> npt.NDArray[Any]:
    """Values (h, w) float32 of a grey PFM (`Pf`, width height, scale): rows from the bottom in the file, little-endian where the
    scale is negative; its size, a hint for display, is not applied."""
    content = read_bytes(path)
    lines = content[:256].split(b"\n", 3)
    try:
        kind, size, scale = (line.decode("ascii").strip() for line in lines[:3])
        width, height = (int(w) for w in size.split())
        order = "<" if float(scale) < 0 else ">"
    except (ValueError, UnicodeDecodeError):
        raise InputError(path, "is not a PFM file: its header is not `Pf`, width height, scale on three lines") from None
    if kind != "Pf" or len(size) > 20:
        raise InputError(path, f"is a PFM of kind {kind!r}; distances are grey, kind 'Pf'")
    check_cells(path, width, height)
    start = sum(len(line) + 1 for line in lines[:3])
    check_holds(path, 4 * width * height, len(content) - start, f"{width} x {height} floats")
    values = np.frombuffer(content, np.dtype(order + "f4"), width * height, start)
    return values.reshape(height, width)[::-1].astype(np.float32)
