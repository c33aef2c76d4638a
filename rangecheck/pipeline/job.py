"""run: the whole job in the order in which a person would want it - mesh, check, look, and only then export."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.animation import Orbit
from rangecheck.arrays import FloatArray
from rangecheck.config import Settings
from rangecheck.errors import PosesRefused
from rangecheck.export.map_files import write_maps
from rangecheck.export.meshes import write_mesh
from rangecheck.export.pictures import png_bytes, read_png
from rangecheck.export.stl import write_stl
from rangecheck.export.video import find_encoder
from rangecheck.files import write_bytes, write_json
from rangecheck.pipeline.consistency import Known, judge, known_of, write_consistency
from rangecheck.pipeline.folder import check_free, job_folder, key_of
from rangecheck.pipeline.health import versions
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.page import contours_of, keep_for_report, page_of
from rangecheck.pipeline.preparing import Prepared, prepared, scan_facts
from rangecheck.pipeline.refining import labelled, share_refined
from rangecheck.pipeline.scanning import refused
from rangecheck.pipeline.shape import solid_of, standing_of
from rangecheck.pipeline.subject import Subject, eye_of, hashes, read_all_scans, surface_of
from rangecheck.pipeline.together import sentence_of, verdicts_of
from rangecheck.pipeline.turning import Rendered, render_turntable
from rangecheck.pipeline.views import map_at, orbit_of
from rangecheck.progress import Reporter
from rangecheck.reflectance import load_material
from rangecheck.report import write_report
from rangecheck.scan import RangeScan
from rangecheck.scan.readers.limits import plain_name
from rangecheck.solid import Finding, Verdict, finding, verdict
from rangecheck.surface import INVENTED, ORIGIN_NAMES, Surface
from rangecheck.transport import Tracers

FINISHED = "run.json"
#: the job's stripes are looked at view by view: a third of the turntable's frames, but not fewer than these
LEAST_STRIPES = 8


def run(
    scans: Sequence[str], out: str, *, settings: Settings, unit: str | None, force: bool, reporter: Reporter, scheduler: str | None = None
) -> Outcome:  # fmt: skip
    """Scans in; in `out` the bust's STL (of a solid only), turntables, maps, report.html and run.json. With `scheduler` the turntables'
    frames are made on that dask cluster."""
    began = time.perf_counter()
    check_free(out, FINISHED, force=force)
    find_encoder(".mp4")
    inputs = hashes(scans)
    measured = read_all_scans(scans, unit, reporter)
    with _one_thread() as early:
        try:
            ready = prepared(measured, settings, reporter, quality=settings.scan.quality, aside=early)
        except PosesRefused as refusal:
            return refused("run", refusal, reporter)
        key = key_of(inputs=inputs, unit=unit, settings=settings.determining(), versions=versions())
        # the thread ends before the folder is given free, however the job ends
        with job_folder(out, key, FINISHED, force=force) as folder, _one_thread() as aside:
            outcome = _made(ready, folder, aside, settings, reporter, inputs=inputs, force=force, scheduler=scheduler)
    done = f"{out}: {sentence_of(outcome.document['verdicts'])}; {time.perf_counter() - began:.1f} s"
    return replace(outcome, lines=[done, *outcome.lines])


def _made(
    ready: Prepared, folder: Path, aside: ThreadPoolExecutor, settings: Settings, reporter: Reporter, *, inputs: Any, force: bool,
    scheduler: str | None,
) -> Outcome:  # fmt: skip
    """The job in its folder; `aside` does what needs one core only."""
    read = ready.grids
    write_json(folder / "settings.json", document("settings", **settings.model_dump(mode="json")))
    surface, method, reason = surface_of(ready.scans, settings, reporter)
    made, judged = solid_of(surface, settings, reporter, eye_of(ready.scans))
    shown = surface if made is None else made.surface
    judged = _with_scan_findings(judged, shown, settings)
    if ready.refined and settings.solid.height_mm is None:
        shown = labelled(shown, ready.refined, ready.scans)
        reporter.note(
            f"{100 * share_refined(shown):.1f} % of the measured surface stands on heights refined by shading; surface.ply says which"
        )
    write_mesh(shown, folder / "surface.ply")

    front = _front_deg(shown, eye_of(ready.scans), reporter)
    turn = settings.turntable.model_copy(update={"start_deg": settings.turntable.start_deg + front})
    orbit = orbit_of(shown, settings.model_copy(update={"turntable": turn}))
    subject = Subject("bust", shown, front_deg=front)
    # work on one core that needs no pictures, beside them
    kept = aside.submit(
        keep_for_report, folder, shown, surface, read, judged if made is not None else None, settings, front_deg=front
    )
    known = aside.submit(known_of, shown, ready.grids, orbit, settings)
    charted = aside.submit(_maps_and_contours, shown, read, folder, settings, front)
    # a material may be a file anywhere; its turntable is called as the file is
    taken = {"stripes"}
    labels = {name: plain_name(Path(name).stem, taken) for name in settings.light.materials}
    tracers = Tracers()
    turntables = [
        replace(
            render_turntable(
                subject,
                name,
                orbit,
                folder / f"{label}.mp4",
                folder / "frames" / label,
                settings,
                reporter,
                force=force,
                scheduler=scheduler,
                tracers=tracers,
            ),
            material=label,
        )
        for name, label in labels.items()
    ]
    turntables += _stripes(subject, orbit, folder, settings, reporter, tracers, force=force, scheduler=scheduler)
    del tracers
    consistency = _consistency(shown, ready.grids, orbit, turntables, folder, settings, reporter, known)
    stl: dict[str, Any] | None = None
    (folder / "bust.stl").unlink(missing_ok=True)
    if made is not None and judged.fit:
        with reporter.stage("exporting STL"):
            written = write_stl(made, folder / "bust.stl", stand=settings.solid.file_up == "z")
        stl = {
            "file": "bust.stl",
            "faces": written.faces,
            "moved_by_rounding_mm": written.moved_mm,
            "standing": standing_of(written),
            "verdict": written.verdict.to_dict(),
        }
    else:
        reporter.note("no STL: the verdict holds it back")

    ready = ready.whole()
    shares = {name: shown.share_of_area(origin) for origin, name in enumerate(ORIGIN_NAMES)}
    content = document(
        "run", fit=judged.fit, verdicts=verdicts_of(judged, ready.quality, consistency), verdict=judged.to_dict(), stl=stl, method=method, reason=reason, area_shares=shares,
        scans=[scan_facts(scan) for scan in ready.scans], quality=ready.quality, registration=ready.registration, filtered=ready.filtered, refined=ready.refining,
        faces=len(shown.faces), decisions=reporter.notes, front_deg=front,
        consistency=consistency,
        turntables=[{"material": t.material, "film": t.film.name, "frames": len(t.frames), "plan": t.plan} for t in turntables],
        inputs=inputs, settings=settings.model_dump(mode="json"), versions=versions(), seconds=reporter.seconds,
        peak_memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    )  # fmt: skip
    with reporter.stage("report"):
        kept.result()
        charted.result()
        write_report(page_of(folder, content), folder / "report.html")
    content["seconds"] = dict(reporter.seconds)
    write_json(folder / FINISHED, content)
    lines = [
        *ready.quality_lines[1:2],
        *judged.lines(),
        f"bust.stl: {stl['faces']:,} faces, read back and checked" if stl else "no STL: the findings above hold it back",
        f"look at {folder / 'report.html'}",
    ]
    return Outcome(content, lines, judged.fit)


@contextmanager
def _one_thread() -> Iterator[ThreadPoolExecutor]:
    """A thread for work beside the job's own; what has not begun when the job ends, or fails, is not begun."""
    pool = ThreadPoolExecutor(1)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _consistency(
    shown: Surface, scans: Sequence[RangeScan], orbit: Orbit, turntables: Sequence[Rendered], folder: Path, settings: Settings,
    reporter: Reporter, known: Future[Known],
) -> dict[str, Any]:  # fmt: skip
    """What the turntables show of the surface, measured; drawn in the folder `consistency`."""
    with reporter.stage("consistency"):
        mirrored = next((t for t in turntables if t.mirrors), None)
        frames = [] if mirrored is None else [path for path in mirrored.frames if path.suffix == ".png"]
        judged, said, pictures = judge(shown, scans, orbit, settings, map(read_png, frames), known.result())
        write_consistency(folder / "consistency", judged, pictures)
    for line in said:
        reporter.note(line.strip())
    return judged


