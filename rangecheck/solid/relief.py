"""An open relief, as one view gives it, closed into a solid: gaps filled, a skirt along its rim, a flat back.

Seen from one eye every ray meets the surface at most once, so in the plane of its rays (u, v) the relief's triangles lie side by side,
and whatever is added side by side with them, or straight behind them along the rays, cannot meet them. All decisions are therefore
taken in (u, v), by exact signs: what is hidden goes; holes and narrow gaps are triangulated over the existing rims, made as fine as these,
and bent smoothly; the skirt runs along the rays, first to a plane just behind the relief, then straight to the back. No vertex of a
measured face moves. The result is proved like any other `Solid`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray, require
from rangecheck.errors import SurfaceError
from rangecheck.kernels import kernel
from rangecheck.solid.engine import triangulate
from rangecheck.solid.solid import Solid
from rangecheck.surface import topology as topo
from rangecheck.surface.intersections import self_intersections
from rangecheck.surface.patches import neighbours_of, refined, smooth_values, turn_diagonals
from rangecheck.surface.predicates import side_of_line
from rangecheck.surface.surface import INVENTED, Surface

#: gaps up to this many typical edges wide are bridged at the outer rim, and wider ones where pieces would else fall apart: up to this
#: share of the relief's extent
GAP_EDGES, GAP_SHARE = 6.0, 0.1
#: gaps bridged to join pieces are this many times as wide as the narrowest that joins them
BRIDGE = 3.0
#: pieces with less than this share of the largest one's area in (u, v) are dropped
ISLAND_SHARE = 0.02


@dataclass(frozen=True)
class View:
    """Rays of a relief: from an eye, or parallel. `depth` grows away from the eye; (u, v) are mm at depth `scale`."""

    eye_mm: FloatArray
    right: FloatArray
    up: FloatArray
    forward: FloatArray
    scale: float | None  # None: parallel rays

    def flatten(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(u, v) (n, 2) and depth (n,) of points."""
        local = points_mm - self.eye_mm
        depth = local @ self.forward
        uv = np.stack([local @ self.right, local @ self.up], axis=1)
        return (uv, depth) if self.scale is None else (uv * (self.scale / depth)[:, None], depth)

    def lift(self, uv: FloatArray, depth: FloatArray) -> FloatArray:
        """Points (n, 3) of (u, v) and depth."""
        spread = 1.0 if self.scale is None else (depth / self.scale)[:, None]
        across = uv * spread
        return self.eye_mm + across[:, :1] * self.right + across[:, 1:] * self.up + depth[:, None] * self.forward


def view_of(surface: Surface, eye_mm: npt.ArrayLike | None = None) -> View:
    """The view from `eye_mm`; without an eye, parallel rays against the surface's mean normal."""
    total = surface.area_vectors.sum(axis=0)
    if eye_mm is None:
        if np.linalg.norm(total) < 1e-6 * surface.area_mm2:
            raise SurfaceError("the surface faces all ways equally, so it is no relief; mesh several views together instead")
        forward = -total / np.linalg.norm(total)
        eye = surface.bounds_mm.mean(axis=0)
    else:
        eye = require("eye_mm", eye_mm, (3,), finite=True)
        forward = surface.vertices[_used(surface.vertices, surface.faces)].mean(axis=0) - eye
        forward = forward / np.linalg.norm(forward)
    right, down = rigid.across(forward)
    depth = (surface.vertices - eye) @ forward
    if eye_mm is not None and depth[_used(surface.vertices, surface.faces)].min() <= 0:
        raise SurfaceError("part of the surface lies behind the eye; give the place that the scan was taken from")
    return View(eye, right, -down, forward, None if eye_mm is None else float(np.median(depth)))


def _used(points: FloatArray, faces: IntArray) -> BoolArray:
    """(n,) whether a face names a point."""
    used = np.zeros(len(points), bool)
    used[faces] = True
    return used


