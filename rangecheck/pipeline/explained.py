"""A scan against the pictures that belong to it: what `fit` does with a scan, and `check` with one that has a picture.

A structured-light scan of two cameras is held against the second camera's picture, any other against its own brightness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray
from rangecheck.errors import OutputError, ScanError
from rangecheck.export.legend import INK, PAPER, ColourScale, colours_of, font, framed, letter_px
from rangecheck.export.pictures import Picture, write_png
from rangecheck.optics import Sensor
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import hashes, holds_capture, read_all_scans
from rangecheck.pipeline.views import refuse_existing
from rangecheck.progress import Reporter
from rangecheck.recover.compare import JUDGED_MM, Comparison, compare
from rangecheck.recover.dents import JUDGED_MM as DENT_MM
from rangecheck.recover.dents import RADII_MM
from rangecheck.recover.regions import AGAINST_SHAPE, Region
from rangecheck.recover.second_view import Agreement, second_view
from rangecheck.scan import RangeScan
from rangecheck.solid.findings import Finding, finding

#: cells of the grid on which scan and picture are compared, about
_CELLS = 400_000
#: the same of a second picture, which finer paint tells more
_SECOND_CELLS = 900_000
#: regions told of in lines; the document has all
_TOLD = 12
#: of the picture of what is left: levels to either side, greys of what was not compared, cells around, and about its longer side in pixels
_SPAN, _FADED, _MARGIN, _SIDE = 2.0, (120.0, 235.0), 4, 720
_MEANS = "red: the scan lies deeper than its picture shows, blue: higher; named beyond 1; grey: not compared"
#: share of a scan below which it is not said to be judged
_HARDLY = 0.005
_CODE = "scan-contradicts-picture"


@dataclass(frozen=True)
class Pictured:
    """Scans against their pictures: `facts` JSON-ready, scan by scan, `lines` for a person, `findings` with places in the world frame."""

    facts: list[dict[str, Any]]
    lines: list[str]
    findings: list[Finding]


def pictured(path: str | Path, scans: Sequence[Any], severities: Mapping[str, str], reporter: Reporter) -> Pictured:
    """What the pictures say of the scans that were read from `path`; those without a picture are passed over."""
    facts: list[dict[str, Any]] = []
    lines: list[str] = []
    findings: list[Finding] = []
    for scan in scans:
        if not isinstance(scan, RangeScan) or scan.brightness is None:
            continue
        try:
            with reporter.stage(f"comparing {scan.name} with its picture"):
                about, regions, said = _by_second_picture(path, scan) or _by_shading(scan)
        except ScanError as refusal:
            facts.append({"name": scan.name, "by": "none", "judged": 0.0, "regions": [], "refused": str(refusal)})
            lines.append(f"not held against its picture: {refusal}")
            continue
        facts.append({"name": scan.name, **about, "regions": [vars(region) for region in regions]})
        lines += said
        wrong = [region for region in regions if region.kind in AGAINST_SHAPE]
        if wrong:
            places = rigid.move_points(scan.world_from_scan, np.array([region.middle_mm for region in wrong]))
            counts = {kind: sum(r.kind == kind for r in wrong) for kind in AGAINST_SHAPE}
            kinds = " and ".join(f"{count} of {kind}" for kind, count in counts.items() if count)
            places_said = "one place" if len(wrong) == 1 else f"{len(wrong)} places"
            message = f"{scan.name}: at {places_said} its shape is not what its picture shows ({kinds})"
            findings.append(
                finding(_CODE, len(wrong), message, places, None, severities, kinds=[region.kind for region in wrong])
            )
            lines.append(f"{findings[-1].severity}: {message}; rangecheck explain {_CODE}")
    return Pictured(facts, lines, findings)


def _by_second_picture(path: str | Path, scan: RangeScan) -> tuple[dict[str, Any], tuple[Region, ...], list[str]] | None:
    """By the right camera's picture of a folder of structured light; None where there is none."""
    if not holds_capture(Path(path)):
        return None
    from rangecheck.scan.decode import read_capture

    capture = read_capture(path)
    if capture.right is None or capture.right_view is None:
        return None
    sensor = Sensor(bits=0, response="srgb")
    assert scan.brightness is not None
    linear = replace(scan, brightness=sensor.linearise(scan.brightness).astype(np.float32))
    right = sensor.linearise(capture.right.white / capture.right.full_scale)
    found: Agreement = second_view(linear, right, capture.right_view, step=_step(scan, _SECOND_CELLS))
    whole = ", ".join(f"{100 * share:.0f} % ({radius:g} mm)" for share, radius in zip(found.dents.judged, RADII_MM))
    said = [
        f"{scan.name}: held against the second camera's picture, steps of {found.level_mm:.2f} mm would be named on {100 * found.judged:.0f} % of it, dents of "
        f"{DENT_MM:g} mm on {whole}, by radius; elsewhere there is too little paint, or gloss that the two see in different places, or a rim",
        *_places(found.regions, scan.world_from_scan, max(found.judged, *found.dents.judged)),
    ]
    judged_dents = [{"radius_mm": radius, "judged": share} for share, radius in zip(found.dents.judged, RADII_MM)]
    about = {"by": "second picture", "judged": found.judged, "least_mm": found.level_mm, "dents": judged_dents}
    return about, found.regions, said


