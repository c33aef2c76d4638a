"""Pixels out of focus, traced through the whole lens; all others keep their pinhole's rays.

The lens is thin: all rays of a pixel's point meet in the plane of focus (`optics.lens`). Rays through the lens are drawn evenly over its
disc (Shirley & Chiu, *A low distortion map between disk and square*, 1997); those that a rim stops are drawn again, so that a
pixel's value is the mean radiance of what passes. Sources in mirrors are met by the rays themselves here: a footprint seen
through a single point would be sharp.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray, require
from rangecheck.kernels import stage_kernel
from rangecheck.optics import ThinLens
from rangecheck.rigid import checked
from rangecheck.transport.camera_rays import PictureRays, pixel_order
from rangecheck.transport.chance import key_of, point
from rangecheck.transport.film import Film, Plate
from rangecheck.transport.queues import Rays
from rangecheck.transport.settings import Settings
from rangecheck.transport.tracer import Tracer

#: rays through the lens for each pixel out of focus: as many where nothing says how much noise is allowed, and at most
LENS_RAYS, MOST_LENS_RAYS = 64, 1024
#: rays of one group, spread evenly over pixel and lens
_EACH = 4
#: what the chance is for, beside those of `chance`, and how often a ray that the rim stopped is drawn again
_LENS, _TRIES = 11, 16


class LensRays(PictureRays):
    """The rays of one camera at one pose, through every point of its lens."""

    def __init__(self, lens: ThinLens, world_from_camera: FloatArray, centre_mm: FloatArray, scale_mm: float) -> None:
        super().__init__(lens.camera, world_from_camera, centre_mm, scale_mm)
        rim = math.inf if lens.rim_mm is None else lens.rim_mm
        self._lens = np.array([0.5 * lens.aperture_mm, lens.focus_mm, 0.5 * rim, lens.rim_distance_mm]) / scale_mm

    def start(
        self, pixels: IntArray, numbers: IntArray, each: int, centre: bool, seed: int, places: FloatArray, rays: Rays
    ) -> None:
        """As the pinhole's, then moved to a point of the lens and turned to where the plane of focus was met."""
        super().start(pixels, numbers, each, centre, seed, places, rays)
        _through_lens(self._lens, self.rotation, self.eye, len(pixels) * each, rays)

    def may_see(self, boxes: FloatArray) -> None:
        """Rays start anywhere on the lens: the outline that one point sees is not theirs."""


@stage_kernel
def _disc_point(a, b):
    """A point of the unit disc for one of the unit square; equal areas stay equal."""
    x, y = 2.0 * a - 1.0, 2.0 * b - 1.0
    if x == 0.0 and y == 0.0:
        return 0.0, 0.0
    if abs(x) > abs(y):
        radius, angle = x, 0.25 * math.pi * y / x
    else:
        radius, angle = y, 0.5 * math.pi - 0.25 * math.pi * x / y
    return radius * math.cos(angle), radius * math.sin(angle)


@stage_kernel
def _through_lens(lens, rotation, eye, n, rays):
    radius, focus, rim, rim_distance = lens[0], lens[1], lens[2], lens[3]
    for k in range(n):
        dx, dy, dz = float(rays.direction[k, 0]), float(rays.direction[k, 1]), float(rays.direction[k, 2])
        # in the camera's frame, where its axis is z
        cx = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
        cy = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
        cz = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
        tx, ty = cx / cz * focus, cy / cz * focus
        lx, ly = 0.0, 0.0
        for attempt in range(_TRIES):
            a, b = point(key_of(rays.stream[k], _LENS + attempt * 256), rays.number[k])
            lx, ly = _disc_point(a, b)
            lx, ly = radius * lx, radius * ly
            mx, my = lx + rim_distance / focus * (tx - lx), ly + rim_distance / focus * (ty - ly)
            if mx * mx + my * my <= rim * rim:
                break
        vx, vy = tx - lx, ty - ly
        size = 1.0 / math.sqrt(vx * vx + vy * vy + focus * focus)
        vx, vy, vz = vx * size, vy * size, focus * size
        wx = rotation[0, 0] * vx + rotation[0, 1] * vy + rotation[0, 2] * vz
        wy = rotation[1, 0] * vx + rotation[1, 1] * vy + rotation[1, 2] * vz
        wz = rotation[2, 0] * vx + rotation[2, 1] * vy + rotation[2, 2] * vz
        ox = eye[0] + rotation[0, 0] * lx + rotation[0, 1] * ly
        oy = eye[1] + rotation[1, 0] * lx + rotation[1, 1] * ly
        oz = eye[2] + rotation[2, 0] * lx + rotation[2, 1] * ly
        skip = max(0.0, -(ox * wx + oy * wy + oz * wz) - 2.0)
        rays.origin[k, 0], rays.origin[k, 1], rays.origin[k, 2] = ox + skip * wx, oy + skip * wy, oz + skip * wz
        rays.direction[k, 0], rays.direction[k, 1], rays.direction[k, 2] = wx, wy, wz


def defocus(
    tracer: Tracer,
    film: Film,
    lens: ThinLens,
    world_from_camera: FloatArray,
    settings: Settings,
    blurred: BoolArray,
    *,
    error: float | None = None,
    seed: int = 0,
) -> Film:
    """`film`, which a pinhole took, with the pixels `blurred` (h, w) taken again through the lens.

    LENS_RAYS for each, or as many as bring their standard error to `error` of the frame's mean radiance, at most MOST_LENS_RAYS. The
    budget of the light stays that of the pinhole. Same bytes on any number of threads."""
    camera = lens.camera
    chosen = require("blurred", blurred, (camera.height, camera.width), np.bool_).ravel()
    order = pixel_order(camera.width, camera.height)
    pixels = np.ascontiguousarray(order[chosen[order]])
    if not len(pixels) or lens.aperture_mm == 0:
        return film
    pose = checked(world_from_camera, "world_from_camera")
    picture = LensRays(lens, pose, tracer.caster.centre_mm, tracer.caster.scale_mm)
    followed = replace(settings, passes=1, each=_EACH, centre=False, glints="ray")
    plate = Plate(camera.height, camera.width, tracer.scene.channels)
    done, wanted = 0, LENS_RAYS // _EACH
    while wanted > done:
        tracer.expose(picture, pixels, followed, seed, plate, np.full(len(pixels), done), np.full(len(pixels), wanted - done))
        done = wanted
        if error is not None and film.mean_radiance > 0:
            variance = float(plate.spread[pixels].mean(dtype=np.float64)) / (done * (done - 1))
            if variance > (error * film.mean_radiance) ** 2:
                wanted = min(2 * done, MOST_LENS_RAYS // _EACH)
    taken = plate.develop(film.budget, film.lights, plate.count * np.int32(_EACH))
    mask = chosen.reshape(blurred.shape)

    def both(mine: FloatArray, other: FloatArray) -> FloatArray:
        return np.where(mask if mine.ndim == 2 else mask[..., None], mine, other)

    return replace(
        film,
        radiance=both(taken.radiance, film.radiance),
        coverage=both(taken.coverage, film.coverage),
        variance=both(taken.variance, film.variance),
        samples=np.where(mask, taken.samples, film.samples),
    )