def close_relief(
    surface: Surface,
    *,
    back_mm: float,
    eye_mm: npt.ArrayLike | None = None,
    gap_mm: float | None = None,
    island_share: float = ISLAND_SHARE,
) -> Solid:
    """A solid whose front is `surface` and whose back is a plane `back_mm` behind its deepest point.

    eye_mm       (3,) where the scan was taken from; None means parallel rays against the mean normal
    gap_mm       width up to which gaps of the outer rim are bridged; None means GAP_EDGES typical edges, or BRIDGE times what joins the pieces,
                 but at most GAP_SHARE of the extent. Inner holes are all filled
    island_share pieces below this share of the largest one's area are dropped

    Filled faces are of part "filled", the rest of "skirt" and "back", all invented. Raises SurfaceError when there is no relief to
    close, NotSolid when the proof fails."""
    if not back_mm > 0:
        raise SurfaceError(f"back_mm is {back_mm}; the back must lie behind the relief")
    if not len(surface.faces):
        raise SurfaceError("the surface has no faces; there is nothing to close")
    view = view_of(surface, eye_mm)
    notes: list[str] = []
    uv, depth = view.flatten(surface.vertices)
    kept = _visible(surface, uv, depth, notes)
    kept = _without_islands(surface, kept, uv, island_share, notes)
    typical = float(np.median(np.linalg.norm(uv[surface.faces[kept][:, 1]] - uv[surface.faces[kept][:, 0]], axis=1)))
    rest = outside_of(uv, surface.faces[kept])
    gap = _gap_that_joins(uv, surface.faces[kept], rest, GAP_EDGES * typical, notes) if gap_mm is None else gap_mm
    kept, filling = _one_disc(uv, surface.faces, kept, rest, gap, notes)
    uv, depth, front, fill_count = _with_filling(uv, depth, surface.faces[kept], filling)
    closed = _with_skirt(surface, view, uv, depth, front, kept, back_mm)
    filled = float(closed.face_areas[len(kept) : len(kept) + fill_count].sum())
    if fill_count:
        notes.append(f"{filled:.0f} mm2 of gaps and holes were filled smoothly, all labelled invented")
    return Solid.from_surface(closed, notes=tuple(notes))


def _visible(surface: Surface, uv: FloatArray, depth: FloatArray, notes: list[str]) -> IntArray:
    """Faces that face the eye and that no nearer face hides."""
    facing = np.flatnonzero(signs_of_area(uv, surface.faces) > 0)
    if not len(facing):
        raise SurfaceError(
            "no face of the surface faces the eye; turn its faces over, or give the place that the scan was taken from"
        )
    flat = Surface(np.concatenate([uv, np.zeros((len(uv), 1))], axis=1), surface.faces[facing])
    met = self_intersections(flat)
    middle = depth[surface.faces[facing]].mean(axis=1)
    hidden = np.zeros(len(facing), bool)
    if len(met.pairs):
        i, j = met.pairs.T
        hidden[np.where(middle[i] > middle[j], i, j)] = True
    total = surface.area_mm2
    gone = 1.0 - float(surface.face_areas[facing[~hidden]].sum()) / total
    if gone > 0.25:
        raise SurfaceError(
            f"{100 * gone:.0f} % of the surface is turned away or hidden, so it is no relief from there; give eye_mm, the place that the scan "
            "was taken from, or mesh several views together",
            hidden_share=gone,
        )
    if len(facing) < len(surface.faces) or hidden.any():
        notes.append(
            f"{len(surface.faces) - len(facing)} faces turned away and {int(hidden.sum())} hidden ones were left out ({100 * gone:.2f} % of the area)"
        )
    return facing[~hidden]


@kernel
def signs_of_area(uv, faces):
    """(m,) 1 where a face runs counter-clockwise in (u, v), -1 where clockwise, 0 without area; exact."""
    signs = np.empty(len(faces), np.int8)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        signs[f] = side_of_line(uv[a, 0], uv[a, 1], uv[b, 0], uv[b, 1], uv[c, 0], uv[c, 1])
    return signs


def _plane_areas(uv: FloatArray, faces: IntArray) -> FloatArray:
    a, b, c = uv[faces[:, 0]], uv[faces[:, 1]], uv[faces[:, 2]]
    return 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))


def _flat_surface(uv: FloatArray, faces: IntArray) -> Surface:
    return Surface(np.concatenate([uv, np.zeros((len(uv), 1))], axis=1), faces)


def _without_islands(surface: Surface, kept: IntArray, uv: FloatArray, share: float, notes: list[str]) -> IntArray:
    count, shell = topo.shells(_flat_surface(uv, surface.faces[kept]))
    areas = np.bincount(shell, _plane_areas(uv, surface.faces[kept]), minlength=count)
    small = areas < share * areas.max()
    if small.any():
        notes.append(f"{int(small.sum())} islands with {100 * areas[small].sum() / areas.sum():.2f} % of the area were dropped")
    return kept[~small[shell]]


