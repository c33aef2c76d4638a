"""What a modelled scene's file knows of the pictures a fit is given: its camera, its lamps, which faces are of the material looked for, and all light else."""

from __future__ import annotations

import difflib
import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.config import Settings
from rangecheck.errors import SettingError
from rangecheck.modeler.model import Model
from rangecheck.pipeline.pictures import scene_of
from rangecheck.pipeline.subject import Subject
from rangecheck.recover.lights import Light
from rangecheck.recover.looks import Look
from rangecheck.recover.problem import Guess, Problem
from rangecheck.reflectance import Material, load_material
from rangecheck.scene import Scene, Source
from rangecheck.transport import REPORT, Tracer
from rangecheck.transport import Settings as LightSettings
from rangecheck.transport.camera_rays import pixel_order
from rangecheck.transport.settings import FULL


def faces_of(model: Model, part: str | None) -> BoolArray | None:
    """(m,) the triangles of a body or face by its name; None for all of a scene of one material.

    Raises SettingError where the scene has no such part, and where several materials are not told apart."""
    names = model.surface.part_names
    bodies = list(dict.fromkeys(name.split("/")[0] for name in names))
    if part is None:
        if len(set(model.material_of_part)) > 1:
            raise SettingError(
                f"{model.name} is of several materials; say whose is looked for: --part, of {', '.join(bodies)}", key="part"
            )
        return None
    mine = [name == part or name.startswith(f"{part}/") for name in names]
    if not any(mine):
        near = difflib.get_close_matches(part, [*bodies, *names], n=1)
        raise SettingError(
            f"{model.name} has no part {part!r}; its bodies are {', '.join(bodies)}" + (f"; did you mean {near[0]}?" if near else ""),
            key="part",
        )  # fmt: skip
    return np.asarray(np.array(mine)[model.surface.part_of_face])


def scene_looked_at(subject: Subject, settings: Settings) -> Scene:
    """The scene as `render` takes its picture, at its own wavelengths: lamps and surroundings of its file, or a studio."""
    return scene_of(subject, load_material(settings.light.materials[0]), direct=settings.light.model == "direct")


def own_material(scene: Scene, faces: BoolArray | None) -> Material:
    """What the scene says that the part is made of; what metal it is counts as known."""
    of_face = scene.material_of_face
    return scene.materials[int(of_face[0] if faces is None else of_face[faces][0])]


def lamps_of(
    scene: Scene, name: str, middle_mm: FloatArray, exposure: float | None, irradiance: float | None
) -> tuple[Light, ...]:
    """The scene's own lamps as light on `middle_mm`, in parts of full scale: at this `exposure`, or so that the first has this `irradiance`; as the scene
    has them where neither is said.

    Raises SettingError where both are."""
    if exposure is not None and irradiance is not None:
        raise SettingError(
            f"{name} has lamps of its own; how bright the pictures are is said by one of --set picture.exposure=E (as they were rendered, and as render "
            "writes beside a picture) and --irradiance of the first lamp", key="irradiance",
        )  # fmt: skip
    if not scene.sources:
        raise SettingError(f"{name} has no lamps; say where they stood: --lights FILE", key="lights")
    shining = [Light.of(source, middle_mm) for source in scene.sources]
    factor = 1.0 if exposure is None and irradiance is None else exposure or float(irradiance or 0.0) / shining[0].irradiance
    return tuple(replace(light, irradiance=factor * light.irradiance) for light in shining)


class SceneSimulator:
    """All light that reaches pixels of a scene's picture, at one wavelength, as a fit asks for it."""

    def __init__(self, scene: Scene, look: Look, lamps: tuple[Light, ...], settings: Settings, wavelength_um: float) -> None:
        parts = scene.surface.part_of_face
        chosen = range(len(scene.material_of_part)) if look.faces is None else np.unique(parts[look.faces])
        self.others = tuple(material.at((wavelength_um,)) for material in scene.materials)
        of_part = tuple(len(self.others) if k in chosen else m for k, m in enumerate(scene.material_of_part))
        looked_for = Material("looked for", K_lm=0.5, K_sl=0.1, sigma_um=0.1, wavelengths_um=(wavelength_um,))
        self.tracer = Tracer(replace(scene, materials=(*self.others, looked_for), material_of_part=of_part))
        self.camera = look.camera
        # how large a radiance of the scene's file is in the pictures
        self.scale = lamps[0].radiance / float(scene.sources[0].radiance[0])
        self.settings = _followed(settings)

    def __call__(
        self, material: Guess, state: Problem, pose: FloatArray, pixels: IntArray, passes: int, seed: int, bounded: bool
    ) -> FloatArray:  # fmt: skip
        sources = tuple(
            Source(light.centre_mm, light.radius_mm, np.array([light.radiance / self.scale])) for light in state.lights
        )
        scene = replace(self.tracer.scene, materials=(*self.others, _reflecting(material, bounded)), sources=sources)
        tracer = self.tracer.lit_as(scene)
        settings = replace(self.settings, passes=1 if self.settings.centre else passes)
        # neighbours in the picture go through the tracer together
        order = np.argsort(_place_in_order(self.camera.width, self.camera.height)[pixels])
        seen = np.empty((settings.passes, len(pixels)))
        rays = tracer.picture_rays(self.camera, pose)
        seen[:, order] = tracer.probe(rays, np.ascontiguousarray(pixels[order], np.int32), settings, seed)[..., 0]
        return self.scale * seen


@lru_cache(maxsize=4)
def _place_in_order(width: int, height: int) -> IntArray:
    places: IntArray = np.empty(width * height, np.int64)
    places[pixel_order(width, height)] = np.arange(width * height)
    return places


def _followed(settings: Settings) -> LightSettings:
    """What light is followed: under a plan everything, because what it leaves out is an error that pictures would be blamed for."""
    match settings.light.model:
        case "direct":
            return LightSettings(each=4, shadow_rays=0, diffuse=False, depth=2, backdrop=False)
        case "report":
            return replace(REPORT, backdrop=False)
    return replace(FULL, backdrop=False)


def _reflecting(guess: Guess, bounded: bool) -> Material:
    """A fit's material, mirroring no more than what it does not scatter."""
    spike, lobe = (min(k, max(0.0, 1.0 - guess.K_lm)) for k in (guess.K_spike, guess.K_lobe))
    both = min(spike, lobe)
    wave = (guess.wavelength_um,)
    index: dict[str, Any] = {"index_um": wave, "n": (guess.n,), "k": (guess.k,)} if guess.n > 0.0 else {}
    return Material(
        "looked for", K_lm=min(guess.K_lm, 1.0), K_ss=spike - both, K_sl=lobe - both, K_s=both, sigma_um=guess.sigma_um,
        correlation_um=guess.correlation_um, wavelengths_um=wave, masking=guess.masking, bounded=bounded, **index,
    )  # fmt: skip


def field_of(model: Model) -> float | None:
    """The horizontal field of view of the scene's camera, degrees."""
    camera = model.camera
    return None if camera is None else 2 * math.degrees(math.atan(camera.width / (2 * camera.fx)))
