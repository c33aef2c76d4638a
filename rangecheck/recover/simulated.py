"""A fit to pictures of a modelled scene: the material of one part, and what else is asked for, with all light that a simulator follows.

What lamps send straight to the part is known in closed form, with its slopes. The rest is simulated at a state, on some of the picture's pixels, with its
slopes by differences; steps follow from both (Gauss-Newton), and the simulator is asked again where they end - always with the same chance, so that the
turns have a fixed point, at which nothing is linearised any more:

    picture = exposure * (straight(material) + thrown(material)) + ambient,        thrown = simulated - straight near the state         (`Thrown`)

Chance in the simulated light is part of each pixel's noise. Where exposure, ambient light or the camera are unknown, pixels of the other parts bear
witness of them: their light is all simulated. Strengths enter it linearly at the last reflection, so that each start needs three simulations. World frame, mm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import SceneError
from rangecheck.recover.calm import calmed
from rangecheck.recover.fit import elsewhere, joined
from rangecheck.recover.looks import CameraFound, Look, camera_found, facing_of, inside_of, moved_by, photographs, stands_still
from rangecheck.recover.polish import Fitted, accumulate, polish
from rangecheck.recover.problem import LENGTHS, STRENGTHS, Guess, Problem, Unknowns
from rangecheck.recover.residuals import robust_cost, undarkened
from rangecheck.recover.sight import POSE_NUMBERS, Sight, see
from rangecheck.recover.starts import families, with_best_strengths
from rangecheck.recover.thrown import NUMBERS, Thrown

#: pixels of the part, and as many of the others, that starts are tried on and that the end is fitted to; observations of each
_FEW, _ALL, _FEW_PASSES, _PASSES = 2000, 8000, 4, 16
#: starts that are followed, their turns, and those that are followed to the end with its most turns
_FOLLOWED, _TURNS, _FINALISTS, _LAST_TURNS = 3, 3, 2, 8
#: slopes serve as long as no length or strength has moved by more than this (their logarithms)
_SAME_SLOPES = 0.05
#: how much more an end on few pixels may cost (minus log likelihood) to be followed on all
_RIVAL = 12.0
#: logarithm by which lengths may move in one turn, and that of the differences' step;  share of a strength that is changed for its slope
_REACH, _STEP, _SHARE = 0.7, 0.1, 0.2
#: a number moved by less than this share of its standard deviation stands still
_STILL = 0.2
#: and a turn that gains less than this (minus log likelihood) is the last
_LITTLE = 0.02


class Simulator(Protocol):
    """All light by all lamps, in parts of full scale at exposure 1."""

    def __call__(
        self, material: Guess, state: Problem, pose: FloatArray, pixels: IntArray, passes: int, seed: int, bounded: bool
    ) -> FloatArray:
        """(passes, n): observations of the pixels (n,) by the camera at `pose` (4, 4), the part being of `material`, under the state's lamps. The same
        seed is the same chance; unbounded materials are ready sooner, and differ at grazing angles."""


class _Asked(NamedTuple):
    """What a turn looks at: pixels of the part and witnesses, each from a grid of rows and columns that far apart."""

    sight: Sight
    mine: BoolArray
    steps: tuple[int, int]


@dataclass
class _Turns:
    """The picture, the simulator, and how much of both is used; `exact`: with materials bounded at grazing angles, which takes its time."""

    look: Look
    simulate: Simulator
    witnesses: bool
    pixels: int
    passes: int
    exact: bool = False

    def looks_at(self) -> _Asked:
        """The pixels that the present pose sees. Raises SceneError where the part is not seen."""
        look = self.look
        seen = see(look.scene, look.camera, look.pose, look.caster, 1, look.pivot_mm)
        part = np.ones(len(seen), bool) if look.faces is None else look.faces[seen.face]
        mine = inside_of(seen, part) & facing_of(seen)
        if not mine.any():
            raise SceneError("the camera sees nothing of the part that is looked for; name another, or check the camera")
        others = inside_of(seen, np.ones(len(seen), bool)) & ~mine & self.witnesses
        chosen, steps = [], []
        for some in (mine, others):
            step = max(1, math.ceil(math.sqrt(some.sum() / self.pixels)))
            row, column = np.divmod(seen.pixel, seen.shape[1])
            chosen.append(np.flatnonzero(some & (row % step == 0) & (column % step == 0)))
            steps.append(step)
        asked = np.concatenate(chosen)
        return _Asked(seen.only(asked), np.arange(len(asked)) < len(chosen[0]), (steps[0], steps[1]))

    def at(self, problem: Problem, asked: _Asked, thrown: Thrown, variance: FloatArray) -> Problem:
        """The problem with the pictures as they show these pixels, and the light thrown on them, (n,) its variance."""
        look = self.look
        taken = photographs(asked.sight, look.pictures, problem.lights, look.noise, look.caster, look.together)
        photos = tuple(
            replace(t, lit=t.lit & asked.mine[:, None], exposure=p.exposure, ambient=p.ambient, saturation=p.saturation, thrown=thrown,
                    noise=np.sqrt(t.noise**2 + p.exposure**2 * variance))
            for t, p in zip(taken, problem.photographs)
        )  # fmt: skip
        return replace(problem, photographs=photos)

    def seen(
        self,
        problem: Problem,
        asked: _Asked,
        material: Guess,
        seed: int,
        *,
        pose: FloatArray | None = None,
        bounded: bool = False,
    ) -> FloatArray:
        """(passes, n) what the simulator shows of these pixels."""
        where = self.look.pose if pose is None else pose
        return self.simulate(material, problem, where, asked.sight.pixel, self.passes, seed, bounded)

    def calm(self, asked: _Asked, observed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) the mean of observations (passes, n) with what its pixels' neighbours know, and its variance."""
        value, variance = observed.mean(axis=0), _variance(observed)
        label = self.look.scene.surface.part_of_face[asked.sight.face]
        for some, step in zip((asked.mine, ~asked.mine), asked.steps):
            if some.any() and variance[some].any():
                value[some], variance[some] = calmed(asked.sight.only(some), value[some], variance[some], label[some], step)
        return value, variance

    def thrown(self, problem: Problem, asked: _Asked, known: Thrown | None = None) -> tuple[Thrown, FloatArray]:
        """The light beside the lamps' straight light near the problem's state, and its variance (n,); with the slopes `known` of the same pixels, where
        they still serve."""
        state, want = problem.material, problem.unknowns
        n = len(asked.sight)
        bare = self.at(problem, asked, Thrown.none(n), np.zeros(n))
        straight, by_state = _straight(bare, pose=want.pose)
        held, at = _within_one(state), np.array(state.numbers())
        value, variance = self.calm(asked, self.seen(problem, asked, held, 0, bounded=self.exact) - straight[None])
        if known is not None and not want.pose and _as_before(at, known.at):
            slopes, by_pose = known.slopes, known.by_pose
        else:
            slopes = self._slopes(problem, asked, held, by_state)
            by_pose = self._by_pose(problem, asked, held, by_state[:, NUMBERS:]) if want.pose else np.zeros((n, POSE_NUMBERS))
        # what was simulated is the material that reflects no more than it receives
        return Thrown(at, value + slopes @ (at - held.numbers()), slopes, by_pose), variance

    def _slopes(self, problem: Problem, asked: _Asked, held: Guess, straight: FloatArray) -> FloatArray:
        """(n, 5) of thrown light by the NUMBERS: strengths mixed in at the same total, lengths either way. With chance of its own: what slopes and values
        err in together would be taken for a signal."""
        want, slopes, dark = problem.unknowns.material, np.zeros((len(asked.sight), NUMBERS)), None
        for k, name in enumerate(STRENGTHS):
            if name in want:
                dark = self.seen(problem, asked, _mixed(held, None), 1) if dark is None else dark
                lighter = self.seen(problem, asked, _mixed(held, name), 1)
                slopes[:, k] = self.calm(asked, (lighter - dark) / _SHARE - straight[None, :, k])[0]
        for k, name in enumerate(LENGTHS, len(STRENGTHS)):
            if name in want and held.K_spike + held.K_lobe > 0.0:
                ends = [
                    self.seen(problem, asked, held.but(**{name: getattr(held, name) * math.exp(h)}), 1) for h in (_STEP, -_STEP)
                ]
                slopes[:, k] = self.calm(asked, (ends[0] - ends[1]) / (2.0 * _STEP) - straight[None, :, k])[0]
        return slopes

    def _by_pose(self, problem: Problem, asked: _Asked, held: Guess, straight: FloatArray) -> FloatArray:
        span = float(np.median(asked.sight.spans_mm[asked.sight.spans_mm > 0.0]))
        size = float(np.ptp(asked.sight.points, axis=0).max())
        slopes = np.zeros((len(asked.sight), POSE_NUMBERS))
        for k in range(POSE_NUMBERS):
            # half a pixel either way
            step = (span / size if k < 3 else 0.5 * span) * np.eye(POSE_NUMBERS)[k]
            ends = [
                self.seen(problem, asked, held, 1, pose=moved_by(self.look.pose, self.look.pivot_mm, s)) for s in (step, -step)
            ]
            slopes[:, k] = ((ends[0] - ends[1]) / (2.0 * step[k])).mean(axis=0) - straight[:, k]
        return slopes

    def starts(self, problem: Problem) -> list[Problem]:
        """States to begin from, the best first: each with its best strengths, of the lengths of all families and those given."""
        asked = self.looks_at()
        n = len(asked.sight)
        bare = self.at(problem, asked, Thrown.none(n), np.zeros(n))
        free = [name for name in STRENGTHS if name in problem.unknowns.material]
        shining = [name for name in STRENGTHS if name in free or getattr(problem.material, name) > 0.0]
        begun = [bare, *(p for family in families(bare) for p in family)]
        found: list[tuple[float, Problem]] = []
        matt: FloatArray | None = None
        for start in begun:
            guess = start.material
            slopes, variance = np.zeros((n, NUMBERS)), np.zeros(n)
            by_state = _straight(start)[1]
            for name in shining:
                k = STRENGTHS.index(name)
                if name == "K_lm" and matt is not None:
                    pure = matt
                else:
                    pure = self.seen(start, asked, _only(guess, name), 1)
                matt = pure if name == "K_lm" else matt
                slopes[:, k], spread = self.calm(asked, pure - by_state[None, :, k])
                variance += getattr(guess, name) ** 2 * spread
            at = np.array(guess.numbers())
            ready = self.at(start, asked, Thrown(at, slopes @ at, slopes, np.zeros((n, POSE_NUMBERS))), variance)
            ready = with_best_strengths(ready)
            found.append((robust_cost(ready, ready.start()), ready))
        found.sort(key=lambda pair: pair[0])
        return [state for _, state in found]

    def followed(self, problem: Problem, turns: int) -> tuple[Fitted, bool]:
        """Where turns of simulation and steps lead from the problem's state, and whether they came to rest. `look` is moved along."""
        fitted, rests, thrown = None, False, None
        asked = self.looks_at()
        for _ in range(turns):
            thrown, variance = self.thrown(problem, asked, thrown)
            ready = undarkened(replace(self.at(problem, asked, thrown, variance), reach=_REACH))
            before = accumulate(ready, ready.start())[3]
            fitted = polish(ready, known_noise=False)
            problem = fitted.problem
            if problem.unknowns.pose:
                self.look.move(_pose_of(fitted))
                asked = self.looks_at()
            # along what the pictures do not fix there is no end to walk to: little gained is the end too
            rests = _rests(fitted) or before - fitted.cost < _LITTLE
            if rests:
                break
        assert fitted is not None
        return fitted, rests


