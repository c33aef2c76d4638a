"""What a solid would be on a printer: the check of its walls, supports and hollows, and advice on which way up."""

from __future__ import annotations

from typing import Any

import numpy as np

from rangecheck import memory
from rangecheck.config import Settings
from rangecheck.config.schema import Solidify
from rangecheck.pipeline.outcome import document
from rangecheck.solid import Solid
from rangecheck.solid.findings import Finding, finding
from rangecheck.solid.printer import Printer, printer

#: what the look at walls, and what the whole check and the advice, take of a face (measured from 2e5 to 2e6 faces: 305 to 385, 540 to 660)
BYTES_OF_WALLS, BYTES_OF_PRINTING = 385, 660
#: orientations that are printed
SHOWN = 5


def printer_of(wanted: Solidify) -> Printer | None:
    """The profile that the part is judged for, if one was named."""

    return printer(wanted.printer) if wanted.printer else None


def left_out(solid: Solid, settings: Settings) -> list[Finding]:
    """What `printing_of` has no room for where memory is bounded, as a finding; empty where it has."""
    wanted = settings.solid
    if wanted.printer is None and wanted.height_mm is None and wanted.wall_mm is None:
        return []
    what, of_face = ("printing", BYTES_OF_PRINTING) if wanted.printer else ("walls", BYTES_OF_WALLS)
    takes = of_face * len(solid.surface.faces) / 1e6
    if takes <= memory.left_mb():
        return []
    words = f"not judged: {what}, which takes about {takes:,.0f} MB, more than memory_mb leaves"
    return [finding("left-out", 1, words, severities=settings.checking.severities)]


def printing_of(solid: Solid, settings: Settings, *, orient: bool) -> tuple[dict[str, Any], list[str]]:
    """Content and lines about printing `solid` on the settings' printer: nothing without one, except the thinnest wall where the part was
    scaled or hollowed. With `orient`, advice is among it."""
    from rangecheck.errors import SettingError
    from rangecheck.solid.printing import check_printing

    wanted = settings.solid
    profile = printer_of(wanted)
    if profile is None:
        if orient:
            raise SettingError("advice on orientation is for a printer; name one with --printer", key="solid.printer")
        if wanted.height_mm is None and wanted.wall_mm is None:
            return {}, []
        wall = _thin_walls(solid)
        if wall is None:
            return {}, []
        line = f"walls at this size: 1 % of the area is thinner than {wall['thin_mm']:.2f} mm, half of it than {wall['median_mm']:.2f} mm"
        return {"walls": wall}, [f"{line}; --printer NAME says where they are too thin for it"]
    judged = check_printing(solid, profile, up=wanted.print_up, severities=settings.checking.severities)
    facts = judged.facts
    cost = f", {facts['cost']:.2f} for resin" if facts["cost"] else ""
    lines = [
        f"on {profile.name}: {facts['footprint_mm'][0]:.1f} x {facts['footprint_mm'][1]:.1f} x {facts['height_mm']:.1f} mm, {facts['layers']} layers, "
        f"{facts['volume_mm3'] / 1000:.1f} ml, {facts['mass_g']:.1f} g{cost}, largest layer {facts['peak_section_mm2']:.0f} mm2",
        *(line for line in judged.lines()[1:]),
    ]
    content: dict[str, Any] = {"printing": document("printing", **judged.to_dict())} | {"fit": judged.fit}
    if orient:
        from rangecheck.solid.orientation import advise

        found = advise(solid.surface, profile, up=wanted.print_up)
        content["orientations"] = [o.to_dict() for o in found]
        lines.append(
            "which way up (away from the build plate)   tilt  islands  overhang mm2  largest layer mm2  height mm  held mm3"
        )
        lines += [
            f"  {o.up[0]:6.3f}, {o.up[1]:6.3f}, {o.up[2]:6.3f} {'' if o.fits else '(does not fit)':<15} {o.tilt_deg:4.0f} {o.islands:>8} {o.overhang_mm2:>13.0f} "
            f"{o.peak_mm2:>18.0f} {o.height_mm:>10.1f} {o.held_mm3:>9.0f}"
            for o in found[:SHOWN]
        ]
        if not any(o.tilt_deg == 0 for o in found[:SHOWN]):
            lines.append("  (as it stands it is beaten in everything by one of these)")
    return content, lines


def _thin_walls(solid: Solid) -> dict[str, float] | None:
    """Thickness that 1 % and half of the area with an opposite side fall short of."""
    from rangecheck.solid.thickness import sample_surface, wall_thickness_mm

    samples = sample_surface(solid.surface, solid.surface.extent_mm / 100)
    wall = wall_thickness_mm(solid.surface, samples)
    finite = np.isfinite(wall)
    if not finite.any():
        return None
    order = np.argsort(wall[finite], kind="stable")
    share = np.cumsum(samples.area_mm2[finite][order])
    at = np.minimum(np.searchsorted(share, [0.01 * share[-1], 0.5 * share[-1]]), len(order) - 1)
    thin, median = wall[finite][order][at]
    return {"thin_mm": float(thin), "median_mm": float(median)}