def _with_scan_findings(judged: Verdict, shown: Surface, settings: Settings) -> Verdict:
    """The verdict, and whether too much of the surface was never measured."""
    # by plain areas a noisy scan would seem to have measured more
    areas = shown.areas_without_wrinkles()
    standing = np.array([name not in ("base", "back", "skirt") for name in shown.part_names])[shown.part_of_face]
    invented = (shown.origin_of_face == INVENTED) & standing
    share = float(areas[invented].sum() / max(areas[standing].sum(), 1e-300))
    facts = dict(judged.facts) | {"invented_share": share}
    found: list[Finding] = list(judged.findings)
    limit = settings.checking.max_invented_percent / 100
    if share > limit:
        faces = np.flatnonzero(invented)
        found.append(
            finding(
                "too-much-invented", len(faces),
                f"{100 * share:.1f} % of the surface, base and back left aside, was never measured; {100 * limit:.0f} % is allowed",
                shown.triangles[faces].mean(axis=1), faces, settings.checking.severities,
            )
        )  # fmt: skip
    return verdict(found, facts)


def _front_deg(shown: Surface, eye_mm: FloatArray | None, reporter: Reporter) -> float:
    """Azimuth that turntable and maps count from: where a single scan was taken from, else that of the world."""
    if eye_mm is None:
        return 0.0
    away = eye_mm - shown.bounds_mm.mean(axis=0)
    front = float(np.round(np.degrees(np.arctan2(away[0], away[2]))))
    reporter.note(f"the scanner's side, azimuth {front:g} degrees, counts as the front")
    return front


