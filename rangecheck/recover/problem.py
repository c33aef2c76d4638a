"""The inverse problem: photographs of one material under some lights, as residuals of numbered parameters, with their exact derivatives.

    picture = exposure * (sum over lights of radiance * value + thrown) + ambient
                                                    values from `radiance.shade`, thrown light from a simulator, picture in parts of full scale

Parameters count from the problem's own state: K_lm, K_spike and ambient as they are, K_lobe, lengths, irradiance, distance, radius and exposure
by their logarithms, a light's direction by two angles (rad), a camera's pose by its small turn (rad) and shift (mm).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import ArrayError, SettingError
from rangecheck.kernels import in_chunks
from rangecheck.recover.lights import ONE_NODE, Light, light_arrays, tangents
from rangecheck.recover.radiance import MATERIAL_NUMBERS, shade
from rangecheck.recover.sight import POSE_NUMBERS, Sight
from rangecheck.recover.thrown import Thrown
from rangecheck.reflectance.lobe import MASKINGS, two_numbers

STRENGTHS = ("K_lm", "K_spike", "K_lobe")
LENGTHS = ("sigma_um", "correlation_um")
#: a lobe weaker than this is none
LEAST_LOBE = 1e-4
#: radius that a lamp may grow to: at 90 degrees it would stand all around
WIDEST_DEG = 89.0
_CHUNK = 8192
#: owner of a parameter that serves all pictures
_ALL = -1


@dataclass(frozen=True)
class Guess:
    """What a surface is taken to be made of: strengths of Lambert, spike and lobe, lengths in micrometres at one wavelength; of a metal that is known
    its refractive index n + i k there (n = 0: a perfect conductor)."""

    K_lm: float = 0.5
    K_spike: float = 0.0
    K_lobe: float = 0.3
    sigma_um: float = 0.2
    correlation_um: float = 2.0
    wavelength_um: float = 0.555
    masking: str = "smith"
    n: float = 0.0
    k: float = 0.0

    def numbers(self) -> tuple[float, ...]:
        """As `Thrown` counts them: the strengths, and the logarithms of the lengths."""
        return (self.K_lm, self.K_spike, self.K_lobe, math.log(self.sigma_um), math.log(self.correlation_um))

    def but(self, **numbers: float) -> Guess:
        """The same with some numbers changed."""
        known: dict[str, Any] = dict(numbers)
        return replace(self, **known)


@dataclass(frozen=True, eq=False)
class Photograph:
    """Pixels of one picture, as parts of full scale, beside what they see.

    sight     what the n pixels see
    values    (n,) measured, linear in light
    noise     (n,) standard deviation of each
    lit       (n, s) whether the light reaches each point, for the s lights of this picture
    lights    their numbers in `Problem.lights`
    saturation  where the sensor stops counting;  floor: below which it shows nothing, so that noise in the dark is cut off there
    exposure, ambient  what multiplies and what is added
    thrown    what is beside the lights' straight light
    """

    sight: Sight
    values: FloatArray
    noise: FloatArray
    lit: BoolArray
    lights: tuple[int, ...]
    saturation: float = 1.0
    floor: float = -math.inf
    exposure: float = 1.0
    ambient: float = 0.0
    thrown: Thrown | None = None

    def __post_init__(self) -> None:
        n = len(self.sight)
        if len(self.values) != n or len(self.noise) != n or self.lit.shape != (n, len(self.lights)):
            raise ArrayError(
                f"a photograph of {n} pixels has {len(self.values)} values, {len(self.noise)} noises and lit {self.lit.shape}",
                name="values",
            )
        if not (np.isfinite(self.values).all() and np.isfinite(self.noise).all() and (self.noise > 0.0).all()):
            raise ArrayError("a photograph's values must be finite and its noise above 0; leave such pixels out", name="noise")

    def only(self, keep: IntArray | BoolArray) -> Photograph:
        """The same picture, only these of its pixels."""
        thrown = None if self.thrown is None else self.thrown.only(keep)
        few = {name: getattr(self, name)[keep] for name in ("values", "noise", "lit")}
        return replace(self, sight=self.sight.only(keep), thrown=thrown, **few)


@dataclass(frozen=True)
class Unknowns:
    """What is to be found. `material` names strengths and lengths; the others say which of a light's or a picture's numbers are free.

    Where both strengths and irradiance are free, or irradiance and exposure, only products act: `fit` says so. `first_fixed`: irradiance of
    the first light and exposure of the first picture are known. `one_camera`: one pose serves all pictures."""

    material: tuple[str, ...] = ("K_lm", "K_lobe", *LENGTHS)
    direction: bool = True
    irradiance: bool = False
    distance: bool = False
    radius: bool = False
    exposure: bool = False
    ambient: bool = False
    pose: bool = False
    first_fixed: bool = True
    one_camera: bool = False

    def __post_init__(self) -> None:
        unknown = [name for name in self.material if name not in STRENGTHS + LENGTHS]
        if unknown:
            raise SettingError(
                f"{unknown[0]} is no number of a material; there are {', '.join(STRENGTHS + LENGTHS)}", key="material"
            )


class Parameter(NamedTuple):
    """One unknown: `kind`, which light or picture it belongs to, and its `number` within; `unit` is a change of it that matters."""

    name: str
    kind: str
    owner: int
    number: int
    unit: float
    low: float
    high: float


class Prediction(NamedTuple):
    """values (n,) and slopes (n, p) of one photograph."""

    values: FloatArray
    slopes: FloatArray


@dataclass(frozen=True, eq=False)
class Problem:
    """Photographs, the lights they were taken under, the material as far as it is guessed, and what is unknown. `reach`: how far lengths and strengths
    may move (their logarithms), where thrown light is known near a state only."""

    photographs: tuple[Photograph, ...]
    lights: tuple[Light, ...]
    material: Guess
    unknowns: Unknowns = field(default_factory=Unknowns)
    nodes: FloatArray = field(default_factory=lambda: ONE_NODE)
    reach: float = math.inf

    def parameters(self) -> list[Parameter]:
        """The unknowns in order, with their bounds relative to the state (absolute for strengths)."""
        want, found = self.unknowns, []
        wave, inf = self.material.wavelength_um, math.inf
        for name in want.material:
            if name == "K_lobe":
                # by its logarithm: on smooth surfaces K_lobe sigma^2 acts, and what is free then is a straight line
                least, most = (math.log(k / max(self.material.K_lobe, LEAST_LOBE)) for k in (LEAST_LOBE, 1e3))
                least, most = max(least, -self.reach), min(most, self.reach)
                found.append(Parameter(name, "log strength", 0, STRENGTHS.index(name), 1.0, least, most))
            elif name in STRENGTHS:
                found.append(Parameter(name, "strength", 0, STRENGTHS.index(name), 1.0, 0.0, 1e3))
            else:
                now = getattr(self.material, name)
                low, high = (3e-3, 8.0) if name == "sigma_um" else (0.5, 1e3)
                number = 3 + LENGTHS.index(name)
                least, most = max(math.log(low * wave / now), -self.reach), min(math.log(high * wave / now), self.reach)
                found.append(Parameter(name, "length", 0, number, 1.0, least, most))
        for k in range(len(self.lights)):
            if want.direction:
                found += [
                    Parameter(f"light {k} direction {axis}", "direction", k, n, 0.2, -1.5, 1.5) for n, axis in enumerate("ab")
                ]
            later = k > 0 or not want.first_fixed
            widest = min(max(math.log(WIDEST_DEG / self.lights[k].angular_radius_deg), 0.0), 3.0)
            for kind, free, most in (
                ("irradiance", want.irradiance and later, 7.0),
                ("distance", want.distance, 7.0),
                ("radius", want.radius, widest),
            ):
                if free:
                    found.append(Parameter(f"light {k} {kind}", kind, k, 0, 1.0, -7.0, most))
        for k in range(len(self.photographs)):
            if want.exposure and (k > 0 or not want.first_fixed):
                found.append(Parameter(f"picture {k} exposure", "exposure", k, 0, 1.0, -7.0, 7.0))
            if want.ambient:
                found.append(Parameter(f"picture {k} ambient", "ambient", k, 0, 1.0, -1.0, 1.0))
            if want.pose and (k == 0 or not want.one_camera):
                size = float(np.ptp(self.photographs[k].sight.points, axis=0).max())
                for n in range(POSE_NUMBERS):
                    whose, owner = ("camera", _ALL) if want.one_camera else (f"picture {k}", k)
                    name = f"{whose} {'turn' if n < 3 else 'shift'} {'xyz'[n % 3]}"
                    unit = 0.02 if n < 3 else 0.02 * size
                    found.append(Parameter(name, "pose", owner, n, unit, -inf, inf))
        return found

    def start(self) -> FloatArray:
        """The parameters of the problem's own state."""
        begin = []
        for p in self.parameters():
            if p.kind == "strength":
                begin.append(getattr(self.material, p.name))
            else:
                begin.append(self.photographs[p.owner].ambient if p.kind == "ambient" else 0.0)
        return np.array(begin)

    def at(self, theta: FloatArray) -> tuple[Problem, FloatArray]:
        """The problem with its state moved to `theta`, and the poses (pictures, 6) that its sights are still to be moved by."""
        lights, photographs, material = list(self.lights), list(self.photographs), self.material
        poses = np.zeros((len(photographs), POSE_NUMBERS))
        across = np.zeros((len(lights), 2))
        for p, value in zip(self.parameters(), theta):
            value = float(value)
            if p.kind == "strength":
                material = material.but(**{p.name: value})
            elif p.kind == "log strength":
                material = replace(material, K_lobe=max(material.K_lobe, LEAST_LOBE) * math.exp(value))
            elif p.kind == "length":
                material = replace(material, **{p.name: getattr(material, p.name) * math.exp(value)})
            elif p.kind == "direction":
                across[p.owner, p.number] = value
            elif p.kind in ("irradiance", "distance", "radius"):
                name = {"irradiance": "irradiance", "distance": "distance_mm", "radius": "angular_radius_deg"}[p.kind]
                grown = getattr(lights[p.owner], name) * math.exp(value)
                lights[p.owner] = replace(lights[p.owner], **{name: grown})
            elif p.kind == "exposure":
                photographs[p.owner] = replace(photographs[p.owner], exposure=photographs[p.owner].exposure * math.exp(value))
            elif p.kind == "ambient":
                photographs[p.owner] = replace(photographs[p.owner], ambient=value)
            else:
                poses[slice(None) if p.owner == _ALL else p.owner, p.number] = value
        turned = tuple(light.turned(a) for light, a in zip(lights, across))
        return replace(self, photographs=tuple(photographs), lights=turned, material=material), poses

    def predict(self, theta: FloatArray, which: int, *, slopes: bool = True) -> Prediction:
        """What photograph `which` should show at `theta`, and its derivatives by all parameters."""
        state, poses = self.at(theta)
        photo = state.photographs[which]
        n, parameters = len(photo.sight), self.parameters()
        values, jacobian = np.empty(n), np.zeros((n, len(parameters) if slopes else 0))
        if n == 0:
            return Prediction(values, jacobian)
        shown = _Shown(state, photo, poses[which])
        centre_slopes = _centre_slopes(self, state, theta, parameters)

        def work(start: int, stop: int) -> None:
            shown.fill(start, stop, values, jacobian, parameters if slopes else [], centre_slopes, which)

        in_chunks(work, n, _CHUNK)
        return Prediction(values, jacobian)

    def by_normal(self, which: int) -> tuple[FloatArray, FloatArray]:
        """What photograph `which` shows at the problem's own state, (n,), and its derivatives (n, 3) by each point's normal."""
        photo = self.photographs[which]
        n = len(photo.sight)
        values, slopes = np.empty(n), np.empty((n, 3))
        if n:
            shown = _Shown(self, photo, np.zeros(POSE_NUMBERS))
            in_chunks(lambda start, stop: shown.fill_by_normal(start, stop, values, slopes), n, _CHUNK)
        return values, slopes