def _one_disc(
    uv: FloatArray, faces: IntArray, kept: IntArray, rest: Outside, gap_mm: float, notes: list[str]
) -> tuple[IntArray, IntArray]:
    """The faces kept and the filling (k, 3) over existing vertices that together have one rim and no tunnel."""
    for _ in range(30):
        filling = _filling(len(uv), rest, gap_mm)
        whole = np.concatenate([faces[kept], filling])
        flat = _flat_surface(uv, whole)
        count, shell = topo.shells(flat)
        areas = np.bincount(shell, _plane_areas(uv, whole), minlength=count)
        doomed = shell != int(np.argmax(areas))
        if doomed.any():
            notes.append(
                f"{count - 1} pieces beyond gaps of {gap_mm:.2f} mm, {100 * (1 - areas.max() / areas.sum()):.2f} % of the area, were dropped"
            )
        else:
            doomed = _smaller_fans(flat, _plane_areas(uv, whole))
        if not doomed[: len(kept)].any():
            return kept, filling[~doomed[len(kept) :]]
        kept = kept[~doomed[: len(kept)]]
        rest = outside_of(uv, faces[kept])
    raise SurfaceError("the rim of the relief touches itself in too many points; smooth or fill the scan first")


def _smaller_fans(flat: Surface, areas: FloatArray) -> BoolArray:
    """Faces of all but the largest fan at each vertex with several fans."""
    doomed = np.zeros(len(flat.faces), bool)
    fan = topo.edge_table(flat).fans[1].reshape(-1, 3)
    for vertex in topo.non_manifold_vertices(flat).tolist():
        face, corner = np.nonzero(flat.faces == vertex)
        names = fan[face, corner]
        sizes = {name: float(areas[face[names == name]].sum()) for name in np.unique(names).tolist()}
        largest = max(sizes, key=lambda name: sizes[name])
        doomed[face[names != largest]] = True
    return doomed


def _gap_that_joins(uv: FloatArray, faces: IntArray, rest: Outside, least_mm: float, notes: list[str]) -> float:
    """The narrowest gap, at least `least_mm`, whose bridging makes one piece of all; `least_mm` when that is too wide."""
    count, shell = rest.shells
    if count == 1:
        return least_mm
    piece = np.full(len(uv) + 4, -1)
    piece[faces] = shell[:, None]
    longest = rest.longest_mm
    pieces = piece[rest.triangles]
    joins = (pieces >= 0).all(axis=1) & (pieces != pieces[:, :1]).any(axis=1)
    group = np.arange(count)
    for triangle in np.flatnonzero(joins)[np.argsort(longest[joins], kind="stable")]:
        met = np.unique(group[pieces[triangle]])
        group[np.isin(group, met)] = met[0]
        if (group == group[0]).all():
            widest = GAP_SHARE * rest.extent_mm
            narrowest = float(longest[triangle])
            # a bridge over the narrowest place alone would be a thread
            needed = min(BRIDGE * narrowest, widest)
            if least_mm < needed and narrowest < widest:
                notes.append(
                    f"{count} pieces lie {narrowest:.1f} mm apart at the narrowest; gaps of up to {needed:.1f} mm were bridged, so that they hang together"
                )
                return needed
            break
    return least_mm


def _filling(vertex_count: int, rest: Outside, gap_mm: float) -> IntArray:
    """Triangles that fill all holes and the outer gaps narrower than `gap_mm`."""
    outside = rest.triangles
    framed = (outside >= vertex_count).any(axis=1)
    # what is wide stays open only where it can be reached from the frame through wide triangles
    across = neighbours_of(outside, vertex_count + 4)
    return outside[~_reached(framed, framed | (rest.longest_mm > gap_mm), across)]


class Outside(NamedTuple):
    """What lies beside a plane mesh: triangles (k, 3) over its rims and the four corners of a frame around it (numbered last), the longest
    side of each, the mesh's shells (number, and that of each face), and its extent."""

    triangles: IntArray
    longest_mm: FloatArray
    shells: tuple[int, IntArray]
    extent_mm: float


def outside_of(uv: FloatArray, faces: IntArray) -> Outside:
    """What lies beside the faces (m, 3) of points (n, 2), which lie side by side."""
    flat = _flat_surface(uv, faces)
    used = uv[_used(uv, faces)]
    low = np.array([column.min() for column in used.T])
    high = np.array([column.max() for column in used.T])
    extent = float((high - low).max())
    (x0, y0), (x1, y1) = low - extent, high + extent
    frame = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    rings = [r[::-1] for r in topo.boundary_loops(flat)]
    vertex = np.concatenate([np.arange(len(uv), len(uv) + 4), *rings])
    points = np.concatenate([uv, frame])
    outside = vertex[triangulate([frame, *(uv[r] for r in rings)])].astype(np.int32)
    outside = outside[signs_of_area(points, outside) > 0]
    across = neighbours_of(outside, len(points))
    turn_diagonals(points, outside, across, np.zeros(len(outside), np.bool_))
    corners = points[outside]
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    return Outside(outside, sides.max(axis=1), topo.shells(flat), extent)


