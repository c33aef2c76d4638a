"""All poses together: one Gauss-Newton step moves every scan so that the residuals of all overlapping pairs shrink at once.

A pair's equations act on the difference of its two motions, so the whole is a graph Laplacian with 6 x 6 blocks (Pulli,
*Multiview registration for large data sets*, 1999; Toldo et al., 2010, on global point-to-plane). Loops close because every pair that overlaps is in it,
neighbours in the order of scanning or not. World frame, millimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray
from rangecheck.kernels import in_chunks
from rangecheck.scan.registration.matching import Equations, Target, equations, motion_numbers, small_motion
from rangecheck.scan.registration.samples import Samples

#: a level ends when no scan moves more than this share of the sample spacing
_STILL = 2e-3
#: added to the diagonal per unit of weight: directions that nothing determines stay where they are
_DAMPING = 1e-6
#: matches below which a pair says nothing
LEAST_MATCHES = 12
#: cells of the smallest smoothing window: readings within one err together
WINDOW_CELLS = 25
#: the same for points smoothed as little as noise allows: between white noise alone (2 to 4 cells) and ridges that residuals share; with it
#: the sample bust's poses err by about what is expected
FINE_WINDOW_CELLS = 12


@dataclass(frozen=True)
class Level:
    """One level of coarse to fine: every `step`-th cell of the targets, about `count` points per moving scan."""

    step: int
    count: int
    iterations: int


#: from initial errors of about 25 sample spacings down to the full grid
LEVELS = (Level(8, 800, 30), Level(4, 1500, 20), Level(2, 3000, 15), Level(1, 6000, 15))


@dataclass(frozen=True, eq=False)
class JointResult:
    """Poses after joint registration and the equations at the end.

    poses     world_from_scan of each scan
    equations of each ordered pair (moving, target) that matched
    centre_mm, length_mm  about which and in which units the equations count motions
    moved_mm  length of the last step, the largest over the scans
    """

    poses: list[FloatArray]
    equations: dict[tuple[int, int], Equations] = field(repr=False)
    centre_mm: FloatArray
    length_mm: float
    iterations: int
    moved_mm: float


def frame_of(samples: Sequence[Samples], poses: Sequence[FloatArray]) -> tuple[FloatArray, float]:
    """Centre (3,) and size in mm that turns are counted about and in: the mean point and the RMS distance from it."""
    points = np.concatenate([rigid.move_points(pose, s.spread(300)[0]) for s, pose in zip(samples, poses)])
    centre = points.mean(axis=0)
    return centre, max(float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean())), 1e-9)


def align_jointly(
    samples: Sequence[Samples],
    poses: Sequence[FloatArray],
    *,
    levels: Sequence[Level] = LEVELS,
    fixed: Sequence[int] = (0,),
    pairs: Sequence[tuple[int, int]] | None = None,
    restrict: Callable[[FloatArray, FloatArray], FloatArray] | None = None,
    hold: float = 0.0,
) -> JointResult:
    """Poses (n of 4, 4) that bring all scans onto each other, from `poses` that are nearly right; `fixed` scans stay.

    pairs     ordered pairs (moving, target) to use; without it all
    hold      pull towards the poses at the start, as a share of each scan's own weight: motions that the overlaps leave free stay there
    restrict  solves the equations (6 n, 6 n), (6 n,) in its own way, such as a turntable's five numbers
    """
    start = [np.array(p, dtype=float) for p in poses]
    poses = list(start)
    n = len(samples)
    wanted = list(pairs) if pairs is not None else [(i, j) for i in range(n) for j in range(n) if i != j]
    centre, length = frame_of(samples, poses)
    found: dict[tuple[int, int], Equations] = {}
    total, moved = 0, np.inf
    for level in levels:
        targets = [Target(s, level.step) for s in samples]
        moving = [s.spread(level.count) for s in samples]
        active = wanted
        for iteration in range(level.iterations):
            found = gather(samples, poses, targets, moving, active, centre, length)
            if iteration == 0:
                # a step of a level moves a scan by less than its gate: pairs far apart now will not meet in it
                active = [p for p in wanted if p in found]
            if restrict is not None:
                step = restrict(*assemble(found, n))
            else:
                strayed = [motion_numbers(p @ rigid.inverse(q), centre, length) for p, q in zip(poses, start)]
                step = solve(found, n, fixed, hold, np.concatenate(strayed))
            poses = [small_motion(step[6 * i : 6 * i + 6], centre, length) @ p for i, p in enumerate(poses)]
            moved = float(np.abs(step).max(initial=0.0))
            total += 1
            if moved < _STILL * level.step * min(s.spacing_mm for s in samples):
                break
    return JointResult([rigid.checked(p) for p in poses], found, centre, length, total, moved)


def gather(
    samples: Sequence[Samples],
    poses: Sequence[FloatArray],
    targets: Sequence[Target],
    moving: Sequence[tuple[FloatArray, FloatArray]],
    pairs: Sequence[tuple[int, int]],
    centre_mm: FloatArray,
    length_mm: float,
    gate_mm: float | None = None,
) -> dict[tuple[int, int], Equations]:
    """Equations of the ordered pairs that have at least `LEAST_MATCHES` matches."""

    def one(first: int, last: int) -> Equations:
        i, j = pairs[first]
        target = targets[j]
        return equations(
            *moving[i], poses[i], target, poses[j], centre_mm=centre_mm, length_mm=length_mm,
            gate_mm=gate_mm or target.gate_mm, least_scale_mm=max(samples[i].smooth_mm, target.samples.smooth_mm),
        )  # fmt: skip

    every = in_chunks(one, len(pairs), 1)
    return {pair: e for pair, e in zip(pairs, every) if e.matches >= LEAST_MATCHES and e.weight > 0}


def assemble(found: dict[tuple[int, int], Equations], n: int) -> tuple[FloatArray, FloatArray]:
    """The whole system (6 n, 6 n), (6 n,): block Laplacian and gradient."""
    a, g = np.zeros((6 * n, 6 * n)), np.zeros(6 * n)
    for (i, j), e in found.items():
        p, q = slice(6 * i, 6 * i + 6), slice(6 * j, 6 * j + 6)
        a[p, p] += e.normal
        a[q, q] += e.normal
        a[p, q] -= e.normal
        a[q, p] -= e.normal
        g[p] += e.gradient
        g[q] -= e.gradient
    return a, g


def solve(
    found: dict[tuple[int, int], Equations], n: int, fixed: Sequence[int], hold: float = 0.0, strayed: FloatArray | None = None
) -> FloatArray:
    """The step (6 n,), zero for `fixed` scans and for those without matches; `hold` pulls back what has `strayed` (6 n,)."""
    a, g = assemble(found, n)
    free = np.ones(6 * n, np.bool_)
    for k in fixed:
        free[6 * k : 6 * k + 6] = False
    step = np.zeros(6 * n)
    if free.any() and found:
        weight = sum(e.weight for e in found.values()) / n
        if strayed is not None:
            g = g + hold * weight * strayed
        system = a[np.ix_(free, free)] + (hold + _DAMPING) * weight * np.eye(int(free.sum()))
        step[free] = np.linalg.solve(system, -g[free])
    return step


def pose_errors_mm(
    samples: Sequence[Samples], poses: Sequence[FloatArray], fixed: int, count: int = 3000, window_cells: int = WINDOW_CELLS
) -> list[float]:
    """Expected error of each pose relative to scan `fixed`: RMS displacement of the scan's points, one standard deviation.

    From the equations of all pairs at `poses`, each weighted by its own residual. Readings that share a smoothing window err
    together, so only one of each window counts as evidence. inf where the overlaps leave a motion free."""
    n = len(samples)
    targets, moving = [Target(s, 1) for s in samples], [s.spread(count) for s in samples]
    pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
    centre, length = frame_of(samples, poses)
    found = gather(samples, poses, targets, moving, pairs, centre, length)
    information = np.zeros((6 * n, 6 * n))
    for (i, j), e in found.items():
        shared = max(1.0, window_cells * len(moving[i][0]) / max(int(samples[i].inner.sum()), 1))
        # both directions of a pair look at the same readings
        weighted = replace(e, normal=e.normal / (2 * shared * e.scale_mm**2))
        information += assemble({(i, j): weighted}, n)[0]
    free = np.r_[0 : 6 * fixed, 6 * fixed + 6 : 6 * n]
    errors = [0.0] * n
    if len(free) == 0:
        return errors
    values, vectors = np.linalg.eigh(information[np.ix_(free, free)])
    spread = vectors / np.sqrt(np.maximum(values, 1e-12 * max(float(values[-1]), 1e-300)))
    covariance = spread @ spread.T
    others = [k for k in range(n) if k != fixed]
    for place, k in enumerate(others):
        block = covariance[6 * place : 6 * place + 6, 6 * place : 6 * place + 6]
        points = rigid.move_points(poses[k], moving[k][0][::10]) - centre
        # displacement of a point: turn x p / length + shift
        jacobian = np.zeros((len(points), 3, 6))
        for axis in range(3):
            jacobian[:, :, axis] = np.cross(np.eye(3)[axis], points / length)
            jacobian[:, axis, 3 + axis] = 1.0
        errors[k] = float(np.sqrt(np.einsum("nij,jk,nik->", jacobian, block, jacobian) / len(points)))
    return errors
