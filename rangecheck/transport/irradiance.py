"""Diffuse interreflection kept on the surface: gathered once for a scene, looked up in every picture of it.

What matters to a matt surface is its irradiance, which does not depend on who looks, and of which the part that other surfaces and the
surroundings give varies slowly. So it is gathered at records, a few thousand places spread over the surface, and interpolated
between them (Ward, Rubinstein & Clear, *A ray tracing solution for diffuse interreflection*, 1988). Each record looks out along
rays drawn by their cosine. What they meet is remembered: the further reflections are sums over the same rays, not new ones
(Goral et al. 1984, with rays for form factors).

Light is counted as the radiance of a white surface, E/pi. What the interpolation costs is measured: at places between the records
the same light is gathered twice with independent rays, and the root mean square of the difference, relative to the mean light
on the surface, is `error`; noise of the two does not enter, for the product of two differences is free of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import SceneError
from rangecheck.kernels import in_chunks, thread_count
from rangecheck.raycast import EmbreeCaster
from rangecheck.reflectance import Material
from rangecheck.scene import Scene
from rangecheck.scene.surroundings import SurroundingsArrays
from rangecheck.surface.edges import every_edge_passed_both_ways
from rangecheck.transport.geometry import Geometry, SourceArrays
from rangecheck.transport.irradiance_nodes import areas, joined, nodes_of, pieces
from rangecheck.transport.irradiance_stages import look_out, look_up, mix, see_sky, stand, sum_up
from rangecheck.transport.light import add_light, aim
from rangecheck.transport.queues import KIND_NAMES, LOBE, new_hits, new_rays, new_shadows
from rangecheck.transport.reflection import Materials, materials_of

#: rays of each record
RAYS = 128
#: nodes on lattices of large faces, for each record that a surface begins with
_NODES_PER_RECORD = 20
#: how often the spacing is halved where a record and its neighbours disagree, and how many records there may be
_LEVELS, _MOST_RECORDS = 3, 150_000
#: records whose light is interpolated at a node
_NEIGHBOURS = 8
#: a record so much nearer than the others, in spacings, speaks alone
_SELF = 0.02
#: difference of unit normals that counts like one spacing of records
_TURN = 0.35
#: places at which the error is measured, and rays of each of the two gatherings there
_PILOTS, _PILOT_RAYS = 512, 512
#: reflections are followed until one adds less than this share of the light
_CONVERGED = 1e-4
_RECORDS_AT_ONCE, _NODES_AT_ONCE = 64, 8192


class Stored(NamedTuple):
    """The cache as `meet` reads it: node_of_face (m, 3), steps (m,), light (n sides, c) float32, the back side's nodes after the front's;
    albedo (materials, c); sides 0 (nothing is stored), 1 or 2; shares (lights,) by which the light budget names the light."""

    node_of_face: IntArray
    steps: IntArray
    light: FloatArray
    albedo: FloatArray
    sides: int
    shares: FloatArray


@dataclass(frozen=True, eq=False)
class IrradianceCache:
    """error: root mean square of what interpolation is off by, relative to the mean light on the surface; records, rays of each;
    reflections that were followed before the last; met: the error asked for was met; everything: the same with the light of the sources
    added to what other places send; off_at: see `_Gathering.off_at`."""

    stored: Stored = field(repr=False)
    everything: Stored = field(repr=False)
    off_at: Callable[..., FloatArray] = field(repr=False)
    error: float
    records: int
    rays: int
    reflections: int
    met: bool

    def in_one_channel(self, channel: int) -> IrradianceCache:
        """The same at one wavelength."""
        one = slice(channel, channel + 1)

        def alone(stored: Stored) -> Stored:
            light, albedo = (np.ascontiguousarray(a[:, one]) for a in (stored.light, stored.albedo))
            return stored._replace(light=light, albedo=albedo)

        def off_at(*places: FloatArray) -> FloatArray:
            return self.off_at(*places)[..., one]

        return replace(self, stored=alone(self.stored), everything=alone(self.everything), off_at=off_at)

    def explain(self) -> str:
        """One line for people."""
        said = "" if self.met else ", more than was asked for"
        return (
            f"{self.records:,} records of {self.rays} rays, {self.reflections} reflections before the last; "
            f"interpolation is off by {100 * self.error:.2g} % of the light on the surface{said}"
        )


def nothing_stored(channels: int) -> Stored:
    """A cache in which nothing is found."""
    faces = np.empty((0, 3), np.int32)
    faces.flags.writeable = False  # as those of every cache are, so that stages are compiled once
    return Stored(faces, np.empty(0, np.int32), np.empty((0, channels), np.float32), np.empty((0, channels)), 0, np.empty(0))


class Traced(Protocol):
    """A scene ready for the stages, as a `Tracer` is."""

    scene: Scene
    caster: EmbreeCaster
    geometry: Geometry
    sources: SourceArrays
    surroundings: SurroundingsArrays
    materials: Materials


def may_be_cached(tracer: Traced) -> bool:
    """Whether nothing in the scene shines: what leaves a surface is then the same in every direction."""
    return not tracer.materials.shiny.any()


def gather_irradiance(
    tracer: Traced, *, depth: int = 64, error: float = 0.01, records: int = 6000, shadow_rays: int = 1, seed: int = 0
) -> IrradianceCache:
    """The light that reaches every place of a matt scene from its surroundings and after up to depth - 1 reflections at other places, with
    interpolation off by at most `error` of the mean light on the surface, or as near as the most records bring it (`met` says).

    records: how many there are before any place asks for more, if the surface were flat; shadow_rays to each source, 0 to its middle alone. Same bytes on any number of threads. Raises SceneError where something shines."""
    if not may_be_cached(tracer):
        names = ", ".join(m.name for m, shiny in zip(tracer.scene.materials, tracer.materials.shiny) if shiny)
        raise SceneError(
            f"irradiance cannot be kept where surfaces shine ({names}); follow paths instead: gather_diffuse='paths'"
        )
    return _Gathering(tracer, depth, records, shadow_rays, seed).until(error)


class _Gathering:
    """One scene's nodes, its light straight from the sources, and what records gather of it."""

    def __init__(self, tracer: Traced, depth: int, records: int, shadow_rays: int, seed: int) -> None:
        self.tracer, self.depth, self.records, self.shadow_rays, self.seed = tracer, depth, records, shadow_rays, seed
        self.channels = tracer.scene.channels
        nodes = nodes_of(tracer.geometry, _NODES_PER_RECORD * records)
        closed = every_edge_passed_both_ways(tracer.geometry.faces, len(tracer.geometry.vertices))
        self.sides = 1 if closed else 2  # of a closed surface only one side is ever seen from outside
        self.node_of_face, self.steps = nodes.node_of_face, nodes.steps
        self.place = joined([nodes.place] * self.sides)
        self.normal = joined([nodes.normal] if closed else [nodes.normal, -nodes.normal])
        self.albedo = np.stack([m.strengths()[0] for m in tracer.scene.materials])
        self.direct, by_source = self._direct_light()
        self.by_light = np.append(by_source, 0.0)

    def _areas(self) -> FloatArray:
        """(m,) of the faces, not kept."""
        geometry = self.tracer.geometry
        return np.concatenate([areas(geometry.corners(some).astype(np.float64)) for some in pieces(len(geometry.faces))])

    def until(self, error: float) -> IrradianceCache:
        spacing = math.sqrt(self.sides * float(self._areas().sum()) / self.records)
        everywhere = np.arange(len(self.place))
        chosen, met = np.empty(0, np.int64), _nothing_met(self.channels)
        candidates, step = everywhere, spacing
        for level in range(_LEVELS + 1):
            fresh = np.setdiff1d(candidates[self._one_in_each(self._cells(candidates, step), candidates, step)], chosen)
            if len(chosen) + len(fresh) > _MOST_RECORDS:
                break
            met = met.and_also(self._look(self.place[fresh], self.normal[fresh], RAYS, self.seed, len(chosen)))
            chosen = np.append(chosen, fresh)
            if level < _LEVELS:
                fresh_rows = np.arange(len(chosen) - len(fresh), len(chosen))
                rough = chosen[fresh_rows[self._disagreement(met, chosen, spacing)[fresh_rows] > 2 * error]]
                marked = np.unique(self._cells(rough, step))
                candidates = candidates[np.isin(self._cells(candidates, step), marked)]
                step /= 2
                if not len(candidates):
                    break
        return self._solve(chosen, met, spacing, error)

    def _solve(self, chosen: IntArray, met: _Met, spacing: float, error: float) -> IrradianceCache:
        near, weight = self._neighbours(chosen, spacing)
        light = _interpolated(near, weight, met.sky)
        total = float(self.direct.mean(dtype=np.float64)) + float(light.mean(dtype=np.float64))
        reflections = 0
        for _ in range(1, self.depth):
            reflections += 1
            brighter = _interpolated(near, weight, self._sum(met, light))
            step = float(np.sqrt(np.square(brighter - light, dtype=np.float64).mean()))
            light = brighter
            if step <= _CONVERGED * total:
                break
        shares = self.by_light.copy()
        shares[-1] = float(met.sky.sum(dtype=np.float64)) * len(light) / max(len(met.sky), 1)
        shares = shares / shares.sum() if shares.sum() > 0 else shares
        stored = Stored(self.node_of_face, self.steps, light, self.albedo, self.sides, shares)
        off = self._error(stored)
        everything = stored._replace(light=light + self.direct, shares=self._shares_of_all(shares, light))
        return IrradianceCache(
            stored, everything, partial(self.off_at, stored), off, len(chosen), met.rays, reflections, off <= error
        )

    def _shares_of_all(self, shares: FloatArray, light: FloatArray) -> FloatArray:
        """(lights,) whose the light is, when that of the sources is added."""
        kept, straight = float(light.sum(dtype=np.float64)), self.by_light
        total = kept + float(straight.sum())
        return (shares * kept + straight) / total if total > 0 else shares

    def _direct_light(self) -> tuple[FloatArray, FloatArray]:
        """(n, c) float32 radiance of white nodes in the light of the sources alone; (sources,) how much of it is whose."""
        tracer, n = self.tracer, len(self.place)
        light, sources = np.zeros((n, self.channels), np.float32), len(tracer.sources.radius)
        white = materials_of((Material("white", K_lm=1.0, wavelengths_um=tracer.scene.materials[0].wavelengths_um),))
        if not sources:
            return light, np.zeros(0)

        def some(start: int, stop: int) -> FloatArray:
            tally = np.zeros((len(KIND_NAMES), 2, sources + 1))
            hits = new_hits(stop - start, self.channels)
            shadows = new_shadows((stop - start) * sources * max(1, self.shadow_rays), self.channels)
            with np.errstate(over="ignore"):
                stand(self.place[start:stop], self.normal[start:stop], tracer.geometry.skin, self.seed, start, hits)
                k = aim(tracer.sources, white, hits, 0, stop - start, self.shadow_rays, True, False, shadows)
            tracer.caster.occluded_local(
                shadows.origin[:k], shadows.direction[:k], shadows.far[:k], shadows.blocked[:k], coherent=True
            )
            add_light(shadows, k, 1, light[start:stop], tally, LOBE)
            return tally.sum(axis=(0, 1))[:sources]

        return light, np.sum(in_chunks(some, n, _NODES_AT_ONCE), axis=0)

    def _cells(self, nodes: IntArray, step: float) -> IntArray:
        """(k,) which cube of side `step`, and which main direction of the normal, each node belongs to."""
        cells = np.empty(len(nodes), np.int64)
        for some in pieces(len(nodes)):
            place, normal = self.place[nodes[some]], self.normal[nodes[some]]
            cube = np.floor(place / step).astype(np.int64)
            axis = np.abs(normal).argmax(axis=1)
            turn = 2 * axis + (normal[np.arange(len(axis)), axis] < 0)
            cells[some] = ((cube[:, 0] * 2097152 + cube[:, 1]) * 2097152 + cube[:, 2]) * 6 + turn
        return cells

    def _one_in_each(self, cells: IntArray, nodes: IntArray, step: float) -> IntArray:
        """Rows of one node of every cell, the one nearest to its middle."""
        aside = np.empty(len(nodes), np.float32)
        for some in pieces(len(nodes)):
            aside[some] = np.square((self.place[nodes[some]] / step) % 1.0 - 0.5).sum(axis=1)
        order = np.lexsort((aside, cells))
        return np.sort(order[np.append(True, np.diff(cells[order]) != 0)])

    def _disagreement(self, met: _Met, chosen: IntArray, spacing: float) -> FloatArray:
        """(records,) how far the light that each sees is from what the others would have it see, relative to the mean light."""
        seen = self._sum(met, np.zeros_like(self.direct))
        near, weight = self._nearest(chosen, spacing, _NEIGHBOURS + 1)(chosen)
        weight = np.where(near == np.arange(len(chosen))[:, None], 0, weight)
        total = weight.sum(axis=1, keepdims=True)
        others = (weight[..., None] * seen[near]).sum(axis=1) / np.maximum(total, 1e-30)
        mean = float((self.direct.mean(dtype=np.float64)) + seen.mean(dtype=np.float64))
        gap = np.where(total > 0, np.abs(others - seen), 0).max(axis=1)
        return np.asarray(gap / mean if mean > 0 else gap)

    def _neighbours(self, chosen: IntArray, spacing: float) -> tuple[IntArray, FloatArray]:
        """(n, k) int32 rows of the records nearest to every node, and (n, k) float32 weights that sum to 1."""
        k = min(_NEIGHBOURS, len(chosen))
        near, weight = np.empty((len(self.place), k), np.int32), np.empty((len(self.place), k), np.float32)
        nearest = self._nearest(chosen, spacing, _NEIGHBOURS)
        for some in pieces(len(near)):
            near[some], own = nearest(np.arange(len(near))[some])
            weight[some] = own / own.sum(axis=1, keepdims=True)
        return near, weight

    def _nearest(self, chosen: IntArray, spacing: float, count: int) -> Callable[[IntArray], tuple[IntArray, FloatArray]]:
        """Tells of nodes (n,) the rows (n, count) of the records nearest to them by place and normal, and weights that fall from all to 0
        at the last (Franke & Little's form of Shepard's)."""
        from scipy.spatial import cKDTree

        def where(nodes: IntArray) -> FloatArray:
            return np.hstack([self.place[nodes] / spacing, self.normal[nodes] / _TURN])

        tree, k = cKDTree(where(chosen)), min(count, len(chosen))

        def nearest(nodes: IntArray) -> tuple[IntArray, FloatArray]:
            distance, near = tree.query(where(nodes), k=k, workers=thread_count())
            distance, near = distance.reshape(len(nodes), k), near.reshape(len(nodes), k)
            reach = 1.001 * distance[:, -1:] + 1e-9
            return near, np.square((reach - distance) / (reach * (distance + _SELF)))

        return nearest

    def _look(self, place: FloatArray, normal: FloatArray, rays: int, seed: int, first: int = 0) -> _Met:
        """What `rays` from each place meet; places count from `first`, by which their chance is told apart."""
        tracer, n = self.tracer, len(place)
        met = _Met(
            np.empty(n * rays, np.int32), np.empty(n * rays, np.float32), np.empty(n * rays, np.float32),
            np.zeros((n, self.channels), np.float32), rays,
        )  # fmt: skip
        sky = tracer.surroundings

        def some(start: int, stop: int) -> None:
            queue = new_rays((stop - start) * rays, self.channels)
            own = slice(start * rays, stop * rays)
            with np.errstate(over="ignore"):
                look_out(
                    place[start:stop], normal[start:stop], tracer.geometry.skin, rays, seed & 0xFFFFFFFF, first + start, queue
                )
            face, u, v = met.face[own], met.u[own], met.v[own]
            tracer.caster.closest_local(queue.origin, queue.direction, queue.far, face, u, v)
            see_sky(sky, tracer.geometry, queue, rays, face, met.sky[start:stop])

        in_chunks(some, n, max(1, _RECORDS_AT_ONCE * RAYS // rays))
        return met

    def _sum(self, met: _Met, light: FloatArray) -> FloatArray:
        """(records, c) float32: what they see if the nodes have this light beside that of the sources."""
        total = self.direct + light
        seen = np.empty_like(met.sky)
        materials = self.tracer.geometry.material

        def some(start: int, stop: int) -> None:
            own = slice(start * met.rays, stop * met.rays)
            sum_up(
                self.node_of_face, self.steps, total, self.albedo, materials, len(total) // self.sides, met.rays,
                met.face[own], met.u[own], met.v[own], met.sky[start:stop], seen[start:stop],
            )  # fmt: skip

        in_chunks(some, len(seen), 1024)
        return seen

    def _error(self, stored: Stored) -> float:
        """What interpolation is off by, from places anywhere on the surface, as many where there is more of it."""
        chance = np.random.default_rng([self.seed, 0x1CACE])
        edges = np.cumsum(self._areas())
        places = min(_PILOTS, 4 * len(edges))
        face = np.searchsorted(edges, (np.arange(places) + chance.random(places)) / places * edges[-1]).clip(0, len(edges) - 1)
        del edges
        u, v = chance.random((2, places))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        back = chance.random(places) < (0.5 if self.sides == 2 else 0.0)
        corners, normals = self.tracer.geometry.corners(face), self.tracer.geometry.corner_normals(face)
        weights = np.stack([1 - u - v, u, v], axis=1)[:, :, None]
        place = np.ascontiguousarray((weights * corners).sum(axis=1), np.float32)
        normal = (weights * normals).sum(axis=1)
        normal *= np.where(back, -1, 1)[:, None] / np.linalg.norm(normal, axis=1, keepdims=True)
        normal = np.ascontiguousarray(normal, np.float32)
        kept, straight = (np.empty((places, self.channels), np.float32) for _ in range(2))
        look_up(stored, self.direct, face, u, v, back, kept, straight)
        gaps = self._gaps(stored, kept, place, normal)
        mean = float((kept + straight).mean(dtype=np.float64))
        product = (gaps[0].astype(np.float64) * gaps[1]).mean(axis=1)
        squared = float(product.mean()) + 2.0 * float(product.std()) / math.sqrt(places)
        return math.sqrt(max(squared, 0.0)) / mean if mean > 0 else 0.0

    def _gaps(self, stored: Stored, kept: FloatArray, place: FloatArray, normal: FloatArray) -> FloatArray:
        """(2, n, c) what places are sent, gathered twice afresh, less what is kept there."""
        looks = (self._look(place, normal, _PILOT_RAYS, self.seed + 0x5EED + k) for k in (0, 1))
        return np.stack([(self._sum(met, stored.light) if self.depth > 1 else met.sky) - kept for met in looks])

    def off_at(
        self, stored: Stored, face: IntArray, u: FloatArray, v: FloatArray, back: BoolArray, normal: FloatArray
    ) -> FloatArray:
        """(2, n, c) how far what is kept at places (u, v) of faces, on their `back` or front side, is from what is gathered there along
        unit normals (n, 3): twice, with independent chance. Radiance of a white surface."""
        corners = self.tracer.geometry.corners(face)
        weights = np.stack([1 - u - v, u, v], axis=1)[:, :, None]
        place = np.ascontiguousarray((weights * corners).sum(axis=1), np.float32)
        kept, straight = (np.empty((len(face), self.channels), np.float32) for _ in range(2))
        look_up(stored, self.direct, face, u, v, back & (self.sides == 2), kept, straight)
        return self._gaps(stored, kept, place, np.ascontiguousarray(normal, np.float32))


@dataclass(frozen=True, eq=False)
class _Met:
    """face (records rays,): what each ray met: a face, its back side -2 - face, or -1 the surroundings; u, v; sky (records, c)."""

    face: IntArray
    u: FloatArray
    v: FloatArray
    sky: FloatArray
    rays: int

    def and_also(self, other: _Met) -> _Met:
        """These records and others, after them."""
        return _Met(
            np.concatenate([self.face, other.face]), np.concatenate([self.u, other.u]), np.concatenate([self.v, other.v]),
            np.concatenate([self.sky, other.sky]), other.rays,
        )  # fmt: skip


def _nothing_met(channels: int) -> _Met:
    return _Met(
        np.empty(0, np.int32), np.empty(0, np.float32), np.empty(0, np.float32), np.empty((0, channels), np.float32), RAYS
    )


def _interpolated(near: IntArray, weight: FloatArray, light: FloatArray) -> FloatArray:
    """(n, c) float32 at the nodes of (records, c) at the records."""
    result = np.empty((len(near), light.shape[1]), np.float32)
    in_chunks(lambda start, stop: mix(near[start:stop], weight[start:stop], light, result[start:stop]), len(near), 32768)
    return result