def fit_simulated(
    problem: Problem, look: Look, simulate: Simulator, *, witnesses: bool = False
) -> tuple[Fitted, CameraFound | None, bool]:
    """Fit the problem's unknowns to the pictures of `look`, with all light that `simulate` knows, and move `look` to where its camera is found; that, if its
    pose is unknown; and whether the turns came to rest. witnesses: the other parts are as the scene says, and tell of exposure, ambient light and pose.

    Raises SceneError where the part is not seen."""
    few = _Turns(look, simulate, witnesses, _FEW, _FEW_PASSES)
    begun_at = look.pose.copy()
    ends: list[tuple[Fitted, FloatArray]] = []
    for start in _distinct(few.starts(problem), _FOLLOWED):
        look.pose = begun_at.copy()
        ends.append((few.followed(start, _TURNS)[0], look.pose.copy()))
    ends.sort(key=lambda end: end[0].cost)
    last = replace(few, pixels=_ALL, passes=_PASSES, exact=True)
    settled: list[tuple[Fitted, FloatArray, bool]] = []
    for end, pose in ends:
        if (
            len(settled) == _FINALISTS
            or end.cost > ends[0][0].cost + _RIVAL
            or any(not elsewhere(end, other) for other, _, _ in settled)
        ):
            continue
        look.pose = pose
        fitted, rests = last.followed(replace(end.problem, reach=math.inf), _LAST_TURNS)
        settled.append((fitted, look.pose.copy(), rests))
    settled.sort(key=lambda end: end[0].cost)
    best, look.pose, rests = settled[0]
    whole = joined([polish(replace(f.started, reach=math.inf), known_noise=False) for f, _, _ in settled])
    return whole, camera_found(best, look) if problem.unknowns.pose else None, rests


