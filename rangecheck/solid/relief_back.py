"""A relief with a hollow back: a front of even wall, open behind, which needs no drain and little resin.

Made of a relief that was closed with a plane: its skirt runs straight to the back, so the back can be moved further away, the cavity taken
one wall inside of that longer part, and the part that was asked for cut out of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangecheck.errors import SurfaceError
from rangecheck.solid.engine import from_engine, simplified, to_engine
from rangecheck.solid.hollow import STEP
from rangecheck.solid.offset import inner_offset
from rangecheck.surface.surface import Surface


def hollow_back(relief: Surface, *, wall_mm: float, step_mm: float | None = None, tolerance_mm: float = 0.15) -> Surface:
    """A closed relief with the part "back" (see `close_relief`), hollowed from behind to `wall_mm`; closed and manifold, its solidity not
    proved here. Raises SurfaceError where it has no back, or nothing lies deeper than the wall."""
    if "back" not in relief.part_names:
        raise SurfaceError(
            "only a relief that was closed with a back plane can be hollowed from its back; close it as a relief first"
        )
    back = relief.part_of_face == relief.part_names.index("back")
    total = relief.area_vectors[back].sum(axis=0)
    away = total / np.linalg.norm(total)
    mark = np.zeros(len(relief.vertices), bool)
    mark[relief.faces[back]] = True
    longer = replace(relief, vertices=relief.vertices + 2 * wall_mm * np.outer(mark, away))
    inner = inner_offset(longer, wall_mm, step_mm or STEP * wall_mm)
    if inner is None:
        raise SurfaceError(
            f"nothing lies {wall_mm:g} mm deep in the relief, so its back cannot be hollowed; ask for a thinner wall",
            wall_mm=wall_mm,
        )
    inner = simplified(inner, tolerance_mm / 10)
    outer, outer_name = to_engine(relief)
    cavity, cavity_name = to_engine(inner)
    return from_engine(outer - cavity, [(outer_name, relief), (cavity_name, inner)], "back")
