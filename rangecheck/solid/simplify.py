"""Fewer triangles within a stated error, measured afterwards both ways.

manifold3d collapses edges while its faces stay within a tolerance and the solid stays a solid. Faces of different part or origin are not
merged, so what was measured and what was invented can still be told apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangecheck.errors import SettingError
from rangecheck.solid.engine import simplified
from rangecheck.solid.printer import Printer
from rangecheck.solid.solid import Solid
from rangecheck.surface.distance import SurfaceDistance
from rangecheck.surface.surface import Surface


@dataclass(frozen=True, eq=False)
class Simplified:
    """solid with fewer faces; error_mm: farthest that either surface lies from the other at their vertices and face middles; its faces
    before and after."""

    solid: Solid
    error_mm: float
    faces_before: int
    faces_after: int


def printable_error_mm(printer: Printer) -> float:
    """An error that the printer cannot show: a quarter of its pixel or layer, whichever is smaller."""
    return min(printer.pixel_mm, printer.layer_mm) / 4


def simplify(solid: Solid, *, error_mm: float) -> Simplified:
    """`solid` with fewer triangles, nowhere farther than `error_mm` from what it was.

    The engine's tolerance bounds each collapse; the error that adds up is measured both ways, and the tolerance halved until it keeps the
    promise. Raises SettingError for an error that is no length."""
    if not (np.isfinite(error_mm) and error_mm > 0):
        raise SettingError(f"error_mm is {error_mm}; a positive length is needed", key="error_mm")
    tolerance = error_mm
    for _ in range(6):
        surface = simplified(solid.surface, tolerance)
        measured = _apart(solid.surface, surface)
        if measured <= error_mm and surface.volume_mm3 > 0:
            break
        tolerance /= 2
    else:
        return Simplified(solid, 0.0, len(solid.surface.faces), len(solid.surface.faces))
    note = f"simplified from {len(solid.surface.faces)} to {len(surface.faces)} faces, nowhere off by more than {measured:.4f} mm"
    made = Solid.from_surface(surface, notes=(*solid.notes, note))
    return Simplified(made, measured, len(solid.surface.faces), len(surface.faces))


def _apart(one: Surface, other: Surface) -> float:
    farthest = 0.0
    for of, reference in ((one, other), (other, one)):
        probes = np.concatenate([of.vertices, of.triangles.mean(axis=1)])
        farthest = max(farthest, float(SurfaceDistance(reference).distance_mm(probes)[0].max()))
    return farthest
