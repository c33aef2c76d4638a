"""render: the scene, how its light is planned, and one picture of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.config import Settings
from rangecheck.errors import OutputError
from rangecheck.export.camera_files import write_camera_json, write_colmap, write_opencv_yaml
from rangecheck.export.pictures import exposure_from, write_png
from rangecheck.optics import Camera, PinholeCamera
from rangecheck.pipeline.camera import developed, image_of, optics_of, take
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.subject import Subject, read_subject
from rangecheck.pipeline.views import refuse_existing, seen_by, view_of
from rangecheck.progress import Reporter
from rangecheck.reflectance import Material, load_material, side_by_side
from rangecheck.scene import Scene, Source, gradient, studio
from rangecheck.transport import Plan, Tracer, make_plan
from rangecheck.transport import Settings as LightSettings

#: departure from the neighbours, relative to the mean radiance seen, from which a pixel of a matt surface gets more samples: 8 bits show less of it
UNEVEN = 0.15
#: samples of a picture that stands alone, over those of a turntable's frame
STILL = 8


def scene_of(subject: Subject, material: Material, *, direct: bool = False, stripes: bool = False) -> Scene:
    """A modelled scene as its file says; any other surface in the studio that suits its material: soft boxes for what mirrors,
    lamps for what does not - lamps alone where only their `direct` light is followed. Or any surface among inspection `stripes`."""
    surface, model = subject.surface, subject.model
    azimuth = np.radians(subject.front_deg)
    front = (float(np.sin(azimuth)), 0.0, float(np.cos(azimuth)))
    if stripes:
        return studio(surface, material, "stripes", smooth=True, front=front)
    if model is not None and model.lamps:
        names = list(dict.fromkeys(name or material.name for name in model.material_of_part))
        return Scene(
            surface,
            side_by_side([load_material(name) for name in names]),
            tuple(names.index(name or material.name) for name in model.material_of_part),
            tuple(Source(np.array(lamp.centre_mm), lamp.radius_mm, np.array([lamp.radiance])) for lamp in model.lamps),
            gradient(0.05, 0.25),
            smooth=True,
            vertex_normals=np.nan_to_num(model.corner_normals),
        )
    strengths = material.strengths().mean(axis=1)
    matt = strengths[0] > strengths[1:].sum()
    return studio(surface, material, ("dark" if direct else "plaster") if matt else "steel", smooth=True, front=front)


def plan_of(tracer: Tracer, camera: Camera, pose: FloatArray, settings: Settings, *, still: bool = False) -> Plan:
    """How the light of this picture is followed, and why so; pictures have a backdrop of their own instead of the surroundings.

    A `still`, which is looked at for longer than a frame of a film, has STILL times its samples."""
    light = settings.light
    if light.model == "direct":
        return _direct_plan(tracer.scene, light.samples * (STILL if still else 1))
    plan = make_plan(tracer, camera, pose, tolerance=light.tolerance_percent / 100, model=light.model, seed=settings.seed)
    return replace(plan, settings=replace(plan.settings, backdrop=False))


def _direct_plan(scene: Scene, samples: int) -> Plan:
    """Light straight from the sources, and what surfaces mirror of them, of the surroundings and, once, of each other."""
    strengths = np.stack([material.strengths() for material in scene.materials])
    grey = bool((strengths == strengths[..., :1]).all() and not any(material.index_um for material in scene.materials))
    mirrors = bool(strengths[:, 1:].any())
    if mirrors:
        followed = LightSettings(each=samples, shadow_rays=0, diffuse=False, depth=2, backdrop=False)
        said = f"{samples} samples in every pixel, shadows, one reflection in mirrors"
    else:
        followed = LightSettings(each=2 * samples, uneven=UNEVEN, spike=False, lobe=False, diffuse=False, depth=1, backdrop=False)
        said = f"one sample through each pixel's middle, {2 * samples} instead where the picture is uneven, shadows, no interreflection"
    reasons = (f"direct light: {said}; light.model=plan follows as much light as a tolerance asks for",)
    return Plan("direct", 0.0, followed, None, grey, reasons=reasons)


def known_of(scene: Scene) -> list[str]:
    """How well the numbers of the scene's materials are known, where fits say so; of several materials each by its name."""
    told = [(material.name, said) for material in scene.materials for said in material.stated]
    return [said if len(scene.materials) == 1 else f"{name}: {said}" for name, said in told]


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
    middle = float((subject.surface.bounds_mm.mean(axis=0) - pose[:3, 3]) @ pose[:3, 2])
    optics = optics_of(settings, camera, middle)
    with reporter.stage("rendering"):
        tracer = Tracer(scene_of(subject, material, direct=settings.light.model == "direct"))
        plan = plan_of(tracer, optics.camera, pose, settings, still=True)
        film, said = take(tracer, optics, pose, plan, settings.seed)
        known = known_of(tracer.scene)
        del tracer  # of a large mesh it is far more than the picture
    exposure = settings.picture.exposure or exposure_from([film.radiance])
    write_png(out, developed(image_of(film, optics), exposure, optics, settings.seed), force=force)
    beside = Path(out)
    write_camera_json(beside.with_suffix(".camera.json"), camera, pose, {"exposure": exposure, **optics.to_dict()})
    if isinstance(camera, PinholeCamera):
        # the others know no other camera
        write_opencv_yaml(beside.with_suffix(".opencv.yaml"), camera, pose)
        write_colmap(beside.with_suffix(".colmap"), [camera], [pose], [beside.name.replace(" ", "_")])
    explained = [line for line in (*known, *plan.explain(), seen_by(camera), *optics.reasons, *said) if line]
    lines = [f"{out}: {camera.width}x{camera.height}, {material.name}, mean radiance {film.mean_radiance:.4g}", *explained]
    return Outcome(
        document("render", output=out, material=material.name, camera=camera.to_dict(), world_from_camera=pose, exposure=exposure,
                 film=film.to_dict(), plan=explained, seconds=reporter.seconds, **optics.to_dict()),
        lines,
    )  # fmt: skip
