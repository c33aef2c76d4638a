"""render: the scene, how its light is planned, and one picture of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.config import Settings
from rangecheck.errors import OutputError
from rangecheck.export.camera_files import write_camera_json
from rangecheck.export.pictures import develop, exposure_from, write_png
from rangecheck.optics import PinholeCamera
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import Subject, read_subject
from rangecheck.pipeline.views import refuse_existing, view_of
from rangecheck.progress import Reporter
from rangecheck.reflectance import Material, load_material
from rangecheck.scene import Scene, Source, gradient, studio
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


def before_backdrop(film: Film) -> FloatArray:
    """(h, w, c) radiance of the film in front of the backdrop."""
    return film.radiance + (BACKDROP * (1 - film.coverage))[..., None].astype(film.radiance.dtype)


@dataclass(frozen=True)
class LightPlan:
    """How the light of a scene is followed, and why so."""

    settings: LightSettings
    reasons: tuple[str, ...] = ()

    def render(self, tracer: Tracer, camera: PinholeCamera, world_from_camera: FloatArray, seed: int) -> Film:
        """The picture by this plan."""
        return tracer.render(camera, world_from_camera, self.settings, seed=seed)

    def explain(self) -> list[str]:
        """Each decision with its reason."""
        return list(self.reasons)


def plan_of(tracer: Tracer, camera: PinholeCamera, pose: FloatArray, settings: Settings) -> LightPlan:
    return LightPlan(LightSettings(passes=4, depth=3, backdrop=False))


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
        film = plan.render(tracer, camera, pose, settings.seed)
    exposure = exposure_from([film.radiance])
    write_png(out, develop(grey_or_colour(before_backdrop(film)), exposure), force=force)
    write_camera_json(Path(out).with_suffix(".camera.json"), camera, pose)
    lines = [f"{out}: {camera.width}x{camera.height}, {material.name}, mean radiance {film.mean_radiance:.4g}", *plan.explain()]
    return Outcome(
        document("render", output=out, material=material.name, camera=camera.to_dict(), world_from_camera=pose, exposure=exposure,
                 film=film.to_dict(), plan=plan.explain(), seconds=reporter.seconds),
        lines,
    )  # fmt: skip


def grey_or_colour(radiance: FloatArray) -> FloatArray:
    """(h, w) where there is one wavelength, else (h, w, 3)."""
    return radiance[..., 0] if radiance.shape[2] == 1 else radiance
