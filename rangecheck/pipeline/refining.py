"""Scans refined by the shading of their own brightness, where that is asked for, and the faces that came of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rangecheck.errors import ScanError
from rangecheck.progress import Reporter
from rangecheck.recover.refine import Refined, refine, refined_faces
from rangecheck.scan import RangeScan
from rangecheck.surface import MEASURED, Surface


@dataclass(frozen=True)
class Shaped:
    """scans in the given order, refined where that could be done; `done` what was refined; `facts` JSON-ready, scan by scan."""

    scans: list[RangeScan]
    done: list[Refined]
    facts: list[dict[str, Any]]


def refined_scans(scans: list[RangeScan], reporter: Reporter) -> Shaped:
    """Each scan with a brightness image refined by it; those that cannot be are kept, and it is said why."""
    found, done, facts = [], [], []
    with reporter.stage("refining by shading", len(scans)):
        for number, scan in enumerate(scans, 1):
            try:
                better = refine(scan)
            except ScanError as refusal:
                found.append(scan)
                facts.append({"name": scan.name, "refined": 0.0, "refused": str(refusal)})
                reporter.note(f"not refined: {refusal}")
            else:
                found.append(better.scan)
                done.append(better)
                share = float(better.refined.sum() / scan.valid.sum())
                moved = float(np.sqrt(np.nanmean(better.moved_mm**2)))
                facts.append(
                    {
                        "name": scan.name,
                        "refined": share,
                        "moved_rms_mm": moved,
                        "painted": float(better.painted.sum() / scan.valid.sum()),
                    }
                )
                reporter.note(
                    f"{scan.name}: {100 * share:.0f} % of the cells refined by their brightness, ranges moved by {moved:.3f} mm (rms)"
                )
            reporter.advance(number)
    return Shaped(found, done, facts)


def labelled(surface: Surface, done: list[Refined], scans: list[Any]) -> Surface:
    """The surface, its faces told apart by whether a picture had a say in them; scans as they were placed at last."""
    places = {scan.name: scan.world_from_scan for scan in scans if isinstance(scan, RangeScan)}
    placed = [replace(one, scan=one.scan.moved(places[one.scan.name])) for one in done if one.scan.name in places]
    if not placed:
        return surface
    # a face's middle lies as far from its cells' ranges as noise and the slant of one cell let it
    reach = max(4.0 * float(np.nanmedian(one.noise_mm)) for one in placed) + 2.0 * float(np.sqrt(np.median(surface.face_areas)))
    return replace(surface, refined_of_face=refined_faces(surface, placed, reach))


def share_refined(surface: Surface) -> float:
    """Of the area measured, that whose heights a picture had a say in."""
    if surface.refined_of_face is None:
        return 0.0
    area = surface.face_areas
    return float(area[surface.refined_of_face].sum() / max(area[surface.origin_of_face == MEASURED].sum(), 1e-300))
