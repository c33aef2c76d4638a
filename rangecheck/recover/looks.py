"""A fit to photographs of a known shape: what a pixel sees of it changes with the camera's pose, and shadows change with the lamps.

While numbers are moved, both are held (`sight`). So steps and looks - rays from where the camera is now known to stand, shadows of the lamps as now known -
take turns. A camera is first shifted until the model lies on the picture, then found roughly, on few pixels with as much noise as what does not fit: while
the picture does not lie on the shape, it says little of lobes. Then all starts are tried again; the best is followed, a few steps a look, until the pose stands
still beside its own uncertainty, and the last look is fitted with all pixels. World frame, millimetres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.optics import PinholeCamera
from rangecheck.raycast import EmbreeCaster
from rangecheck.recover.fit import explored, followed, settled
from rangecheck.recover.lights import Light
from rangecheck.recover.polish import TWO_SIDED_95, Fitted, accumulate, polish
from rangecheck.recover.problem import Photograph, Problem
from rangecheck.recover.residuals import UNTOLD, undarkened
from rangecheck.recover.sight import Sight, lit_by, see
from rangecheck.recover.starts import with_best_strengths
from rangecheck.scene import Scene

#: cosine below which a pixel is left out: grazing views, where the model's bound and the shape's own errors count
_LEAST_COSINE = 0.3
#: tilts of triangles against what they stand for: pixels so near a terminator tell nothing
_TILTS = 2.0
#: the most looks, and steps of each;  a pose that moved by less than this share of its standard deviations stands still
_LOOKS, _STEPS, _STILL = 20, 3, 0.2
#: how often a camera is shifted until the model lies on the picture, and how far at most, in the picture's size
_BROUGHT, _FARTHEST_SHIFT = 2, 0.1
#: pixels that a rough look has about
_ROUGH = 16000
#: cosine of the angle by which lamps may turn before all starts are tried again, under their new shadows
_SAME_SHADOWS = math.cos(math.radians(10.0))


@dataclass
class Look:
    """A camera that looks at a surface, from a pose that a fit may move by turns about the middle of the surface, and shifts; and the pictures (h, w) that
    it took, linear, in parts of full scale, one lamp each or all lamps `together`, with their noise. Where not all of the surface is of the material looked
    for, `faces` (m,) are: those of one part of a scene, of whose other light a simulator knows (`simulated`)."""

    scene: Scene
    caster: EmbreeCaster
    camera: PinholeCamera
    pose: FloatArray
    pictures: Sequence[FloatArray]
    noise: float
    faces: BoolArray | None = None
    together: bool = False

    @property
    def pivot_mm(self) -> FloatArray:
        """(3,) what the camera turns about."""
        return np.asarray(self.scene.surface.bounds_mm.mean(axis=0))

    def see(self, step: int = 1) -> Sight:
        """The pixels that see the surface at angles that can be trusted, of every `step`-th row and column."""
        return facing(see(self.scene, self.camera, self.pose, self.caster, step, self.pivot_mm))

    def at(self, problem: Problem, state: Problem, step: int = 1) -> Problem:
        """The problem at a state, seen from the present pose under that state's lamps."""
        taken = photographs(self.see(step), self.pictures, state.lights, self.noise, self.caster, self.together)
        photos = tuple(replace(t, exposure=p.exposure, ambient=p.ambient) for t, p in zip(taken, state.photographs))
        return undarkened(replace(problem, photographs=photos, lights=state.lights, material=state.material))

    def move(self, pose: FloatArray) -> None:
        """Move by small turns (rad) and shifts (mm), (6,)."""
        self.pose = moved_by(self.pose, self.pivot_mm, pose)


class CameraFound(NamedTuple):
    """The pose (4, 4) world from camera;  within_mm (3,) of its place and turn_within_rad of its directions, 95 %; None where a part is not determined."""

    world_from_camera: FloatArray
    within_mm: FloatArray | None
    turn_within_rad: float | None