def _stripes(
    subject: Subject, orbit: Orbit, folder: Path, settings: Settings, reporter: Reporter, tracers: Tracers, *, force: bool,
    scheduler: str | None,
) -> list[Rendered]:  # fmt: skip
    """Where a material of the pictures mirrors, also what it makes of bands of light: they bend where its slope does."""
    mirror = next((name for name in settings.light.materials if load_material(name).strengths()[1:].any()), None)
    if mirror is None or settings.turntable.show != "picture":
        return []
    turn = settings.turntable.model_copy(update={"show": "stripes", "fps": max(1, settings.turntable.fps // 3)})
    striped = settings.model_copy(update={"turntable": turn})
    frames = folder / "frames" / "stripes"
    fewer = replace(orbit, frames=max(min(orbit.frames, LEAST_STRIPES), orbit.frames // 3))
    made = render_turntable(
        subject,
        mirror,
        fewer,
        folder / "stripes.mp4",
        frames,
        striped,
        reporter,
        force=force,
        scheduler=scheduler,
        tracers=tracers,
    )
    return [replace(made, material="stripes")]


def _maps_and_contours(shown: Surface, scans: Sequence[RangeScan], folder: Path, settings: Settings, front_deg: float) -> None:
    """Contour pictures of the scans, and distance maps from around the surface."""
    for scan in scans:
        write_bytes(folder / "contours" / f"{scan.name}.png", png_bytes(contours_of(scan, settings)))
    for azimuth in settings.maps.azimuths_deg:
        measured, where = map_at(shown, settings, front_deg + azimuth)
        write_maps(folder / "maps" / f"azimuth_{azimuth:g}", measured, subtitle=where)
