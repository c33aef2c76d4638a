"""How a part stands in a file for slicers, whose z is up, and the way back.

In the frame of scans y is up. A file that stands holds (x, -z, y - low): turned about x, so that what faces the viewer along +z in the frame of
scans faces him along -y on the build plate, and lowered onto z = 0. The file says so in words, so that its reader here turns it back: a part keeps
its frame through every command, and stands wherever else the file is opened. The turn is exact; lowering costs less than a float32 step.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.surface.surface import Surface

_SAID = re.compile(rb"rangecheck[^\n]{0,40}, z up, lowered by (-?[0-9][0-9.e+-]*)")
_UP_TO_Z = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def file_from_scans(lowered_mm: float) -> FloatArray:
    """(4, 4) the motion from the frame of scans to that of a file which stands."""
    motion = np.eye(4)
    motion[:3, :3], motion[2, 3] = _UP_TO_Z, -lowered_mm
    return motion


def standing(surface: Surface) -> tuple[Surface, float]:
    """`surface` as it stands in a file for slicers, and by how much its y was lowered, mm."""
    low = float(surface.bounds_mm[0, 1])
    x, y, z = surface.vertices.T
    return replace(surface, vertices=np.stack([x, -z, y - low], axis=1)), low


def words(lowered_mm: float) -> str:
    """What the head of such a file says, after the name of the program."""
    return f", z up, lowered by {lowered_mm!r}"


def lowered_in(head: bytes) -> float | None:
    """By how much a file stands lower, in its own unit; None where its head does not say that it stands."""
    said = _SAID.search(head)
    return float(said.group(1)) if said else None


def turned_back(vertices: FloatArray, lowered: float) -> FloatArray:
    """Vertices (n, 3) of a file that stands, in the frame of scans."""
    x, y, z = vertices.T
    return np.stack([x, z + lowered, -y], axis=1)
