"""The arrays that the stages hand to each other, compacted to what is alive, and the memory they live in.

A `Rays` queue waits to be cast; a `Hits` queue waits to be lit and to scatter; a `Shadows` queue waits to be tested for light.
Places and directions are local (see `geometry`), float32. `pixel` numbers the samples of the chunk at hand.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray

#: what a ray carries light for: it came from the camera, or from a reflection of this kind
CAMERA, SPIKE, LOBE, DIFFUSE = 0, 1, 2, 3
KIND_NAMES = ("seen directly", "spike", "lobe", "diffuse")


class Rays(NamedTuple):
    """origin, direction (n, 3); far, u, v (n,); face (n,) int32; weight (n, c): what reaches the pixel of the radiance that is
    found; pixel (n,); kind (n,) uint8: the reflection it leaves, whose light it looks for; first (n,) uint8: the first
    reflection of its path; stream, number (n,) uint32: which sequence of chance
    serves it, and at which place."""

    origin: FloatArray
    direction: FloatArray
    far: FloatArray
    face: IntArray
    u: FloatArray
    v: FloatArray
    weight: FloatArray
    pixel: IntArray
    kind: IntArray
    first: IntArray
    stream: IntArray
    number: IntArray


class Hits(NamedTuple):
    """place, shading, facing, arriving (n, 3): point a skin off its face, shading normal, the face's normal, direction of the
    ray that came; weight (n, c); pixel (n,); first (n,); material (n,) int16; stream, number (n,); settled (n,) bool: the light of
    its hemisphere is accounted for already."""

    place: FloatArray
    shading: FloatArray
    facing: FloatArray
    arriving: FloatArray
    weight: FloatArray
    pixel: IntArray
    first: IntArray
    material: IntArray
    stream: IntArray
    number: IntArray
    settled: BoolArray


class Shadows(NamedTuple):
    """origin, direction (n, 3); far (n,); blocked (n,) bool; gain (n, c): what reaches the pixel if nothing is in the way;
    diffuse_share (n,) of it; pixel, first (n,); source (n,); across, down (n,) float64: room for places on discs."""

    origin: FloatArray
    direction: FloatArray
    far: FloatArray
    blocked: BoolArray
    gain: FloatArray
    diffuse_share: FloatArray
    pixel: IntArray
    first: IntArray
    source: IntArray
    across: FloatArray
    down: FloatArray


def _floats(*shape: int) -> FloatArray:
    return np.empty(shape, np.float32)


def new_rays(n: int, channels: int) -> Rays:
    """Room for n rays."""
    return Rays(
        _floats(n, 3), _floats(n, 3), _floats(n), np.empty(n, np.int32), _floats(n), _floats(n),
        _floats(n, channels), np.empty(n, np.int32), np.empty(n, np.uint8), np.empty(n, np.uint8),
        np.empty(n, np.uint32), np.empty(n, np.uint32),
    )  # fmt: skip


def new_hits(n: int, channels: int) -> Hits:
    """Room for n hits."""
    return Hits(
        _floats(n, 3), _floats(n, 3), _floats(n, 3), _floats(n, 3),
        _floats(n, channels), np.empty(n, np.int32), np.empty(n, np.uint8), np.empty(n, np.int16),
        np.empty(n, np.uint32), np.empty(n, np.uint32), np.empty(n, np.bool_),
    )  # fmt: skip


def new_shadows(n: int, channels: int) -> Shadows:
    """Room for n shadow rays."""
    return Shadows(
        _floats(n, 3), _floats(n, 3), _floats(n), np.empty(n, np.bool_),
        _floats(n, channels), _floats(n), np.empty(n, np.int32), np.empty(n, np.uint8), np.empty(n, np.int16), np.empty(n), np.empty(n),
    )  # fmt: skip


class Workspace:
    """One thread's memory: grown when more is needed, kept from chunk to chunk, never shared."""

    def __init__(self, channels: int) -> None:
        self.channels = channels
        self._rays: list[Rays] = []
        self._hits: list[Hits] = []
        self._shadows: Shadows | None = None
        self.sample = np.empty((0, channels), np.float32)
        self.places = np.empty((2, 0))

    def rays(self, level: int, n: int) -> Rays:
        """At least n rays for recursion `level`."""
        while len(self._rays) <= level:
            self._rays.append(new_rays(0, self.channels))
        if len(self._rays[level].far) < n:
            self._rays[level] = new_rays(n, self.channels)
        return self._rays[level]

    def hits(self, level: int, n: int) -> Hits:
        """At least n hits for recursion `level`."""
        while len(self._hits) <= level:
            self._hits.append(new_hits(0, self.channels))
        if len(self._hits[level].pixel) < n:
            self._hits[level] = new_hits(n, self.channels)
        return self._hits[level]

    def shadows(self, n: int) -> Shadows:
        """At least n shadow rays."""
        if self._shadows is None or len(self._shadows.far) < n:
            self._shadows = new_shadows(n, self.channels)
        return self._shadows

    def samples(self, n: int) -> FloatArray:
        """(n, c) zeros: the radiance of n pixel samples."""
        if len(self.sample) < n:
            self.sample = np.empty((n, self.channels), np.float32)
        cleared = self.sample[:n]
        cleared[:] = 0
        return cleared

    def pixel_places(self, n: int) -> FloatArray:
        """(2, n) room for pixel coordinates."""
        if self.places.shape[1] < n:
            self.places = np.empty((2, n))
        return self.places[:, :n]