def moved_by(world_from_camera: FloatArray, pivot_mm: FloatArray, pose: FloatArray) -> FloatArray:
    """(4, 4) a camera turned about the pivot, then shifted, by the six numbers of `pose` (rad, mm)."""
    moved = world_from_camera.copy()
    turn, angle = pose[:3], float(np.linalg.norm(pose[:3]))
    if angle > 0.0:
        about = rigid.about_axis(turn / angle, angle)[:3, :3]
        moved[:3, :3] = about @ moved[:3, :3]
        moved[:3, 3] = pivot_mm + about @ (moved[:3, 3] - pivot_mm)
    moved[:3, 3] += pose[3:]
    return moved


def facing_of(sight: Sight) -> BoolArray:
    """(n,) the pixels that see the surface steeply enough."""
    return np.asarray((sight.normals * sight.views).sum(1) > _LEAST_COSINE)


def facing(sight: Sight) -> Sight:
    """Only those pixels."""
    return sight.only(facing_of(sight))


def inside_of(sight: Sight, chosen: BoolArray) -> BoolArray:
    """(n,) the chosen pixels (n,) but for the outermost, which may see what is beside them too; of a sight of every row and column."""
    from scipy.ndimage import binary_erosion

    inner = binary_erosion(sight.spread(chosen.astype(float), 0.0) > 0.0, np.ones((3, 3)))
    return np.asarray(inner.reshape(-1)[sight.pixel])


def photographs(
    sight: Sight, pictures: Sequence[FloatArray], lamps: Sequence[Light], noise: float, caster: EmbreeCaster | None, together: bool = False
) -> tuple[Photograph, ...]:  # fmt: skip
    """Pictures (h, w), linear in parts of full scale, one lamp each or all lamps `together`, as a fit takes them; without a caster nothing is in shadow."""
    photos = []
    for k, picture in enumerate(pictures):
        seen = picture.reshape(-1)[sight.pixel]
        shining = tuple(range(len(lamps))) if together else (k,)
        lit = (
            np.ones((len(sight), len(shining)), bool)
            if caster is None
            else lit_by(sight, tuple(lamps[n] for n in shining), caster)
        )
        unsure = UNTOLD * at_the_terminator(sight, [lamps[n] for n in shining])
        floor = 0.0 if (picture <= 0.0).any() and not (picture < 0.0).any() else -math.inf
        photos.append(Photograph(sight, seen, np.hypot(noise, unsure), lit, shining, floor=floor))
    return tuple(photos)


def at_the_terminator(sight: Sight, lamps: Sequence[Light]) -> BoolArray:
    """(n,) the pixels where a lamp grazes the surface so closely that triangles and the rounded surface that they stand for disagree whether it is lit:
    within some tilts of one against the other. On a finely made surface there are few."""
    tilt = np.arccos(np.clip((sight.normals * sight.facing).sum(1), -1.0, 1.0))
    margin = math.sin(min(_TILTS * float(np.quantile(tilt, 0.95)), 0.5))
    grazed = np.zeros(len(sight), bool)
    for lamp in lamps:
        towards = lamp.centre_mm - sight.points
        grazed |= np.abs((sight.normals * towards).sum(1)) < margin * np.linalg.norm(towards, axis=1)
    return grazed


def fit_looking(problem: Problem, look: Look) -> tuple[Fitted, CameraFound | None]:
    """Fit the problem, whose pixels are what `look` sees, and move `look` to where its camera is found; that, if its pose is unknown."""
    pose = problem.unknowns.pose
    step = max(1, round(math.sqrt(max(len(photo.sight) for photo in problem.photographs) / _ROUGH)))
    state = problem
    if pose:
        for _ in range(_BROUGHT):
            problem = brought_over(problem, look)
        state = _walked(problem, explored(_widened(with_best_strengths(problem)))[0], look, step, roughly=True)
    states = [state]
    for _ in range(_LOOKS):
        problem = look.at(problem, state)
        states = explored(problem, starts=states[1:])
        state = states[0]
        if pose:
            state = _walked(problem, _walked(problem, state, look, step), look, 1)
        if all(float(a.direction @ b.direction) > _SAME_SHADOWS for a, b in zip(problem.lights, state.lights)):
            break
    problem = look.at(problem, state)
    fitted = settled(problem, [f.problem for f in followed(problem, [state, *states[1:]])], known_noise=False)
    _moved(look, fitted)
    return fitted, camera_found(fitted, look) if pose else None