def _by_shading(scan: RangeScan) -> tuple[dict[str, Any], tuple[Region, ...], list[str]]:
    found = compared(scan, "linear")
    known = found.least_mm[np.isfinite(found.least_mm)]
    about = {
        "by": "shading",
        "judged": found.judged,
        "least_mm": float(np.median(known)) if known.size else None,
        "paint": found.paint,
        "excluded": found.excluded,
    }
    return about, found.regions, [_judged_line(scan.name, found), *_places(found.regions, scan.world_from_scan, found.judged)]


def _judged_line(name: str, found: Comparison) -> str:
    known = found.least_mm[np.isfinite(found.least_mm)]
    compared = known.size / max(1, int(found.grid.valid.sum()))
    least = f"dents of {np.median(known):.2f} mm (median) would be named" if known.size else "nothing of it is lit well enough"
    why = [f"{100 * share:.0f} % {reason}" for reason, share in found.excluded.items() if share >= _HARDLY]
    rest = f"; not compared: {', '.join(why)}" if why else ""
    if found.judged < _HARDLY:
        return (
            f"{name}: {100 * compared:.0f} % of it could be compared{rest}; there its brightness differs by {100 * found.paint:.1f} % from the scan's shading in "
            f"structures of a dent's size (paint, or noise of the ranges), so that only {least}: its shape cannot be judged to {JUDGED_MM:g} mm by it"
        )
    left = "; what is left of that has too much paint or noise of the ranges" if compared - found.judged >= _HARDLY else ""
    return (
        f"{name}: {100 * found.judged:.0f} % of it judged by its brightness to {JUDGED_MM:g} mm, of {100 * compared:.0f} % that could be compared, where "
        f"{least}{left}{rest}"
    )


def _places(regions: Sequence[Region], world_from_scan: FloatArray, judged: float) -> list[str]:
    """Places in lines, in the world's frame, as findings give them; judged: share of the scan."""
    if not regions and judged >= _HARDLY:
        return ["  where it was judged the scan explains the picture: no place contradicts it"]
    lines = []
    for k, region in enumerate(regions[:_TOLD]):
        x, y, z = rigid.move_points(world_from_scan, np.array([region.middle_mm]))[0]
        lines.append(
            f"  {k + 1}: {_said_of(region)} at {x:.1f}, {y:.1f}, {z:.1f} mm, {region.length_mm:.0f} x {region.width_mm:.0f} mm large "
            f"({abs(region.z):.1f} sigma, named from {region.asked:.1f})"
        )
    if len(regions) > _TOLD:
        lines.append(f"  and {len(regions) - _TOLD} more")
    return lines


def _said_of(region: Region) -> str:
    """What is wrong at a place, and by how much where it is the shape."""
    if region.amount_mm is None:
        return f"{region.kind} (nothing against the shape)"
    if region.kind == "registration":
        return f"registration, a step of {abs(region.amount_mm):.2f} mm"
    return f"shape, the scan {abs(region.amount_mm):.2f} mm too {'deep' if region.amount_mm > 0.0 else 'high'}"


def fit_scan(
    path: str, out: str | None, *, response: str, unit: str | None, scale_mm: float | None, force: bool, reporter: Reporter
) -> Outcome:
    """Material and lamp of a scan's brightness image on the scan's own surface, and where the scan does not explain it."""
    if out is not None and Path(out).suffix.lower() != ".png":
        raise OutputError(out, "must end in .png: of a scan and its own brightness, the picture of what is left is written")
    scans = read_all_scans([path], unit, reporter)
    pictures = {} if out is None else {s.name: Path(out) if len(scans) == 1 else _named(Path(out), s.name) for s in scans}
    for picture in pictures.values():
        refuse_existing(picture, force)
    results, lines = [], []
    fit = True
    for scan in scans:
        if not isinstance(scan, RangeScan):
            continue
        with reporter.stage(f"comparing {scan.name} with its picture"):
            found = compared(scan, response, scale_mm)
        results.append({"name": scan.name} | facts(found))
        lines += told(scan, found)
        fit &= not any(region.kind in AGAINST_SHAPE for region in found.regions)
        if pictures:
            write_png(pictures[scan.name], residual_picture(found, scan.name), force=force)
            lines.append(f"{pictures[scan.name]}: {_MEANS}")
    return Outcome(document("explained", fit=fit, scans=results, inputs=hashes([path]), seconds=reporter.seconds), lines, fit)


