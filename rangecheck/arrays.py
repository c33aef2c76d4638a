"""Checks of arrays that name the array, and the units of length.

Lengths inside rangecheck are millimetres; a reader multiplies by `MM_PER_UNIT[unit]` once, at the door.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.errors import ArrayError

FloatArray = npt.NDArray[np.floating[Any]]
IntArray = npt.NDArray[np.integer[Any]]
BoolArray = npt.NDArray[np.bool_]

MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3, "in": 25.4}


def mm_per(unit: str) -> float:
    """Millimetres in one `unit` (mm, cm, m, um, in). Raises ArrayError for any other word."""
    try:
        return MM_PER_UNIT[unit]
    except KeyError:
        raise ArrayError(f"unit is {unit!r}; it must be one of {', '.join(MM_PER_UNIT)}", name="unit", value=unit) from None


def require(
    name: str,
    values: npt.ArrayLike,
    shape: Sequence[int | None] | None = None,
    dtype: npt.DTypeLike = np.float64,
    *,
    finite: bool = False,
) -> npt.NDArray[Any]:
    """`values` as a contiguous array of `dtype`, refused by name when the shape differs (None matches any length) or,
    with `finite`, when a value is NaN or infinite. Raises ArrayError."""
    try:
        array = np.ascontiguousarray(values, dtype=dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise ArrayError(f"{name} cannot be read as {np.dtype(dtype)}: {error}", name=name) from None
    if np.ndim(values) == 0:
        array = array.reshape(())
    if shape is not None and not (
        array.ndim == len(shape) and all(want is None or want == have for want, have in zip(shape, array.shape))
    ):
        wanted = "(" + ", ".join("n" if n is None else str(n) for n in shape) + ")"
        raise ArrayError(f"{name} has shape {array.shape}; it must be {wanted}", name=name, shape=array.shape)
    if finite and array.dtype.kind == "f":
        good = np.isfinite(array)
        if not good.all():
            bad = np.argwhere(~good)
            raise ArrayError(
                f"{name} has {len(bad)} values that are not finite, the first at index {tuple(bad[0].tolist())}; remove them first",
                name=name,
                count=len(bad),
            )
    return array


def unit_vectors(vectors: FloatArray) -> FloatArray:
    """`vectors` (..., 3) divided by their lengths; a zero vector becomes NaN."""
    length = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))[..., None]
    with np.errstate(invalid="ignore", divide="ignore"):
        return vectors / length


def float32_spacing_mm(extent_mm: float) -> float:
    """Step between neighbouring float32 numbers at `extent_mm`: what STL and Embree can tell apart at that size."""
    return float(np.spacing(np.float32(abs(extent_mm))))
