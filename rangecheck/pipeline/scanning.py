"""mesh, simulate, sample: scans to a surface, and surfaces to scans."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rangecheck.config import Settings
from rangecheck.errors import OutputError, PosesRefused
from rangecheck.files import whole_file
from rangecheck.pipeline.folder import check_free, check_writable, job_folder, key_of
from rangecheck.pipeline.health import versions
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.preparing import prepared
from rangecheck.pipeline.subject import hashes, read_all_scans, surface_of
from rangecheck.progress import Reporter
from rangecheck.surface import ORIGIN_NAMES
from rangecheck.surface.topology import boundary_edges


def mesh(scans: Sequence[str], out: str, *, settings: Settings, unit: str | None, force: bool, reporter: Reporter) -> Outcome:
    """One surface of all scans, written to `out`."""
    from rangecheck.export.meshes import SUFFIXES, write_mesh

    if Path(out).suffix.lower() not in SUFFIXES:
        raise OutputError(out, f"ends in {Path(out).suffix or 'nothing'}; a mesh ends in {', '.join(SUFFIXES)}")
    check_writable(out)
    read = read_all_scans(scans, unit, reporter)
    try:
        ready = prepared(read, settings, reporter)
    except PosesRefused as refusal:
        return refused("mesh", refusal, reporter)
    surface, method, reason = surface_of(ready.scans, settings, reporter)
    if ready.refined:
        from rangecheck.pipeline.refining import labelled

        surface = labelled(surface, ready.refined, ready.scans)
    open_edges = len(boundary_edges(surface.faces))
    with reporter.stage("writing"):
        write_mesh(surface, out, force=force)
    shares = {name: surface.share_of_area(origin) for origin, name in enumerate(ORIGIN_NAMES)}
    lines = [
        f"{out}: {len(surface.faces):,} faces by {method} ({reason})",
        f"{'closed' if not open_edges else f'open: {open_edges} boundary edges'}; "
        + ", ".join(f"{share:.1%} {name}" for name, share in shares.items()),
    ]
    if surface.refined_of_face is not None:
        lines.append(
            f"{surface.refined_of_face.mean():.1%} of the faces refined by the shading of the brightness (property refined of a .ply)"
        )
    return Outcome(
        document(
            "mesh", output=out, method=method, reason=reason, faces=len(surface.faces), vertices=len(surface.vertices),
            boundary_edges=open_edges, shares=shares, registration=ready.registration, filtered=ready.filtered, refined=ready.refining, inputs=hashes(scans), seconds=reporter.seconds, settings=settings.model_dump(mode="json"),
        ),
        lines,
    )  # fmt: skip


def refused(command: str, refusal: PosesRefused, reporter: Reporter) -> Outcome:
    """No result, because the scans could not be shown to belong together."""
    measured = refusal.measured
    return Outcome(
        document(command, fit=False, output=None, registration=measured["registration"], seconds=reporter.seconds),
        [*measured["lines"], str(refusal).rsplit("; ", 1)[-1]],
        False,
    )


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
    key = key_of(
        inputs=hashes([path]), unit=unit, views=views, size=size, noise_mm=noise_mm, kind=kind, ambient=ambient, seed=seed
    )
    with reporter.stage("writing"), job_folder(out, key, "scans.json", force=force) as folder:
        for one in made:
            with whole_file(folder / "truth" / f"{one.scan.name}.npz") as part, part.open("wb") as stream:
                np.savez_compressed(
                    stream, true_range_mm=one.true_range_mm, true_normal=one.true_normal, noise_mm=one.noise_mm, reason=one.reason
                )
        # last: with its manifest the folder is finished
        manifest = write_scans(folder, [one.scan for one in made], step_mm=step)
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
    with reporter.stage("scanning the sample bust"), job_folder(out, key_of(sample=versions()), "scans.json", force=force):
        manifests = make_sample_data(out)
    return Outcome(document("sample", manifests=manifests, files=hashes([out])), [str(path) for path in manifests])
