"""turntable: frames of an orbit and their film, on this machine or on many."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.animation import Orbit, render_frames
from rangecheck.animation.frames import MANIFEST, frame_name
from rangecheck.arrays import FloatArray
from rangecheck.config import Settings
from rangecheck.errors import OutputError, SettingError
from rangecheck.export.camera_files import write_camera_list, write_colmap
from rangecheck.export.exr import need_openexr, read_exr
from rangecheck.export.filming import Filming
from rangecheck.export.mapped import contact_sheet
from rangecheck.export.pictures import read_png, write_png
from rangecheck.export.video import FORMATS, find_encoder
from rangecheck.files import read_json
from rangecheck.optics import PinholeCamera
from rangecheck.pipeline.camera import camera_of, optics_of
from rangecheck.pipeline.consistency import Standing, judge, standing_in_frames, standing_in_waves, write_consistency
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.pictures import known_of, plan_of, scene_of
from rangecheck.pipeline.subject import Subject, read_subject
from rangecheck.pipeline.turning_job import Job, encoded, exposure_of, frames_of, picture_of
from rangecheck.pipeline.views import orbit_of, refuse_existing
from rangecheck.progress import Reporter
from rangecheck.reflectance import Material, load_material
from rangecheck.surface import Surface
from rangecheck.transport import Tracer, Tracers

#: pixels of all frames that are in the making at once, each on a thread of its own: more would need gigabytes
_ABREAST_PIXELS = 1 << 24


@dataclass(frozen=True)
class Rendered:
    """A turntable on disk."""

    material: str
    frames: list[Path]
    film: Path
    plan: list[str]
    mirrors: bool = False


def render_turntable(
    surface: Surface | Subject,
    material_name: str,
    orbit: Orbit,
    film: Path,
    frames_dir: Path,
    settings: Settings,
    reporter: Reporter,
    *,
    force: bool,
    scheduler: str | None = None,
    tracers: Tracers | None = None,
) -> Rendered:
    """Frames of the orbit in one material, and their film. Frames that are there already are kept. Several turntables of one surface
    share `tracers`."""
    made = _planned(surface, material_name, lambda: orbit, frames_dir, settings, reporter, tracers)
    with Filming(film, settings.turntable.fps, orbit.frames, made.picture) as filming:
        _make(made, reporter, force, scheduler, filming.stands)
        with reporter.stage(f"film, {made.called}"):
            filming.finish()
    return Rendered(made.name, made.frames, film, made.plan, any(_mirrors(m) for m in made.job.scene.materials))


@dataclass(frozen=True)
class _Made:
    """Frames of one material, planned or finished; `tracer` makes them here, and is None for maps."""

    name: str
    job: Job
    frames: list[Path]
    plan: list[str]
    tracer: Tracer | None = dataclasses.field(repr=False)

    @property
    def called(self) -> str:
        """What is being made, for whoever waits for it."""
        return "stripes" if self.job.show == "stripes" else self.name

    def picture(self, index: int) -> npt.NDArray[Any]:
        """A finished frame as people are shown it."""
        path = self.frames[index]
        if path.suffix == ".png":
            return read_png(path)
        exposure = float(read_json(path.with_name(MANIFEST))["exposure"])
        channels = read_exr(path)
        if self.job.show == "id":
            image = np.where(channels["part_id"] > 0, channels["part_id"], np.nan)
        elif len(channels) == 1:
            image = next(iter(channels.values()))[..., None] if self.job.plan else next(iter(channels.values()))
        else:
            image = np.stack([channels[name] for name in "RGB"], axis=-1)
        return picture_of(self.job, image, exposure, index)

    def pictures(self) -> Iterator[npt.NDArray[Any]]:
        """Every frame as people are shown it."""
        return (self.picture(index) for index in range(len(self.frames)))


def _planned(
    subject: Surface | Subject,
    material_name: str,
    orbit_when_found: Callable[[], Orbit],
    folder: Path,
    settings: Settings,
    reporter: Reporter,
    tracers: Tracers | None = None,
) -> _Made:
    """Frames that are yet to be made, and how their light is followed. What needs no orbit is done before it is waited for."""
    known = subject if isinstance(subject, Subject) else Subject(material_name, subject)
    material, show = load_material(material_name), settings.turntable.show
    scene = scene_of(known, material, direct=settings.light.model == "direct", stripes=show == "stripes")
    lit = show in ("picture", "stripes")
    with reporter.stage(f"planning light, {'stripes' if show == 'stripes' else material.name}" if lit else "framing"):
        tracer = (tracers or Tracers()).of(scene) if lit else None
        orbit = orbit_when_found()
        optics = optics_of(settings, camera_of(settings), orbit.distance_mm)
        if optics.sensor is not None and optics.sensor.bits > 8:
            raise SettingError(f"sensor.bits is {optics.sensor.bits}; films and their frames have 8", key="sensor.bits")
        plan, said = None, list(optics.reasons)
        if tracer is not None:
            plan = plan_of(tracer, optics.camera, orbit.world_from_camera(0), settings)
            if show == "stripes" and not plan.grey:
                plan = dataclasses.replace(
                    plan, grey=True, reasons=(*plan.reasons, "one wavelength: stripes show slope, not colour")
                )
            said = [*(known_of(scene) if show == "picture" else ()), *plan.explain(), *said]
            if optics.lens is not None:
                said.append(
                    f"defocus: traced where circles of confusion exceed half a pixel, focused at {optics.lens.focus_mm:.4g} mm"
                )
    job = Job(scene, show, settings.turntable.lights, optics, orbit, plan, settings.seed)
    suffix = f".{settings.turntable.frame_format}"
    frames = [folder / frame_name(index, orbit.frames, suffix) for index in range(orbit.frames)]
    return _Made(material.name if lit else show, job, frames, said, tracer)


def _make(
    made: _Made, reporter: Reporter, force: bool, scheduler: str | None, stands: Callable[[int], None] | None = None
) -> None:
    """Make the frames that are missing; `stands` is told of each that is there."""
    job, folder, suffix = made.job, made.frames[0].parent, made.frames[0].suffix

    def frames(frame: Callable[[int], FloatArray], spread: Any = None) -> None:
        render_frames(
            frame,
            job.orbit.frames,
            folder,
            job.key(),
            encode=encoded(job, suffix),
            exposure=1.0 if job.plan is None else exposure_of,
            suffix=suffix,
            force=force,
            progress=lambda done, _: reporter.advance(done),
            spread=spread,
            abreast=max(1, _ABREAST_PIXELS // (job.optics.camera.width * job.optics.camera.height)),
            stands=stands,
        )

    with reporter.stage(f"turntable, {made.called}", job.orbit.frames):
        if scheduler is None:
            frames(frames_of(job, made.tracer))
        else:
            from rangecheck.animation.farm import Farm

            with Farm(scheduler) as farm:
                reporter.note(f"frames are made at {scheduler} by {farm.threads()} threads")
                frames(_nowhere, farm.spread(frames_of, job, job.key()))
        poses = [job.orbit.world_from_camera(i) for i in range(job.orbit.frames)]
        names = [path.name for path in made.frames]
        write_camera_list(folder / "cameras.json", job.optics.asked, poses, names, job.optics.to_dict())
        write_colmap(folder / "colmap", [job.optics.asked] * len(poses), poses, names)


def _standing(made: Sequence[_Made], mirrored: _Made | None, settings: Settings) -> Standing | None:
    """Places that bend unlike their surroundings: in waves where something mirrors, else in the frames themselves where their lights move over
    the model, each pixel sees it sharply and in a line, and no light is gathered from elsewhere but evenly."""
    if mirrored is not None:
        job = mirrored.job
        return standing_in_waves(job.scene, camera_of(settings), job.orbit, job.optics.sensor, settings.seed)
    matt = next((m for m in made if m.job.plan is not None and m.job.show == "picture" and m.job.lights == "room"), None)
    if matt is None:
        return None
    job, optics = matt.job, matt.job.optics
    camera = optics.camera
    if not isinstance(camera, PinholeCamera) or any(camera.distortion) or optics.lens is not None or optics.vignetting:
        return None
    exposure = float(read_json(matt.frames[0].with_name(MANIFEST))["exposure"])
    return standing_in_frames(job.scene, camera, job.orbit, matt.picture, exposure, optics.sensor)


def _nowhere(index: int) -> FloatArray:
    raise AssertionError(f"frame {index} was to be made on the cluster")


def check_asked(out: str, materials: Sequence[str], sheet: str | None, settings: Settings, force: bool) -> tuple[str, ...]:
    """The materials of a turntable, after all that can be refused before its subject is read."""
    film = Path(out)
    if film.suffix.lower() not in FORMATS:
        raise OutputError(out, f"must end in one of {', '.join(FORMATS)}")
    if sheet is not None and Path(sheet).suffix.lower() != ".png":
        raise OutputError(sheet, "must end in .png")
    for target in (out, *([sheet] if sheet else [])):
        refuse_existing(target, force)
    find_encoder(film.suffix.lower())
    if settings.turntable.frame_format == "exr":
        need_openexr()
    chosen = tuple(materials) or _chosen(settings)
    if settings.turntable.show in ("distance", "id"):
        chosen = chosen[:1]
    for name in chosen:
        material = load_material(name)
        if settings.turntable.show == "stripes":
            _need_mirror(material)
    camera_of(settings)
    return chosen


def turntable(
    path: str,
    out: str,
    *,
    settings: Settings,
    unit: str | None,
    frames_dir: str | None,
    materials: Sequence[str] = (),
    sheet: str | None = None,
    consistency: bool = False,
    scheduler: str | None = None,
    force: bool,
    reporter: Reporter,
) -> Outcome:
    """Frames and film of one turn around what is in `path`: in one material, or in several, side by side.

    Without `materials` it is the first of the settings, for stripes the first that mirrors. `sheet` is a picture of all frames.
    With `consistency` what the turntable shows of the surface is measured and drawn beside the frames; the outcome is its verdict."""
    film = Path(out)
    chosen = check_asked(out, materials, sheet, settings, force)
    subject = read_subject(path, settings, unit, reporter)
    folder = Path(frames_dir) if frames_dir else film.with_name(f"{film.stem}-frames")
    made: list[_Made] = []
    tracers = Tracers()
    with ThreadPoolExecutor(1) as aside:
        framing = aside.submit(orbit_of, subject.surface, settings)
        for name in chosen:
            if made:
                _make(made[-1], reporter, force, scheduler)
                made[-1] = dataclasses.replace(made[-1], tracer=None)
            where = folder if len(chosen) == 1 else folder / Path(name).stem
            made.append(_planned(subject, name, framing.result, where, settings, reporter, tracers))
    orbit = framing.result()
    with Filming(film, settings.turntable.fps, orbit.frames, partial(_beside_each_other, made)) as filming:
        _make(made[-1], reporter, force, scheduler, filming.stands)
        with reporter.stage("film"):
            filming.finish()
            if sheet is not None:
                numbers = [f"{360 * i / orbit.frames:.0f}°" for i in range(orbit.frames)]
                write_png(sheet, contact_sheet([_beside_each_other(made, i) for i in range(orbit.frames)], numbers))
    names = " | ".join(m.name for m in made)
    lines = [f"{out}: {orbit.frames} frames in {names}", f"frames are kept in {folder}"]
    lines += list(dict.fromkeys(line for m in made for line in m.plan))
    judged: dict[str, Any] | None = None
    if consistency:
        with reporter.stage("consistency"):
            mirrored = next((m for m in made if m.job.plan is not None and any(map(_mirrors, m.job.scene.materials))), None)
            shown = () if mirrored is None else mirrored.pictures()
            standing = _standing(made, mirrored, settings)
            judged, said, pictures = judge(subject.surface, subject.scans, orbit, settings, shown, standing=standing)
            write_consistency(folder, judged, pictures)
        lines += said
    return Outcome(
        document("turntable", output=out, frames=[path for m in made for path in m.frames], material=names, show=settings.turntable.show,
                 sheet=sheet, plan=[line for m in made for line in m.plan], seconds=reporter.seconds,
                 consistency=judged),
        lines,
        judged is None or judged["fit"],
    )  # fmt: skip


def _beside_each_other(made: Sequence[_Made], index: int) -> npt.NDArray[Any]:
    """Frame `index`; of several materials, beside each other."""
    pictures = [m.picture(index) for m in made]
    if len(pictures) == 1:
        return pictures[0]
    coloured = [p if p.ndim == 3 else np.repeat(p[..., None], 3, axis=2) for p in pictures]
    return np.concatenate(coloured, axis=1)


def _chosen(settings: Settings) -> tuple[str, ...]:
    names = settings.light.materials
    if settings.turntable.show == "stripes":
        return next(((name,) for name in names if _mirrors(load_material(name))), names[:1])
    return names[:1]


def _mirrors(material: Material) -> bool:
    return bool(material.strengths()[1:].any())


def _need_mirror(material: Material) -> None:
    if not _mirrors(material):
        raise SettingError(
            f"{material.name} mirrors nothing, and stripes are seen in mirrors; choose steel", key="light.materials"
        )
