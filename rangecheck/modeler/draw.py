"""Line drawings with hidden lines removed: creases, borders between faces, silhouettes, in picture coordinates.

Candidates are edges of the facets: where two numbered faces meet (a crease where the true surfaces meet at an angle, a seam where
they meet smoothly), where the surface ends, and where a facet that faces the eye meets one that does not (silhouette; it lies within
the tessellation error of the true one). Visibility is asked of rays from the eye, at points half a pixel apart, and where it changes
the place is found by halving (Appel 1967 counts crossings instead; rays agree with the maps by construction).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import SceneError
from rangecheck.kernels import in_chunks
from rangecheck.modeler.model import Model
from rangecheck.optics import Camera
from rangecheck.raycast import EmbreeCaster

KINDS = ("silhouette", "border", "crease", "seam")
SILHOUETTE, BORDER, CREASE, SEAM = range(4)
#: faces that meet at less than this angle meet smoothly
CREASE_RAD = math.radians(1.0)
SAMPLE_PX = 0.5
HALVINGS = 6
#: a line is hidden by what is nearer to the eye by more than this share of the scene's extent
BEHIND = 2e-5


@dataclass(frozen=True)
class Line:
    """A polyline (n, 2) in pixel coordinates (u, v), integers at pixel centres."""

    kind: int
    visible: bool
    points: FloatArray = field(repr=False)


@dataclass(frozen=True)
class Drawing:
    """Lines of one view, `width` x `height` pixels."""

    width: int
    height: int
    lines: tuple[Line, ...] = field(repr=False)

    def visible(self) -> list[Line]:
        """The lines that are not hidden."""
        return [line for line in self.lines if line.visible]


@dataclass(frozen=True)
class _Edges:
    ends: IntArray  # (k, 2) vertices
    faces: IntArray  # (k, 2) the facets on both sides, -1 = none


def _edges_of(faces: IntArray) -> _Edges:
    """Every edge once, with the (first) two facets on it."""
    sides = np.stack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]], axis=1).reshape(-1, 2)
    face = np.repeat(np.arange(len(faces)), 3)
    ends = np.sort(sides, axis=1)
    order = np.lexsort((face, ends[:, 1], ends[:, 0]))
    ends, face = ends[order], face[order]
    first = np.flatnonzero(np.r_[True, (ends[1:] != ends[:-1]).any(axis=1)])
    count = np.diff(np.r_[first, len(ends)])
    pair = np.full((len(first), 2), -1)
    pair[:, 0] = face[first]
    two = count >= 2
    pair[two, 1] = face[first[two] + 1]
    return _Edges(ends[first], pair)


def _chosen(model: Model, eye_of: FloatArray, edges: _Edges) -> tuple[IntArray, IntArray]:
    """Indices of the edges that are drawn, and their kinds. `eye_of` (m,): > 0 where the facet faces the eye."""
    surface = model.surface
    a, b = edges.faces.T
    single = b < 0
    towards_a, towards_b = eye_of[a] > 0, np.where(single, False, eye_of[b] > 0)
    part_a, part_b = surface.part_of_face[a], np.where(single, -1, surface.part_of_face[b])
    curved = np.array([f.is_curved for f in model.true_faces])
    middle = surface.vertices[edges.ends].mean(axis=1)
    between = ~single & (part_a != part_b)
    kind = np.full(len(a), -1)
    if between.any():
        at = np.flatnonzero(between)
        normal_a, normal_b = model.normals_at(middle[at], a[at]), model.normals_at(middle[at], b[at])
        angle = np.arccos(np.clip((normal_a * normal_b).sum(axis=1), -1, 1))
        kind[at] = np.where(angle > CREASE_RAD, CREASE, SEAM)
    # within a mesh's face sharp edges are creases too
    mesh = np.array([f.kind == "mesh" for f in model.true_faces])
    inside = ~single & ~between & mesh[part_a]
    sharp = (surface.face_normals[a] * surface.face_normals[np.where(single, a, b)]).sum(axis=1) < math.cos(math.radians(40))
    kind[inside & sharp] = CREASE
    outline = ~single & (towards_a != towards_b) & (between | curved[part_a])
    kind[outline] = SILHOUETTE
    kind[single] = BORDER
    drawn = np.flatnonzero(kind >= 0)
    return drawn, kind[drawn]


def draw(model: Model, camera: Camera, world_from_camera: FloatArray, *, hidden: bool = False) -> Drawing:
    """The lines of `model` seen from a pinhole or orthographic camera; with `hidden`, hidden parts too, marked so.

    Raises SceneError when the scene has no facets or lies behind the camera."""
    surface = model.surface
    if not len(surface.faces):
        raise SceneError("the model has no faces; there is nothing to draw")
    pose = rigid.checked(world_from_camera, "world_from_camera")
    eye, along = pose[:3, 3], pose[:3, 2]
    central = camera.model != "orthographic"
    to_eye = eye - surface.triangles.mean(axis=1) if central else np.broadcast_to(-along, surface.area_vectors.shape)
    edges = _edges_of(surface.faces)
    index, kind = _chosen(model, (surface.area_vectors * to_eye).sum(axis=1), edges)
    ends = surface.vertices[edges.ends[index]]
    depth = rigid.move_points(rigid.inverse(pose), ends)[..., 2]
    near = 1e-3 * surface.extent_mm
    if not (depth > near).any():
        raise SceneError("the whole model lies behind the camera; turn the camera or move it back")
    ends, kept = _before_camera(ends, depth, near)
    index, kind = index[kept], kind[kept]
    looker = _Looker(model, camera, pose, edges, index, ends)
    return Drawing(camera.width, camera.height, tuple(_joined(looker.pieces(kind, hidden))))


def _before_camera(ends: FloatArray, depth: FloatArray, near: float) -> tuple[FloatArray, IntArray]:
    """Edges cut off at depth `near`, and which of them are left."""
    kept = np.flatnonzero((depth > near).any(axis=1))
    ends, depth = ends[kept].copy(), depth[kept]
    for side in (0, 1):
        cut = depth[:, side] < near
        share = ((near - depth[cut, side]) / (depth[cut, 1 - side] - depth[cut, side]))[:, None]
        ends[cut, side] += share * (ends[cut, 1 - side] - ends[cut, side])
    return ends, kept


class _Looker:
    """Asks rays from the eye which parts of edges are seen."""

    def __init__(self, model: Model, camera: Camera, pose: FloatArray, edges: _Edges, index: IntArray, ends: FloatArray) -> None:
        self.camera, self.pose, self.ends = camera, pose, ends
        self.caster = EmbreeCaster(model.surface.vertices, model.surface.faces)
        self.slack = BEHIND * model.surface.extent_mm
        self.own = edges.faces[index]
        self.central = camera.model != "orthographic"

    def pixels(self, points: FloatArray) -> FloatArray:
        return self.camera.project(rigid.move_points(rigid.inverse(self.pose), points))[0]

    def seen(self, edge: IntArray, share: FloatArray) -> BoolArray:
        """Whether the eye sees the points at `share` (0..1) along edges `edge`."""
        points = self.ends[edge, 0] + share[:, None] * (self.ends[edge, 1] - self.ends[edge, 0])
        answer = np.empty(len(points), bool)

        def chunk(start: int, stop: int) -> None:
            here = points[start:stop]
            if self.central:
                away = here - self.pose[:3, 3]
                length = np.linalg.norm(away, axis=1)
                directions = away / length[:, None]
                origins = np.broadcast_to(self.pose[:3, 3], here.shape)
            else:
                directions = np.broadcast_to(self.pose[:3, 2], here.shape)
                length = (here - self.pose[:3, 3]) @ self.pose[:3, 2]
                origins = here - length[:, None] * directions
            hits = self.caster.closest(np.ascontiguousarray(origins), np.ascontiguousarray(directions))
            own = (self.own[edge[start:stop]] == hits.face[:, None]).any(axis=1)
            answer[start:stop] = own | (hits.distance_mm >= length - self.slack)

        in_chunks(chunk, len(points), 16384)
        return answer

    def pieces(self, kind: IntArray, hidden: bool) -> list[tuple[int, bool, FloatArray]]:
        """(kind, visible, (2, 2) pixel ends) of all parts of all edges that are in one state, in the edges' order."""
        uv = self.pixels(self.ends.reshape(-1, 3)).reshape(-1, 2, 2)
        size = np.array([self.camera.width, self.camera.height])
        low, high = uv.min(axis=1), uv.max(axis=1)
        outside = (high[:, 0] < -1) | (high[:, 1] < -1) | (low[:, 0] > size[0]) | (low[:, 1] > size[1]) | np.isnan(high[:, 0])
        # edges that leave the frame are sampled to where they leave it, no further than a frame away
        length = np.minimum(np.nan_to_num(np.linalg.norm(uv[:, 1] - uv[:, 0], axis=1)), 4.0 * size.max())
        count = np.where(outside, 0, np.maximum(1, np.ceil(length / SAMPLE_PX))).astype(int)
        edge = np.repeat(np.arange(len(count)), count)
        step = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
        # samples in the middles of the steps: ends, where lines meet other faces, are not asked
        visible = self.seen(edge, (step + 0.5) / count[edge])
        change = np.flatnonzero((edge[1:] == edge[:-1]) & (visible[1:] != visible[:-1]))
        low, high = (step[change] + 0.5) / count[edge[change]], (step[change] + 1.5) / count[edge[change]]
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            same = self.seen(edge[change], middle) == visible[change]
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        # each run of samples in one state becomes one piece
        last_of_edge = np.flatnonzero(np.r_[edge[1:] != edge[:-1], True])
        stops = np.concatenate([change, last_of_edge])
        share = np.concatenate([0.5 * (low + high), np.ones(len(last_of_edge))])
        order = np.argsort(stops, kind="stable")
        stops, share = stops[order], share[order]
        begin = np.r_[0.0, np.where(edge[stops[:-1]] == edge[stops[1:]], share[:-1], 0.0)] if len(stops) else np.empty(0)
        e = edge[stops]
        start, stop = (self.ends[e, 0] + s[:, None] * (self.ends[e, 1] - self.ends[e, 0]) for s in (begin, share))
        drawn = np.stack([self.pixels(start), self.pixels(stop)], axis=1)
        return [
            (int(kind[i]), bool(v), line)
            for i, v, line in zip(e, visible[stops], drawn)
            if (v or hidden) and np.isfinite(line).all()
        ]


