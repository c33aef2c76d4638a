"""turntable: frames of an orbit and their film, on this machine or on many."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rangecheck import __version__
from rangecheck.animation import Orbit, render_frames
from rangecheck.arrays import FloatArray
from rangecheck.config import Settings
from rangecheck.errors import OutputError
from rangecheck.export.pictures import develop, exposure_from, png_bytes
from rangecheck.export.video import FORMATS, find_encoder, write_film
from rangecheck.optics import PinholeCamera
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.pictures import before_backdrop, grey_or_colour, plan_of, scene_of
from rangecheck.pipeline.subject import Subject, read_subject
from rangecheck.pipeline.views import camera_of, orbit_of, refuse_existing
from rangecheck.progress import Reporter
from rangecheck.reflectance import Material, load_material
from rangecheck.surface import Surface
from rangecheck.transport import Plan, Tracer, render


@dataclass(frozen=True, eq=False)
class Job:
    """Everything that determines a turntable's frames; it travels to other machines as it is."""

    surface: Surface
    material: Material
    camera: PinholeCamera
    orbit: Orbit
    plan: Plan
    seed: int

    def key(self) -> dict[str, Any]:
        """What the frames are known by: the same on every machine, another as soon as anything that shows is another."""
        return {
            "version": __version__,
            "vertices": self.surface.vertices,
            "faces": self.surface.faces,
            "material": repr(dataclasses.astuple(self.material)),
            "camera": self.camera.to_dict(),
            "orbit": repr(self.orbit),
            "plan": repr(self.plan),
            "seed": self.seed,
        }


def frames_of(job: Job) -> Callable[[int], FloatArray]:
    """The function of frame numbers that `job` describes; frame i is the same wherever and whenever it is made."""
    tracer = Tracer(scene_of(Subject(job.material.name, job.surface), job.material, direct=job.plan.model == "direct"))

    def frame(index: int) -> FloatArray:
        film = render(tracer, job.camera, job.orbit.world_from_camera(index), plan=job.plan, seed=job.seed + index)
        return before_backdrop(film)

    return frame


@dataclass(frozen=True)
class Rendered:
    """A turntable on disk."""

    material: str
    frames: list[Path]
    film: Path
    plan: list[str]


def render_turntable(
    surface: Surface,
    material_name: str,
    orbit: Orbit,
    film: Path,
    frames_dir: Path,
    settings: Settings,
    reporter: Reporter,
    *,
    force: bool,
    scheduler: str | None = None,
) -> Rendered:
    """Frames of the orbit in one material, and their film. Frames that are there already are kept."""
    material = load_material(material_name)
    camera = camera_of(settings)
    with reporter.stage(f"planning light, {material.name}"):
        tracer = Tracer(scene_of(Subject(material.name, surface), material, direct=settings.light.model == "direct"))
        plan = plan_of(tracer, camera, orbit.world_from_camera(0), settings)
    job = Job(surface, material, camera, orbit, plan, settings.seed)
    with reporter.stage(f"turntable, {material.name}", orbit.frames):
        frames = _make(job, frames_dir, reporter, force, scheduler)
    with reporter.stage(f"film, {material.name}"):
        write_film(frames, film, settings.turntable.fps)
    return Rendered(material.name, frames, film, plan.explain())


def _make(job: Job, folder: Path, reporter: Reporter, force: bool, scheduler: str | None) -> list[Path]:
    def made(frame: Callable[[int], FloatArray], spread: Any = None) -> list[Path]:
        return render_frames(
            frame,
            job.orbit.frames,
            folder,
            job.key(),
            encode=_encode,
            exposure=exposure_from,
            force=force,
            progress=lambda done, _: reporter.advance(done),
            spread=spread,
        )

    if scheduler is None:
        return made(frames_of(job))
    from rangecheck.animation.farm import Farm

    with Farm(scheduler) as farm:
        reporter.note(f"frames are made at {scheduler} by {farm.threads()} threads")
        return made(_nowhere, farm.spread(frames_of, job, job.key()))


def _nowhere(index: int) -> FloatArray:
    raise AssertionError(f"frame {index} was to be made on the cluster")


def _encode(radiance: FloatArray, exposure: float) -> bytes:
    return png_bytes(develop(grey_or_colour(radiance), exposure))


def turntable(
    path: str,
    out: str,
    *,
    settings: Settings,
    unit: str | None,
    frames_dir: str | None,
    scheduler: str | None = None,
    force: bool,
    reporter: Reporter,
) -> Outcome:
    """Frames and film of one turn around what is in `path`, in the first material of the settings."""
    film = Path(out)
    if film.suffix.lower() not in FORMATS:
        raise OutputError(out, f"must end in one of {', '.join(FORMATS)}")
    refuse_existing(out, force)
    find_encoder(film.suffix.lower())
    subject = read_subject(path, settings, unit, reporter)
    folder = Path(frames_dir) if frames_dir else film.with_name(f"{film.stem}-frames")
    made = render_turntable(
        subject.surface,
        settings.light.materials[0],
        orbit_of(subject.surface, settings),
        film,
        folder,
        settings,
        reporter,
        force=force,
        scheduler=scheduler,
    )
    lines = [f"{out}: {len(made.frames)} frames in {made.material}", f"frames are kept in {folder}", *made.plan]
    return Outcome(
        document("turntable", output=out, frames=made.frames, material=made.material, plan=made.plan, seconds=reporter.seconds),
        lines,
    )
