"""Normals of a surface measured in noisy pictures of it: of a mirror in waves of light, of a matt surface under lights that move over it.

Mirrors: phase-measuring deflectometry (Knauer, Kaminski, Haeusler, Phase measuring deflectometry: a new approach to measure specular
free-form surfaces, 2004). The surroundings are cosines of the direction's component along each of three axes, SHIFTS pictures an axis with
the wave shifted between them: the phase in a pixel is the mirrored direction, whatever the mirror reflects of it, and the normal is halfway
between it and the way back to the camera. One wave spans all directions, so that no phase is ambiguous.

Matt surfaces: photometric stereo (Woodham, 1980) with one albedo for the whole surface, estimated; each picture gives one equation
light . normal for each pixel, and those of a place are solved on the unit sphere. Lights that never move over the surface leave one
of the two slopes unknown, and no normal is measured.

What the pixels say is gathered at the surface's vertices. A mirror's whole normals are averaged together with the points that the pixels see:
between vertices normals change linearly, so the mean normal is that of the mean point. The equations of a matt surface are of different
points for different lights, and are brought to the vertex by what the expected normals change in between.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.maps import Maps, trace_maps, trace_shadows
from rangecheck.maps.shadow import LIT
from rangecheck.maps.trace import Caster
from rangecheck.optics import PinholeCamera, Sensor
from rangecheck.raycast import EmbreeCaster
from rangecheck.scene import Scene
from rangecheck.scene.sources import Source
from rangecheck.scene.surroundings import DARKNESS, Surroundings, panorama
from rangecheck.surface import Surface
from rangecheck.surface.attributes import barycentric
from rangecheck.transport import Settings, Tracer

#: pictures of the wave along each axis
SHIFTS = 3
#: radians of the wave for a unit of a direction's component: from -1 to 1 it stays within one turn
WAVE = 0.45 * 2 * math.pi
#: the brighter end of the waves is this many times the darker
_LOW, _HIGH = 0.02, 1.0
#: rows of the panorama that holds the waves
_ROWS = 256
#: pixels that see the surface turned further away than this are not used
LEAST_COSINE = math.cos(math.radians(65.0))
#: where less of the wave is left, or the three components are not those of a direction by more than this, the pixel mirrors something nearer
_LEAST_WAVE, _OFF_LENGTH = 0.5, 0.15
#: darker pixels, in shares of full well, tell nothing
_DARK = 0.02
#: lights this close to a place's horizon (its cosine, beside twice the light's radius) are not told from their halves
_HORIZON = 0.1
#: vertices whose slope is known no better than this, one standard deviation, are left out
_WORST_RAD = math.radians(5.0)
#: entries of a symmetric matrix, in the order in which they are kept
SIX = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
#: steps towards the normal that fits all pictures, and the longest of them, rad
_STEPS, _LONGEST = 6, 0.3


@dataclass(frozen=True, eq=False)
class MeasuredNormals:
    """points_mm (k, 3), normals (k, 3) unit, covariance (k, 6) of their noise, rad^2: xx xy xz yy yz zz."""

    points_mm: FloatArray = field(repr=False)
    normals: FloatArray = field(repr=False)
    covariance: FloatArray = field(repr=False)

    @property
    def noise_rad(self) -> FloatArray:
        """(k,) standard deviation of a slope, root mean square of the two."""
        return np.sqrt(0.5 * self.covariance[:, [0, 3, 5]].sum(axis=1))


@dataclass(frozen=True, eq=False)
class LitPicture:
    """A picture of a matt surface: light (h, w), NaN where it says nothing, in any unit that all pictures share, and its noise; the pose
    and the sources of light."""

    light: FloatArray = field(repr=False)
    noise: FloatArray = field(repr=False)
    world_from_camera: FloatArray = field(repr=False)
    sources: tuple[Source, ...]


def waves() -> Surroundings:
    """The waves along x, y and z as one panorama, one channel a picture: (axis, shift) in this order."""
    polar = (np.arange(_ROWS) + 0.5) / _ROWS * math.pi
    around = ((np.arange(2 * _ROWS) + 0.5) / (2 * _ROWS) - 0.5) * 2 * math.pi
    level = np.sin(polar)[:, None]
    axes = (level * np.sin(around), np.broadcast_to(np.cos(polar)[:, None], (_ROWS, 2 * _ROWS)), -level * np.cos(around))
    mix = [0.5 + 0.5 * np.cos(WAVE * axis + shift) for axis in axes for shift in _shifts()]
    return panorama((_LOW + (_HIGH - _LOW) * np.stack(mix, axis=-1)).astype(np.float32))


def _shifts() -> FloatArray:
    return 2 * math.pi / SHIFTS * np.arange(SHIFTS)


def normals_in_waves(
    scene: Scene, camera: PinholeCamera, poses: Sequence[FloatArray], settings: Settings, sensor: Sensor, *, seed: int = 0
) -> MeasuredNormals:
    """What the scene's mirrors show of their normals when waves surround them: 3 x SHIFTS pictures from each pose, exposed alike so
    that hardly anything saturates, in the middle one of the scene's wavelengths."""
    surface = scene.surface
    middle = scene.materials[0].wavelengths_um[scene.channels // 2]
    tracer = Tracer(scene.lit_by((), DARKNESS).at((middle,) * (3 * SHIFTS)).lit_by((), waves()))
    gathered = _Gathered(len(surface.vertices))
    for k, pose in enumerate(poses):
        maps, judged = _judged(surface, camera, pose, tracer.caster)
        pictures = tracer.render(camera, pose, settings, seed=seed + k).radiance.astype(np.float64)
        exposed = _exposed(sensor, pictures[maps.hit])
        said = exposed.linearise(exposed.expose(pictures, seed=seed + k))[judged].reshape(-1, 3, SHIFTS)
        phasor = (said * np.exp(-1j * _shifts())).sum(axis=2) * 2 / SHIFTS
        amplitude, mean = np.abs(phasor), said.mean(axis=2)
        mirrored = np.angle(phasor) / WAVE
        length = np.linalg.norm(mirrored, axis=1)
        clear = (amplitude > _LEAST_WAVE * mean).all(axis=1) & (mean > _DARK).all(axis=1) & (np.abs(length - 1) < _OFF_LENGTH)
        points = maps.points_mm()[judged][clear]
        normals = _unit(mirrored[clear]) - _unit(points - pose[:3, 3])
        # the noise of a phase from SHIFTS pictures; a normal turns by half of what its mirrored direction does
        noise = noise_of(exposed, mean[clear]) * math.sqrt(2 / SHIFTS) / amplitude[clear] / (2 * WAVE)
        weight = 1 / (noise * noise).mean(axis=1)
        gathered.add_normals(_nearest_corner(surface, maps, judged)[clear], points, _unit(normals), weight)
    return gathered.solved(np.asarray(surface.vertex_normals, np.float64))


def normals_in_shading(
    surface: Surface, camera: PinholeCamera, pictures: Sequence[LitPicture], expected: FloatArray
) -> MeasuredNormals:
    """What pictures of a matt surface under moving lights show of its normals. `expected` (n, 3) are where the search begins: normals
    of the vertices' surroundings, which tell the albedo too."""
    caster = EmbreeCaster(surface.vertices, surface.faces)
    gathered = _Gathered(len(surface.vertices))
    for picture in pictures:
        maps, judged = _judged(surface, camera, picture.world_from_camera, caster)
        judged &= np.isfinite(picture.light)
        points, facing = maps.points_mm()[judged], maps.normals[judged].astype(np.float64)
        lamps = np.array([[*source.centre_mm, 1.0] for source in picture.sources]).reshape(-1, 4)
        lit = trace_shadows(surface, maps, lamps, caster).state[:, judged] == LIT
        light, clear = np.zeros((len(points), 3)), np.ones(len(points), bool)
        for source, shines in zip(picture.sources, lit):
            away = source.centre_mm - points
            sine, towards = source.radius_mm / np.linalg.norm(away, axis=1), _unit(away)
            # white and matt, it would reflect L sin^2 cos, equation (20) over pi
            light = light + np.where(shines, source.radiance.mean() * sine * sine, 0.0)[:, None] * towards
            clear &= np.abs((towards * facing).sum(axis=1)) > 2 * sine + _HORIZON
        clear &= (light != 0).any(axis=1)
        corner, noise = _nearest_corner(surface, maps, judged)[clear], picture.noise[judged][clear]
        face = maps.face[judged][clear]
        within = barycentric(surface, points[clear], face)
        beside = np.einsum("kc,kci->ki", within, expected[surface.faces[face]]) - expected[corner]
        gathered.add_equations(corner, light[clear], picture.light[judged][clear], beside, 1 / (noise * noise))
    return gathered.with_albedo(expected).solved(expected, surface.vertices)


class _Gathered:
    """Sums at each vertex: of the equations' matrix (n, 6: xx xy xz yy yz zz) and right sides, of points, and how many pixels."""

    def __init__(self, count: int) -> None:
        self._matrix, self._right, self._beside = np.zeros((count, 6)), np.zeros((count, 3)), np.zeros((count, 3))
        self._points, self._pixels = np.zeros((count, 3)), np.zeros(count)

    def _add(self, corner: IntArray, columns: FloatArray, sums: FloatArray) -> None:
        for k in range(columns.shape[1]):
            sums[:, k] += np.bincount(corner, columns[:, k], len(sums))

    def add_normals(self, corner: IntArray, points: FloatArray, normals: FloatArray, weight: FloatArray) -> None:
        """Pixels that tell a whole normal each."""
        self._pixels += np.bincount(corner, minlength=len(self._pixels))
        self._add(corner, points * weight[:, None], self._points)
        self._add(corner, normals * weight[:, None], self._right)
        for k in (0, 3, 5):
            self._matrix[:, k] += np.bincount(corner, weight, len(self._matrix))

    def add_equations(
        self, corner: IntArray, light: FloatArray, said: FloatArray, beside: FloatArray, weight: FloatArray
    ) -> None:
        """Pixels that tell one equation each, albedo light . (normal + beside) = said."""
        self._pixels += np.bincount(corner, minlength=len(self._pixels))
        self._add(corner, light * (said * weight)[:, None], self._right)
        self._add(corner, light * ((light * beside).sum(axis=1) * weight)[:, None], self._beside)
        products = np.stack([light[:, i] * light[:, j] for i, j in SIX], axis=1)
        self._add(corner, products * weight[:, None], self._matrix)

    def with_albedo(self, expected: FloatArray) -> _Gathered:
        """The light times the surface's albedo, which is the median of what the vertices tell of it where normals are as expected."""
        would = np.einsum("ki,kij,kj->k", expected, _whole(self._matrix), expected)
        told = would > 0
        if told.any():
            albedo = float(np.median((self._right * expected).sum(axis=1)[told] / would[told]))
            self._matrix, self._right = self._matrix * albedo**2, self._right * albedo - self._beside * albedo**2
        return self

    def solved(self, start: FloatArray, points: FloatArray | None = None) -> MeasuredNormals:
        """The unit normals that fit best, by Newton's method on the sphere from `start`; of `points`, or of the mean points."""
        known = np.flatnonzero(self._pixels > 0)
        matrix, right, normals = _whole(self._matrix[known]), self._right[known], start[known]
        for _ in range(_STEPS):
            across = np.stack(rigid.across(normals), axis=2)
            curved = np.einsum("kia,kij,kjb->kab", across, matrix, across)
            curved[:, [0, 1], [0, 1]] += 1e-6 / _WORST_RAD**2
            slope = np.einsum("kia,ki->ka", across, right - np.einsum("kij,kj->ki", matrix, normals))
            step = np.linalg.solve(curved, slope[..., None])[..., 0]
            step *= np.minimum(1.0, _LONGEST / np.maximum(np.linalg.norm(step, axis=1), 1e-12))[:, None]
            normals = _unit(normals + np.einsum("kia,ka->ki", across, step))
        noise = np.linalg.inv(curved)
        half = np.hypot(0.5 * (noise[:, 0, 0] - noise[:, 1, 1]), noise[:, 0, 1])
        sure = 0.5 * (noise[:, 0, 0] + noise[:, 1, 1]) + half < _WORST_RAD**2
        whole = np.einsum("kia,kab,kjb->kij", across[sure], noise[sure], across[sure])
        means = self._points[known] / np.maximum(self._matrix[known, :1], 1e-300) if points is None else points[known]
        return MeasuredNormals(means[sure], normals[sure], np.stack([whole[:, i, j] for i, j in SIX], axis=1))


def _whole(sums: FloatArray) -> FloatArray:
    return sums[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def _unit(vectors: FloatArray) -> FloatArray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)


def _judged(surface: Surface, camera: PinholeCamera, pose: FloatArray, caster: Caster) -> tuple[Maps, BoolArray]:
    """What each pixel sees, and which see it well enough."""
    maps = trace_maps(surface, camera, pose, caster, allow_inside=True)
    return maps, maps.hit & (np.cos(np.nan_to_num(maps.incidence_rad, nan=3.0)) > LEAST_COSINE)


def _nearest_corner(surface: Surface, maps: Maps, judged: BoolArray) -> IntArray:
    """(k,) the vertex nearest to what each judged pixel sees."""
    corners = surface.faces[maps.face[judged]]
    away = ((surface.vertices[corners] - maps.points_mm()[judged][:, None, :]) ** 2).sum(axis=2)
    return np.take_along_axis(corners, away.argmin(axis=1)[:, None], axis=1)[:, 0]


def _exposed(sensor: Sensor, seen: FloatArray) -> Sensor:
    """The sensor, exposed so that hardly anything that is seen saturates."""
    white = float(np.quantile(seen, 0.98)) if seen.size else 1.0
    return replace(sensor, electrons_per_unit=sensor.full_well * (0.8 / white if white > 0 else 1.0))


def lit_picture(
    tracer: Tracer, camera: PinholeCamera, pose: FloatArray, settings: Settings, sensor: Sensor, *, seed: int = 0
) -> LitPicture:
    """A picture of the tracer's scene, of one wavelength, by a noisy sensor, in the scene's unit of light."""
    picture = tracer.render(camera, pose, settings, seed=seed).radiance[..., 0].astype(np.float64)
    exposed = _exposed(sensor, picture[picture > 0])
    share = exposed.linearise(exposed.expose(picture, seed=seed))
    unit = exposed.full_well / exposed.electrons_per_unit
    light = np.where(share > _DARK, share * unit, np.nan)
    return LitPicture(light, noise_of(exposed, share) * unit, pose, tracer.scene.sources)


def noise_of(sensor: Sensor, share: FloatArray) -> FloatArray:
    """Standard deviation, in shares of full well, of what a pixel says: shot, read and rounding."""
    steps = 2.0**sensor.bits - 1
    level = np.rint(sensor.respond(share) * steps)
    step = sensor.linearise(np.minimum(level + 1, steps) if sensor.bits else level) - sensor.linearise(level)
    return np.sqrt(share / sensor.full_well + (sensor.read_noise / sensor.full_well) ** 2 + step**2 / 12)
