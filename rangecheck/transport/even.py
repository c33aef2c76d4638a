"""Pictures of the same number of samples in every pixel, as the reference is taken; and a scene's lobes evaluated by other forms."""

from __future__ import annotations

import math
from copy import copy

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.optics import Camera
from rangecheck.reflectance import MaterialTables
from rangecheck.reflectance.forms import with_forms
from rangecheck.transport.camera_rays import pixel_order
from rangecheck.transport.film import Film, Plate
from rangecheck.transport.settings import Settings
from rangecheck.transport.tracer import Tracer

#: observations of a pixel that are taken in one go
_AT_ONCE = 64


def render_evenly(
    tracer: Tracer,
    camera: Camera,
    world_from_camera: FloatArray,
    settings: Settings,
    error: float,
    *,
    seed: int = 0,
    most: int = 1 << 18,
) -> Film:
    """The same number of samples in every pixel, as many as bring the frame's standard error to `error` of its mean."""
    picture, pixels = tracer.picture_rays(camera, world_from_camera), pixel_order(camera.width, camera.height)
    plate = Plate(camera.height, camera.width, tracer.scene.channels)
    tally = np.zeros(())
    done, passes = 0, 4
    while True:
        while done < passes:
            step = min(_AT_ONCE, passes - done)
            tally = tally + tracer.expose(picture, pixels, settings, seed, plate, done, step)
            done += step
        film = plate.develop(tally / (passes * len(pixels)), tracer.lights, plate.count * np.int32(settings.each))
        mean = film.mean_radiance
        if not mean > 0 or passes * settings.each >= most:
            return film
        ratio = film.standard_error() / (error * mean)
        if ratio <= 1:
            return film
        passes = min(max(passes + 1, math.ceil(passes * min(ratio * ratio, 4.0))), max(1, most // settings.each))


def with_lobe_forms(tracer: Tracer, forms: tuple[str, ...]) -> Tracer:
    """The same scene, its lobes evaluated by these forms."""
    if not forms or set(forms) == {"fast"}:
        return tracer
    twin = copy(tracer)
    tables = with_forms(MaterialTables(tracer.materials.surfaces, tracer.materials.series), forms)
    twin.materials = tracer.materials._replace(surfaces=tables.surfaces)
    return twin
