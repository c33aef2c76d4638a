"""mesh, solid, simulate, sample: commands whose result is geometry."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rangecheck.arrays import FloatArray
from rangecheck.config import Settings
from rangecheck.errors import NotSolid, OutputError
from rangecheck.files import whole_file
from rangecheck.pipeline.folder import check_free, check_writable
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import eye_of, hashes, read_all_scans, read_subject, surface_of
from rangecheck.progress import Reporter
from rangecheck.solid import Solid, Verdict, check_solid, choose_base_height, close_relief, cut_flat, untangle
from rangecheck.surface import ORIGIN_NAMES, Surface
from rangecheck.surface.topology import boundary_edges, is_closed


def mesh(scans: Sequence[str], out: str, *, settings: Settings, unit: str | None, force: bool, reporter: Reporter) -> Outcome:
    """One surface of all scans, written to `out`."""
    from rangecheck.export.meshes import SUFFIXES, write_mesh

    if Path(out).suffix.lower() not in SUFFIXES:
        raise OutputError(out, f"ends in {Path(out).suffix or 'nothing'}; a mesh ends in {', '.join(SUFFIXES)}")
    check_writable(out)
    read = read_all_scans(scans, unit, reporter)
    surface, method, reason = surface_of(read, settings, reporter)
    open_edges = len(boundary_edges(surface.faces))
    with reporter.stage("writing"):
        write_mesh(surface, out, force=force)
    shares = {name: surface.share_of_area(origin) for origin, name in enumerate(ORIGIN_NAMES)}
    lines = [
        f"{out}: {len(surface.faces):,} faces by {method} ({reason})",
        f"{'closed' if not open_edges else f'open: {open_edges} boundary edges'}; "
        + ", ".join(f"{share:.1%} {name}" for name, share in shares.items()),
    ]
    return Outcome(
        document(
            "mesh", output=out, method=method, reason=reason, faces=len(surface.faces), vertices=len(surface.vertices),
            boundary_edges=open_edges, shares=shares, inputs=hashes(scans), seconds=reporter.seconds, settings=settings.model_dump(mode="json"),
        ),
        lines,
    )  # fmt: skip


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


def simulate(
    path: str,
    out: str,
    *,
    unit: str | None,
    views: int,
    noise_mm: float,
    kind: str,
    ambient: float,
    size: tuple[int, int],
    seed: int,
    force: bool,
    reporter: Reporter,
) -> Outcome:
    """Scans of a mesh from a ring of views, as depth pictures with a manifest, and the truth beside each."""
    import numpy as np

    from rangecheck.optics import PinholeCamera
    from rangecheck.raycast import EmbreeCaster
    from rangecheck.scan.readers import write_scans
    from rangecheck.scan.simulate import RangeFinder, ring_of_poses, simulate_scan
    from rangecheck.surface.mesh_files import read_mesh

    check_free(out, "scans.json", force=force)
    with reporter.stage("reading mesh"):
        surface = read_mesh(path, unit)
    low, high = surface.bounds_mm
    camera = PinholeCamera.from_field_of_view(*size, 40.0)
    radius = 0.5 * float(np.linalg.norm(high - low))
    # the smaller field of view holds the sphere around the object
    distance = 1.05 * radius / np.sin(np.arctan(0.5 * min(size) / camera.fx))
    finder = RangeFinder(
        source_mm=(distance / 4, 0.0, 0.0),
        working_distance_mm=distance,
        noise_mm=noise_mm,
        step_mm=noise_mm / 10,
        kind=kind,
        ambient=ambient,
    )
    caster = EmbreeCaster(surface.vertices, surface.faces)
    poses = ring_of_poses(views, distance, target_mm=0.5 * (low + high), elevations_deg=(-12.0, 38.0) if views > 1 else (10.0,))
    made = []
    with reporter.stage("simulating", views):
        for index, pose in enumerate(poses):
            made.append(simulate_scan(caster, camera, pose, finder, seed, scan_index=index, name=f"view_{index:02d}"))
            reporter.advance(index + 1)
    step = finder.step_mm or distance * 2 / 65535
    with reporter.stage("writing"):
        manifest = write_scans(Path(out), [one.scan for one in made], step_mm=step)
        for one in made:
            with whole_file(Path(out) / "truth" / f"{one.scan.name}.npz") as part, part.open("wb") as stream:
                np.savez_compressed(
                    stream, true_range_mm=one.true_range_mm, true_normal=one.true_normal, noise_mm=one.noise_mm, reason=one.reason
                )
    valid = [int(one.scan.valid.sum()) for one in made]
    lines = [
        f"{manifest}: {views} scans of {size[0]}x{size[1]}, {sum(valid):,} distances, {kind}, noise {noise_mm:g} mm at {distance:.0f} mm",
        f"the truth of each, cell by cell, is in {Path(out) / 'truth'}",
    ]
    return Outcome(
        document(
            "simulate", manifest=manifest, valid=valid, distance_mm=distance, noise_mm=noise_mm, seed=seed, inputs=hashes([path])
        ),
        lines,
    )


def sample(out: str, *, force: bool, reporter: Reporter) -> Outcome:
    """The project's own sample scans, made again."""
    from rangecheck.scan.sample import make_sample_data

    check_free(out, "scans.json", force=force)
    with reporter.stage("scanning the sample bust"):
        manifests = make_sample_data(out)
    return Outcome(document("sample", manifests=manifests, files=hashes([out])), [str(path) for path in manifests])
