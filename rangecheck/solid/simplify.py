"""Fewer triangles within a stated error, measured afterwards both ways.

manifold3d collapses edges while its faces stay within a tolerance and the solid stays a solid. Faces of different part or origin are not
merged, so what was measured and what was invented can still be told apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rangecheck.errors import SettingError
from rangecheck.solid.engine import simplified
from rangecheck.solid.printer import Printer
from rangecheck.solid.solid import Solid
from rangecheck.surface.distance import SurfaceDistance
from rangecheck.surface.surface import Surface


@dataclass(frozen=True, eq=False)
class Simplified:
    """surface with fewer faces (closed and manifold; `solid` proves it); error_mm: farthest that either surface lies from the other at their
    vertices and face middles; its faces before and after."""

    surface: Surface
    error_mm: float
    faces_before: int
    faces_after: int

    @cached_property
    def solid(self) -> Solid:
        """The simplified part as a proven solid. Raises NotSolid."""
        words = (
            f"simplified from {self.faces_before} to {self.faces_after} faces, nowhere off by more than {self.error_mm:.4f} mm"
        )
        return Solid.from_surface(self.surface, notes=(words,))


def printable_error_mm(printer: Printer) -> float:
    """An error that the printer cannot show: a quarter of its pixel or layer, whichever is smaller."""
    return min(printer.pixel_mm, printer.layer_mm) / 4


def simplify(solid: Solid | Surface, *, error_mm: float) -> Simplified:
    """A solid, or a closed surface, with fewer triangles, nowhere farther than `error_mm` from what it was.

    The engine's tolerance bounds each collapse; the error that adds up is measured both ways, and the tolerance halved until it keeps the
    promise. Raises SettingError for an error that is no length."""
    if not (np.isfinite(error_mm) and error_mm > 0):
        raise SettingError(f"error_mm is {error_mm}; a positive length is needed", key="error_mm")
    given = solid.surface if isinstance(solid, Solid) else solid
    tolerance = error_mm
    for _ in range(6):
        surface = simplified(given, tolerance)
        measured = _apart(given, surface)
        if measured <= error_mm and surface.volume_mm3 > 0:
            return Simplified(surface, measured, len(given.faces), len(surface.faces))
        tolerance /= 2
    return Simplified(given, 0.0, len(given.faces), len(given.faces))


def _apart(one: Surface, other: Surface) -> float:
    farthest = 0.0
    for of, reference in ((one, other), (other, one)):
        probes = np.concatenate([of.vertices, of.triangles.mean(axis=1)])
        farthest = max(farthest, float(SurfaceDistance(reference).distance_mm(probes)[0].max()))
    return farthest
