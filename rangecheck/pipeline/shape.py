"""solid: from a surface to a part that can be built."""

from __future__ import annotations

from pathlib import Path

from rangecheck.arrays import FloatArray
from rangecheck.config import Settings
from rangecheck.errors import NotSolid, OutputError
from rangecheck.pipeline.folder import check_writable
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import eye_of, hashes, read_subject
from rangecheck.progress import Reporter
from rangecheck.solid import Solid, Verdict, check_solid, choose_base_height, close_relief, cut_flat, untangle
from rangecheck.surface import Surface
from rangecheck.surface.topology import is_closed


def solid_of(
    surface: Surface, settings: Settings, reporter: Reporter, eye_mm: FloatArray | None = None
) -> tuple[Solid | None, Verdict]:
    """A solid of the surface - a relief closed, a bust cut flat - and the verdict; no solid when it cannot honestly be made one."""
    wanted = settings.solid
    try:
        made: Solid | Surface
        with reporter.stage("closing"):
            if is_closed(surface):
                made = _untangled(surface, wanted.max_move_mm, reporter)
            else:
                made = close_relief(surface, back_mm=wanted.relief_depth_mm, eye_mm=eye_mm)
                reporter.note("open surface closed as a relief: skirt and back plane along its outer loop")
        with reporter.stage("base"):
            based = _based(made, settings, reporter)
            if wanted.height_mm is not None:
                based = _scaled(based, wanted.height_mm)
    except NotSolid as refusal:
        found = refusal.measured.get("verdict")
        return None, found if isinstance(found, Verdict) else check_solid(surface)
    return based, based.verdict


def _untangled(surface: Surface, max_move_mm: float, reporter: Reporter) -> Surface:
    """The surface with small folds loosened, none of its points moved by more than the leash."""
    result = untangle(surface, max_move_mm=max_move_mm)
    if result.before:
        reporter.note(
            f"{result.before} pairs of faces ran through each other; {result.after} do after moving {result.vertices_moved} "
            f"vertices by at most {result.moved_mm:.3f} mm (leash {max_move_mm:g} mm)"
        )
    return result.surface


def _based(made: Solid | Surface, settings: Settings, reporter: Reporter) -> Solid:
    """Cut flat where it stands, and proved."""
    wanted = settings.solid
    surface = made.surface if isinstance(made, Solid) else made
    if wanted.base_height_mm is not None:
        return cut_flat(made, height_mm=float(surface.bounds_mm[0, 1]) + wanted.base_height_mm)
    if wanted.base == "none" or "back" in surface.part_names:
        return made if isinstance(made, Solid) else Solid.from_surface(made)
    chosen = choose_base_height(made)
    cut = cut_flat(made, height_mm=chosen.height_mm)
    reporter.note(
        f"base at {chosen.height_mm:.1f} mm: {chosen.reason}; {1 - cut.volume_mm3 / made.volume_mm3:.1%} of the volume goes"
    )
    return cut


def _scaled(made: Solid, height_mm: float) -> Solid:
    """The same solid at another height; checked again, because what is sound at one size need not be at another."""
    from dataclasses import replace

    low, high = made.surface.bounds_mm
    scale = height_mm / float(high[1] - low[1])
    error = made.surface.vertex_error_mm
    scaled = replace(
        made.surface, vertices=(made.surface.vertices - low) * scale, vertex_error_mm=None if error is None else error * scale
    )
    return Solid.from_surface(scaled, notes=(*made.notes, f"scaled by {scale:.4f} to {height_mm:g} mm"))


def solid(path: str, out: str, *, settings: Settings, unit: str | None, force: bool, reporter: Reporter) -> Outcome:
    """A solid of what is in `path`, written as STL to `out` when it is one; otherwise the findings that stand against it."""
    from rangecheck.export.stl import write_stl

    if Path(out).suffix.lower() != ".stl":
        raise OutputError(out, "must end in .stl")
    check_writable(out)
    if Path(out).exists() and not force:
        raise OutputError(out, "exists already; pass --force to replace it")
    subject = read_subject(path, settings, unit, reporter)
    made, verdict = solid_of(subject.surface, settings, reporter, eye_of(subject.scans))
    if made is None:
        return Outcome(
            document("solid", output=None, verdict=verdict.to_dict(), inputs=hashes([path])),
            [*findings_lines(verdict), "no STL was written"],
            False,
        )
    with reporter.stage("exporting"):
        written = write_stl(made, out, force=force)
    lines = [f"{out}: {written.verdict.sentence()}, {written.faces:,} faces, read back and checked", *made.notes]
    return Outcome(
        document("solid", output=out, faces=written.faces, moved_by_rounding_mm=written.moved_mm, notes=made.notes,
                 verdict=written.verdict.to_dict(), inputs=hashes([path]), seconds=reporter.seconds),
        lines,
    )  # fmt: skip


def findings_lines(verdict: Verdict) -> list[str]:
    """A verdict for people: the sentence, then each finding with a place and what mends it."""
    lines = [verdict.sentence()]
    for found in verdict.findings:
        place = ""
        if len(found.places_mm):
            place = (
                " at " + ", ".join(f"{x:.2f}" for x in found.places_mm[0]) + " mm" + (" and elsewhere" if found.count > 1 else "")
            )
        lines.append(f"  {found.severity:<8} {found.code}: {found.message}{place}")
        lines.append(f"           mend: {found.mend}")
    return lines
