"""A closed surface cut by a plane face by face, without an engine: what is held beside the surface is a byte a face.

A face that the plane crosses is divided, and an edge that it crosses is divided once, for both its faces. Where the surface is closed and consistently
wound, one of these runs into the divided edge and the other out of it, so the new edges in the plane form rings, and a cap over the rings closes what
is left. That holds whatever the coordinates are, if no vertex counts as lying in the plane; the plane is moved a little to where none is near, so that
no new edge is so short that rounding to float32 turns a face over.
"""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray, float32_spacing_mm
from rangecheck.errors import NotSolid
from rangecheck.kernels import kernel
from rangecheck.modeler.engine import triangulate
from rangecheck.solid.slices import frame_of
from rangecheck.surface.surface import INVENTED, Surface

#: float32 steps: how clear of vertices the plane should lie, and the farthest that it is moved for it
CLEAR_STEPS, MOST_STEPS = 32, 2048


def cut_by_plane(whole: Surface, normal: FloatArray, height_mm: float, cap: str) -> Surface:
    """What of a closed surface lies above the plane normal . x = height_mm, with a cap of part `cap`. Faces keep part and origin, and their order.

    The plane is moved by up to MOST_STEPS float32 steps towards what is kept. Raises NotSolid where the surface is not closed at the plane."""
    heights = whole.vertices @ normal
    height = clear_height_mm(heights, height_mm, float32_spacing_mm(float(np.abs(whole.bounds_mm).max())))
    above = heights > height
    corners_above = count_above(whole.faces, above)
    kept = np.flatnonzero(corners_above == 3)
    crossed = np.flatnonzero((corners_above == 1) | (corners_above == 2))
    del corners_above
    used = np.zeros(len(whole.vertices), bool)
    used[whole.faces[crossed]] = True
    used &= above
    for first in range(0, len(kept), 1 << 20):
        used[whole.faces[kept[first : first + (1 << 20)]]] = True
    number = np.cumsum(used, dtype=np.int32) - 1
    edges, pieces, parent, into, out_of = _divided(whole.faces[crossed], above)
    points = _in_plane(whole.vertices, heights, edges, normal, height)
    rings = _rings(into, out_of, len(edges))
    right, front, _ = frame_of(-normal)
    flat = points @ np.stack([right, front], axis=1)
    order = np.concatenate(rings)
    lid = order[triangulate([flat[ring] for ring in rings])]
    old = int(used.sum())
    # a piece names a corner by its vertex, or a divided edge as -1 - edge
    pieces = np.where(pieces >= 0, number[np.maximum(pieces, 0)], old - 1 - pieces)
    faces = np.empty((len(kept) + len(pieces) + len(lid), 3), np.int32)
    for first in range(0, len(kept), 1 << 20):
        last = min(first + (1 << 20), len(kept))
        faces[first:last] = number[whole.faces[kept[first:last]]]
    faces[len(kept) : len(kept) + len(pieces)] = pieces
    faces[len(kept) + len(pieces) :] = old + lid
    origin = np.full(len(faces), INVENTED, np.uint8)
    source = np.concatenate([kept, crossed[parent]])
    origin[: len(source)] = whole.origin_of_face[source]
    names, part = _parts(whole, source, len(lid), cap)
    del kept, number, above, heights
    return Surface(np.concatenate([whole.vertices[used], points]), faces, part, origin, names)


def clear_height_mm(heights: FloatArray, height_mm: float, step_mm: float) -> float:
    """The height nearest to `height_mm`, from there up to MOST_STEPS steps, that is CLEAR_STEPS away from all `heights`, or else in the middle of
    the widest gap between these."""
    top = height_mm + MOST_STEPS * step_mm
    near = np.sort(heights[(heights > height_mm - CLEAR_STEPS * step_mm) & (heights < top)])
    if not len(near):
        return height_mm
    # the first of these gaps may be used from height_mm on only
    low = np.maximum(np.concatenate([[height_mm - CLEAR_STEPS * step_mm], near]), height_mm - CLEAR_STEPS * step_mm)
    high = np.concatenate([near, [top]])
    first_clear = np.maximum(low + CLEAR_STEPS * step_mm, height_mm)
    wide = np.flatnonzero(first_clear + CLEAR_STEPS * step_mm <= high)
    if len(wide):
        return float(first_clear[wide[0]])
    low = np.maximum(low, height_mm)
    widest = int(np.argmax(high - low))
    return float(0.5 * (low[widest] + high[widest]))