def exposed(problem: Problem, look: Look, simulate: Simulator, *, witnesses: bool) -> Problem:
    """The problem with each picture's exposure as the other parts show it, whose materials are known; without `witnesses` as its own guess would."""
    turns = _Turns(look, simulate, witnesses, _FEW, _FEW_PASSES)
    asked = turns.looks_at()
    told = ~asked.mine if (~asked.mine).any() else asked.mine
    light = turns.seen(problem, asked, problem.material, 0).mean(axis=0)
    bright = told & (light > 0.2 * np.quantile(light[told], 0.9))
    photos = []
    for photo, picture in zip(problem.photographs, look.pictures):
        values = picture.reshape(-1)[asked.sight.pixel]
        used = bright & (values < photo.saturation)
        photos.append(replace(photo, exposure=float(np.median(values[used] / light[used]))) if used.any() else photo)
    return replace(problem, photographs=tuple(photos))


def _variance(observed: FloatArray) -> FloatArray:
    """(n,) of the mean of observations (passes, n); 0 for a single one, which is taken to know."""
    passes = len(observed)
    return np.asarray(observed.var(axis=0, ddof=1) / passes) if passes > 1 else np.zeros(observed.shape[1])


def _straight(problem: Problem, *, pose: bool = False) -> tuple[FloatArray, FloatArray]:
    """(n,) the lamps' straight light at exposure 1, and its slopes by the NUMBERS, (n, 5), and by the pose."""
    nothing = dict.fromkeys(("direction", "irradiance", "distance", "radius", "exposure", "ambient"), False)
    wanted = Unknowns((*STRENGTHS, *LENGTHS), pose=pose, one_camera=True, **nothing)
    photo = replace(problem.photographs[0], exposure=1.0, ambient=0.0, thrown=None)
    bare = replace(problem, photographs=(photo,), unknowns=wanted, reach=math.inf)
    values, slopes = bare.predict(bare.start(), 0)
    lobe = STRENGTHS.index("K_lobe")
    slopes[:, lobe] /= bare.at(bare.start())[0].material.K_lobe
    return values, slopes


