"""render, maps, turntable: what is seen of a surface, with light and without."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rangecheck import __version__
from rangecheck.animation import Orbit, orbit_around, render_frames
from rangecheck.arrays import FloatArray
from rangecheck.config import Settings
from rangecheck.errors import OutputError
from rangecheck.export.map_files import write_maps
from rangecheck.export.pictures import develop, exposure_from, png_bytes, write_png
from rangecheck.export.video import FORMATS, find_encoder, write_film
from rangecheck.maps import Maps, back_projection_error, require_outside, trace_maps
from rangecheck.optics import PinholeCamera
from rangecheck.pipeline.folder import check_free, check_writable
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import read_subject
from rangecheck.progress import Reporter
from rangecheck.reflectance import Material, load_material
from rangecheck.rigid import look_at
from rangecheck.scene import Scene, studio
from rangecheck.surface import Surface
from rangecheck.transport import Film, Tracer
from rangecheck.transport import Settings as LightSettings

#: radiance behind the object, where white that faces the key light has 1: an even, dark backdrop, whatever the surroundings
BACKDROP = 0.05


def camera_of(settings: Settings) -> PinholeCamera:
    """The pinhole camera of the settings."""
    picture = settings.picture
    return PinholeCamera.from_field_of_view(picture.width, picture.height, picture.field_of_view_deg)


def scene_of(surface: Surface, material: Material) -> Scene:
    """The surface in the studio that suits its material: soft boxes for what mirrors, lamps for what does not."""
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
    tracer = Tracer(scene_of(surface, material))
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


def orbit_of(surface: Surface, settings: Settings) -> Orbit:
    """The tightest orbit whose every frame holds the whole surface."""
    turn = settings.turntable
    return orbit_around(surface, camera_of(settings), frames=turn.frames, elevation_deg=turn.elevation_deg, margin=turn.margin)


def pose_from(surface: Surface, settings: Settings, camera_mm: tuple[float, ...] | None) -> FloatArray:
    """world_from_camera at `camera_mm` looking at the middle of the surface, or the first view of the orbit."""
    if camera_mm is None:
        return orbit_of(surface, settings).world_from_camera(0)
    return look_at(camera_mm, surface.bounds_mm.mean(axis=0))


def _refuse_existing(path: str | Path, force: bool) -> None:
    check_writable(path)
    if Path(path).exists() and not force:
        raise OutputError(path, "exists already; pass --force to replace it")


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
    _refuse_existing(out, force)
    material = load_material(settings.light.materials[0])
    subject = read_subject(path, settings, unit, reporter)
    camera = camera_of(settings)
    pose = pose_from(subject.surface, settings, camera_mm)
    require_outside(subject.surface, camera, pose)
    with reporter.stage("rendering"):
        tracer = Tracer(scene_of(subject.surface, material))
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


def map_at(surface: Surface, settings: Settings, azimuth_deg: float) -> tuple[Maps, str]:
    """Maps from a focal point of its own orbit at `azimuth_deg`, and where that is in words."""
    camera = camera_of(settings)
    orbit = orbit_around(
        surface,
        camera,
        frames=1,
        elevation_deg=settings.maps.elevation_deg,
        margin=settings.turntable.margin,
        start_deg=azimuth_deg,
    )
    pose = orbit.world_from_camera(0)
    eye = ", ".join(f"{x:.0f}" for x in pose[:3, 3])
    return trace_maps(surface, camera, pose), f"focal point at ({eye}) mm"


def maps(
    path: str,
    out: str,
    *,
    settings: Settings,
    unit: str | None,
    camera_mm: tuple[float, ...] | None,
    force: bool,
    reporter: Reporter,
) -> Outcome:
    """All maps of what is in `path` from one focal point, proved by projecting them back onto the surface."""
    check_free(out, "maps.npz", force=force)
    subject = read_subject(path, settings, unit, reporter)
    camera = camera_of(settings)
    pose = pose_from(subject.surface, settings, camera_mm)
    require_outside(subject.surface, camera, pose)
    with reporter.stage("measuring"):
        measured = trace_maps(subject.surface, camera, pose)
        proof = back_projection_error(subject.surface, measured)
    with reporter.stage("writing"):
        eye = ", ".join(f"{x:.0f}" for x in pose[:3, 3])
        written = write_maps(out, measured, subtitle=f"focal point at ({eye}) mm")
    nearest, farthest = float(np.nanmin(measured.distance_mm)), float(np.nanmax(measured.distance_mm))
    lines = [
        f"{out}: {len(written)} files; distances {nearest:.2f} to {farthest:.2f} mm over {int(measured.hit.sum()):,} pixels",
        f"projected back, no point lies further than {proof.distance_max_mm:.2g} mm from the surface (bound {proof.bound_mm:.2g} mm)",
    ]
    return Outcome(
        document("maps", files=written, nearest_mm=nearest, farthest_mm=farthest, pixels=int(measured.hit.sum()),
                 back_projection={"distance_max_mm": proof.distance_max_mm, "depth_max_mm": proof.depth_max_mm, "bound_mm": proof.bound_mm, "holds": proof.holds},
                 camera=camera.to_dict(), world_from_camera=pose, seconds=reporter.seconds),
        lines,
        proof.holds,
    )  # fmt: skip


def turntable(
    path: str, out: str, *, settings: Settings, unit: str | None, frames_dir: str | None, force: bool, reporter: Reporter
) -> Outcome:
    """Frames and film of one turn around what is in `path`, in the first material of the settings."""
    film = Path(out)
    if film.suffix.lower() not in FORMATS:
        raise OutputError(out, f"must end in one of {', '.join(FORMATS)}")
    _refuse_existing(out, force)
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
