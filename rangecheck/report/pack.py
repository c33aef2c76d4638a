"""Arrays as text for the page: whole numbers, differences along the array, bytes apart by significance, deflate, base64.

Neighbours in maps and meshes are alike, so their differences are small and deflate finds them so; nothing is lost beyond the stated step.
"""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import ArrayError

_UNSIGNED = {1: np.uint8, 2: np.uint16, 4: np.uint32}
_SIGNED = {1: np.int8, 2: np.int16, 4: np.int32}
#: steps of a quantised map; 0 is kept for what has no value
LEVELS = 65534


def packed(array: IntArray) -> dict[str, Any]:
    """JSON-ready form of an array (n,) or (n, k) of uint8, uint16 or uint32: {bytes, columns, count, data}.

    Differences are taken down each column, modulo the type, and folded so that small ones of either sign are small numbers."""
    width = array.dtype.itemsize
    if array.ndim not in (1, 2) or width not in _UNSIGNED or array.dtype != _UNSIGNED[width]:
        raise ArrayError(
            f"{array.dtype} {array.shape} cannot be packed; it must be uint8, uint16 or uint32 in one or two dimensions"
        )
    rows = array.reshape(len(array), 1 if array.ndim == 1 else array.shape[1])
    change = np.diff(rows, axis=0, prepend=np.zeros((1, rows.shape[1]), rows.dtype)).view(_SIGNED[width])
    folded = ((change << 1) ^ (change >> (8 * width - 1))).view(_UNSIGNED[width]).T.copy()
    planes = folded.reshape(-1, 1).view(np.uint8).T if folded.size else np.empty((width, 0), np.uint8)
    text = base64.b64encode(zlib.compress(np.ascontiguousarray(planes).tobytes(), 6)).decode()
    return {"bytes": width, "columns": rows.shape[1], "count": len(rows), "data": text}


def unpacked(form: dict[str, Any]) -> IntArray:
    """The array (count, columns) that `packed` was given."""
    width, count, columns = form["bytes"], form["count"], form["columns"]
    planes = np.frombuffer(zlib.decompress(base64.b64decode(form["data"])), np.uint8).reshape(width, columns * count)
    folded = np.ascontiguousarray(planes.T).view(_UNSIGNED[width]).reshape(columns, count).T
    change = (folded >> 1) ^ (~(folded & 1) + 1).astype(_UNSIGNED[width])
    return np.cumsum(change, axis=0, dtype=_UNSIGNED[width])


def packed_floats(values: FloatArray, low: float | None = None, high: float | None = None) -> dict[str, Any]:
    """Numbers (n,) or (n, k) in 65534 equal steps from `low` to `high` (by default their own range), with {low, step}:
    value = low + (code - 1) step; code 0 where there is none. What lies beyond the ends is put on them."""
    known = np.isfinite(values)
    least = float(values[known].min(initial=np.inf)) if low is None else low
    most = float(values[known].max(initial=-np.inf)) if high is None else high
    if not known.any():
        least, most = 0.0, 1.0
    step = (most - least) / LEVELS or 1.0
    code = np.zeros(values.shape, np.uint16)
    code[known] = np.rint((np.clip(values[known], least, most) - least) / step) + 1
    return {"low": least, "step": step, **packed(code)}


def octahedral(normals: FloatArray) -> IntArray:
    """(n, 2) uint16 in 0..4095 of unit normals (n, 3), folded onto the octahedron (Cigolle et al., *A Survey of Efficient
    Representations for Independent Unit Vectors*, 2014)."""
    n = normals / np.maximum(np.abs(normals).sum(axis=1, keepdims=True), 1e-300)
    flat = n[:, :2].copy()
    under = n[:, 2] < 0
    flat[under] = (1 - np.abs(n[under][:, [1, 0]])) * np.where(n[under][:, :2] >= 0, 1.0, -1.0)
    return np.rint((flat + 1) * 2047.5).astype(np.uint16)