def _as_before(now: FloatArray, before: FloatArray) -> bool:
    """Whether no number has moved by enough to change slopes."""
    strengths = slice(0, len(STRENGTHS))
    moved = np.abs(now - before)
    moved[strengths] /= np.maximum(np.abs(before[strengths]), 0.1)
    return bool((moved < _SAME_SLOPES).all())


def _within_one(guess: Guess) -> Guess:
    """A material that reflects no more than it receives, in the same proportions."""
    total = guess.K_lm + max(guess.K_spike, guess.K_lobe)
    return guess if total <= 1.0 else guess.but(**{name: getattr(guess, name) / total for name in STRENGTHS})


def _mixed(guess: Guess, name: str | None) -> Guess:
    """Less of the material by _SHARE, with as much of one strength alone instead."""
    mixed = {s: (1.0 - _SHARE) * getattr(guess, s) for s in STRENGTHS}
    if name is not None:
        mixed[name] += _SHARE
    return guess.but(**mixed)


def _only(guess: Guess, name: str) -> Guess:
    return guess.but(**{s: float(s == name) for s in STRENGTHS})


def _pose_of(fitted: Fitted) -> FloatArray:
    return fitted.theta[[k for k, p in enumerate(fitted.parameters) if p.kind == "pose"]]


def _rests(fitted: Fitted) -> bool:
    """Whether every number that is determined moved by little beside what is not known of it, from where light was simulated."""
    moved = np.abs(
        fitted.theta - np.clip(fitted.started.start(), [p.low for p in fitted.parameters], [p.high for p in fitted.parameters])
    )
    spread = np.sqrt(np.diag(fitted.determination.covariance))
    known = np.array([e.low is not None for e in fitted.estimates])
    return bool((moved[known] <= _STILL * spread[known]).all()) and stands_still(fitted)


def _distinct(states: Sequence[Problem], count: int) -> list[Problem]:
    chosen: list[Problem] = []
    for state in states:
        if len(chosen) < count and not any(_near(state.material, other.material) for other in chosen):
            chosen.append(state)
    return chosen


def _near(one: Guess, other: Guess) -> bool:
    return abs(math.log(one.sigma_um / other.sigma_um)) + abs(math.log(one.correlation_um / other.correlation_um)) < 0.2