@kernel
def count_above(faces, above):
    """(m,) how many corners of each face are above."""
    count = np.empty(len(faces), np.uint8)
    for f in range(len(faces)):
        count[f] = np.uint8(above[faces[f, 0]]) + np.uint8(above[faces[f, 1]]) + np.uint8(above[faces[f, 2]])
    return count


def _divided(faces: IntArray, above: BoolArray) -> tuple[IntArray, IntArray, IntArray, IntArray, IntArray]:
    """Of faces (k, 3) that the plane crosses: the divided edges (e, 2), the lower vertex first; the pieces above, with divided edges as -1 - edge,
    and the face that each comes from; and for each face the divided edges between which a cap runs along it, from and to."""
    up = above[faces]
    lone_is_above = up.sum(axis=1) == 1
    lone = np.argmax(up == lone_is_above[:, None], axis=1)
    a, b, c = (faces[np.arange(len(faces)), (lone + k) % 3].astype(np.int64) for k in range(3))
    ends = np.sort(np.concatenate([np.stack([a, b], axis=1), np.stack([a, c], axis=1)]), axis=1)
    edges, edge = np.unique(ends, axis=0, return_inverse=True)
    ab, ac = edge.reshape(2, -1)
    one, two = np.flatnonzero(lone_is_above), np.flatnonzero(~lone_is_above)
    pieces = np.concatenate(
        [
            np.stack([a, -1 - ab, -1 - ac], axis=1)[one],
            np.stack([-1 - ab, b, c], axis=1)[two],
            np.stack([-1 - ab, c, -1 - ac], axis=1)[two],
        ]
    )
    into, out_of = np.where(lone_is_above, ac, ab), np.where(lone_is_above, ab, ac)
    return edges, pieces, np.concatenate([one, two, two]), into, out_of


def _in_plane(vertices: FloatArray, heights: FloatArray, edges: IntArray, normal: FloatArray, height: float) -> FloatArray:
    """(e, 3) where edges cross the plane."""
    low, high = edges.T
    share = (height - heights[low]) / (heights[high] - heights[low])
    points = vertices[low] + share[:, None] * (vertices[high] - vertices[low])
    # onto the plane itself, as far as rounding lets it
    return points - (points @ normal - height)[:, None] * normal


def _rings(into: IntArray, out_of: IntArray, count: int) -> list[IntArray]:
    """Divided edges in the order in which the cap runs along them. Raises NotSolid where one is not left and entered once each."""
    if (np.bincount(into, minlength=count) != 1).any() or (np.bincount(out_of, minlength=count) != 1).any():
        raise NotSolid("the surface is not closed where the plane cuts it; check_solid() says where it is open", findings=())
    following = np.empty(count, np.int64)
    following[into] = out_of
    rank, start = ring_order(following)
    return np.split(rank, start[1:])


@kernel
def ring_order(following):
    """All members, ring after ring, and where each ring begins."""
    order, done = np.empty(len(following), np.int64), np.zeros(len(following), np.bool_)
    start = np.empty(len(following), np.int64)
    count, rings = 0, 0
    for first in range(len(following)):
        if done[first]:
            continue
        start[rings] = count
        rings += 1
        at = first
        while not done[at]:
            done[at] = True
            order[count] = at
            count += 1
            at = following[at]
    return order, start[:rings]


def _parts(whole: Surface, source: IntArray, lid: int, cap: str) -> tuple[tuple[str, ...], IntArray]:
    """Names of the parts that are left, and the part of each face."""
    own = whole.part_of_face[source]
    there = np.bincount(own, minlength=len(whole.part_names)) > 0
    names = [name for name, is_there in zip(whole.part_names, there) if is_there]
    place = (np.cumsum(there, dtype=np.int32) - 1).astype(np.int32)
    if cap not in names:
        names.append(cap)
    return tuple(names), np.concatenate([place[own], np.full(lid, names.index(cap), np.int32)])
