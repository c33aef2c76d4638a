"""Scans refined by the shading of their own brightness, where that is asked for, and the faces that came of it."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import count
from threading import Lock
from typing import Any

import numpy as np

from rangecheck import kernels, memory
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
    """Each scan with a brightness image refined by it; those that cannot be are kept, and it is said why. Side by side, a core each, unless memory is
    bounded."""
    with reporter.stage("refining by shading", len(scans)):
        ended, telling = count(1), Lock()

        def one(first: int, _: int) -> Refined | ScanError:
            with kernels.alone():
                try:
                    return refine(scans[first])
                except ScanError as refusal:
                    return refusal
                finally:
                    with telling:
                        reporter.advance(next(ended))

        with kernels.threads(1) if memory.bounded() else nullcontext():
            answers = kernels.in_chunks(one, len(scans), 1)
    found, done, facts = [], [], []
    for scan, answer in zip(scans, answers, strict=True):
        if isinstance(answer, ScanError):
            found.append(scan)
            facts.append({"name": scan.name, "refined": 0.0, "refused": str(answer)})
            reporter.note(f"not refined: {answer}")
            continue
        found.append(answer.scan)
        done.append(answer)
        share = float(answer.refined.sum() / scan.valid.sum())
        moved = float(np.sqrt(np.nanmean(answer.moved_mm**2)))
        painted = float(answer.painted.sum() / scan.valid.sum())
        facts.append({"name": scan.name, "refined": share, "moved_rms_mm": moved, "painted": painted})
        reporter.note(
            f"{scan.name}: {100 * share:.0f} % of the cells refined by their brightness, ranges moved by {moved:.3f} mm (rms)"
        )
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