def _centre_slopes(problem: Problem, state: Problem, theta: FloatArray, parameters: Sequence[Parameter]) -> list[FloatArray]:
    """How each parameter moves the middle of its light, (3,); zero where it does not."""
    found: list[FloatArray] = []
    across = {(p.owner, p.number): float(v) for p, v in zip(parameters, theta) if p.kind == "direction"}
    for p in parameters:
        move: FloatArray = np.zeros(3)
        if p.kind == "direction":
            base, distance = problem.lights[p.owner].direction, state.lights[p.owner].distance_mm
            frame = tangents(base)
            t = np.array([across[p.owner, 0], across[p.owner, 1]])
            angle = float(np.hypot(*t))
            aside = t @ frame
            if angle < 1e-6:
                move = distance * (frame[p.number] - t[p.number] * base)
            else:
                bend = (math.cos(angle) - math.sin(angle) / angle) / angle**2
                move = distance * (math.sin(angle) / angle * (frame[p.number] - t[p.number] * base) + bend * t[p.number] * aside)
        elif p.kind == "distance":
            light = state.lights[p.owner]
            move = light.distance_mm * light.direction
        found.append(move)
    return found


class _Shown:
    """One photograph's forward model at one state, filled chunk by chunk."""

    def __init__(self, state: Problem, photo: Photograph, pose: FloatArray) -> None:
        guess, sight = state.material, photo.sight
        self.photo = photo
        self.lights = [state.lights[k] for k in photo.lights]
        self.numbers = photo.lights
        roughness, reach = two_numbers(guess.sigma_um, guess.correlation_um, guess.wavelength_um)
        self.strengths = np.array([guess.K_lm, guess.K_spike, guess.K_lobe])
        seen = sight.moved(pose) if pose.any() else sight
        self.arguments = (
            MASKINGS[guess.masking], self.strengths, roughness, reach, np.array([guess.n, guess.k]),
            np.ascontiguousarray(seen.points), np.ascontiguousarray(seen.normals), np.ascontiguousarray(seen.views), seen.footprints, photo.lit.astype(np.uint8), *light_arrays(tuple(self.lights)),
            np.ascontiguousarray(state.nodes),
        )  # fmt: skip
        self.radiance = np.array([light.radiance for light in self.lights])
        self.thrown = np.zeros(len(sight)) if photo.thrown is None else photo.thrown.near(guess.numbers(), pose)

    def _shade(self, start: int, stop: int) -> tuple[FloatArray, ...]:
        """value, by_material, by_centre, by_radius, by_point, by_normal, by_view, by_footprint of these pixels, source by source."""
        m, s = stop - start, len(self.lights)
        one: tuple[FloatArray, ...] = np.empty((m, s)), np.empty((m, s, MATERIAL_NUMBERS))
        out = (*one, np.empty((m, s, 3)), np.empty((m, s)), *(np.empty((m, s, 3)) for _ in range(3)), np.empty((m, s)))
        shade(*self.arguments, start, stop, *out)
        return out

    def fill_by_normal(self, start: int, stop: int, values: FloatArray, slopes: FloatArray) -> None:
        value, *_, by_normal, _, _ = self._shade(start, stop)
        each = self.photo.exposure * self.radiance
        values[start:stop] = value @ each + self.photo.exposure * self.thrown[start:stop] + self.photo.ambient
        slopes[start:stop] = np.einsum("msj,s->mj", by_normal, each)

    def _by_pose(self, start: int, stop: int, by: Sequence[FloatArray], by_footprint: FloatArray) -> FloatArray:
        """(m, 6) by the pose's numbers, from those by point, normal and view, (m, 3) each, and by footprint (m,)."""
        along, sight = np.concatenate(by, axis=1)[:, None, :], self.photo.sight
        moved = (along @ sight.by_pose[start:stop].reshape(stop - start, -1, POSE_NUMBERS))[:, 0]
        return np.asarray(moved + by_footprint[:, None] * sight.footprints_by_pose[start:stop])

    def fill(
        self, start: int, stop: int, values: FloatArray, jacobian: FloatArray, parameters: Sequence[Parameter],
        centre_slopes: Sequence[FloatArray], which: int,
    ) -> None:  # fmt: skip
        value, by_material, by_centre, by_radius, *turned, by_footprint = self._shade(start, stop)
        exposure, ambient = self.photo.exposure, self.photo.ambient
        each = exposure * self.radiance
        light = value @ each + exposure * self.thrown[start:stop]
        values[start:stop] = light + ambient
        rows, thrown = jacobian[start:stop], self.photo.thrown
        by_pose = (
            self._by_pose(start, stop, [np.einsum("msj,s->mj", by, each) for by in turned], by_footprint @ each)
            if any(p.kind == "pose" for p in parameters)
            else None
        )
        for column, (p, move) in enumerate(zip(parameters, centre_slopes)):
            if p.kind in ("strength", "length", "log strength"):
                rows[:, column] = by_material[:, :, p.number] @ each
                if thrown is not None:
                    rows[:, column] += exposure * thrown.slopes[start:stop, p.number]
                if p.kind == "log strength":
                    rows[:, column] *= self.strengths[p.number]
            elif p.kind in ("exposure", "ambient", "pose"):
                if p.owner not in (which, _ALL):
                    continue
                if p.kind == "exposure":
                    rows[:, column] = light
                elif p.kind == "ambient":
                    rows[:, column] = 1.0
                elif by_pose is not None:
                    rows[:, column] = by_pose[:, p.number]
                    if thrown is not None:
                        rows[:, column] += exposure * thrown.by_pose[start:stop, p.number]
            elif p.owner in self.numbers:
                k = self.numbers.index(p.owner)
                light_k = self.lights[k]
                alpha = math.radians(light_k.angular_radius_deg)
                if p.kind == "direction":
                    rows[:, column] = each[k] * (by_centre[:, k] @ move)
                elif p.kind == "irradiance":
                    rows[:, column] = each[k] * value[:, k]
                elif p.kind == "distance":
                    rows[:, column] = each[k] * (by_centre[:, k] @ move + by_radius[:, k] * light_k.radius_mm)
                else:
                    by_log = by_radius[:, k] * light_k.distance_mm * math.cos(alpha) * alpha
                    rows[:, column] = each[k] * (by_log - 2.0 * alpha / math.tan(alpha) * value[:, k])