@kernel
def _reached(seeds, passable, across):
    reached = seeds.copy()
    waiting = [f for f in range(len(seeds)) if seeds[f]]
    while len(waiting) > 0:
        f = waiting.pop()
        for side in range(3):
            g = across[f, side] // 3
            if across[f, side] >= 0 and passable[g] and not reached[g]:
                reached[g] = True
                waiting.append(g)
    return reached


def _with_filling(
    uv: FloatArray, depth: FloatArray, faces: IntArray, filling: IntArray
) -> tuple[FloatArray, FloatArray, IntArray, int]:
    """(u, v), depth and faces with the filling refined and bent; the filling's faces come last."""
    if not len(filling):
        return uv, depth, faces, 0
    n = len(uv)
    points, fine = refined(uv, filling)
    free = np.arange(len(points)) >= n
    heights = np.concatenate([depth, np.zeros(len(points) - n)])[:, None]
    whole = np.concatenate([faces, fine])
    membrane = smooth_values(points, heights, free, whole, plate=False)[:, 0]
    plate = smooth_values(points, heights, free, whole, plate=True)[:, 0]
    count, shell = topo.shells(_flat_surface(points, fine))
    result = membrane.copy()
    order = np.argsort(shell, kind="stable")
    for own_faces in np.split(fine[order], np.searchsorted(shell[order], np.arange(1, count))):
        own = np.unique(own_faces)
        rim, inner = own[own < n], own[own >= n]
        if not len(inner):
            continue
        # across a jump in depth a plate swings beyond both sides: there a membrane spans it
        rise, width = np.ptp(depth[rim]), np.ptp(points[rim], axis=0).max()
        swing = max(depth[rim].min() - plate[inner].min(), plate[inner].max() - depth[rim].max())
        if rise < width and swing < width / 2:
            result[inner] = plate[inner]
    return points, result, whole, len(fine)


def _with_skirt(
    surface: Surface, view: View, uv: FloatArray, depth: FloatArray, front: IntArray, kept: IntArray, back_mm: float
) -> Surface:
    """Front, skirt and back as one closed surface, the measured faces first and over their own vertices."""
    loops = topo.boundary_loops(_flat_surface(uv, front))
    if len(loops) != 1:
        raise SurfaceError(f"the filled relief has {len(loops)} rims, and one is needed; raise gap_mm or drop more islands")
    rim = loops[0]
    n, k = len(uv), len(rim)
    vertices = np.concatenate([surface.vertices, view.lift(uv[len(surface.vertices) :], depth[len(surface.vertices) :])])
    deepest = float(depth[_used(depth, front)].max())
    ring = view.lift(uv[rim], np.full(k, deepest + 0.1 * back_mm))
    rings = [ring, ring + 0.9 * back_mm * view.forward] if view.scale is not None else [ring + 0.9 * back_mm * view.forward]
    faces = [front]
    before = rim
    for i in range(len(rings)):
        behind = np.arange(n + i * k, n + (i + 1) * k)
        a, b, c, d = before, np.roll(before, -1), behind, np.roll(behind, -1)
        faces += [np.stack([b, a, c], axis=1), np.stack([b, c, d], axis=1)]
        before = behind
    faces.append(before[triangulate([uv[rim]])[:, ::-1]])
    skirt_count = sum(len(f) for f in faces[1:-1])
    names = (*surface.part_names, "filled", "skirt", "back")
    parts = len(surface.part_names)
    fill_count = len(front) - len(kept)
    part = np.concatenate(
        [surface.part_of_face[kept], np.repeat([parts, parts + 1, parts + 2], [fill_count, skirt_count, len(faces[-1])])]
    )
    origin = np.concatenate([surface.origin_of_face[kept], np.full(len(part) - len(kept), INVENTED)])
    vertices, all_faces = np.concatenate([vertices, *rings]), np.concatenate(faces)
    used = _used(vertices, all_faces)
    place = np.cumsum(used, dtype=np.int32) - 1
    return Surface(vertices[used], place[all_faces], part, origin, names)