def _named(picture: Path, scan: str) -> Path:
    return picture.with_name(f"{picture.stem}-{scan}{picture.suffix}")


def _step(scan: RangeScan, cells: int = _CELLS) -> int:
    return max(1, round(float(np.sqrt(scan.range_mm.size / cells))))


def compared(scan: RangeScan, response: str, scale_mm: float | None = None) -> Comparison:
    """The comparison on about _CELLS cells, the brightness made linear in light first."""
    if scan.brightness is not None and response != "linear":
        linear = Sensor(bits=0, response=response).linearise(scan.brightness)
        scan = replace(scan, brightness=linear.astype(np.float32))
    return compare(scan, step=_step(scan), scale_mm=scale_mm)


def facts(found: Comparison) -> dict[str, Any]:
    """A comparison as a document."""
    light, material = found.fitted.problem.lights[0], found.fitted.problem.material
    return {
        "judged": found.judged,
        "excluded": found.excluded,
        "paint": found.paint,
        "light_direction": light.direction,
        "light_distance_mm": light.distance_mm,
        "material": vars(material),
        "not_determined": found.fitted.statements,
        "regions": [vars(region) for region in found.regions],
    }


def told(scan: RangeScan, found: Comparison) -> list[str]:
    """A comparison in lines."""
    light = found.fitted.problem.lights[0]
    d = ", ".join(f"{v:.3f}" for v in light.direction)
    lines = [_judged_line(scan.name, found), f"  lamp towards {d} (scan's frame)"]
    lines += [f"  not determined: {said}" for said in found.fitted.statements]
    return lines + _places(found.regions, scan.world_from_scan, found.judged)


def residual_picture(found: Comparison, name: str) -> Picture:
    """(H, W, 3) uint8: z of the strongest false hollow in units of the level, over the scan's faded brightness where nothing was compared; places
    that are named have a ring, and the number that they have in the list, with what they are."""
    from PIL import Image, ImageDraw

    valid = found.grid.valid
    rows, columns = (np.flatnonzero(valid.any(axis=axis)) for axis in (1, 0))
    held = (
        slice(max(0, rows[0] - _MARGIN), rows[-1] + 1 + _MARGIN),
        slice(max(0, columns[0] - _MARGIN), columns[-1] + 1 + _MARGIN),
    )
    light = np.sqrt(np.clip(np.nan_to_num(found.grid.picture) / max(float(np.nanmax(found.grid.picture)), 1e-9), 0.0, 1.0))
    faded = np.rint(_FADED[0] + (_FADED[1] - _FADED[0]) * light).astype(np.uint8)
    shown = np.where(valid[..., None], faded[..., None], np.array(PAPER, np.uint8))
    compared = np.isfinite(found.hollow)
    shown = np.where(compared[..., None], colours_of(found.hollow / found.level, -_SPAN, _SPAN, "RdBu_r"), shown)[held]
    times = max(1, round(_SIDE / max(shown.shape[:2])))
    image = Image.fromarray(np.repeat(np.repeat(shown.astype(np.uint8), times, axis=0), times, axis=1))
    draw = ImageDraw.Draw(image)
    letters = font(letter_px(image.height))
    for k, region in enumerate(found.regions[:_TOLD]):
        y, x = ((at - start.start + 0.5) * times for at, start in zip(_cell_of(region, found), held))
        reach = times * (0.5 * region.length_mm / found.grid.spacing_mm + 4.0)
        draw.ellipse((x - reach, y - reach, x + reach, y + reach), outline=INK, width=2)
        said = f"{k + 1} {region.kind}"
        wide, high = draw.textbbox((0, 0), said, font=letters)[2:]
        # beside the ring, and inside the picture
        right, up = min(x + 0.8 * reach, image.width - wide - 4.0), max(y - 0.8 * reach, high + 4.0)
        draw.text((right, up), said, font=letters, fill=INK, anchor="lb", stroke_width=2, stroke_fill=PAPER)
    scale = ColourScale(-_SPAN, _SPAN, f"{found.level:.1f} sigma", "RdBu_r", (-1.0, 1.0))
    return framed(np.asarray(image), f"{name}: shape against brightness", _MEANS, scale)


def _cell_of(region: Region, found: Comparison) -> tuple[int, int]:
    """The cell nearest to a place's middle."""
    away = np.linalg.norm(found.grid.points - region.middle_mm, axis=-1)
    row, column = np.unravel_index(int(np.nanargmin(away)), away.shape)
    return int(row), int(column)
