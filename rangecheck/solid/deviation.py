"""How far two surfaces lie apart, each seen from the other: signed, by area, in bands, split by measured and invented.

One way only would miss what the other surface has and the first lacks, so both are taken. Samples stand for equal pieces of area.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.solid.thickness import Samples, sample_surface
from rangecheck.surface.distance import SurfaceDistance
from rangecheck.surface.surface import ORIGIN_NAMES, Surface


@dataclass(frozen=True, eq=False)
class Deviation:
    """Signed distances of samples of one surface from another: positive outside it.

    distance_mm (n,), samples (see `Samples`), origin (n,) of the sampled faces."""

    distance_mm: FloatArray = field(repr=False)
    samples: Samples = field(repr=False)
    origin: IntArray = field(repr=False)

    def statistics(self, tolerance_mm: float) -> dict[str, Any]:
        """Mean, RMS, median and 95 % of the absolute distance, extremes and the share of area within the tolerance: over all, and over each
        origin that occurs. JSON-ready."""
        kinds = {"all": np.ones(len(self.distance_mm), bool)} | {name: self.origin == k for k, name in enumerate(ORIGIN_NAMES)}
        return {name: self._numbers(mine, tolerance_mm) for name, mine in kinds.items() if mine.any()}

    def _numbers(self, mine: Any, tolerance_mm: float) -> dict[str, float]:
        d, area = self.distance_mm[mine], self.samples.area_mm2[mine]
        size = np.abs(d)
        order = np.argsort(size, kind="stable")
        cumulated = np.cumsum(area[order]) / area.sum()
        return {
            "area_mm2": float(area.sum()),
            "mean_mm": float(np.average(d, weights=area)),
            "rms_mm": float(np.sqrt(np.average(d * d, weights=area))),
            "median_mm": float(size[order][min(int(np.searchsorted(cumulated, 0.5)), len(d) - 1)]),
            "p95_mm": float(size[order][min(int(np.searchsorted(cumulated, 0.95)), len(d) - 1)]),
            "lowest_mm": float(d.min()),
            "highest_mm": float(d.max()),
            "share_within": float(area[size <= tolerance_mm].sum() / area.sum()),
        }

    def histogram(self, edges_mm: FloatArray) -> FloatArray:
        """(len(edges) + 1,) share of area below the first edge, between each two, and from the last one on."""
        place = np.searchsorted(edges_mm, self.distance_mm, side="right")
        share: FloatArray = np.bincount(place, self.samples.area_mm2, minlength=len(edges_mm) + 1).astype(np.float64)
        return share / share.sum()


def deviation(of: Surface, reference: Surface, *, spacing_mm: float) -> Deviation:
    """Signed distances from `reference` of samples of `of`, about one per spacing_mm^2 and at least one per face."""
    samples = sample_surface(of, spacing_mm)
    distance, _ = SurfaceDistance(reference).signed_distance_mm(samples.places_mm)
    return Deviation(distance, samples, of.origin_of_face[samples.face])


def both_ways(one: Surface, other: Surface, *, spacing_mm: float) -> tuple[Deviation, Deviation]:
    """`deviation` of each from the other."""
    return deviation(one, other, spacing_mm=spacing_mm), deviation(other, one, spacing_mm=spacing_mm)


def vertex_deviation_mm(of: Surface, reference: Surface) -> FloatArray:
    """(n,) signed distance of each vertex from `reference`, for colouring."""
    return SurfaceDistance(reference).signed_distance_mm(of.vertices)[0]


def band_colours(distance_mm: FloatArray, tolerance_mm: float) -> FloatArray:
    """(n, 3) linear RGB: white within a quarter of the tolerance, through yellow to red above it, through cyan to blue below it."""
    t = np.clip((np.abs(distance_mm) / tolerance_mm - 0.25) / 0.75, 0.0, 1.0)[:, None]
    middle, far = np.array([1.0, 0.9, 0.2]), np.array([0.8, 0.05, 0.05])
    cold_middle, cold_far = np.array([0.3, 0.85, 0.9]), np.array([0.05, 0.1, 0.75])
    warm = np.where(t < 0.5, 1 + 2 * t * (middle - 1), middle + (2 * t - 1) * (far - middle))
    cold = np.where(t < 0.5, 1 + 2 * t * (cold_middle - 1), cold_middle + (2 * t - 1) * (cold_far - cold_middle))
    return np.where((distance_mm >= 0)[:, None], warm, cold)
