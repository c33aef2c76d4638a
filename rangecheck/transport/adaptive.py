"""Samples where they are needed: one through every pixel's middle, then more at edges, highlights, penumbrae and noise, until the
estimated error of the frame is small enough.

The error of a frame is the root mean square over its pixels (and wavelengths) of the radiance's error, divided by the frame's mean
radiance. What one sample may be off is judged by how its pixel departs from the straight line through its neighbours, in four directions;
what a group of evenly spread samples may be off, by the spread of the groups, shared among neighbours. Samples are allotted in
proportion to that spread (Neyman 1934), which gives the least error for their number.

The variance of m groups of samples that are spread evenly together falls about as m^-1.5 at an edge, of which m^-1.25 is assumed, and as
m^-1 where light is gathered by chance. There a single sample says nothing about its error (it may by chance have met no light at all), so
that every pixel that sees a surface gets two groups before anything is judged.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.kernels import in_chunks, inline_kernel, stage_kernel
from rangecheck.optics import Camera
from rangecheck.transport.camera_rays import pixel_order
from rangecheck.transport.film import Film, Plate
from rangecheck.transport.settings import Settings
from rangecheck.transport.sight import GROUP, Sight
from rangecheck.transport.tracer import Tracer

#: rays in one group; two groups are the least from which a spread can be told
EACH = GROUP
#: pixels whose first sample may be off by less than this share of the error asked for are left alone
_QUIET = 0.1
#: groups per pixel at most grow so much from one round to the next, because their number rests on an estimate
_GROWTH = 4
#: rows of the picture that a thread looks at in one go
_ROWS = 64
#: numbers of groups whose gain is kept in a table
_TABLED = 4096
#: halvings of the range, some thirty octaves, in which the step lies
_HALVINGS = 16
#: how the variance of a pixel falls with its number of groups: without and with chance in the gathering
_DECAY_OF_EDGES, _DECAY_OF_NOISE = 1.25, 1.0


def render_to(
    tracer: Tracer,
    camera: Camera,
    world_from_camera: FloatArray,
    settings: Settings,
    error: float,
    *,
    seed: int = 0,
    most: int = 1 << 18,
) -> Film:
    """The picture with an estimated error of at most `error` (0.005: half a percent of the mean radiance), or as near to that as
    `most` rays per pixel bring it. `settings.passes`, `each` and `centre` are chosen here. Same bytes on any number of threads."""
    exposure = Exposure(tracer, camera, world_from_camera, settings, seed=seed, most=most)
    exposure.refine(error)
    return exposure.film()


class Exposure:
    """A picture that can be refined again and again: what it has seen stays. Arguments as of `render_to`."""

    def __init__(
        self, tracer: Tracer, camera: Camera, world_from_camera: FloatArray, settings: Settings, *, seed: int, most: int = 1 << 18
    ) -> None:
        self._tracer, self._seed, self._most = tracer, seed, max(2, most // EACH)
        self._settings = replace(settings, passes=1, each=EACH, centre=False)
        self._picture = tracer.picture_rays(camera, world_from_camera)
        self._pixels = pixel_order(camera.width, camera.height)
        self._plate = Plate(camera.height, camera.width, tracer.scene.channels)
        once = replace(settings, passes=1, each=1, centre=True)
        known = Sight.serves(len(tracer.scene.sources), settings.shadow_rays)
        self._sight = Sight(camera.height, camera.width, len(tracer.scene.sources)) if known else None
        self._tally = tracer.expose(self._picture, self._pixels, once, seed, self._plate, sight=self._sight)
        self._prior = unevenness(self._plate.mean, *self._plate.shape)
        self._groups, self._rays = np.zeros(len(self._pixels), np.int32), np.ones(len(self._pixels), np.int32)

    def refine(self, error: float) -> None:
        """Add samples until the estimated error is at most `error` of the mean radiance, or no pixel may have more."""
        plate, groups, pixels = self._plate, self._groups, self._pixels
        by_chance = self._settings.by_chance
        decay = _DECAY_OF_NOISE if by_chance else _DECAY_OF_EDGES
        least = _near_surfaces(plate.covered, plate.shape) * np.int32(2 if by_chance else 0)
        spread = np.empty(len(pixels), np.float32)
        while True:
            mean = float(plate.mean.mean(dtype=np.float64))
            allowed = (error * mean) ** 2
            if not allowed > 0:
                return
            in_chunks(
                lambda start, stop: _group_variance(plate.spread, groups, self._prior, *plate.shape, start, stop, spread),
                plate.shape[0],
                _ROWS,
            )
            wanted = np.maximum(_allot(self._prior, spread, groups, allowed, self._most, decay), least)
            more = pixels[(wanted > groups)[pixels]]
            if not len(more):
                return
            fresh = more[groups[more] == 0]
            plate.erase(fresh)
            self._rays[fresh] = 0
            if self._sight is not None:
                self._sight.settle()
            self._tracer.expose(
                self._picture, more, self._settings, self._seed, plate, groups[more], wanted[more] - groups[more], self._sight
            )
            self._rays[more] += EACH * (wanted[more] - groups[more])
            groups[more] = wanted[more]

    def film(self) -> Film:
        """What has been seen so far; the light budget is that of the rays through the pixels' middles."""
        return self._plate.develop(self._tally / len(self._pixels), self._tracer.lights, self._rays.copy())


