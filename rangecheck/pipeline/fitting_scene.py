"""What a modelled scene's file knows of the pictures a fit is given: its camera, its lamps, which faces are of the material looked for, and all light else."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.config import Settings
from rangecheck.errors import SettingError
from rangecheck.modeler.model import Model
from rangecheck.pipeline.pictures import plan_of, scene_of
from rangecheck.pipeline.subject import Subject
from rangecheck.recover.lights import Light
from rangecheck.recover.looks import Look
from rangecheck.recover.problem import Guess, Problem
from rangecheck.reflectance import Material, load_material
from rangecheck.scene import Source
from rangecheck.transport import Tracer
from rangecheck.transport import render as render_film


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


def lamps_of(model: Model, middle_mm: FloatArray, exposure: float | None, irradiance: float | None) -> tuple[Light, ...]:
    """The scene's own lamps as light on `middle_mm`, in parts of full scale: at this `exposure`, or so that the first has this `irradiance`.

    Raises SettingError where neither is known, or both are."""
    if (exposure is None) == (irradiance is None):
        raise SettingError(
            f"{model.name} has lamps of its own; say how bright the pictures are, one of --set picture.exposure=E (as they were rendered, and "
            "as render writes beside a picture) and --irradiance of the first lamp", key="irradiance",
        )  # fmt: skip
    shining = [
        Light.of(Source(np.array(lamp.centre_mm), lamp.radius_mm, np.array([lamp.radiance])), middle_mm) for lamp in model.lamps
    ]
    factor = exposure if irradiance is None else irradiance / shining[0].irradiance
    return tuple(replace(light, irradiance=float(factor or 0.0) * light.irradiance) for light in shining)


def simulator(subject: Subject, look: Look, lamps: tuple[Light, ...], settings: Settings) -> Callable[[Problem], FloatArray]:
    """The picture (h, w) that `render` makes of the scene with a fit's material and lamps from where `look` is, in parts of full scale."""
    wave = (Guess().wavelength_um,)
    base = scene_of(subject, load_material(settings.light.materials[0]), direct=settings.light.model == "direct")
    others = tuple(material.at(wave) for material in base.materials)
    chosen = range(len(base.material_of_part)) if look.faces is None else np.unique(subject.surface.part_of_face[look.faces])
    of_part = tuple(len(others) if k in chosen else m for k, m in enumerate(base.material_of_part))
    # how large a radiance of the scene's file is in the pictures
    scale = lamps[0].radiance / float(base.sources[0].radiance[0])

    def simulated(state: Problem) -> FloatArray:
        sources = tuple(Source(light.centre_mm, light.radius_mm, np.array([light.radiance / scale])) for light in state.lights)
        scene = replace(base, materials=(*others, _reflecting(state.material)), material_of_part=of_part, sources=sources)
        tracer = Tracer(scene)
        plan = plan_of(tracer, look.camera, look.pose, settings, still=True)
        film = render_film(tracer, look.camera, look.pose, plan=plan, seed=settings.seed)
        return np.asarray(scale * film.radiance[..., 0], np.float64)

    return simulated


def _reflecting(guess: Guess) -> Material:
    """A fit's material, mirroring no more than what it does not scatter: strengths that nothing determines may be any."""
    spike, lobe = (min(k, max(0.0, 1.0 - guess.K_lm)) for k in (guess.K_spike, guess.K_lobe))
    both = min(spike, lobe)
    return Material(
        "looked for", K_lm=min(guess.K_lm, 1.0), K_ss=spike - both, K_sl=lobe - both, K_s=both, sigma_um=guess.sigma_um,
        correlation_um=guess.correlation_um, wavelengths_um=(guess.wavelength_um,), masking=guess.masking,
    )  # fmt: skip


def field_of(model: Model) -> float | None:
    """The horizontal field of view of the scene's camera, degrees."""
    camera = model.camera
    return None if camera is None else 2 * math.degrees(math.atan(camera.width / (2 * camera.fx)))
