"""The tracer: a scene, made ready once, and the pictures taken of it.

A picture is cut into chunks of pixels; a chunk goes through the stages with all its rays at once:

    start -> cast -> meet -> aim -> cast -> add light -> split or choose -> cast -> meet -> ...

Every pixel's value depends on (scene, camera, settings, seed, pixel) alone, so that the bytes are the same on any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from threading import Lock

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.kernels import in_chunks
from rangecheck.optics import Camera
from rangecheck.raycast import EmbreeCaster
from rangecheck.scene import Scene
from rangecheck.scene.surroundings import CONSTANT
from rangecheck.transport.camera_rays import PictureRays, pixel_order
from rangecheck.transport.film import Film, Plate, expose
from rangecheck.transport.geometry import geometry_of, sources_of
from rangecheck.transport.glint import CELLS, aim_glints, corner_places, find_glints, glint_shares, keep_near, mirrored_corners
from rangecheck.transport.irradiance import IrradianceCache, Stored, gather_irradiance, nothing_stored
from rangecheck.transport.light import add_light, aim
from rangecheck.transport.meet import meet
from rangecheck.transport.outline import boxes_around, boxes_of, keep_seeing
from rangecheck.transport.queues import KIND_NAMES, LOBE, SPIKE, Hits, Rays, Shadows, Workspace
from rangecheck.transport.reflection import materials_of
from rangecheck.transport.scatter import choose_one, split
from rangecheck.transport.settings import Settings
from rangecheck.transport.sight import Sight, aim_unsettled, remember

#: pixels that go through the stages together: two tiles
CHUNK = 8192
#: what the interpolation of kept irradiance may be off by, relative to the mean light on the surface
KEPT_ERROR = 0.01
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
        self._boxes: list[FloatArray] = []
        self._idle: list[Workspace] = []
        self._grey: Tracer | None = None
        self._coloured: Tracer | None = None
        self._kept: dict[tuple[int, int], IrradianceCache] = {}
        self._keeping = Lock()

    def grey(self) -> Tracer:
        """The same scene at one wavelength only, for scenes whose wavelengths all look the same; always the same tracer."""
        if self._grey is not None:
            return self._grey
        twin = copy(self)
        twin.scene = self.scene.grey()
        twin.sources = sources_of(twin.scene, self.caster, 1)
        twin.surroundings = twin.scene.surroundings.arrays(1)
        twin.materials = materials_of(twin.scene.materials)
        twin._idle, twin._kept, twin._keeping = [], {}, Lock()
        twin._grey, twin._coloured = twin, self
        self._grey = twin
        return twin

    def irradiance(self, depth: int, records: int) -> IrradianceCache:
        """The light of up to `depth` reflections that is kept on the surfaces, from about so many records: gathered when it is first asked for, the same for every
        picture of the scene. Raises SceneError where something shines."""
        with self._keeping:
            if (depth, records) not in self._kept:
                if self._coloured is not None:
                    kept = self._coloured.irradiance(depth, records).in_one_channel(self._coloured.scene.channels // 2)
                else:
                    kept = gather_irradiance(self, depth=depth, error=KEPT_ERROR, records=records)
                self._kept[depth, records] = kept
            return self._kept[depth, records]

    def _stored(self, settings: Settings) -> tuple[Stored, Stored]:
        """What is kept where the camera looks, and where rays that gather meet surfaces."""
        nothing = nothing_stored(self.scene.channels)
        if (
            not settings.diffuse
            or settings.gather_diffuse == "paths"
            or (settings.depth < 2 and settings.gather_diffuse == "second")
        ):
            return nothing, nothing
        kept = self.irradiance(settings.depth, settings.records)
        return (kept.stored, kept.stored) if settings.gather_diffuse == "cache" else (nothing, kept.everything)

    def lit_as(self, scene: Scene) -> Tracer:
        """The lights and materials of `scene`, whose surface and parts are the same."""
        twin = copy(self)
        twin.scene = scene
        twin.sources = sources_of(scene, self.caster, scene.channels)
        twin.surroundings = scene.surroundings.arrays(scene.channels)
        twin.materials = materials_of(scene.materials)
        twin.lights = (*(f"source {k}" for k in range(len(scene.sources))), "surroundings")
        twin._grey, twin._kept, twin._keeping = None, {}, Lock()
        if scene.channels != self.scene.channels:
            twin._idle = []
        return twin

    def render(self, camera: Camera, world_from_camera: FloatArray, settings: Settings | None = None, *, seed: int = 0) -> Film:
        """The picture that `camera` takes from `world_from_camera` (4, 4), with the same bytes on any number of threads."""
        settings = settings or Settings()
        plate = Plate(camera.height, camera.width, self.scene.channels)
        picture = self.picture_rays(camera, world_from_camera)
        pixels = pixel_order(camera.width, camera.height)
        tally = self._nothing(settings)
        for number in range(settings.passes):
            tally += self.expose(picture, pixels, settings, seed, plate, number)
        rays = plate.count * np.int32(settings.each)
        return plate.develop(tally / (settings.passes * len(pixels)), self.lights, rays)

    def picture_rays(self, camera: Camera, world_from_camera: FloatArray) -> PictureRays:
        """The rays of a camera at a pose, in this tracer's frame."""
        pose = rigid.checked(world_from_camera, "world_from_camera")
        return PictureRays(camera, pose, self.caster.centre_mm, self.caster.scale_mm)

    def expose(
        self,
        picture: PictureRays,
        pixels: IntArray,
        settings: Settings,
        seed: int,
        plate: Plate,
        first: int | IntArray = 0,
        count: int | IntArray = 1,
        sight: Sight | None = None,
    ) -> FloatArray:
        """Add observations number first .. first + count - 1 of each of the pixels, none named twice, to the plate.
        `sight` is what is known of the sources' shadows in them, and learns of it.

        Returns the tally (first reflection, reflections, light) of their light."""
        outline = self.may_see(picture, settings)
        if outline is not None:
            rows = np.empty(len(pixels), np.int32)
            rows = rows[: keep_seeing(outline, pixels, np.atleast_1d(np.asarray(count, np.int32)), plate.count, rows)]
            first, count = (n if isinstance(n, int) else np.broadcast_to(n, len(pixels))[rows] for n in (first, count))
            pixels = pixels[rows]
        if isinstance(first, int) and isinstance(count, int) and count == 1:
            return self._expose_once(picture, pixels, settings, seed, plate, first, sight)
        counts = np.broadcast_to(np.asarray(count, np.int64), len(pixels))
        firsts = np.broadcast_to(np.asarray(first, np.int64), len(pixels))
        ends = np.cumsum(counts)
        # all observations of one pixel stay together, so that no two threads ever touch the same pixel
        size = max(1, CHUNK // settings.each)
        pieces = np.unique(np.searchsorted(ends, np.arange(0, ends[-1], size), side="right")) if len(ends) else np.zeros(1, int)
        edges = np.append(pieces, len(pixels))

        def chunk(start: int, stop: int) -> FloatArray:
            mine = slice(edges[start], edges[start + 1])
            repeated = np.repeat(pixels[mine], counts[mine])
            before = np.repeat(ends[mine] - counts[mine], counts[mine]) - (ends[mine.start] - counts[mine.start])
            numbers = np.repeat(firsts[mine], counts[mine]) + np.arange(len(repeated)) - before
            with self._workspace() as work:
                sample, face, tally = _Chunk(self, settings, work, sight).shine(picture, repeated, numbers, seed)
                expose(repeated, settings.each, sample, face, plate.mean, plate.spread, plate.covered, plate.count)
            return tally

        return np.sum([self._nothing(settings), *in_chunks(chunk, len(pieces), 1)], axis=0)

    def may_see(self, picture: PictureRays, settings: Settings) -> BoolArray | None:
        """Pixels that may see a surface or a source; None where all others see light too, or the camera cannot tell."""
        if settings.backdrop and not self._dark:
            return None
        if not picture.outline:
            if not self._boxes:
                self._boxes.append(boxes_of(self.geometry.vertices, self.geometry.faces))
            boxes = np.concatenate([self._boxes[0], boxes_around(self.sources)]) if len(self.sources.radius) else self._boxes[0]
            picture.outline.append(picture.may_see(boxes))
        return picture.outline[0]

    @property
    def _dark(self) -> bool:
        around = self.scene.surroundings
        return around.kind == CONSTANT and not around.low.any() and not around.boxes

    def _expose_once(
        self,
        picture: PictureRays,
        pixels: IntArray,
        settings: Settings,
        seed: int,
        plate: Plate,
        number: int,
        sight: Sight | None,
    ) -> FloatArray:
        numbers = np.full(min(len(pixels), CHUNK), number, np.int64)

        def chunk(start: int, stop: int) -> FloatArray:
            mine = pixels[start:stop]
            with self._workspace() as work:
                sample, face, tally = _Chunk(self, settings, work, sight).shine(picture, mine, numbers[: stop - start], seed)
                expose(mine, settings.each, sample, face, plate.mean, plate.spread, plate.covered, plate.count)
            return tally

        chunks = in_chunks(chunk, len(pixels), max(1, CHUNK // settings.each))
        return np.sum([self._nothing(settings), *chunks], axis=0)

    def _nothing(self, settings: Settings) -> FloatArray:
        """A tally of no light."""
        return np.zeros((len(KIND_NAMES), settings.depth + 1, len(self.lights)))

    def probe(self, picture: PictureRays, pixels: IntArray, settings: Settings, seed: int) -> FloatArray:
        """(passes, n, c) float32: `settings.passes` observations of each of a few pixels."""
        seen = np.empty((settings.passes, len(pixels), self.scene.channels), np.float32)

        def chunk(start: int, stop: int) -> None:
            with self._workspace() as work:
                for number in range(settings.passes):
                    numbers = np.full(stop - start, number, np.int64)
                    seen[number, start:stop] = _Chunk(self, settings, work).shine(picture, pixels[start:stop], numbers, seed)[0]

        in_chunks(chunk, len(pixels), max(1, CHUNK // (4 * settings.each)))
        return seen

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

    def __init__(self, tracer: Tracer, settings: Settings, work: Workspace, sight: Sight | None = None) -> None:
        self._tracer, self._settings, self._work, self._sight = tracer, settings, work, sight
        self._tally = tracer._nothing(settings)
        self._sample = work.samples(0)
        self._stored = tracer._stored(settings)
        # the light of the sources is kept too
        self._ends = settings.gather_diffuse == "second" and self._stored[1].sides > 0

    def shine(
        self, picture: PictureRays, pixels: IntArray, numbers: IntArray, seed: int
    ) -> tuple[FloatArray, IntArray, FloatArray]:
        """Observation numbers[i] of pixels[i]: radiance (n, c), face of each of its rays (n each,), and the tally; all three live until
        the next call with this workspace."""
        each, centre = self._settings.each, self._settings.centre
        n = len(pixels) * each
        rays, places = self._work.rays(0, n), self._work.pixel_places(n)
        self._sample = self._work.samples(len(pixels))
        self._picture, self._pixels = picture, pixels
        # hashes overflow by design; only where nothing is compiled would numpy warn of it
        with np.errstate(over="ignore"):
            picture.start(pixels, numbers, each, centre, seed, places, rays)
            self._follow(rays, n, 0)
        return self._sample, rays.face[:n], self._tally

    def _follow(self, rays: Rays, n: int, reflections: int) -> None:
        """Cast n rays whose light has been reflected so many times on its way to the pixel, and all that follow from them."""
        tracer, settings = self._tracer, self._settings
        self._cast(rays, n, coherent=reflections == 0)
        hits = self._work.hits(reflections, n)
        count = meet(
            tracer.geometry, tracer.sources, tracer.surroundings, self._stored[min(reflections, 1)], rays, n, reflections,
            settings.backdrop, reflections != 1 or settings.glints == "ray", hits, self._sample, self._tally,
        )  # fmt: skip
        if count == 0 or reflections == settings.depth or (reflections == 1 and self._ends):
            return
        self._light(hits, count, reflections + 1)
        if reflections == 0 and settings.spike and settings.glints != "ray" and tracer.lights[1:]:
            self._glints(hits, count)
        if not (settings.spike or settings.lobe or settings.diffuse):
            return
        branches = self._branches(reflections)
        step = max(1, _QUEUE // branches)
        for start in range(0, count, step):
            stop = min(start + step, count)
            sent = self._scatter(hits, start, stop, reflections)
            if sent:
                self._follow(self._work.rays(reflections + 1, 0), sent, reflections + 1)

    def _cast(self, rays: Rays, n: int, *, coherent: bool) -> None:
        self._tracer.caster.closest_local(
            rays.origin[:n], rays.direction[:n], rays.far[:n], rays.face[:n], rays.u[:n], rays.v[:n], coherent=coherent
        )

    def _block(self, shadows: Shadows, n: int, *, coherent: bool) -> None:
        self._tracer.caster.occluded_local(
            shadows.origin[:n], shadows.direction[:n], shadows.far[:n], shadows.blocked[:n], coherent=coherent
        )

    def _light(self, hits: Hits, count: int, reflections: int) -> None:
        tracer, settings = self._tracer, self._settings
        each = len(tracer.sources.radius) * max(1, settings.shadow_rays)
        if each == 0:
            return
        step = max(1, _QUEUE // each)
        for start in range(0, count, step):
            stop = min(start + step, count)
            shadows = self._work.shadows((stop - start) * each)
            sight = self._sight if reflections == 1 else None
            if sight is None:
                k = aim(tracer.sources, tracer.materials, hits, start, stop, settings.shadow_rays, True, True, shadows)
            else:
                k = aim_unsettled(
                    tracer.sources, tracer.materials, hits, start, stop, sight.settled, self._pixels, shadows, self._sample, self._tally
                )  # fmt: skip
            if k:
                self._block(shadows, k, coherent=reflections == 1)
                if sight is not None:
                    remember(shadows, k, self._pixels, sight.lit, sight.dark)
                add_light(shadows, k, reflections, self._sample, self._tally, LOBE)

    def _glints(self, hits: Hits, count: int) -> None:
        """Sources that the surfaces seen mirror into their pixels."""
        tracer, work, whole = self._tracer, self._work, self._settings.glints == "corners"
        glint_hit = np.empty(count * len(tracer.sources.radius), np.int32)
        glint_source = np.empty_like(glint_hit)
        n = find_glints(tracer.materials, tracer.sources, hits, count, glint_hit, glint_source)
        quad = np.empty((4, 2))
        if not whole and n:
            places, directions = self._mirrored(hits, glint_hit[:n], 1)
            n = keep_near(tracer.sources, hits, glint_hit, glint_source, n, places, directions, quad)
        cells = 1 if whole else CELLS
        step = _QUEUE // (cells + 1) ** 2
        for start in range(0, n, step):
            hit, source = glint_hit[start : min(start + step, n)], glint_source[start : min(start + step, n)]
            places, directions = self._mirrored(hits, hit, cells)
            share = np.empty(len(hit))
            glint_shares(tracer.sources, hits, hit, source, len(hit), cells, places, directions, whole, quad, share)
            shadows = work.shadows(len(hit))
            k = aim_glints(tracer.sources, tracer.materials, hits, hit, source, share, len(hit), shadows)
            if k:
                self._block(shadows, k, coherent=False)
                add_light(shadows, k, 1, self._sample, self._tally, SPIKE)

    def _mirrored(self, hits: Hits, chosen: IntArray, cells: int) -> tuple[FloatArray, FloatArray]:
        """Places and mirror directions (len(chosen) (cells + 1)^2, 3) of the corners of the cells of these hits' pixels."""
        work, n = self._work, len(chosen) * (cells + 1) ** 2
        rays, coordinates = work.rays(1, n), work.pixel_places(n)
        corner_places(self._pixels[hits.pixel[chosen]], len(chosen), self._picture.camera.width, cells, coordinates)
        self._picture.fill(coordinates[0], coordinates[1], rays.origin, rays.direction)
        rays.far[:n] = np.inf
        self._cast(rays, n, coherent=True)
        places, directions = np.empty((n, 3)), np.empty((n, 3))
        mirrored_corners(self._tracer.geometry, rays, n, work.hits(1, 1), places, directions)
        return places, directions

    def _branches(self, reflections: int) -> int:
        settings = self._settings
        if reflections > 0:
            return 1
        rings = settings.lobe_rays
        over_lobe = 1 + 3 * rings * (rings + 1) if settings.gather == "fan" else rings
        return max(1, int(settings.spike) + settings.lobe * over_lobe + settings.diffuse * settings.diffuse_rays)

    def _scatter(self, hits: Hits, start: int, stop: int, reflections: int) -> int:
        tracer, settings = self._tracer, self._settings
        rays = self._work.rays(reflections + 1, (stop - start) * self._branches(reflections))
        if reflections == 0:
            return split(
                tracer.materials, hits, start, stop, settings.spike, settings.lobe * settings.lobe_rays,
                math.radians(settings.fan_step_deg) if settings.gather == "fan" else 0.0, settings.diffuse * settings.diffuse_rays, settings.least, rays,
            )  # fmt: skip
        roulette = 0 < settings.roulette_from <= reflections
        return choose_one(
            tracer.materials, hits, start, stop, settings.spike, settings.lobe, settings.diffuse, roulette, settings.least, rays
        )  # fmt: skip
