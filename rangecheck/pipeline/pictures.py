"""render, maps, turntable: what is seen of a surface, with light and without."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rangecheck import __version__
from rangecheck.animation import Orbit, render_frames
from rangecheck.arrays import FloatArray
from rangecheck.config import Settings
from rangecheck.errors import OutputError
from rangecheck.export.pictures import develop, exposure_from, png_bytes, write_png
from rangecheck.export.video import FORMATS, find_encoder, write_film
from rangecheck.optics import PinholeCamera
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import Subject, read_subject
from rangecheck.pipeline.views import camera_of, orbit_of, refuse_existing, view_of
from rangecheck.progress import Reporter
from rangecheck.reflectance import Material, load_material
from rangecheck.scene import Scene, Source, gradient, studio
from rangecheck.surface import Surface
from rangecheck.transport import Film, Tracer
from rangecheck.transport import Settings as LightSettings

#: radiance behind the object, where white that faces the key light has 1: an even, dark backdrop, whatever the surroundings
BACKDROP = 0.05


def scene_of(subject: Subject, material: Material) -> Scene:
    """A modelled scene as its file says; any other surface in the studio that suits its material: soft boxes for what mirrors,
    lamps for what does not."""
    surface, model = subject.surface, subject.model
    if model is not None and model.lamps:
        names = list(dict.fromkeys(name or material.name for name in model.material_of_part))
        return Scene(
            surface,
            tuple(load_material(name) for name in names),
            tuple(names.index(name or material.name) for name in model.material_of_part),
            tuple(Source(np.array(lamp.centre_mm), lamp.radius_mm, np.array([lamp.radiance])) for lamp in model.lamps),
            gradient(0.05, 0.25),
            smooth=True,
            vertex_normals=np.nan_to_num(model.corner_normals),
        )
    strengths = material.strengths().mean(axis=1)
    return studio(surface, material, "plaster" if strengths[0] > strengths[1:].sum() else "steel", smooth=True)


@dataclass(frozen=True)
class Rendered:
    """A turntable on disk."""

    material: str
    frames: list[Path]
    film: Path
    plan: list[str]
    exposure: float


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
) -> Rendered:
    """Frames of the orbit in one material, and their film. Frames that are there already are kept."""
    material = load_material(material_name)
    camera = camera_of(settings)
    tracer = Tracer(scene_of(Subject(material.name, surface), material))
    with reporter.stage(f"planning light, {material.name}"):
        plan = plan_of(tracer, camera, orbit.world_from_camera(0), settings)

    def frame(index: int) -> FloatArray:
        return before_backdrop(tracer.render(camera, orbit.world_from_camera(index), plan.settings, seed=settings.seed + index))

    key = {
        "version": __version__,
        "vertices": surface.vertices,
        "faces": surface.faces,
        "material": repr(dataclasses.astuple(material)),
        "camera": camera.to_dict(),
        "orbit": repr(orbit),
        "plan": repr(plan.settings),
        "seed": settings.seed,
    }
    with reporter.stage(f"turntable, {material.name}", orbit.frames):
        frames = render_frames(
            frame,
            orbit.frames,
            frames_dir,
            key,
            encode=_encode,
            exposure=exposure_from,
            force=force,
            progress=lambda done, _: reporter.advance(done),
        )
    with reporter.stage(f"film, {material.name}"):
        write_film(frames, film, settings.turntable.fps)
    return Rendered(material.name, frames, film, plan.explain(), 0.0)


def before_backdrop(film: Film) -> FloatArray:
    """(h, w, c) radiance of the film in front of the backdrop."""
    return film.radiance + (BACKDROP * (1 - film.coverage))[..., None].astype(film.radiance.dtype)


@dataclass(frozen=True)
class LightPlan:
    settings: LightSettings
    reasons: list[str]

    def explain(self) -> list[str]:
        return self.reasons


def plan_of(tracer: Tracer, camera: PinholeCamera, pose: FloatArray, settings: Settings) -> LightPlan:
    return LightPlan(LightSettings(passes=4, depth=3, backdrop=False), [])


def _encode(radiance: FloatArray, exposure: float) -> bytes:
    return png_bytes(develop(_grey_or_colour(radiance), exposure))


def render(
    path: str,
    out: str,
    *,
    settings: Settings,
    unit: str | None,
    camera_mm: tuple[float, ...] | None,
    force: bool,
    reporter: Reporter,
) -> Outcome:
    """One picture of what is in `path`, in the first material of the settings."""
    if Path(out).suffix.lower() != ".png":
        raise OutputError(out, "must end in .png")
    refuse_existing(out, force)
    material = load_material(settings.light.materials[0])
    subject = read_subject(path, settings, unit, reporter)
    camera, pose = view_of(subject, settings, camera_mm)
    with reporter.stage("rendering"):
        tracer = Tracer(scene_of(subject, material))
        plan = plan_of(tracer, camera, pose, settings)
        film = tracer.render(camera, pose, plan.settings, seed=settings.seed)
    exposure = exposure_from([film.radiance])
    write_png(out, develop(_grey_or_colour(before_backdrop(film)), exposure), force=force)
    lines = [f"{out}: {camera.width}x{camera.height}, {material.name}, mean radiance {film.mean_radiance:.4g}", *plan.explain()]
    return Outcome(
        document("render", output=out, material=material.name, camera=camera.to_dict(), world_from_camera=pose, exposure=exposure,
                 film=film.to_dict(), plan=plan.explain(), seconds=reporter.seconds),
        lines,
    )  # fmt: skip


def _grey_or_colour(radiance: FloatArray) -> FloatArray:
    return radiance[..., 0] if radiance.shape[2] == 1 else radiance


def turntable(
    path: str, out: str, *, settings: Settings, unit: str | None, frames_dir: str | None, force: bool, reporter: Reporter
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
    )
    lines = [f"{out}: {len(made.frames)} frames in {made.material}", f"frames are kept in {folder}", *made.plan]
    return Outcome(
        document("turntable", output=out, frames=made.frames, material=made.material, plan=made.plan, seconds=reporter.seconds),
        lines,
    )