def render_at_edges(tracer: Tracer, camera: Camera, world_from_camera: FloatArray, settings: Settings, *, seed: int = 0) -> Film:
    """The picture with one ray through every pixel's middle, and `settings.each` rays, spread evenly, instead of it where the pixel departs
    from its neighbours by more than `settings.uneven` of the mean radiance of what is seen. Same bytes on any number of threads."""
    picture, pixels = tracer.picture_rays(camera, world_from_camera), pixel_order(camera.width, camera.height)
    plate = Plate(camera.height, camera.width, tracer.scene.channels)
    tally = tracer.expose(picture, pixels, replace(settings, each=1, centre=True), seed, plate)
    rays = np.ones(len(pixels), np.int32)
    seen = float(plate.covered.sum(dtype=np.float64))
    mean = float((plate.mean * plate.covered[:, None]).sum(dtype=np.float64)) / max(seen * tracer.scene.channels, 1.0)
    if mean > 0:
        departs = unevenness(plate.mean, *plate.shape)
        more = pixels[(departs > (settings.uneven * mean) ** 2)[pixels]]
        plate.erase(more)
        tracer.expose(picture, more, replace(settings, centre=False), seed, plate)
        rays[more] = settings.each
    return plate.develop(tally / len(pixels), tracer.lights, rays)


def _near_surfaces(covered: FloatArray, shape: tuple[int, int]) -> IntArray:
    """(n,) int32 1 where a pixel or a neighbour met a surface."""
    met = np.pad(covered.reshape(shape) > 0, 1)
    wide = met[:, :-2] | met[:, 1:-1] | met[:, 2:]
    return np.asarray((wide[:-2] | wide[1:-1] | wide[2:]).ravel(), np.int32)


def _allot(prior: FloatArray, spread: FloatArray, groups: IntArray, allowed: float, most: int, decay: float) -> IntArray:
    """(n,) groups that every pixel should have, at least those it has, so that the mean squared error is `allowed`."""
    wanted = groups.copy()
    noisy = np.flatnonzero((groups > 0) | (prior > (_QUIET**2) * allowed))
    if not len(noisy):
        return wanted
    quiet = float(prior.sum(dtype=np.float64) - prior[noisy].sum(dtype=np.float64))
    left = allowed * len(prior) - quiet
    single, now, rough = prior[noisy].astype(np.float64), groups[noisy], np.maximum(spread[noisy], 0.0).astype(np.float64)
    # groups that a pixel wants are a power of its deviation over a step that all pixels share
    power = 2 / (1 + decay)
    reach = rough ** (0.5 * power)
    falls = np.arange(1, _TABLED + 1, dtype=np.float64) ** -decay
    count = np.empty_like(now)
    if _remains(now, rough, single, falls, decay) <= left:
        return wanted
    low, high = 1e-6 * np.sqrt(allowed), float(np.sqrt(rough.max())) + np.sqrt(single.max())
    for _ in range(_HALVINGS):
        middle = np.sqrt(low * high)
        _number(reach, rough, single, now, middle**-power, middle, most, count)
        low, high = (middle, high) if _remains(count, rough, single, falls, decay) <= left else (low, middle)
    # how many the goal asks for; that some places may not yet grow to it asks for no more in others
    _number(reach, rough, single, now, low**-power, low, most, count)
    wanted[noisy] = np.minimum(count, np.maximum(2, _GROWTH * now))
    return wanted


