"""Primitive solids as triangles within a stated error of the true surface, every face numbered.

Frames as in `analytic.shapes`: centre or apex at the origin, axis along y. Vertices lie on the true surface. `error_mm` bounds how
far any point of a facet lies from it; where two curvatures meet in a facet each gets half.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import SceneError
from rangecheck.modeler.body import Body
from rangecheck.modeler.engine import triangulate
from rangecheck.modeler.profiles import Segment, arc_chords, segments
from rangecheck.modeler.true_faces import TrueFace

#: no body is cut into more facets than this: a scene that needs more has a tolerance that nobody can see
MOST_FACETS = 1_000_000


def _afford(facets: float, name: str, error_mm: float) -> None:
    if facets > MOST_FACETS:
        raise SceneError(
            f"{name}: a tolerance of {error_mm:g} mm needs about {facets:.2g} facets; at most {MOST_FACETS:g} are made: take a larger "
            "tolerance_mm"
        )


_UP = rigid.identity()
_SIDEWAYS = {
    "right": rigid.about_axis((0, 0, 1), -math.pi / 2),
    "left": rigid.about_axis((0, 0, 1), math.pi / 2),
    "top": _UP,
    "bottom": rigid.about_axis((1, 0, 0), math.pi),
    "front": rigid.about_axis((1, 0, 0), math.pi / 2),
    "back": rigid.about_axis((1, 0, 0), -math.pi / 2),
}


def _shifted(motion: FloatArray, offset: Sequence[float]) -> FloatArray:
    moved = motion.copy()
    moved[:3, 3] = offset
    return moved


def box(size_mm: Sequence[float]) -> Body:
    """Box of full widths x, y, z about the origin: faces right (+x), left, top (+y), bottom, front (+z), back."""
    half = np.array(size_mm, dtype=float) / 2
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    quads = ((4, 6, 7, 5), (0, 1, 3, 2), (2, 3, 7, 6), (0, 4, 5, 1), (1, 5, 7, 3), (0, 2, 6, 4))
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    outward = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    true = tuple(TrueFace("plane", world_from_face=_shifted(m, n * half)) for m, n in zip(_SIDEWAYS.values(), outward))
    return Body(corners, faces, np.repeat(np.arange(6), 2), tuple(_SIDEWAYS), true)


def sheet(size_mm: Sequence[float]) -> Body:
    """Rectangle of full widths x, z in the plane y = 0, facing up: an open surface, no solid."""
    x, z = size_mm[0] / 2, size_mm[1] / 2
    corners = np.array([[-x, 0, -z], [-x, 0, z], [x, 0, z], [x, 0, -z]], dtype=float)
    return Body(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, int), ("top",), (TrueFace("plane"),))


def sphere(radius_mm: float, error_mm: float, name: str = "sphere") -> Body:
    """Sphere about the origin: an octahedron whose faces are cut evenly in angle; one face, `surface`."""
    # facets of an even octahedral sphere sag by about 0.85 r / count^2
    _afford(8 * 0.85 * radius_mm / error_mm, name, error_mm)
    count = 2
    while True:
        vertices, faces = _octahedral_sphere(count)
        corners = vertices[faces]
        # the facet's lowest point is its circumcentre or lies on an edge; the plane's distance bounds both
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        inner = np.abs((corners[:, 0] * normal).sum(axis=1)) / np.linalg.norm(normal, axis=1)
        sag = radius_mm * (1 - float(inner.min()))
        if sag <= error_mm:
            break
        count = max(count + 1, math.ceil(count * math.sqrt(sag / error_mm) * 0.98))
    return Body(radius_mm * vertices, faces, np.zeros(len(faces), int), ("surface",), (TrueFace("sphere", radius_mm),))


def _octahedral_sphere(count: int) -> tuple[FloatArray, IntArray]:
    i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
    inside = i + j <= count
    number = np.full(i.shape, -1)
    number[inside] = np.arange(inside.sum())
    weights = np.stack([i, j, count - i - j], axis=-1)[inside] / count
    # sines of the even angles, so that facets come out nearly alike
    octant = np.sin(0.5 * math.pi * weights)
    octant /= np.linalg.norm(octant, axis=1, keepdims=True)
    up = np.argwhere(inside[:-1, :-1] & inside[1:, :-1] & inside[:-1, 1:])
    down = np.argwhere(inside[1:, 1:])
    a = np.stack([number[up[:, 0], up[:, 1]], number[up[:, 0] + 1, up[:, 1]], number[up[:, 0], up[:, 1] + 1]], axis=1)
    b = np.stack(
        [number[down[:, 0] + 1, down[:, 1]], number[down[:, 0] + 1, down[:, 1] + 1], number[down[:, 0], down[:, 1] + 1]], axis=1
    )
    triangles = np.concatenate([a, b])
    vertices: list[FloatArray] = []
    faces: list[IntArray] = []
    for sx in (1, -1):
        for sy in (1, -1):
            for sz in (1, -1):
                faces.append((triangles if sx * sy * sz > 0 else triangles[:, ::-1]) + len(octant) * len(vertices))
                vertices.append(octant * [sx, sy, sz] + 0.0)
    return _welded(np.concatenate(vertices), np.concatenate(faces))


def _welded(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Vertices that are equal become one; faces that lose a corner go."""
    unique, index = np.unique(vertices + 0.0, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    return unique, faces


def revolved(points: Sequence[Sequence[float]], names: Sequence[str], error_mm: float, name: str) -> Body:
    """The solid that an outline in (radius, y), radius >= 0, sweeps in a turn about y; outline segment k makes the face names[k].

    Segments that lie on the axis make none."""
    outline = segments(points, name)
    order = _names_of(points, outline, names)
    start = np.concatenate([s.chords(error_mm / 2) for s in outline])
    segment = np.concatenate([np.full(len(s.chords(error_mm / 2)), k) for k, s in enumerate(outline)])
    span = float(np.abs(start).max())
    start[np.abs(start[:, 0]) < 1e-12 * span, 0] = 0.0
    if (start[:, 0] < 0).any():
        raise SceneError(
            f"{name}: the outline reaches radius {start[:, 0].min():g} mm; a turned outline stays at radius 0 or more"
        )
    widest = float(start[:, 0].max())
    # arcs of the outline share the error with the turn
    around = max(8, arc_chords(widest, 2 * math.pi, error_mm / 2 if any(s.radius for s in outline) else error_mm))
    _afford(2.0 * around * len(start), name, error_mm)
    angle = 2 * math.pi * np.arange(around) / around
    ring = np.stack([np.cos(angle), np.zeros(around), -np.sin(angle)], axis=1)
    n = len(start)
    vertices = start[:, None, 0, None] * ring + start[:, 1, None, None] * np.array([0.0, 1.0, 0.0])
    index = np.arange(n * around).reshape(n, around)
    # points on the axis are one vertex each
    index[start[:, 0] == 0] = index[start[:, 0] == 0][:, :1]
    a, b = index, np.roll(index, -1, axis=0)
    a2, b2 = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    faces = np.stack([np.stack([a, a2, b2], axis=-1), np.stack([a, b2, b], axis=-1)], axis=2).reshape(-1, 3)
    label = np.repeat(segment, 2 * around)
    real = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces, label = faces[real], label[real]
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    kept = [k for k, s in enumerate(outline) if not (s.p[0] < 1e-12 * span and s.q[0] < 1e-12 * span and not s.radius)]
    # faces are numbered as the outline was given, whatever way round it was
    kept.sort(key=lambda k: order[k][0])
    place = np.full(len(outline), -1)
    place[kept] = np.arange(len(kept))
    return Body(
        vertices.reshape(-1, 3)[used],
        _outward(vertices.reshape(-1, 3)[used], faces),
        place[label],
        tuple(order[k][1] for k in kept),
        tuple(_revolved_face(outline[k]) for k in kept),
    )


def _names_of(points: Sequence[Sequence[float]], outline: list[Segment], names: Sequence[str]) -> list[tuple[int, str]]:
    """(number, name) of each segment as the outline was given, found again where the outline was turned round."""
    found: list[tuple[int, str]] = []
    for s in outline:
        for k, row in enumerate(points):
            following = points[(k + 1) % len(points)]
            ends = {(float(row[0]), float(row[1])), (float(following[0]), float(following[1]))}
            if ends == {s.p, s.q} and (k not in [number for number, _ in found]):
                found.append((k, names[k]))
                break
    return found


def _revolved_face(s: Segment) -> TrueFace:
    (r0, y0), (r1, y1) = s.p, s.q
    if s.radius:
        at = _shifted(_UP, (0.0, s.centre[1], 0.0))
        if abs(s.centre[0]) < 1e-9 * s.radius:
            return TrueFace("sphere", s.radius, world_from_face=at)
        return TrueFace("torus", s.centre[0], s.radius, at)
    if y0 == y1:
        return TrueFace("plane", world_from_face=_shifted(_UP, (0.0, y0, 0.0)))
    if r0 == r1:
        return TrueFace("cylinder", r0)
    slope = (r1 - r0) / (y1 - y0)
    apex = y0 - r0 / slope
    if slope > 0:
        return TrueFace("cone", slope, world_from_face=_shifted(_SIDEWAYS["bottom"], (0.0, apex, 0.0)))
    return TrueFace("cone", -slope, world_from_face=_shifted(_UP, (0.0, apex, 0.0)))


def extruded(points: Sequence[Sequence[float]], names: Sequence[str], depth_mm: float, error_mm: float, name: str) -> Body:
    """The solid of an outline in (x, y) between z = -depth/2 and depth/2: faces names[k] for segment k, then `front` (+z), `back`."""
    outline = segments(points, name)
    order = _names_of(points, outline, names)
    start = np.concatenate([s.chords(error_mm) for s in outline])
    segment = np.concatenate([np.full(len(s.chords(error_mm)), order[k][0]) for k, s in enumerate(outline)])
    n = len(start)
    half = depth_mm / 2
    vertices = np.concatenate([np.column_stack([start, np.full(n, z)]) for z in (half, -half)])
    a = np.arange(n)
    b = np.roll(a, -1)
    sides = np.concatenate([np.stack([a, a + n, b + n], axis=1), np.stack([a, b + n, b], axis=1)])
    cap = triangulate([start])
    faces = np.concatenate([sides, cap, cap[:, ::-1] + n])
    count = len(outline)
    label = np.concatenate([segment, segment, np.full(len(cap), count), np.full(len(cap), count + 1)])
    true = [TrueFace("plane")] * count
    for k, s in enumerate(outline):
        true[order[k][0]] = _extruded_face(s)
    ends = [
        TrueFace("plane", world_from_face=_shifted(_SIDEWAYS[side], (0, 0, z))) for side, z in (("front", half), ("back", -half))
    ]
    return Body(vertices, _outward(vertices, faces), label, (*names, "front", "back"), (*true, *ends))


def _extruded_face(s: Segment) -> TrueFace:
    if s.radius:
        return TrueFace("cylinder", s.radius, world_from_face=_shifted(_SIDEWAYS["front"], (*s.centre, 0.0)))
    (x0, y0), (x1, y1) = s.p, s.q
    # y of the face's frame along the outward normal (dy, -dx)
    turn = rigid.about_axis((0, 0, 1), math.atan2(-(x1 - x0), y1 - y0) - math.pi / 2)
    return TrueFace("plane", world_from_face=_shifted(turn, (x0, y0, 0.0)))


def _outward(vertices: FloatArray, faces: IntArray) -> IntArray:
    """Faces turned so that the closed surface encloses positive volume."""
    corners = vertices[faces]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return faces if volume > 0 else faces[:, ::-1]
