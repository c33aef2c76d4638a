"""--dry-run: what a long job would start with, checked without computing anything: inputs, settings, materials, encoder, cluster, folder, room
on the disk."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from rangecheck.config import Settings
from rangecheck.dataset import read_ranges
from rangecheck.errors import InputError, OutputError
from rangecheck.export.video import find_encoder
from rangecheck.pipeline.folder import check_free
from rangecheck.pipeline.job import FINISHED
from rangecheck.pipeline.many import folder_names
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import holds_scans, read_all_scans, read_subject
from rangecheck.pipeline.turning import check_asked
from rangecheck.pipeline.vision import FINISHED as INDEX
from rangecheck.progress import Reporter
from rangecheck.reflectance import load_material
from rangecheck.scan.point_cloud import PointCloud

#: bytes that a job leaves: of a face in the STL and the surface (their faces are at most three a distance), of a pixel of a frame
#: with its film (of an EXR: three floats), of a pixel of the maps at one focal point, of a pixel of a picture with its truth
BYTES_A_FACE, FACES_A_DISTANCE = 50 + 30, 3
BYTES_A_PIXEL, BYTES_AN_EXR_PIXEL, BYTES_A_MAP_PIXEL, BYTES_A_TRUE_PIXEL = 1.5, 12, 16, 64
#: the report, contour pictures and what else does not grow
BYTES_BESIDES = 20_000_000


def rehearse(
    scans: Sequence[str], out: str, *, settings: Settings, unit: str | None, force: bool, reporter: Reporter, scheduler: str | None = None,
    each: bool = False,
) -> Outcome:  # fmt: skip
    """What `run` would start with; with `each`, what it would for every subject."""
    encoder = find_encoder(".mp4")
    materials = [load_material(name) for name in settings.light.materials]
    subjects = [([path], Path(out) / name) for path, name in zip(scans, folder_names(scans))] if each else [(scans, Path(out))]
    count = distances = 0
    pixels = settings.picture.width * settings.picture.height
    needed = 0.0
    for paths, folder in subjects:
        check_free(folder, FINISHED, force=force)
        measured = read_all_scans(paths, unit, reporter)
        held = sum(len(one.points_mm) if isinstance(one, PointCloud) else int(one.valid.sum()) for one in measured)
        count, distances = count + len(measured), distances + held
        needed += (
            held * FACES_A_DISTANCE * BYTES_A_FACE
            + pixels * settings.turntable.frames * len(materials) * BYTES_A_PIXEL
            + pixels * len(settings.maps.azimuths_deg) * BYTES_A_MAP_PIXEL
            + BYTES_BESIDES
        )
    lines = [
        f"{len(subjects)} subjects, " * each + f"{count} scan{'s' if count != 1 else ''}, {distances:,} distances, can be read",
        f"materials: {', '.join(material.name for material in materials)}; {settings.turntable.frames} frames of "
        f"{settings.picture.width}x{settings.picture.height} each",
        f"encoder: {encoder}",
    ]
    return _told("run", out, needed, lines, scheduler, settings, scans=count, distances=distances, encoder=str(encoder))


def rehearse_turntable(
    path: str, out: str, *, settings: Settings, unit: str | None, frames_dir: str | None, materials: Sequence[str], sheet: str | None,
    scheduler: str | None, force: bool, reporter: Reporter,
) -> Outcome:  # fmt: skip
    """What `turntable` would start with."""
    chosen = check_asked(out, materials, sheet, settings, force)
    read = _readable(path, settings, unit, reporter)
    size, frames = f"{settings.picture.width}x{settings.picture.height}", settings.turntable.frames
    each = BYTES_AN_EXR_PIXEL if settings.turntable.frame_format == "exr" else BYTES_A_PIXEL
    needed = settings.picture.width * settings.picture.height * frames * len(chosen) * each
    where = frames_dir or str(Path(out).with_name(f"{Path(out).stem}-frames"))
    encoder = find_encoder(Path(out).suffix.lower())
    lines = [read, f"{', '.join(chosen)}: {frames} frames of {size} each", f"encoder: {encoder}"]
    return _told("turntable", where, needed, lines, scheduler, settings, pictures=frames * len(chosen), encoder=str(encoder))


def rehearse_dataset(
    path: str, out: str, *, settings: Settings, unit: str | None, count: int, ranges: str | None, size: tuple[int, int],
    scheduler: str | None, force: bool, reporter: Reporter,
) -> Outcome:  # fmt: skip
    """What `dataset` would start with."""
    check_free(out, INDEX, force=force)
    names = [load_material(name).name for name in read_ranges(ranges).names]
    read = _readable(path, settings, unit, reporter)
    lines = [read, f"{count:,} pictures of {size[0]}x{size[1]} in {', '.join(names)}"]
    return _told("dataset", out, size[0] * size[1] * count * BYTES_A_TRUE_PIXEL, lines, scheduler, settings, pictures=count)


def _readable(path: str, settings: Settings, unit: str | None, reporter: Reporter) -> str:
    """What is in `path`, in words; scans are read and not meshed. Raises InputError."""
    if Path(path).exists() and Path(path).suffix.lower() != ".toml" and holds_scans(Path(path)):
        scans = read_all_scans([path], unit, reporter)
        return f"{path}: {len(scans)} scan{'s' if len(scans) != 1 else ''}, can be read"
    surface = read_subject(path, settings, unit, reporter).surface
    if not len(surface.faces):
        raise InputError(path, "has no faces; there is nothing to be seen")
    return f"{path}: {len(surface.faces):,} faces, can be read"


def _told(
    command: str, out: str, needed: float, lines: list[str], scheduler: str | None, settings: Settings, **facts: str | int
) -> Outcome:
    """The rehearsal's outcome. Raises OutputError where the disk has no room, RangecheckError where no scheduler answers."""
    free = shutil.disk_usage(_nearest_existing(Path(out))).free
    if free < needed:
        raise OutputError(
            out, f"may need {needed / 1e6:,.0f} MB and has {free / 1e6:,.0f} MB free; make room, choose another folder, or smaller pictures"
        )  # fmt: skip
    if scheduler is not None:
        from rangecheck.animation.farm import Farm

        with Farm(scheduler) as farm:
            threads = farm.threads()
        said = f"{threads} threads of workers" if threads else "no worker yet; start some with `dask worker`"
        lines.append(f"scheduler: answers at {scheduler}, {said}")
    lines += [
        f"{out}: free to use; at most {needed / 1e6:,.0f} MB are needed, {free / 1e6:,.0f} MB are free",
        "nothing was computed; leave --dry-run away to begin",
    ]
    return Outcome(
        document("rehearsal", command=command, **facts, bytes_needed=int(needed), bytes_free=free, settings=settings.model_dump(mode="json")),
        lines,
    )  # fmt: skip


def _nearest_existing(path: Path) -> Path:
    path = path.absolute()
    while not path.exists():
        path = path.parent
    return path
