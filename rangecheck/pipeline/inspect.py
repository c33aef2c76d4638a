"""check, explain, materials: commands that only look."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from rangecheck.config import Settings
from rangecheck.errors import InputError, OutputError, PosesRefused
from rangecheck.files import sha256
from rangecheck.pipeline.folder import check_writable
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.preparing import counted, prepared, scan_facts
from rangecheck.pipeline.subject import holds_scans, read_all_scans
from rangecheck.progress import Reporter
from rangecheck.solid.findings import catalogue
from rangecheck.solid.findings import explain as explain_code
from rangecheck.solid.opinions import Opinion


def check(
    files: Sequence[str],
    *,
    settings: Settings,
    unit: str | None,
    opinions: bool = False,
    printer: str | None = None,
    reporter: Reporter,
) -> Outcome:
    """Each file judged for what it is: scans by what they hold, meshes as the boundary of a solid, with `opinions` by other programs
    too, and with `printer` (a profile) as something to be printed."""
    from rangecheck.solid.check_file import check_mesh_file
    from rangecheck.solid.printer import printer as printer_profile

    results: list[dict[str, Any]] = []
    lines: list[str] = []
    for file in files:
        path = Path(file)
        if not path.exists():
            raise InputError(path, "does not exist; check the name")
        if holds_scans(path):
            result, said = _check_scans(file, settings, unit, reporter)
            results.append(result)
            lines += said
            continue
        with reporter.stage("checking"):
            checked = check_mesh_file(
                path,
                unit,
                opinions=opinions,
                printer=printer_profile(printer) if printer else None,
                severities=settings.checking.severities,
            )
        results.append(
            {"file": file, "kind": "mesh", "sha256": sha256(path), "notes": checked.file.notes, **checked.verdict.to_dict()}
        )
        lines.append(f"{file}:")
        lines += [f"  {note}" for note in checked.file.notes]
        lines += [f"  {line}" for line in checked.verdict.lines()]
        lines += [f"  {_word_of(opinion)}" for opinion in checked.opinions]
    fit = all(result["fit"] for result in results)
    return Outcome(document("check", fit=fit, files=results, seconds=reporter.seconds), lines, fit)


def _check_scans(file: str, settings: Settings, unit: str | None, reporter: Reporter) -> tuple[dict[str, Any], list[str]]:
    """What the scans of one path hold, whether their pictures contradict them, whether they belong together, and what they are worth."""
    scans = read_all_scans([file], unit, reporter)
    about = [scan_facts(scan) for scan in scans]
    lines = [f"{file}: {counted(scans)}"]
    for a in about:
        if a["camera"] is None:
            lines.append(f"  {a['name']}: {a['valid']:,} points without a grid; what they are worth cannot be told")
        else:
            lines.append(
                f"  {a['name']}: {a['width']}x{a['height']}, {a['valid']:,} distances ({100 * a['valid_share']:.0f} %), "
                f"{a['nearest_mm']:.1f} to {a['farthest_mm']:.1f} mm, spacing {a['spacing_mm'] or 0.0:.2f} mm"
            )
    from rangecheck.pipeline.explained import pictured

    seen = pictured(file, scans, settings.checking.severities, reporter)
    lines += [f"  {line}" for line in seen.lines]
    facts: dict[str, Any] = {
        "file": file, "kind": "scans", "scans": about, "pictures": seen.facts, "findings": [f.to_dict() for f in seen.findings],
    }  # fmt: skip
    try:
        ready = prepared(scans, settings, reporter, quality=settings.scan.quality)
    except PosesRefused as refusal:
        facts |= {"fit": False, "registration": refusal.measured["registration"], "quality": None}
        return facts, [*lines, *(f"  {line}" for line in refusal.measured["lines"])]
    fit = (ready.quality is None or ready.quality["verdict"] != "unfit") and all(f.severity != "error" for f in seen.findings)
    facts |= {"fit": fit, "registration": ready.registration, "filtered": ready.filtered, "quality": ready.quality}
    return facts, [*lines, *(f"  {line}" for line in ready.quality_lines)]


def _word_of(opinion: Opinion) -> str:
    """One program's opinion in one line."""
    said = {True: "closed", False: "not closed", None: "gave no answer"}[opinion.closed]
    counted = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in opinion.facts.items())
    return (
        f"{opinion.program:<10} {said}" + (f" ({counted})" if counted else "") + (f": {opinion.error}" if opinion.error else "")
    )


