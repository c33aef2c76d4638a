"""How far what a map shows lies from another surface: signed, positive outside it, millimetres, both in the same world frame.

The nearest point decides, not the one along the ray: a shift along the surface does not count. Where the nearest point lies on the open
border of the other surface nothing faces the place, and the distance would tell how far the border is: such pixels are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.maps.trace import Maps
from rangecheck.surface import Surface
from rangecheck.surface.distance import Nearest, SurfaceDistance
from rangecheck.surface.topology import boundary_edges


@dataclass(frozen=True, eq=False)
class SeenDeviation:
    """distance_mm (h, w) float64: signed distance of what each pixel sees from the other surface, NaN where nothing is seen or faced.

    seen: how many pixels see the surface."""

    distance_mm: FloatArray = field(repr=False)
    seen: int

    @property
    def faced(self) -> int:
        """Pixels with a distance."""
        return int(np.isfinite(self.distance_mm).sum())

    def statistics(self) -> dict[str, float]:
        """Mean, RMS, median and 95 % of the size, and extremes over the pixels that have a distance, mm; NaN where none has."""
        known = self.distance_mm[np.isfinite(self.distance_mm)]
        if not len(known):
            known = np.array([np.nan])
        size = np.abs(known)
        return {
            "mean_mm": float(known.mean()),
            "rms_mm": float(np.sqrt((known * known).mean())),
            "median_mm": float(np.median(size)),
            "p95_mm": float(np.quantile(size, 0.95)),
            "lowest_mm": float(known.min()),
            "highest_mm": float(known.max()),
        }


def deviation_seen(maps: Maps, other: Surface) -> SeenDeviation:
    """Signed distance from `other` of every place that the maps show. Raises SurfaceError when `other` has no faces.

    On an open surface the sign means "behind the nearest face"."""
    distance = SurfaceDistance(other)
    hit = maps.hit
    values = np.full(hit.shape, np.nan)
    if hit.any():
        signed, found = distance.signed_nearest(maps.points_mm()[hit])
        values[hit] = np.where(on_border(other, found), np.nan, signed)
    return SeenDeviation(values, int(hit.sum()))


def on_border(surface: Surface, found: Nearest) -> BoolArray:
    """(n,) whether nearest points lie on the open border of the surface, of which an edge belongs to one face alone."""
    border = boundary_edges(surface.faces)
    result = np.zeros(len(found.face), bool)
    if not len(border):
        return result
    at = np.zeros(len(surface.vertices), bool)
    at[border.ravel()] = True
    count = len(surface.vertices)
    keys = np.unique(border.min(axis=1).astype(np.int64) * count + border.max(axis=1))
    for corner in range(3):
        here = found.feature == 1 + corner
        result[here] = at[surface.faces[found.face[here], corner]]
        here = found.feature == 4 + corner
        ends = surface.faces[found.face[here]][:, [corner, (corner + 1) % 3]]
        result[here] = np.isin(ends.min(axis=1).astype(np.int64) * count + ends.max(axis=1), keys)
    return result