#: a pixel position to 1/4096
_Place = tuple[int, int]


def _place(point: FloatArray) -> _Place:
    return round(float(point[0]) * 4096), round(float(point[1]) * 4096)


def _joined(pieces: list[tuple[int, bool, FloatArray]]) -> list[Line]:
    """Pieces of one kind that meet end to end become polylines, where exactly two meet."""
    lines: list[Line] = []
    for kind in range(len(KINDS)):
        for visible in (True, False):
            segments = [p for k, v, p in pieces if k == kind and v == visible]
            ends: dict[_Place, list[tuple[int, int]]] = {}
            keys = [tuple(_place(end) for end in segment) for segment in segments]
            for number, (a, b) in enumerate(keys):
                ends.setdefault(a, []).append((number, 0))
                ends.setdefault(b, []).append((number, 1))
            used = [False] * len(segments)

            for number, segment in enumerate(segments):
                if used[number]:
                    continue
                used[number] = True
                ahead = _follow(keys[number][1], used, ends, keys, segments)
                behind = _follow(keys[number][0], used, ends, keys, segments)
                points = np.array([*reversed(behind), segment[0], segment[1], *ahead])
                lines.append(Line(kind, visible, points))
    return lines


def _follow(
    key: _Place,
    used: list[bool],
    ends: dict[_Place, list[tuple[int, int]]],
    keys: list[tuple[_Place, ...]],
    segments: list[FloatArray],
) -> list[FloatArray]:
    """The points of the unused segments that lead on from a place, as long as exactly two meet."""
    path: list[FloatArray] = []
    while len(ends[key]) == 2:
        onward = [(number, side) for number, side in ends[key] if not used[number]]
        if not onward:
            break
        number, side = onward[0]
        used[number] = True
        path.append(segments[number][1 - side])
        key = keys[number][1 - side]
    return path