def explain(code: str | None) -> Outcome:
    """One finding's meaning, or the list of all."""
    if code is None:
        entries = list(catalogue().values())
        return Outcome(
            document("explain", codes=[vars(e) for e in entries]), [f"{e.code:<24} {e.severity:<8} {e.title}" for e in entries]
        )
    entry = explain_code(code)
    return Outcome(
        document("explain", **vars(entry)),
        [f"{entry.code} ({entry.severity}): {entry.title}", f"why:  {entry.why}", f"mend: {entry.mend}"],
    )


def explained(outcome: Outcome) -> Outcome:
    """The same with what each finding in its document means, why it matters and what mends it, each code once."""
    lines: list[str] = []
    for code in dict.fromkeys(_codes(outcome.document)):
        entry = explain_code(code)
        lines += [f"{entry.code}: {entry.title}", f"  why:  {entry.why}", f"  mend: {entry.mend}"]
    return replace(outcome, lines=[*outcome.lines, *(lines or ["no findings to explain"])])


def _codes(content: Any) -> Iterator[str]:
    """The codes of findings anywhere in a document, in its order."""
    if isinstance(content, dict):
        if "severity" in content and content.get("code") in catalogue():
            yield content["code"]
        for value in content.values():
            yield from _codes(value)
    elif isinstance(content, list):
        for value in content:
            yield from _codes(value)


def materials(names: Sequence[str], out: str | None, *, force: bool, reporter: Reporter) -> Outcome:
    """Each material's numbers, source and energy table; with `out`, a polar plot of each there."""
    from rangecheck.files import write_bytes
    from rangecheck.reflectance import energy_table, load_material, material_names, polar_chart
    from rangecheck.scan.readers.limits import plain_name

    if out:
        check_writable(out)
        if Path(out).is_file():
            raise OutputError(out, "is a file; the plots need a folder")
    lines: list[str] = []
    found: list[dict[str, Any]] = []
    taken: set[str] = set()
    for name in names or material_names():
        material = load_material(name)
        with reporter.stage(f"energy of {material.name}"):
            rows = energy_table(material)
        lines.append(f"{material.name}: {material.description}")
        lines.append(f"  sigma {material.sigma_um:g} um, T {material.correlation_um:g} um; {material.source}")
        lines += [f"  {said}" for said in material.stated]
        lines += [f"  beware: {concern}" for concern in material.concerns()]
        lines.append("  wavelength  angle  diffuse  spike   lobe    total   as published")
        lines += [
            f"  {row['wavelength_um']:>7.3f} um {row['degrees']:>5.1f}  {row['diffuse']:.4f}   {row['spike']:.4f}  {row['lobe']:.4f}  "
            f"{row['total']:.4f}  {row['published']:.4f}"
            for row in rows
        ]
        if out:
            write_bytes(Path(out) / f"{plain_name(material.name, taken)}.svg", polar_chart(material), force=force)
        found.append(
            {
                "name": material.name,
                "description": material.description,
                "source": material.source,
                "sigma_um": material.sigma_um,
                "correlation_um": material.correlation_um,
                "concerns": material.concerns(),
                "stated": material.stated,
                "energy": rows,
            }
        )
    return Outcome(document("materials", materials=found), lines)


def study_parts(name: str) -> tuple[str, ...]:
    """The names of a study's parts; none of one that is made as a whole, or that does not exist."""
    from rangecheck.studies import STUDIES

    where = {**STUDIES, "job": "rangecheck.pipeline.job_study"}.get(name)
    return () if where is None else tuple(getattr(import_module(where), "PARTS", ()))


def study(name: str, out: str, *, quick: bool, force: bool, reporter: Reporter, part: str | None = None) -> Outcome:
    """A study of speed against accuracy and of stability, made again on this machine; charts and numbers in `out`."""
    from rangecheck.studies import study_named
    from rangecheck.study import write_study

    # the study of the job runs the job, which the room of studies does not know
    make = (
        partial(import_module("rangecheck.pipeline.job_study").study, part=part)
        if name == "job"
        else study_named(name, part, ("job",))
    )
    check_writable(out)
    with reporter.stage(f"study of {name}"):
        made = make(quick=quick)
    written = write_study(made, out, force=force)
    return Outcome(made.document(), [f"{made.title}", *made.findings, *(str(path) for path in written)])
