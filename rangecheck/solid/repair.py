"""Repair on a leash: one defect per step, each bounded in how far it moves the surface and how much of it may vanish.

What a step cannot mend within the leash it leaves as it was, and says so. Filled faces are invented and of part "filled".
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import NotSolid, SettingError
from rangecheck.solid.checks import NOISE_SHARE
from rangecheck.solid.containment import shell_volumes_mm3
from rangecheck.solid.engine import united
from rangecheck.solid.findings import Verdict
from rangecheck.solid.holes import fill_holes
from rangecheck.solid.rounding import collapse_flat_faces
from rangecheck.solid.sheets import part_sheets, turn_faces
from rangecheck.solid.solid import check_solid
from rangecheck.solid.untangle import untangle
from rangecheck.surface import topology as topo
from rangecheck.surface.distance import SurfaceDistance
from rangecheck.surface.intersections import CROSSING, OVERLAP, self_intersections
from rangecheck.surface.surface import INVENTED, Surface
from rangecheck.surface.weld import weld_exactly

#: farthest that a point of the surface may move
MAX_MOVE_MM = 0.05
#: largest share of the area that may vanish
MAX_VANISHED = 0.01


@dataclass(frozen=True)
class Step:
    """What one step did: its name, how many defects it mended, the sentence for people."""

    name: str
    count: int
    message: str


@dataclass(frozen=True, eq=False)
class Repaired:
    """A repaired surface.

    surface       as far as it could be mended
    steps         what was done
    refused       what was not, and why
    moved_mm      farthest that any point of the given surface lies from the repaired one, or back, outside filled faces
    vanished      share of the given area that is gone
    before, after verdicts
    """

    surface: Surface
    steps: tuple[Step, ...]
    refused: tuple[str, ...]
    moved_mm: float
    vanished: float
    before: Verdict = field(repr=False)
    after: Verdict = field(repr=False)

    def table(self) -> list[tuple[str, Any, Any]]:
        """Rows (what, original, final)."""
        return compared(self.before, self.after)


def compared(before: Verdict, after: Verdict) -> list[tuple[str, Any, Any]]:
    """Rows (what, original, final): sizes, then every kind of defect that either has."""
    codes = dict.fromkeys(f.code for v in (before, after) for f in v.findings)
    rows: list[tuple[str, Any, Any]] = [(name, before.facts[name], after.facts[name]) for name in ("vertices", "faces", "shells")]

    def count(verdict: Verdict, code: str) -> int:
        return verdict.get(code).count if verdict.has(code) else 0

    return rows + [(code, count(before, code), count(after, code)) for code in codes]


def repair(
    surface: Surface,
    *,
    max_move_mm: float = MAX_MOVE_MM,
    max_vanished: float = MAX_VANISHED,
    longest_hole_mm: float | None = None,
) -> Repaired:
    """`surface` mended as far as the leash allows. A surface without defects is returned as it is.

    max_move_mm      farthest that any point may move outside filled faces
    max_vanished     share of the area that may be removed (crumbs, duplicates)
    longest_hole_mm  longest rim that is filled; None fills all. Raises SettingError for a leash that is no length."""
    if not (np.isfinite(max_move_mm) and max_move_mm >= 0 and 0 <= max_vanished <= 1):
        raise SettingError(
            f"max_move_mm is {max_move_mm} and max_vanished {max_vanished}; a length and a share are needed", key="repair"
        )
    before = check_solid(surface)
    steps: list[Step] = []
    refused: list[str] = []
    if before.fit:
        return Repaired(surface, (), (), 0.0, 0.0, before, before)
    mended = _without_idle(surface, steps)
    mended = _without_crumbs(mended, max_vanished, steps, refused)
    mended = _with_rims_welded(mended, max_move_mm, steps)
    mended = _turned(mended, steps)
    if len(topo.non_manifold_edges(mended)):
        mended = _parted(mended, max_move_mm, steps, refused)
    if len(topo.boundary_edges(mended)):
        filled = fill_holes(mended, longest_mm=longest_hole_mm)
        refused += filled.left
        if filled.filled:
            steps.append(
                Step("fill-holes", filled.filled, f"{filled.filled} holes filled, {filled.area_mm2:.2f} mm2, labelled invented")
            )
        mended = filled.surface
    if len(topo.non_manifold_vertices(mended)):
        mended = _parted(mended, max_move_mm, steps, refused)
    mended = _united(mended, steps)
    mended = _untangled(mended, max_move_mm, max_vanished, steps, refused)
    if len(topo.degenerate_faces(mended)):
        count = len(topo.degenerate_faces(mended))
        mended = collapse_flat_faces(mended)
        gone = count - len(topo.degenerate_faces(mended))
        steps.append(Step("collapse-flat", gone, f"{gone} of {count} faces without area removed by turning diagonals"))
    mended = _turned(mended, steps)
    after = check_solid(mended)
    moved, vanished = leash(surface, mended)
    return Repaired(mended, tuple(steps), tuple(refused), moved, vanished, before, after)


def _without_idle(surface: Surface, steps: list[Step]) -> Surface:
    faces = surface.faces
    twice = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    twice[topo.duplicate_faces(surface)] = True
    idle = len(topo.unreferenced_vertices(surface))
    if twice.any():
        steps.append(
            Step("drop-doubles", int(twice.sum()), f"{int(twice.sum())} faces laid twice or closed to a line were left out")
        )
    if not twice.any() and not idle:
        return surface
    if idle:
        steps.append(Step("drop-unused", idle, f"{idle} vertices without faces were left out"))
    return surface.with_faces(~twice)


def _without_crumbs(surface: Surface, max_vanished: float, steps: list[Step], refused: list[str]) -> Surface:
    count, shell = topo.shells(surface)
    if count < 2:
        return surface
    areas = np.bincount(shell, surface.face_areas, minlength=count)
    small = areas < NOISE_SHARE * areas.max()
    share = float(areas[small].sum() / max(areas.sum(), 1e-300))
    if not small.any():
        return surface
    if share > max_vanished:
        refused.append(
            f"{int(small.sum())} crumbs hold {100 * share:.2f} % of the area, more than the {100 * max_vanished:.2f} % that may vanish"
        )
        return surface
    steps.append(
        Step("drop-crumbs", int(small.sum()), f"{int(small.sum())} crumbs with {100 * share:.3f} % of the area were dropped")
    )
    return surface.with_faces(~small[shell])


def _with_rims_welded(surface: Surface, max_move_mm: float, steps: list[Step]) -> Surface:
    """Rim vertices of different edges nearer than the leash become one, halfway; kept only if that closes edges and spoils none."""
    from scipy.spatial import cKDTree

    edges = topo.boundary_edges(surface)
    if not len(edges) or max_move_mm == 0:
        return surface
    rim = np.unique(edges)
    pairs = cKDTree(surface.vertices[rim]).query_pairs(max_move_mm, output_type="ndarray")
    joined = {tuple(sorted(e)) for e in edges.tolist()}
    pairs = np.array(
        [p for p in pairs.tolist() if tuple(sorted((int(rim[p[0]]), int(rim[p[1]])))) not in joined], np.int64
    ).reshape(-1, 2)
    if not len(pairs):
        return surface
    apart = np.linalg.norm(surface.vertices[rim[pairs[:, 0]]] - surface.vertices[rim[pairs[:, 1]]], axis=1)
    target = np.arange(len(surface.vertices))
    taken = np.zeros(len(rim), bool)
    vertices = surface.vertices.copy()
    for i, j in pairs[np.argsort(apart, kind="stable")].tolist():
        if not (taken[i] or taken[j]):
            taken[i] = taken[j] = True
            target[rim[j]] = rim[i]
            vertices[rim[i]] = 0.5 * (vertices[rim[i]] + vertices[rim[j]])
    welded = replace(surface, vertices=vertices, faces=target[surface.faces])
    kept = _whole(welded.faces)
    welded = welded.with_faces(kept)
    closed = len(edges) - len(topo.boundary_edges(welded))
    spoiled = (topo.non_manifold_edges, topo.inconsistent_edges)
    if closed <= 0 or any(len(find(welded)) > len(find(surface)) for find in spoiled):
        return surface
    steps.append(
        Step(
            "weld-rims",
            int(taken.sum() // 2),
            f"{int(taken.sum() // 2)} pairs of rim vertices welded, which closes {closed} edges",
        )
    )
    return welded


def _whole(faces: IntArray) -> IntArray:
    return np.flatnonzero((faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0]))


def _turned(surface: Surface, steps: list[Step]) -> Surface:
    turned = turn_faces(surface)
    if turned.faces:
        steps.append(Step("turn-faces", turned.faces, f"{turned.faces} faces turned so that neighbours agree"))
    if turned.shells:
        steps.append(Step("turn-shells", turned.shells, f"{turned.shells} shells turned over"))
    return turned.surface


def _parted(surface: Surface, max_move_mm: float, steps: list[Step], refused: list[str]) -> Surface:
    parted = part_sheets(surface, max_move_mm=max_move_mm)
    left = len(topo.non_manifold_edges(parted.surface)) + len(topo.non_manifold_vertices(parted.surface))
    if left or len(topo.boundary_edges(parted.surface)) > len(topo.boundary_edges(surface)):
        refused.append("sheets that meet in an edge or a point cannot be parted within the leash")
        return surface
    steps.append(
        Step("part-sheets", parted.doubled, f"{parted.doubled} vertices doubled, drawn apart by {parted.moved_mm:.2g} mm")
    )
    return parted.surface


def _united(surface: Surface, steps: list[Step]) -> Surface:
    """Bodies that run into each other made one: what lies inside another goes, and no point of the outside moves."""
    count, shell = topo.shells(surface)
    if count < 2 or not topo.is_closed(surface) or (shell_volumes_mm3(surface, count, shell) <= 0).any():
        return surface
    met = shell[self_intersections(surface).of_kind(CROSSING, OVERLAP)]
    if not (met[:, 0] != met[:, 1]).any():
        return surface
    try:
        whole = united(surface)
    except NotSolid:
        return surface
    left = topo.shells(whole)[0]
    message = f"{count} bodies, some running into each other, united to {left}; what lay inside another is gone"
    steps.append(Step("unite-bodies", count - left, message))
    return whole


def _untangled(surface: Surface, max_move_mm: float, max_vanished: float, steps: list[Step], refused: list[str]) -> Surface:
    """First by smoothing on the leash; what does not come loose is cut out with its neighbours and filled anew, as invented."""
    loose = untangle(surface, max_move_mm=max_move_mm)
    if loose.before > loose.after:
        message = f"{loose.before - loose.after} pairs of faces came loose, {loose.vertices_moved} vertices moved by up to {loose.moved_mm:.3g} mm"
        steps.append(Step("untangle", loose.before - loose.after, message))
    if not loose.after:
        return loose.surface
    if topo.is_closed(loose.surface):
        again = _cut_out(loose.surface, max_vanished)
        if again is not None:
            result, share = again
            steps.append(
                Step(
                    "cut-out",
                    loose.after,
                    f"{loose.after} pairs of faces cut out with {100 * share:.3f} % of the area and filled anew",
                )
            )
            return result
    refused.append(f"{loose.after} pairs of faces that meet neither come loose within {max_move_mm:g} mm nor can be cut out")
    return loose.surface


def _cut_out(surface: Surface, max_vanished: float) -> tuple[Surface, float] | None:
    doomed = np.asarray(np.zeros(len(surface.faces), bool))
    doomed[self_intersections(surface).faces(CROSSING, OVERLAP)] = True
    for _ in range(4):
        mark = np.zeros(len(surface.vertices), bool)
        mark[surface.faces[doomed].ravel()] = True
        doomed = np.asarray(mark[surface.faces].any(axis=1))
        share = float(surface.face_areas[doomed].sum() / surface.area_mm2)
        if share > max_vanished:
            return None
        count, shell = topo.shells(surface.with_faces(~doomed))
        rest = (
            surface.with_faces(~doomed).with_faces(shell == int(np.argmax(np.bincount(shell))))
            if count > 1
            else surface.with_faces(~doomed)
        )
        if rest.area_mm2 < (1 - max_vanished) * surface.area_mm2:
            return None
        filled = fill_holes(rest)
        if topo.is_closed(filled.surface) and not len(self_intersections(filled.surface).of_kind(CROSSING, OVERLAP)):
            return filled.surface, 1 - rest.area_mm2 / surface.area_mm2
    return None


def leash(given: Surface, mended: Surface) -> tuple[float, float]:
    """Farthest way between the two surfaces outside filled and dropped faces, and the share of area that is gone."""
    if not len(mended.faces) or not len(given.faces):
        return 0.0, 1.0
    own = mended.origin_of_face != INVENTED
    kept = np.zeros(len(mended.vertices), bool)
    kept[mended.faces[own]] = True
    asked = _elsewhere(mended.vertices[kept], given)
    moved = float(SurfaceDistance(given).distance_mm(asked)[0].max(initial=0.0)) if len(asked) else 0.0
    area = float(mended.face_areas[own].sum()) if (given.origin_of_face != INVENTED).all() else mended.area_mm2
    return moved, max(0.0, 1.0 - area / given.area_mm2)


def _elsewhere(points: FloatArray, surface: Surface) -> FloatArray:
    """The points that are not, bit for bit, a vertex that a face of the surface names: those lie on it."""
    used = np.zeros(len(surface.vertices), bool)
    used[surface.faces] = True
    known = surface.vertices[used]
    _, number = weld_exactly(np.concatenate([known, points]))
    return points[number[len(known) :] > number[: len(known)].max(initial=-1)]
