"""What happens to scans before they become a surface: filtered as asked, their poses proved, their worth measured, their noise told."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rangecheck.config import Settings
from rangecheck.errors import PosesRefused, ScanError, SettingError
from rangecheck.kernels import in_chunks
from rangecheck.progress import Reporter
from rangecheck.scan import RangeScan
from rangecheck.scan.point_cloud import PointCloud

Measured = RangeScan | PointCloud


@dataclass(frozen=True)
class Prepared:
    """Scans that may become a surface, and what was done and found: `registration` and `quality` are JSON-ready, or None; `worth` is the
    quality and its lines where they are still being measured (see `whole`); `refined` and `refining`: what shading refined, and what is said of it."""

    scans: list[Measured]
    filtered: list[str] = field(default_factory=list)
    registration: dict[str, Any] | None = None
    quality: dict[str, Any] | None = None
    quality_lines: list[str] = field(default_factory=list)
    refined: list[Any] = field(default_factory=list)
    refining: list[dict[str, Any]] = field(default_factory=list)
    worth: Future[tuple[dict[str, Any] | None, list[str]]] | None = None

    def whole(self) -> Prepared:
        """The same with its quality, which is waited for."""
        if self.worth is None:
            return self
        facts, lines = self.worth.result()
        return replace(self, quality=facts, quality_lines=lines, worth=None)

    @property
    def grids(self) -> list[RangeScan]:
        """The scans among them, without the clouds."""
        return [scan for scan in self.scans if isinstance(scan, RangeScan)]


def prepared(
    scans: Sequence[Measured], settings: Settings, reporter: Reporter, *, quality: bool = False, aside: Executor | None = None
) -> Prepared:
    """The scans, ready to be meshed. With `quality`, also what they are worth: measured `aside`, where there is such a thread, while others work.

    Raises PosesRefused when they could not be shown to belong together and the settings do not allow leaving any out."""
    from rangecheck.scan.registration.samples import Samples, samples_of

    grids = [scan for scan in scans if isinstance(scan, RangeScan)]
    clouds = [scan for scan in scans if isinstance(scan, PointCloud)]
    if not grids:
        return Prepared(list(scans))
    grids, filtered = _filtered(grids, settings, reporter)
    done: list[Any] = []
    refining: list[dict[str, Any]] = []
    before: dict[str, Samples] = {}
    if settings.scan.refine:
        from rangecheck.pipeline.refining import refined_scans

        # what errs in refined ranges neighbours share, and no longer show: they are taken to err by no less than before, and are worth as much
        grids = _with_noise(grids, reporter)
        if quality:
            before = dict(
                zip([grid.name for grid in grids], in_chunks(lambda i, _: samples_of(grids[i]), len(grids), 1), strict=True)
            )
        grids, done, refining = (shaped := refined_scans(grids, reporter)).scans, shaped.done, shaped.facts
    wanted = settings.scan.registration
    if clouds and wanted not in ("auto", "off"):
        raise SettingError(
            f"{clouds[0].name} is a cloud, and clouds are taken where they are; use --register off", key="scan.registration"
        )
    judged = len(grids) > 1 and not clouds and wanted != "off"
    samples: list[Samples] | None = None
    if (judged and wanted == "auto") or quality:
        with reporter.stage("looking at the scans"):
            samples = in_chunks(lambda i, _: samples_of(grids[i]), len(grids), 1)
    report: dict[str, Any] | None = None
    if judged:
        grids, report = _placed(grids, samples, settings, reporter)
    facts: dict[str, Any] | None = None
    lines: list[str] = []
    worth = None
    if quality:
        known = None if report and report["left_out"] else samples
        if before:
            known = [before[grid.name] for grid in grids]
        if aside is None:
            facts, lines = _worth(grids, known, settings, reporter)
        else:
            worth = aside.submit(_worth, grids, known, settings, Reporter())
    return Prepared([*_with_noise(grids, reporter), *clouds], filtered, report, facts, lines, done, refining, worth)


def _filtered(scans: list[RangeScan], settings: Settings, reporter: Reporter) -> tuple[list[RangeScan], list[str]]:
    """The scans without what the filters take away, and what each said."""
    from rangecheck.scan import filters

    wanted = settings.scan
    said: list[str] = []
    with reporter.stage("filtering") if wanted.filters else _nothing():
        for name in wanted.filters:
            for index, scan in enumerate(scans):
                match name:
                    case "flying":
                        left, told = filters.remove_flying_pixels(scan)
                    case "isolated":
                        left, told = filters.remove_isolated(scan, least_cells=wanted.least_patch_cells)
                    case "oblique":
                        left, told = filters.remove_oblique(scan, max_angle_deg=wanted.most_oblique_deg)
                    case "smooth":
                        left, told = filters.smooth_ranges(scan, window=wanted.smooth_cells)
                scans = [*scans[:index], left.need_points(), *scans[index + 1 :]]
                said.append(f"{scan.name}: {told.said}")
                reporter.note(said[-1])
    return scans, said


def _nothing() -> Any:
    from contextlib import nullcontext

    return nullcontext()


def _with_noise(scans: list[RangeScan], reporter: Reporter) -> list[RangeScan]:
    """The scans, each with its noise: stated by the scanner, or told from the scan itself; unknown where neither can be."""
    from rangecheck.scan.noise import estimate_noise

    found = []
    told: list[float] = []
    for scan in scans:
        if scan.noise_mm is None:
            try:
                scan = replace(scan, noise_mm=estimate_noise(scan).normal_mm or None)
                told += [scan.noise_mm] if scan.noise_mm else []
            except ScanError as error:
                reporter.note(f"noise unknown: {error}")
        found.append(scan)
    if told:
        spread = f"{min(told):.3f}" if max(told) - min(told) < 5e-4 else f"{min(told):.3f} to {max(told):.3f}"
        reporter.note(f"noise told from the scans themselves: {spread} mm (standard deviation of a range, at normal incidence)")
    return found


def _placed(
    scans: list[RangeScan], samples: Sequence[Any] | None, settings: Settings, reporter: Reporter
) -> tuple[list[RangeScan], dict[str, Any]]:
    """The scans at poses that hold, and how that was found."""
    from rangecheck.scan.registration import check_poses, register
    from rangecheck.scan.registration.result import Guess

    wanted = settings.scan
    guesses: dict[str, Guess] = {"poses": "poses", "turntable": "turntable", "all": "none"}
    if wanted.registration == "auto":
        with reporter.stage("judging poses"):
            given = check_poses(scans, samples=samples)
        reporter.note(given.line)
        if not given.missing and not given.contradicted:
            return scans, {"verdict": "given", "why": given.line, "pairs": [vars(p) for p in given.agreeing], "left_out": []}
        guess: Guess = "none" if given.missing else "poses"
    else:
        guess = guesses[wanted.registration]
    with reporter.stage("registering"):
        result = register(scans, guess=guess, seed=settings.seed)
    for line in result.lines:
        reporter.note(line)
    out = [state.name for state in result.states if not state.aligned]
    report = {
        "verdict": result.verdict, "guess": guess, "residual_mm": result.residual_mm, "left_out": out,
        "states": [vars(state) for state in result.states], "pairs": [vars(pair) for pair in result.pairs], "lines": result.lines,
    }  # fmt: skip
    if result.verdict == "aligned":
        return result.scans, report
    if result.verdict == "partial" and wanted.misfits == "leave-out":
        reporter.note(f"left out: {', '.join(out)}")
        return result.aligned, report
    raise PosesRefused(
        f"{'; '.join(result.lines)}; leave out what does not fit (--set scan.misfits=leave-out), "
        "or take the poses as given (--register off)",
        lines=result.lines,
        registration=report,
    )


def _worth(
    scans: list[RangeScan], samples: Sequence[Any] | None, settings: Settings, reporter: Reporter
) -> tuple[dict[str, Any] | None, list[str]]:
    """What the scans are worth, JSON-ready and in sentences; None where it cannot be told."""
    from rangecheck.scan.quality import assess

    try:
        with reporter.stage("measuring the scans' worth"):
            found = assess(scans, profile=settings.scan.profile, samples=samples)
    except ScanError as error:
        return None, [f"what the scans are worth cannot be told: {error}"]
    facts = {
        "verdict": found.verdict, "profile": vars(found.profile), "height_mm": found.height_mm, "scale": found.scale,
        "coverage": found.coverage, "seen": found.seen, "never_seen": 1 - found.seen, "unseen_mm2": found.unseen_mm2,
        "hidden_mm2": found.hidden_mm2, "gaps": len(found.gaps), "spacing_mm": found.spacing_mm, "expected_error_mm": found.error_mm,
        "step_mm": found.step_mm, "views": [vars(view) for view in found.views],
        "pairs": [
            {"a": p.a, "b": p.b, "overlap": p.overlap, "residual_mm": p.residual_mm, "expected_mm": p.expected_mm} for p in found.pairs
        ],
        "next_view": None if found.next_view is None else vars(found.next_view), "findings": [vars(f) for f in found.findings],
    }  # fmt: skip
    return facts, [*found.lines, *(f"  {line}" for line in found.drawing), *_by_view(found)]


def _by_view(found: Any) -> list[str]:
    """A line for each scan."""
    return [
        f"  {v.name}: spacing {v.spacing_mm:.2f} mm, noise {v.noise_mm:.3f} mm, {100 * v.grazing:.0f} % grazing"
        + ("" if v.overlap != v.overlap else f", {100 * v.overlap:.0f} % confirmed by others")
        for v in found.views
    ]


def counted(scans: Sequence[Measured]) -> str:
    """How many scans and clouds were read, in words."""
    clouds = sum(isinstance(scan, PointCloud) for scan in scans)
    counts = ((len(scans) - clouds, "range scan"), (clouds, "point cloud"))
    return ", ".join(f"{n} readable {what}{'s' if n > 1 else ''}" for n, what in counts if n)


def scan_facts(scan: Measured) -> dict[str, Any]:
    """What a scan holds, in numbers; `camera` is None for a cloud."""
    if isinstance(scan, PointCloud):
        return {"name": scan.name, "camera": None, "unit": scan.unit, "valid": len(scan.points_mm), "valid_share": 1.0}
    ranges = scan.range_mm[scan.valid]
    points = scan.grid_points_mm
    with np.errstate(invalid="ignore"):
        steps = [np.linalg.norm(np.diff(points, axis=axis), axis=2).ravel() for axis in (0, 1)]
    between = np.concatenate(steps)
    return {
        "name": scan.name,
        "width": scan.camera.width,
        "height": scan.camera.height,
        "camera": scan.camera.model,
        "unit": scan.unit,
        "valid": int(scan.valid.sum()),
        "valid_share": float(scan.valid.mean()),
        "nearest_mm": float(ranges.min()),
        "farthest_mm": float(ranges.max()),
        "spacing_mm": float(np.nanmedian(between)) if np.isfinite(between).any() else None,
        "noise_mm": scan.noise_mm,
        "brightness": scan.brightness is not None,
    }
