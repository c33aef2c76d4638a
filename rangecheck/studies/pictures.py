"""Pictures as whole commands: what turntables and data sets cost, that killing them loses nothing; and maps, cameras and line drawings
against what geometry says."""

from __future__ import annotations

import tempfile
from pathlib import Path

from rangecheck.studies.pictures_killed import killed_dataset_part, kills_part, whole_kills_part
from rangecheck.studies.pictures_known import maps_part
from rangecheck.studies.pictures_lines import drawings_part
from rangecheck.studies.pictures_optics import cameras_part
from rangecheck.studies.whole_commands import command, sample_mesh
from rangecheck.study import Part, study_of_parts

#: what the turntables are held to: seconds from start to film, and megabytes
BARS = {"plaster": 20.0, "steel": 60.0}
MOST_MB = 1500.0
#: what a data set of this many pictures is held to
PICTURES, PICTURES_BAR_S = 1000, 300.0
_QUICK_CELL_MM = 4.0


def _turntable_part(quick: bool) -> Part:
    frames, size = (4, 96) if quick else (72, 720)
    rows, findings = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mesh = sample_mesh(folder, _QUICK_CELL_MM if quick else None)

        def turn(film: str, material: str, frames: int, size: int) -> list[str]:
            what = ["turntable", str(mesh), "--unit", "mm", "--material", material, "--frames", str(frames)]
            return [*what, "--size", f"{size}x{size}", "-o", str(folder / film)]

        for material, bar in BARS.items():
            # compiled kernels are kept on disk: the first run of all makes them
            command(*turn(f"warm-{material}.mp4", material, 1, 64))
            run = command(*turn(f"{material}.mp4", material, frames, size))
            stages = {stage: round(seconds, 3) for stage, seconds in run.document["seconds"].items()}
            rows.append(
                {
                    "material": material, "frames": frames, "size": size, "seconds": run.seconds, "cpu_seconds": run.cpu_seconds,
                    "peak_mb": run.peak_mb, "bar_seconds": bar, "bar_mb": MOST_MB, "stages": stages,
                }
            )  # fmt: skip
            kept = "kept" if run.seconds <= bar and run.peak_mb <= MOST_MB else "missed"
            findings.append(
                f"{material}: {frames} frames of {size}x{size} and their film in {run.seconds:.1f} s from start to end, {run.cpu_seconds:.1f} s of "
                f"processor time, at most {run.peak_mb:.0f} MB (bar {bar:g} s, {MOST_MB:g} MB: {kept})"
            )
    return Part(findings=findings, tables={"turntables": rows})


def _dataset_part(quick: bool) -> Part:
    count = 4 if quick else PICTURES
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mesh = sample_mesh(folder, _QUICK_CELL_MM if quick else None)
        command("dataset", str(mesh), "--unit", "mm", "-o", str(folder / "warm"), "--count", "4")
        run = command("dataset", str(mesh), "--unit", "mm", "-o", str(folder / "set"), "--count", str(count))
        megabytes = sum(path.stat().st_size for path in (folder / "set").rglob("*") if path.is_file()) / 1e6
    wrong = run.document["wrong"]
    finding = (
        f"{count} pictures of 128x128 with their truth in {run.seconds:.1f} s, {run.cpu_seconds:.1f} s of processor time, at most "
        f"{run.peak_mb:.0f} MB, {megabytes:.0f} MB of files; {count - len(wrong)} agree with every truth map (bar {PICTURES_BAR_S:g} s for "
        f"{PICTURES})"
    )
    row = {"count": count, "seconds": run.seconds, "cpu_seconds": run.cpu_seconds, "peak_mb": run.peak_mb, "wrong": wrong}
    return Part(findings=[finding], tables={"dataset": [row]})


_PARTS = {
    "turntable": _turntable_part,
    "dataset": _dataset_part,
    "kills": kills_part,
    "whole-kills": whole_kills_part,
    "killed-dataset": killed_dataset_part,
    "maps": maps_part,
    "cameras": cameras_part,
    "drawings": drawings_part,
}
PARTS = tuple(_PARTS)
study = study_of_parts(
    "pictures", "Pictures: what they cost, what killing them loses, and how far maps, cameras and drawings are off", _PARTS
)