def brought_over(problem: Problem, look: Look) -> Problem:
    """The problem where `look` is shifted across its view so that what the model shows lies on the pictures: what a step finds is within some pixels only.

    Where the pixels of the shape are most alike but for a factor and what is added, of all whole shifts at once by Fourier transforms; what is beside the shape is anybody's."""
    from scipy.signal import fftconvolve

    state = with_best_strengths(problem)
    alike = np.zeros(())
    for k, photo in enumerate(state.photographs):
        mask = photo.sight.spread((photo.noise < UNTOLD).astype(float), 0.0)[::-1, ::-1]
        shown = np.minimum(
            photo.sight.spread(state.predict(state.start(), k, slopes=False).values, 0.0)[::-1, ::-1], photo.saturation
        )
        seen = np.nan_to_num(look.pictures[k])
        pattern = (shown - (shown * mask).sum() / max(mask.sum(), 1.0)) * mask
        power = fftconvolve(seen**2, mask) - fftconvolve(seen, mask) ** 2 / max(mask.sum(), 1.0)
        # what is nearly even resembles nothing
        power = np.maximum(power, 0.1 * power.max()) * max(float((pattern**2).sum()), 1e-30)
        alike = alike + np.maximum(fftconvolve(seen, pattern), 0.0) ** 2 / power
    height, width = state.photographs[0].sight.shape
    most = round(_FARTHEST_SHIFT * max(height, width))
    near = alike[max(height - 1 - most, 0) : height + most, max(width - 1 - most, 0) : width + most]
    row, column = np.unravel_index(int(np.argmax(near)), near.shape)
    down, right = row - min(most, height - 1), column - min(most, width - 1)
    depth = float(np.median((state.photographs[0].sight.points - look.pose[:3, 3]) @ look.pose[:3, 2]))
    camera = look.camera
    across = right * depth / camera.fx * look.pose[:3, 0] + down * depth / camera.fy * look.pose[:3, 1]
    look.move(np.concatenate([np.zeros(3), -across]))
    return look.at(problem, problem)


def _walked(problem: Problem, state: Problem, look: Look, step: int, *, roughly: bool = False) -> Problem:
    """The state where looks of every `step`-th row and column and their steps lead to; `look` is moved along. roughly: noise is taken to be as large as
    what does not fit, so that nothing is an outlier yet."""
    for _ in range(_LOOKS):
        now = look.at(problem, state, step)
        end = polish(_widened(now) if roughly else now, steps=_STEPS)
        state = end.problem
        if _moved(look, end):
            break
    return state


def _widened(problem: Problem) -> Problem:
    """The problem with noise as large as what does not fit."""
    wide = max(1.0, accumulate(problem, problem.start())[4][0])
    return replace(problem, photographs=tuple(replace(photo, noise=wide * photo.noise) for photo in problem.photographs))


def _moved(look: Look, fitted: Fitted) -> bool:
    """Move `look` by the pose that was found; whether that was little beside what is not known of it."""
    at = _pose_of(fitted)
    if at:
        look.move(fitted.theta[at])
    return stands_still(fitted)


def stands_still(fitted: Fitted) -> bool:
    """Whether the pose that was found is little beside what is not known of it."""
    at = _pose_of(fitted)
    spread = np.sqrt(np.diag(fitted.determination.covariance)[at])
    return bool((np.abs(fitted.theta[at]) <= _STILL * spread).all())


def _pose_of(fitted: Fitted) -> list[int]:
    return [k for k, p in enumerate(fitted.parameters) if p.kind == "pose"]


def camera_found(fitted: Fitted, look: Look) -> CameraFound:
    """Where the camera that `look` was moved to is, and how well that is known."""
    at = _pose_of(fitted)
    spread = fitted.determination.covariance[np.ix_(at, at)]
    known = [fitted.estimates[k].low is not None for k in at]
    around = np.cross(np.eye(3), look.pose[:3, 3] - look.pivot_mm)
    move = np.hstack([around.T, np.eye(3)])
    within = TWO_SIDED_95 * np.sqrt(np.diag(move @ spread @ move.T))
    turn = TWO_SIDED_95 * math.sqrt(float(np.linalg.eigvalsh(spread[:3, :3])[-1]))
    return CameraFound(look.pose, within if all(known) else None, turn if all(known[:3]) else None)
