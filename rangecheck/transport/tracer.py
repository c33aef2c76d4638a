"""The tracer: a scene, made ready once, and the pictures taken of it.

A picture is cut into chunks of pixels; a chunk goes through the stages with all its rays at once:

    start -> cast -> meet -> aim -> cast -> add light -> split or choose -> cast -> meet -> ...

Every pixel's value depends on (scene, camera, settings, seed, pixel) alone, so that the bytes are the same on any number of threads.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import in_chunks
from rangecheck.optics import Camera
from rangecheck.raycast import EmbreeCaster
from rangecheck.scene import Scene
from rangecheck.transport.camera_rays import PictureRays, pixel_order, start_rays
from rangecheck.transport.film import Film, Plate, expose
from rangecheck.transport.geometry import geometry_of, sources_of
from rangecheck.transport.light import add_light, aim
from rangecheck.transport.meet import meet
from rangecheck.transport.queues import KIND_NAMES, Rays, Workspace
from rangecheck.transport.reflection import materials_of
from rangecheck.transport.scatter import choose_one, split
from rangecheck.transport.settings import Settings

#: pixels that go through the stages together: one tile
CHUNK = 4096
#: most rays that wait in one queue
_QUEUE = 32768


class Tracer:
    """Takes pictures of one scene. Building it casts nothing; it may be used from several threads."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.caster = EmbreeCaster(scene.surface.vertices, scene.surface.faces)
        self.geometry = geometry_of(scene, self.caster)
        self.sources = sources_of(scene, self.caster, scene.channels)
        self.surroundings = scene.surroundings.arrays(scene.channels)
        self.materials = materials_of(scene.materials)
        self.lights = (*(f"source {k}" for k in range(len(scene.sources))), "surroundings")
        self._idle: list[Workspace] = []

    def render(self, camera: Camera, world_from_camera: FloatArray, settings: Settings | None = None, *, seed: int = 0) -> Film:
        """The picture that `camera` takes from `world_from_camera` (4, 4), with the same bytes on any number of threads."""
        settings = settings or Settings()
        plate = Plate(camera.height, camera.width, self.scene.channels)
        picture = self.picture_rays(camera, world_from_camera)
        pixels = pixel_order(camera.width, camera.height)
        tally = np.zeros((len(KIND_NAMES), settings.depth + 1, len(self.lights)))
        for number in range(settings.passes):
            tally += self.expose(picture, pixels, settings, number, seed, plate)
        rays = plate.count * np.int32(settings.each)
        return plate.develop(tally / (settings.passes * len(pixels)), self.lights, rays)

    def picture_rays(self, camera: Camera, world_from_camera: FloatArray) -> PictureRays:
        """The rays of a camera at a pose, in this tracer's frame."""
        pose = rigid.checked(world_from_camera, "world_from_camera")
        return PictureRays(camera, pose, self.caster.centre_mm, self.caster.scale_mm)

    def expose(
        self, picture: PictureRays, pixels: IntArray, settings: Settings, number: int, seed: int, plate: Plate
    ) -> FloatArray:
        """Add sample `number` of the pixels to the plate; returns the tally (first reflection, reflections, light) of its light."""

        def chunk(start: int, stop: int) -> FloatArray:
            with self._workspace() as work:
                return _Chunk(self, settings, number, work).expose(picture, pixels[start:stop], seed, plate)

        return np.sum(in_chunks(chunk, len(pixels), max(1, CHUNK // settings.each)), axis=0)

    @contextmanager
    def _workspace(self) -> Iterator[Workspace]:
        try:
            work = self._idle.pop()
        except IndexError:
            work = Workspace(self.scene.channels)
        yield work
        self._idle.append(work)


class _Chunk:
    """One chunk's way through the stages, on one thread."""

    def __init__(self, tracer: Tracer, settings: Settings, number: int, work: Workspace) -> None:
        self._tracer, self._settings, self._number, self._work = tracer, settings, number, work
        self._tally = np.zeros((len(KIND_NAMES), settings.depth + 1, len(tracer.lights)))
        self._sample = work.samples(0)

    def expose(self, picture: PictureRays, pixels: IntArray, seed: int, plate: Plate) -> FloatArray:
        each, centre = self._settings.each, self._settings.centre
        n = len(pixels) * each
        rays, places = self._work.rays(0, n), self._work.pixel_places(n)
        self._sample = self._work.samples(len(pixels))
        start_rays(pixels, picture.camera.width, each, centre, seed & 0xFFFFFFFF, self._number, places, rays)
        picture.fill(places[0], places[1], rays.origin, rays.direction)
        self._follow(rays, n, 0)
        expose(pixels, each, self._sample, rays.face, plate.mean, plate.spread, plate.covered, plate.count)
        return self._tally

    def _follow(self, rays: Rays, n: int, reflections: int) -> None:
        """Cast n rays whose light has been reflected so many times on its way to the pixel, and all that follow from them."""
        tracer, settings = self._tracer, self._settings
        tracer.caster.closest_local(
            rays.origin[:n], rays.direction[:n], rays.far[:n], rays.face[:n], rays.u[:n], rays.v[:n], coherent=reflections == 0
        )
        hits = self._work.hits(reflections, n)
        count = meet(
            tracer.geometry, tracer.sources, tracer.surroundings, rays, n, reflections,
            settings.backdrop, True, hits, self._sample, self._tally,
        )  # fmt: skip
        if count == 0 or reflections == settings.depth:
            return
        self._light(hits, count, reflections + 1)
        if not (settings.spike or settings.lobe or settings.diffuse):
            return
        branches = self._branches(reflections)
        step = max(1, _QUEUE // branches)
        for start in range(0, count, step):
            stop = min(start + step, count)
            sent = self._scatter(hits, start, stop, reflections)
            if sent:
                self._follow(self._work.rays(reflections + 1, 0), sent, reflections + 1)

    def _light(self, hits, count: int, reflections: int) -> None:
        tracer, settings = self._tracer, self._settings
        each = len(tracer.sources.radius) * max(1, settings.shadow_rays)
        if each == 0:
            return
        step = max(1, _QUEUE // each)
        for start in range(0, count, step):
            stop = min(start + step, count)
            shadows = self._work.shadows((stop - start) * each)
            k = aim(tracer.sources, tracer.materials, hits, start, stop, settings.shadow_rays, True, True, shadows)
            if k:
                tracer.caster.occluded_local(
                    shadows.origin[:k], shadows.direction[:k], shadows.far[:k], shadows.blocked[:k], coherent=reflections == 1
                )
                add_light(shadows, k, reflections, self._sample, self._tally)

    def _branches(self, reflections: int) -> int:
        settings = self._settings
        if reflections > 0:
            return 1
        return max(1, int(settings.spike) + settings.lobe * settings.lobe_rays + settings.diffuse * settings.diffuse_rays)

    def _scatter(self, hits, start: int, stop: int, reflections: int) -> int:
        tracer, settings = self._tracer, self._settings
        rays = self._work.rays(reflections + 1, (stop - start) * self._branches(reflections))
        if reflections == 0:
            return split(
                tracer.materials, hits, start, stop, settings.spike, settings.lobe * settings.lobe_rays,
                settings.diffuse * settings.diffuse_rays, settings.least, rays,
            )  # fmt: skip
        roulette = 0 < settings.roulette_from <= reflections
        return choose_one(
            tracer.materials, hits, start, stop, settings.spike, settings.lobe, settings.diffuse, roulette, settings.least, rays,
        )  # fmt: skip
