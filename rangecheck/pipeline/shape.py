"""solid: from a surface to a part that can be built - closed, cut, scaled, thinned, hollowed, and only then proved and written."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rangecheck import memory
from rangecheck.arrays import FloatArray
from rangecheck.config import Settings
from rangecheck.config.schema import Solidify
from rangecheck.errors import NotSolid, OutputError, SettingError
from rangecheck.files import write_json
from rangecheck.pipeline.folder import check_writable
from rangecheck.pipeline.health import versions
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.printable import left_out, printer_of, printing_of
from rangecheck.pipeline.subject import eye_of, hashes, read_subject
from rangecheck.progress import Reporter
from rangecheck.rigid import inverse
from rangecheck.solid import Solid, Verdict, check_solid, choose_base_height, untangle, verdict
from rangecheck.solid.base import FACES_OF_ENGINE, UP, trimmed
from rangecheck.solid.closing import Closed, choose_way, close_surface
from rangecheck.solid.engine import needed_mb
from rangecheck.solid.hollow import Hollow, hollow
from rangecheck.surface import ORIGIN_NAMES, Surface
from rangecheck.surface.edges import forget_edges
from rangecheck.surface.intersections import FACES_OF_BLOCK
from rangecheck.surface.standing import file_from_scans
from rangecheck.surface.tree import forget_tree

if TYPE_CHECKING:
    from rangecheck.export.stl import Exported


#: what proving, writing and reading back takes of a face beside the surface itself, without manifold3d (measured at 2e7 faces: 152); of few, whose
#: faces are looked at all at once for crossings, it is more
BYTES_A_FACE, BYTES_OF_FEW = 155, 300


@dataclass
class Made:
    """What became of a surface: the solid or None, the verdict, and what was done and measured on the way."""

    solid: Solid | None
    verdict: Verdict
    surface: Surface
    closed: Closed | None = None
    hollowed: Hollow | None = None
    simplified: dict[str, Any] | None = None
    facts: dict[str, Any] = field(default_factory=dict)


def solid_of(
    surface: Surface, settings: Settings, reporter: Reporter, eye_mm: FloatArray | None = None
) -> tuple[Solid | None, Verdict]:
    """A solid of the surface - a relief closed, a bust cut flat - and the verdict; no solid when it cannot honestly be made one."""
    made = make_solid(surface, settings, reporter, eye_mm)
    return made.solid, made.verdict


def make_solid(surface: Surface, settings: Settings, reporter: Reporter, eye_mm: FloatArray | None = None) -> Made:
    """As `solid_of`, with all that was done. Raises SettingError where memory is bounded and has no room for a step that was asked for."""
    wanted = settings.solid
    _refuse_what_has_no_room(surface, wanted, eye_mm)
    with reporter.stage("closing"):
        closed = _closed(surface, wanted, eye_mm, reporter)
    made = Made(None, closed.after, closed.surface, closed)
    if not _can_go_on(closed.after):
        return made
    del surface
    try:
        with reporter.stage("base"):
            shaped = _based(_cut(closed.surface, wanted, reporter), wanted, reporter)
            shaped = _scaled(shaped, wanted.height_mm, reporter) if wanted.height_mm is not None else shaped
        if shaped is not closed.surface:
            # what it was before is asked for no more, and is held no longer
            made.closed = closed = replace(closed, surface=shaped, solid=None)
            made.surface = shaped
        if wanted.simplify_mm is not None:
            with reporter.stage("simplifying"):
                shaped = _simplified(shaped, made, wanted, reporter)
        made.surface = shaped
        if wanted.wall_mm is not None:
            with reporter.stage("hollowing"):
                shaped = _hollowed(shaped, made, wanted, reporter)
        with reporter.stage("proving"):
            proved = closed.solid if shaped is closed.surface and not settings.checking.severities else None
            made.solid = proved or _proved(shaped, settings, reporter)
        made.surface, made.verdict = made.solid.surface, made.solid.verdict
    except NotSolid as refusal:
        found = refusal.measured.get("verdict")
        made.solid, made.verdict = None, found if isinstance(found, Verdict) else check_solid(made.surface)
    return made


def _refuse_what_has_no_room(surface: Surface, wanted: Solidify, eye_mm: FloatArray | None) -> None:
    """Steps that manifold3d does, where it takes more than there is: said before anything is computed."""
    takes, left = needed_mb(len(surface.faces)), memory.left_mb()
    if takes <= left:
        return
    by_engine = len(surface.faces) <= FACES_OF_ENGINE
    bases = {"auto": by_engine, "socle": True, "none": False}
    steps = {
        "solid.cut": wanted.cut is not None and by_engine,
        "solid.base_height_mm": wanted.base_height_mm is not None and by_engine,
        "solid.simplify_mm": wanted.simplify_mm is not None,
        "solid.wall_mm": wanted.wall_mm is not None,
        "solid.base": bases[wanted.base] and choose_way(surface, one_scan=eye_mm is not None)[0] != "relief",
    }
    named = [key for key, is_asked in steps.items() if is_asked]
    if named:
        raise SettingError(
            f"{', '.join(named)} of {len(surface.faces):,} faces takes about {takes:,.0f} MB, and memory_mb leaves {left:,.0f}; "
            "raise it, or leave that out (--base none)",
            key=named[0],
        )


def _proved(surface: Surface, settings: Settings, reporter: Reporter) -> Solid:
    """The surface as a solid; where cutting and thinning left faces that cross by a hair, with these loosened within the leash."""
    severities = settings.checking.severities
    try:
        return Solid.from_surface(surface, severities=severities)
    except NotSolid as refusal:
        if not any(f.code in ("self-intersections", "overlapping-faces") for f in refusal.measured["findings"]):
            raise
        loose = untangle(surface, max_move_mm=settings.solid.max_move_mm)
        if loose.after:
            raise
        reporter.note(
            f"{loose.before} pairs of faces came loose, {loose.vertices_moved} vertices moved by up to {loose.moved_mm:.3g} mm"
        )
        return Solid.from_surface(loose.surface, severities=severities)


def _can_go_on(judged: Verdict) -> bool:
    """Whether what is closed and manifold may be cut and scaled, though faces of it may still cross: the proof at the end decides."""
    return judged.facts["closed"] and not judged.has("non-manifold-vertices") and not judged.has("engine-refuses")


def _closed(surface: Surface, wanted: Solidify, eye_mm: FloatArray | None, reporter: Reporter) -> Closed:
    closed = close_surface(
        surface,
        way=wanted.close,
        back_mm=wanted.relief_depth_mm,
        eye_mm=eye_mm,
        max_move_mm=wanted.max_move_mm,
        max_vanished=wanted.max_vanished_percent / 100,
        longest_hole_mm=wanted.longest_hole_mm,
    )
    if not closed.before.fit:
        reporter.note(f"closed by {closed.way}: {closed.reason}")
    for step in closed.steps:
        reporter.note(step.message)
    for refusal in closed.refused:
        reporter.note(f"not mended: {refusal}")
    return closed


def _cut(surface: Surface, wanted: Solidify, reporter: Reporter) -> Surface:
    if wanted.cut is None:
        return surface
    *normal, distance = wanted.cut
    length = sum(x * x for x in normal) ** 0.5
    if length == 0:
        raise SettingError("setting solid.cut has a normal of length 0; give nx, ny, nz, d", key="solid.cut")
    kept = trimmed(surface, height_mm=distance / length, up=normal, cap="cut")
    reporter.note(
        f"cut by the plane {', '.join(f'{x:g}' for x in wanted.cut)}: {100 * (1 - kept.volume_mm3 / surface.volume_mm3):.1f} % of the volume goes"
    )
    return kept


def _based(surface: Surface, wanted: Solidify, reporter: Reporter) -> Surface:
    """Cut flat where it stands, on a socle or hollow behind where that is asked for."""
    relief = "back" in surface.part_names
    if relief and wanted.relief_back == "hollow":
        from rangecheck.solid.relief_back import hollow_back

        if wanted.wall_mm is None:
            raise SettingError("a hollow back has a wall; say how thick with solid.wall_mm (--wall-mm)", key="solid.wall_mm")
        before = surface.volume_mm3
        surface = hollow_back(surface, wall_mm=wanted.wall_mm)
        reporter.note(
            f"back hollowed to a wall of {wanted.wall_mm:g} mm: {100 * (1 - surface.volume_mm3 / before):.1f} % less resin, open behind"
        )
    if wanted.base_height_mm is not None:
        height, reason = float(surface.bounds_mm[0, 1]) + wanted.base_height_mm, "asked for"
    elif wanted.base == "none" or relief:
        return surface
    else:
        chosen = choose_base_height(surface)
        height, reason = chosen.height_mm, chosen.reason
    cut = trimmed(surface, height_mm=height, up=UP)
    reporter.note(
        f"base at {height:.1f} mm: {reason}; {100 * (1 - cut.volume_mm3 / surface.volume_mm3):.1f} % of the volume goes"
    )
    if wanted.base == "socle":
        from rangecheck.solid.socle import with_socle

        cut = with_socle(cut, nameplate=wanted.nameplate)
        reporter.note("a socle was put under it")
    elif wanted.nameplate:
        raise SettingError(
            "a nameplate stands on a socle; ask for one with solid.base=socle (--base socle)", key="solid.nameplate"
        )
    return cut


def _scaled(surface: Surface, height_mm: float, reporter: Reporter) -> Surface:
    """The same at another height; what follows sees it at that size, because what is sound at one size need not be at another."""
    low, high = surface.bounds_mm
    scale = height_mm / float(high[1] - low[1])
    error = surface.vertex_error_mm
    reporter.note(f"scaled by {scale:.4f} to {height_mm:g} mm")
    return replace(surface, vertices=(surface.vertices - low) * scale, vertex_error_mm=None if error is None else error * scale)


def _simplified(surface: Surface, made: Made, wanted: Solidify, reporter: Reporter) -> Surface:
    from rangecheck.solid.simplify import printable_error_mm, simplify

    allowed = wanted.simplify_mm
    if allowed == "auto":
        profile = printer_of(wanted)
        if profile is None:
            raise SettingError(
                "simplify_mm auto takes the error from a printer; name one with --printer, or give a length", key="solid.printer"
            )
        allowed = printable_error_mm(profile)
    assert isinstance(allowed, float)
    less = simplify(surface, error_mm=allowed)
    made.simplified = {
        "error_mm": less.error_mm,
        "allowed_mm": allowed,
        "faces_before": less.faces_before,
        "faces_after": less.faces_after,
    }
    reporter.note(
        f"simplified from {less.faces_before:,} to {less.faces_after:,} faces; either lies at most {less.error_mm:.4f} mm off the other "
        f"({allowed:g} mm allowed)"
    )
    return less.surface


def _hollowed(surface: Surface, made: Made, wanted: Solidify, reporter: Reporter) -> Surface:
    if wanted.relief_back == "hollow" and "back" in surface.part_names:
        return surface
    assert wanted.wall_mm is not None
    result = made.hollowed = hollow(surface, wall_mm=wanted.wall_mm, drain_mm=wanted.drain_mm, up=wanted.print_up)
    for note in result.notes:
        reporter.note(note)
    return result.surface


def solid(
    path: str,
    out: str,
    *,
    settings: Settings,
    unit: str | None,
    force: bool,
    reporter: Reporter,
    ascii: bool = False,
    force_open: bool = False,
    orient: bool = False,
) -> Outcome:
    """A solid of what is in `path`, written to `out` (STL, 3MF, PLY, GLB, OBJ, OFF by its ending) when it is one, with a JSON beside it that
    says where it came from; otherwise the findings that stand against it. `force_open` writes what is no solid all the same."""
    from rangecheck.export.meshes import SUFFIXES, write_mesh
    from rangecheck.solid.slicer import weld_distance_mm, weld_findings

    if Path(out).suffix.lower() not in SUFFIXES:
        raise OutputError(out, f"ends in {Path(out).suffix or 'nothing'}; a mesh ends in {', '.join(SUFFIXES)}")
    if force_open and Path(out).suffix.lower() != ".stl":
        raise OutputError(out, "is no STL; --force-open is for a slicer that mends by itself, and other formats hold solids only")
    check_writable(out)
    beside = Path(f"{out}.json")
    for target in (Path(out), beside):
        if target.exists() and not force:
            raise OutputError(target, "exists already; pass --force to replace it")
    printer_of(settings.solid)
    made = _made_of(path, unit, settings, reporter)
    lines, said = _story(made)
    lines += made.verdict.lines()
    shares = {"parts": _areas(made.surface), "origins": {n: made.surface.share_of_area(k) for k, n in enumerate(ORIGIN_NAMES)}}
    content = document(
        "solid", output=None, solid=made.solid is not None, fit=made.solid is not None, verdict=made.verdict.to_dict(), **said, areas=shares,
        options={"unit": unit, "ascii": ascii, "force_open": force_open, "settings": settings.model_dump(mode="json")},
        inputs=hashes([path]), versions=versions(),
    )  # fmt: skip
    if made.solid is None and not force_open:
        return Outcome(
            content | {"seconds": reporter.seconds, "decisions": reporter.notes}, [*lines, "nothing was written"], False
        )
    with reporter.stage("exporting"):
        part = made.solid or made.surface
        forget_edges(made.surface)
        forget_tree(made.surface)
        stand = settings.solid.file_up == "z"
        written = write_mesh(
            part, out, force=force, force_open=force_open, ascii=ascii, stand=stand, severities=settings.checking.severities
        )
        plugs = _write_plugs(made, out, force, stand)
    fit = made.solid is not None
    if made.solid is not None and written is not None:
        forget_edges(written.read_back)
        near = weld_findings(written.read_back, severities=settings.checking.severities)
        unjudged = left_out(made.solid, settings)
        near += unjudged
        reread = verdict([*written.verdict.findings, *near], written.verdict.facts)
        content["read_back"] = reread.to_dict() | {
            "faces": written.faces, "moved_by_rounding_mm": written.moved_mm, "weld_mm": weld_distance_mm(written.read_back)
        }  # fmt: skip
        lines += [f"{out}: {written.faces:,} faces, read back as a slicer would and checked: {written.verdict.sentence()}"]
        lines += [f"  {f.severity:<8} {f.code}: {f.message}" for f in near]
        with reporter.stage("printing"):
            printed, printing_lines = ({}, []) if unjudged else printing_of(made.solid, settings, orient=orient)
        content |= printed
        lines += printing_lines
        fit = printed.get("fit", True)
    else:
        lines.append(f"{out}: written although it is no solid")
    lines += [f"{path}: plug" for path in plugs]
    content |= {
        "output": out,
        "standing": standing_of(written),
        "plugs": plugs,
        "fit": fit,
        "seconds": reporter.seconds,
        "decisions": reporter.notes,
    }
    try:
        write_json(beside, content, force=force)
    except OutputError:
        for one in (out, *plugs):  # a part without its word is not left; nor does it stand in the way of the next try
            Path(one).unlink(missing_ok=True)
        raise
    return Outcome(content, [*lines, f"{beside}: what it was made of, and how"], fit)


def _made_of(path: str, unit: str | None, settings: Settings, reporter: Reporter) -> Made:
    subject = read_subject(path, settings, unit, reporter)
    count = len(subject.surface.faces)
    takes, left = max(BYTES_A_FACE * count, BYTES_OF_FEW * min(count, FACES_OF_BLOCK)) / 1e6, memory.left_mb()
    if takes > left:
        raise SettingError(
            f"a solid of {count:,} faces takes about {takes:,.0f} MB to prove, write and read back, and memory_mb leaves "
            f"{left:,.0f}; raise it, or begin with a coarser mesh (rangecheck check still judges this one)",
            key="memory_mb",
        )
    eye, surface = eye_of(subject.scans), [subject.surface]
    del subject
    # handed over: once it is cut it is held nowhere
    return make_solid(surface.pop(), settings, reporter, eye)


def _story(made: Made) -> tuple[list[str], dict[str, Any]]:
    """What was done, for people and for programs."""
    lines: list[str] = []
    said: dict[str, Any] = {"repair": None, "hollow": None, "simplified": made.simplified}
    closed = made.closed
    if closed is not None and (closed.steps or closed.refused):
        rows = closed.table()
        lines += [f"{'':<24} {'Original':>12} {'Final':>12}"]
        lines += [f"{name:<24} {before:>12,} {after:>12,}" for name, before, after in rows]
        lines += [
            f"nothing outside filled places moved farther than {closed.moved_mm:.4f} mm; {100 * closed.vanished:.3f} % of the area is gone"
        ]
    if closed is not None:
        said["repair"] = {
            "way": closed.way, "reason": closed.reason, "steps": [vars(s) for s in closed.steps], "refused": closed.refused,
            "moved_mm": closed.moved_mm, "vanished": closed.vanished,
            "table": [{"what": w, "original": a, "final": b} for w, a, b in closed.table()],
        }  # fmt: skip
    if made.hollowed is not None:
        lines += made.hollowed.lines()
        said["hollow"] = made.hollowed.to_dict()
    return lines, document("story", **said) | {"schema": "rangecheck/solid/1"}


def _areas(surface: Surface) -> dict[str, dict[str, float]]:
    """mm2 of each part by origin."""
    areas = surface.face_areas
    return {
        name: {
            origin: float(areas[(surface.part_of_face == part) & (surface.origin_of_face == k)].sum())
            for k, origin in enumerate(ORIGIN_NAMES)
        }
        for part, name in enumerate(surface.part_names)
    }


def standing_of(written: Exported | None) -> dict[str, Any] | None:
    """How a written file stands, for its JSON: the motions between its frame and that of the scans; None where they are the same."""
    if written is None or written.lowered_mm is None:
        return None
    motion = file_from_scans(written.lowered_mm)
    return {"up": "z", "file_from_scans": motion.tolist(), "scans_from_file": inverse(motion).tolist()}


def _write_plugs(made: Made, out: str, force: bool, stand: bool) -> list[str]:
    from rangecheck.export.meshes import write_mesh

    paths = []
    for number, plug in enumerate(made.hollowed.plugs if made.hollowed else (), 1):
        path = Path(out).with_name(f"{Path(out).stem}_plug_{number}{Path(out).suffix}")
        write_mesh(plug, path, force=force, stand=stand)
        paths.append(str(path))
    return paths
