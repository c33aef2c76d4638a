"""The coverage sphere: from an object's middle, in which directions scans have samples; as counts, and as a drawing in letters.

Azimuth 0 is where the world's z axis points and grows towards x; elevation 90 degrees is up (y).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rangecheck.arrays import FloatArray, IntArray

#: rows of elevation and columns of azimuth: for pictures, and for a drawing in letters, whose letters are twice as high as wide
SPHERE_SHAPE, LETTERS_SHAPE = (36, 72), (9, 36)
_UNSEEN, _MANY, _STOOD, _NEXT = "·", "+", "o", "N"


def counted(scans_mm: Sequence[FloatArray], middle_mm: FloatArray, shape: tuple[int, int] = SPHERE_SHAPE) -> IntArray:
    """`shape` uint16: how many scans, each given as its points (n, 3) mm, have a sample in each direction from `middle_mm`; rows from
    elevation +90 to -90 degrees, columns from azimuth 0 (towards +z) through +90 (towards +x)."""
    counts = np.zeros(shape, np.uint16)
    for points in scans_mm:
        x, y, z = (points - middle_mm).T
        cell = _cell(np.degrees(np.arctan2(x, z)), np.degrees(np.arctan2(y, np.hypot(x, z))), shape)
        counts += np.bincount(cell, minlength=counts.size).reshape(shape) > 0
    return counts


def in_letters(
    counts: IntArray, stood_deg: Sequence[tuple[float, float]], next_deg: tuple[float, float] | None = None
) -> list[str]:
    """Lines that draw `counts` with the front in the middle: in each direction how many scans have a sample, and over that where scans
    stood and where the next view is (azimuth, elevation)."""
    letters = np.array([_UNSEEN, *"123456789", _MANY])[np.minimum(counts, 10)]
    for letter, places in ((_STOOD, stood_deg), (_NEXT, [] if next_deg is None else [next_deg])):
        for azimuth, elevation in places:
            letters.flat[_cell(np.array([azimuth]), np.array([elevation]), counts.shape)] = letter
    rows, columns = counts.shape
    lines = ["".join(row) for row in np.roll(letters, columns // 2, axis=1)]
    height = 180.0 / rows
    named = [f"{90 - height * (r + 0.5):+4.0f}" if r % 2 == 0 else 4 * " " for r in range(rows)]
    below = [f"{angle:+d}" if angle else "0" for angle in (-180, -90, 0, 90)]
    return [
        *(f"{name} {line}" for name, line in zip(named, lines)),
        f"     {''.join(text.ljust(columns // 4) for text in below)}+180",
    ]


def legend(next_view: bool) -> str:
    """What the letters mean."""
    following = f", {_NEXT} the next view" if next_view else ""
    return (
        "directions from its middle, elevation by azimuth in degrees, the front (+z) at 0: "
        f"{_UNSEEN} no scan has a sample there, 1 to 9 so many scans ({_MANY} more), {_STOOD} where a scan was taken from{following}"
    )


def _cell(azimuth_deg: FloatArray, elevation_deg: FloatArray, shape: tuple[int, int]) -> IntArray:
    rows, columns = shape
    row = np.clip((0.5 - elevation_deg / 180.0) * rows, 0, rows - 1).astype(int)
    column = np.clip(azimuth_deg % 360.0 / 360.0 * columns, 0, columns - 1).astype(int)
    return row * columns + column
