"""What it does to a picture to look diffuse light up where it is kept on the surfaces, measured at the places that the picture sees.

`cache` looks up what is kept at the surface seen, `second` at the surfaces that its gathering rays meet, where errors of both signs
average over a hemisphere. Each is compared with light gathered afresh, twice with independent chance (see `irradiance`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.transport.camera_rays import PictureRays
from rangecheck.transport.irradiance import RAYS, IrradianceCache
from rangecheck.transport.tracer import Tracer

#: places at which a pixel's own light is gathered afresh, and at which that of its surroundings is: so many, each by its rays
_PLACES, _GROUPS, _EACH = 512, 48, 8
#: records of a picture: as many as it has pixels, within these
_FEWEST, _MOST = 800, 6000
#: rays for which the time of finding a node's records would do, and light on its way from the camera meets surfaces so often
_NODE_RAYS, _MEETINGS = 6, 2.5


def records_for(pixels: int) -> int:
    """Places at which light is gathered for a picture of so many pixels."""
    return int(np.clip(pixels, _FEWEST, _MOST))


def rays_to_keep(tracer: Tracer, records: int) -> float:
    """About how many rays it takes to gather what is kept, other work counted as rays."""
    nodes = len(tracer.geometry.vertices) + 20 * records
    return 1.5 * RAYS * records + nodes * (_NODE_RAYS + len(tracer.sources.radius))


def rays_of_paths(tracer: Tracer, pixels: int, samples: float) -> float:
    """About how many rays a picture takes whose pixels have so many samples on average."""
    return pixels * samples * (1 + len(tracer.sources.radius)) * _MEETINGS


@dataclass(frozen=True)
class Places:
    """Rows `pixel` of the pixels looked at that see a surface; face, u, v (n,) there; normal (n, 3) turned to the viewer; back (n,): it is the
    other side; albedo (n, c)."""

    pixel: IntArray
    face: IntArray
    u: FloatArray
    v: FloatArray
    normal: FloatArray
    back: BoolArray
    albedo: FloatArray


def _met(tracer: Tracer, origin: FloatArray, direction: FloatArray) -> Places:
    """Where local float32 rays meet surfaces."""
    n = len(origin)
    far, face = np.full(n, np.inf, np.float32), np.empty(n, np.int32)
    u, v = np.empty(n, np.float32), np.empty(n, np.float32)
    tracer.caster.closest_local(origin, direction, far, face, u, v)
    hit = np.flatnonzero(face >= 0)
    face, u, v = face[hit], u[hit], v[hit]
    corners = tracer.geometry.corner_normals(face)
    normal = (np.stack([1 - u - v, u, v], axis=1)[:, :, None] * corners).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    back = np.einsum("ij,ij->i", normal, direction[hit]) > 0
    normal[back] *= -1
    strengths = np.stack([m.strengths()[0] for m in tracer.scene.materials])
    return Places(hit, face, u, v, normal, back, strengths[tracer.geometry.material[face]])


def seen_places(tracer: Tracer, picture: PictureRays, pixels: IntArray) -> tuple[Places, int]:
    """What some of the pixels see through their middle, and how many were looked at."""
    some = pixels[:: max(1, len(pixels) // _PLACES)]
    origin, direction = np.empty((len(some), 3), np.float32), np.empty((len(some), 3), np.float32)
    width = picture.camera.width
    picture.fill((some % width).astype(float), (some // width).astype(float), origin, direction)
    return _met(tracer, origin, direction), len(some)


def off_at_once(kept: IrradianceCache, seen: Places, looked_at: int) -> FloatArray:
    """(2, looked_at, c) error of the picture where kept light is looked up at the surface seen."""
    off = np.zeros((2, looked_at, seen.albedo.shape[1]))
    off[:, seen.pixel] = seen.albedo * kept.off_at(seen.face, seen.u, seen.v, seen.back, seen.normal)
    return off


def off_at_second(tracer: Tracer, kept: IrradianceCache, seen: Places, looked_at: int, seed: int) -> FloatArray:
    """(2, looked_at, c) error of the picture where it is looked up one reflection on: the mean over a few rays of each place, which holds
    their scatter still and so is more rather than less."""
    chosen = np.unique(np.linspace(0, len(seen.pixel) - 1, min(_GROUPS, len(seen.pixel))).astype(int))
    chance = np.random.default_rng([seed, 0x2D])
    height, turn = chance.random((2, len(chosen) * _EACH))
    normal = np.repeat(seen.normal[chosen], _EACH, axis=0)
    corners = tracer.geometry.corners(seen.face[chosen])
    u, v = seen.u[chosen], seen.v[chosen]
    place = np.repeat((np.stack([1 - u - v, u, v], axis=1)[:, :, None] * corners).sum(axis=1), _EACH, axis=0)
    # by the cosine: a point of the unit sphere added to the normal
    aside, up = 2 * np.sqrt(height * (1 - height)), 2 * height - 1
    way = normal + np.stack([aside * np.cos(2 * math.pi * turn), aside * np.sin(2 * math.pi * turn), up], axis=1)
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-30)
    start = (place + tracer.geometry.skin * normal).astype(np.float32)
    met = _met(tracer, start, np.ascontiguousarray(way, np.float32))
    off = np.zeros((2, len(normal), seen.albedo.shape[1]))
    off[:, met.pixel] = met.albedo * kept.off_at(met.face, met.u, met.v, met.back, met.normal)
    groups = seen.albedo[chosen] * off.reshape(2, len(chosen), _EACH, -1).mean(axis=2)
    # as many pixels see no surface here as did among all that were looked at
    dark = round(len(chosen) * (looked_at - len(seen.pixel)) / max(len(seen.pixel), 1))
    return np.concatenate([groups, np.zeros((2, dark, groups.shape[2]))], axis=1)
