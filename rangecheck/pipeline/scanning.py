"""mesh, sample: scans to a surface, and the project's own scans."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rangecheck.config import Settings
from rangecheck.errors import OutputError, PosesRefused
from rangecheck.pipeline.folder import check_free, job_folder, key_of
from rangecheck.pipeline.health import versions
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.preparing import Measured, prepared
from rangecheck.pipeline.subject import hashes, read_all_scans, surface_of
from rangecheck.pipeline.views import refuse_existing
from rangecheck.progress import Reporter
from rangecheck.surface import ORIGIN_NAMES
from rangecheck.surface.topology import boundary_edges


def mesh(scans: Sequence[str], out: str, *, settings: Settings, unit: str | None, force: bool, reporter: Reporter) -> Outcome:
    """One surface of all scans, written to `out`."""
    from rangecheck.export.meshes import SUFFIXES, write_mesh

    if Path(out).suffix.lower() not in SUFFIXES:
        raise OutputError(out, f"ends in {Path(out).suffix or 'nothing'}; a mesh ends in {', '.join(SUFFIXES)}")
    refuse_existing(out, force)
    read = read_all_scans(scans, unit, reporter)
    if Path(out).suffix.lower() == ".stl":
        _require_more_than_a_grid(read, settings.meshing.method, out)
    try:
        ready = prepared(read, settings, reporter)
    except PosesRefused as refusal:
        return refused("mesh", refusal, reporter)
    surface, method, reason = surface_of(ready.scans, settings, reporter)
    if ready.refined:
        from rangecheck.pipeline.refining import labelled

        surface = labelled(surface, ready.refined, ready.scans)
    open_edges = len(boundary_edges(surface.faces))
    if open_edges and Path(out).suffix.lower() == ".stl":
        raise OutputError(
            out, f"STL is for what can be built, and this surface has {open_edges:,} boundary edges; write a .ply, and make a part of it with "
            "`rangecheck solid`", boundary_edges=open_edges,
        )  # fmt: skip
    with reporter.stage("writing"):
        write_mesh(surface, out, force=force)
    shares = {name: surface.share_of_area(origin) for origin, name in enumerate(ORIGIN_NAMES)}
    lines = [
        f"{out}: {len(surface.faces):,} faces by {method} ({reason})",
        f"{'closed' if not open_edges else f'open: {open_edges} boundary edges'}; "
        + ", ".join(f"{100 * share:.1f} % {name}" for name, share in shares.items()),
    ]
    if surface.refined_of_face is not None:
        lines.append(
            f"{100 * surface.refined_of_face.mean():.1f} % of the faces refined by the shading of the brightness (property refined of a .ply)"
        )
    return Outcome(
        document(
            "mesh", output=out, method=method, reason=reason, faces=len(surface.faces), vertices=len(surface.vertices),
            boundary_edges=open_edges, shares=shares, registration=ready.registration, filtered=ready.filtered, refined=ready.refining, inputs=hashes(scans), seconds=reporter.seconds, settings=settings.model_dump(mode="json"),
        ),
        lines,
    )  # fmt: skip


def _require_more_than_a_grid(scans: Sequence[Measured], method: str, out: str) -> None:
    """Raises OutputError where scans will be meshed by grid: one view's cells are a sheet, which has a rim. Of other methods it shows later."""
    from rangecheck.surface.meshing import choose_method

    if "grid" in (method, choose_method(scans)[0] if method == "auto" else ""):
        raise OutputError(
            out, f"STL is for what can be built, and {'a grid' if method == 'grid' else 'the grid of a single scan'} is open: nothing behind it "
            "was seen; write a .ply, and make a part of it with `rangecheck solid`",
        )  # fmt: skip


def refused(command: str, refusal: PosesRefused, reporter: Reporter) -> Outcome:
    """No result, because the scans could not be shown to belong together."""
    measured = refusal.measured
    return Outcome(
        document(command, fit=False, output=None, registration=measured["registration"], seconds=reporter.seconds),
        [*measured["lines"], str(refusal).rsplit("; ", 1)[-1]],
        False,
    )


def sample(out: str, *, force: bool, reporter: Reporter) -> Outcome:
    """The project's own sample scans, made again."""
    from rangecheck.scan.sample import make_sample_data

    check_free(out, "scans.json", force=force)
    with reporter.stage("scanning the sample bust"), job_folder(out, key_of(sample=versions()), "scans.json", force=force):
        manifests = make_sample_data(out)
    return Outcome(document("sample", manifests=manifests, files=hashes([out])), [str(path) for path in manifests])