@stage_kernel
def _number(reach, rough, single, now, scale, step, most, count):
    """Groups of each pixel where one that is off by `step` squared is worth one more."""
    for i in range(len(reach)):
        ideal = math.ceil(min(reach[i] * scale, float(most)))
        # one group tells nothing of its spread, and a pixel that needs less than one keeps its single sample
        if ideal <= 1:
            ideal = 0 if now[i] == 0 and single[i] <= math.sqrt(rough[i]) * step else 2
        count[i] = max(now[i], min(np.int64(ideal), np.int64(most)))


@stage_kernel
def _remains(count, rough, single, falls, decay):
    """Sum of the squared errors that so many groups leave; a pixel without any keeps that of its single sample."""
    total = 0.0
    for i in range(len(count)):
        n = count[i]
        if n == 0:
            total += single[i]
        else:
            total += rough[i] * (falls[n - 1] if n <= len(falls) else float(n) ** -decay)
    return total


def unevenness(mean: FloatArray, height: int, width: int) -> FloatArray:
    """(n,) float32 squared error that a single sample of each pixel of a picture (n, c) may have: a quarter of the pixel's largest squared
    second difference, mean over channels."""
    found = np.empty(len(mean), np.float32)
    in_chunks(lambda start, stop: _unevenness(mean, height, width, start, stop, found), height, _ROWS)
    return found


@stage_kernel
def _unevenness(mean, height, width, first, last, prior):
    """The same in rows first .. last - 1."""
    channels = mean.shape[1]
    for row in range(first, last):
        above, below = max(row - 1, 0) * width, min(row + 1, height - 1) * width
        for column in range(width):
            left, right, here = max(column - 1, 0), min(column + 1, width - 1), row * width + column
            worst = 0.0
            if not _dark_around(mean, above, row * width, below, left, column, right):
                for way in range(4):
                    a = row * width + left if way == 0 else above + (column if way == 1 else left if way == 2 else right)
                    b = row * width + right if way == 0 else below + (column if way == 1 else right if way == 2 else left)
                    total = 0.0
                    for c in range(channels):
                        bend = mean[a, c] + mean[b, c] - 2.0 * mean[here, c]
                        total += bend * bend
                    worst = max(worst, total / channels)
            prior[here] = 0.25 * worst


@inline_kernel
def _dark_around(mean, above, level, below, left, middle, right):
    """Whether a pixel and its eight neighbours have seen no light, as most of many pictures has not."""
    for c in range(mean.shape[1]):
        for start in (above, level, below):
            if mean[start + left, c] != 0.0 or mean[start + middle, c] != 0.0 or mean[start + right, c] != 0.0:
                return False
    return True


@stage_kernel
def _group_variance(spread, groups, prior, height, width, first, last, variance):
    """Variance of one group's mean in rows first .. last - 1: pooled over the 5 x 5 pixels around, with the first guess as one more voice."""
    channels = spread.shape[1]
    for row in range(first, last):
        for column in range(width):
            pixel = row * width + column
            # four rays spread evenly over an edge are off by an eighth of what one is
            total, voices = 0.125 * prior[pixel], 1.0
            if groups[pixel] > 1:
                for r in range(max(row - 2, 0), min(row + 3, height)):
                    for c in range(max(column - 2, 0), min(column + 3, width)):
                        near = r * width + c
                        if groups[near] > 1:
                            share = 8.0 if near == pixel else 1.0
                            for k in range(channels):
                                total += share * spread[near, k] / channels
                            voices += share * (groups[near] - 1)
            variance[pixel] = total / voices
