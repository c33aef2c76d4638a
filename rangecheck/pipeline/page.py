"""What the report of a job shows, gathered from what the job made, in the order in which a person decides."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from rangecheck import report
from rangecheck.config import Settings
from rangecheck.export.mapped import contour_picture
from rangecheck.export.pictures import png_bytes
from rangecheck.pipeline.turning import Rendered
from rangecheck.scan import RangeScan
from rangecheck.solid import Verdict


def contours_of(scan: RangeScan, settings: Settings) -> Any:
    """The contour picture of a scan, RGB."""
    return contour_picture(
        scan.depth_mm.astype(np.float64), settings.maps.contour_step_mm, title=f"Depth contours of {scan.name}"
    )


def page_of(
    content: dict[str, Any],
    judged: Verdict,
    read: list[RangeScan],
    contours: dict[str, bytes],
    distance_maps: list[tuple[str, bytes]],
    turntables: list[Rendered],
) -> report.ReportContent:
    """What the report shows, in the order in which a person decides."""
    shares = content["area_shares"]
    reasons = [
        judged.sentence(),
        f"{shares['measured']:.0%} of the surface is measured, {shares['interpolated']:.0%} interpolated, {shares['invented']:.0%} invented",
        f"meshed by {content['method']}: {content['reason']}",
    ]
    pictures = [
        report.Figure(name, "iso-lines of depth over the scan's own relief", picture) for name, picture in contours.items()
    ]
    pictures += [
        report.Figure(scan.name, "brightness, as the scanner's camera saw it", png_bytes(_brightness(scan)))
        for scan in read
        if scan.brightness is not None
    ]
    scan_section = report.Section(
        "Scans",
        "What came in: cells without a return stay without one, they are never points.",
        [(fact["name"], f"{fact['valid']:,} distances, {fact['valid_share']:.0%} of the grid") for fact in content["scans"]]
        + _worth(content["quality"]),
        pictures,
    )
    map_section = report.Section(
        "Distance maps",
        "Length from a focal point to the surface, from places where no scan was taken.",
        figures=[report.Figure("Distance", where, picture) for where, picture in distance_maps],
    )
    findings = [
        report.Finding(
            f.code, f.severity, f.count, f.message,
            "; ".join("(" + ", ".join(f"{x:.1f}" for x in p) + ")" for p in f.places_mm[:2]) + (" mm" if len(f.places_mm) else ""),
            f.why, f.mend,
        )
        for f in judged.findings
    ]  # fmt: skip
    provenance = [(name, text) for name, text in content["versions"].items()]
    provenance += [(f"input {name}", digest[:16]) for name, digest in content["inputs"].items()]
    provenance += [(f"time for {stage}", f"{seconds:.1f} s") for stage, seconds in content["seconds"].items()]
    return report.ReportContent(
        title="rangecheck report",
        fit=judged.fit,
        verdict="bust.stl can be built." if content["stl"] else "No STL was written.",
        reasons=reasons,
        sections=[scan_section, map_section],
        turntables=[report.Turntable(t.material, t.frames) for t in turntables],
        findings=findings,
        settings=json.dumps(content["settings"], indent=1),
        provenance=provenance,
    )


def _worth(quality: dict[str, Any] | None) -> list[tuple[str, str]]:
    """What the scans are worth, as lines of a table."""
    if quality is None:
        return []
    rows = [
        ("worth", f"{quality['verdict']} for {quality['profile']['name']}"),
        ("never seen", f"{quality['never_seen']:.1%} of the surface in reach, in {quality['gaps']} gaps"),
        ("samples", f"{quality['spacing_mm']:.2f} mm apart"),
        ("expected error", f"{quality['expected_error_mm']:.3f} mm"),
    ]
    rows += [(found["severity"], found["text"]) for found in quality["findings"]]
    return rows + ([("next view", quality["next_view"]["reason"])] if quality["next_view"] else [])


def _brightness(scan: RangeScan) -> Any:
    assert scan.brightness is not None
    return np.rint(255 * np.nan_to_num(np.clip(scan.brightness, 0, 1))).astype(np.uint8)
