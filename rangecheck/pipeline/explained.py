"""A scan against its own brightness image: what `fit` does with a scan, and `check` with one that has a picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.export.pictures import write_png
from rangecheck.optics import Sensor
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import hashes, read_all_scans
from rangecheck.progress import Reporter
from rangecheck.recover.compare import Comparison, compare
from rangecheck.scan import RangeScan

#: cells of the grid on which scan and picture are compared, about
_CELLS = 400_000
#: regions told of in lines; the document has all
_TOLD = 12


def fit_scan(
    path: str, out: str | None, *, response: str, unit: str | None, scale_mm: float | None, force: bool, reporter: Reporter
) -> Outcome:
    """Material and lamp of a scan's brightness image on the scan's own surface, and where the scan does not explain it."""
    scans = read_all_scans([path], unit, reporter)
    results, lines = [], []
    for scan in scans:
        if not isinstance(scan, RangeScan):
            continue
        with reporter.stage(f"comparing {scan.name} with its picture"):
            found = compared(scan, response, scale_mm)
        results.append({"name": scan.name} | facts(found))
        lines += told(scan.name, found)
        if out is not None:
            name = Path(out) if len(scans) == 1 else Path(out).with_name(f"{Path(out).stem}-{scan.name}{Path(out).suffix}")
            write_png(name, residual_picture(found), force=force)
            lines.append(f"{name}: dark where the scan's shading is not in the picture, bright where the picture has more of it")
    fit = not any(result["regions"] for result in results)
    return Outcome(document("explained", fit=fit, scans=results, inputs=hashes([path]), seconds=reporter.seconds), lines, fit)


def compared(scan: RangeScan, response: str, scale_mm: float | None = None) -> Comparison:
    """The comparison on about _CELLS cells, the brightness made linear in light first."""
    if scan.brightness is not None and response != "linear":
        linear = Sensor(bits=0, response=response).linearise(scan.brightness)
        scan = replace(scan, brightness=linear.astype(np.float32))
    step = max(1, round(float(np.sqrt(scan.range_mm.size / _CELLS))))
    return compare(scan, step=step, scale_mm=scale_mm)


def facts(found: Comparison) -> dict[str, Any]:
    """A comparison as a document."""
    light, material = found.fitted.problem.lights[0], found.fitted.problem.material
    return {
        "judged": found.judged,
        "light_direction": light.direction,
        "light_distance_mm": light.distance_mm,
        "material": vars(material),
        "not_determined": found.fitted.statements,
        "regions": [vars(region) for region in found.regions],
    }


def told(name: str, found: Comparison) -> list[str]:
    """A comparison in lines."""
    light = found.fitted.problem.lights[0]
    d = ", ".join(f"{v:.3f}" for v in light.direction)
    lines = [f"{name}: {found.judged:.0%} of the scan judged by its picture, lamp towards {d} (scan's frame)"]
    lines += [f"  not determined: {said}" for said in found.fitted.statements]
    if not found.regions:
        lines.append("  the scan explains the picture: no place contradicts it")
    for region in found.regions[:_TOLD]:
        x, y, z = region.middle_mm
        lines.append(
            f"  {region.kind} at {x:.1f}, {y:.1f}, {z:.1f} mm: {region.area_mm2:.0f} mm2, {region.length_mm:.0f} x {region.width_mm:.0f} mm, "
            f"z {region.z:.1f}"
        )
    return lines


def residual_picture(found: Comparison) -> FloatArray:
    """(h, w, 3) uint8: z from -8 (black) to 8 (white), grey 0; blue where not judged."""
    level = np.clip(found.z / 16.0 + 0.5, 0.0, 1.0)
    grey = np.repeat((np.nan_to_num(level) * 255.0)[..., None], 3, axis=2)
    grey[~np.isfinite(found.z)] = (20, 30, 60)
    return grey.astype(np.uint8)
