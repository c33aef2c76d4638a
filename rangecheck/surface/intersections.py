"""Where a surface runs through itself.

Two faces may share a corner or an edge, known by equal coordinates whether welded or not; anything more they share is found and
named: CROSSING (each has area on both sides of the other's plane, and they meet along a segment), OVERLAP (coplanar, with common
area: folded over, duplicated, or laid upon each other) or TOUCHING (they meet without either). Signs are exact as far as
predicates.py says, so no tolerance enters. Faces without area are left out; topology.py names them.

Triangles against triangles by the intervals they cut from the line common to their planes, compared without computing the line:
Guigue and Devillers, *Fast and robust triangle-triangle overlap test using orientation predicates*, 2003.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rangecheck.arrays import IntArray
from rangecheck.kernels import in_chunks, inline_kernel, kernel
from rangecheck.surface.predicates import same_point, side_of_line, side_of_plane
from rangecheck.surface.surface import Surface
from rangecheck.surface.tree import TriangleTree, binary_centre, blocks_of, tree_over, triangle_tree

APART, CROSSING, OVERLAP, TOUCHING = 0, 1, 2, 3
KIND_NAMES = ("apart", "crossing", "overlap", "touching")
#: level of the tree whose nodes are tasks of their own
_TASK_LEVEL = 8
#: more faces than this are looked at in blocks of about so many
FACES_OF_BLOCK = 1 << 21


class Intersections(NamedTuple):
    """Pairs of faces that share more than a corner or an edge.

    pairs (k, 2) int32 faces, the lower index first, in ascending order
    kind  (k,) uint8 CROSSING, OVERLAP or TOUCHING
    """

    pairs: IntArray
    kind: IntArray

    def of_kind(self, *kinds: int) -> IntArray:
        """(j, 2) pairs of these kinds."""
        return self.pairs[np.isin(self.kind, kinds)]

    def faces(self, *kinds: int) -> IntArray:
        """(j,) faces involved in pairs of these kinds (all kinds if none is named)."""
        return np.unique(self.of_kind(*kinds) if kinds else self.pairs)


def self_intersections(surface: Surface) -> Intersections:
    """All pairs of faces of `surface` that cross, overlap or touch. Of large meshes the faces are looked at block by block, so that the boxes
    around those of one block are all that is held beside the mesh; what is found is the same."""
    if len(surface.faces) < 2:
        return Intersections(np.empty((0, 2), np.int32), np.empty(0, np.uint8))
    if len(surface.faces) <= FACES_OF_BLOCK:
        return _ascending(_meeting_in(triangle_tree(surface)))
    centre = binary_centre(surface)
    local = surface.vertices - centre
    found = []
    for block in blocks_of(local, surface.faces, FACES_OF_BLOCK):
        met = _meeting_in(tree_over(local, surface.faces[block], centre))
        found.append(np.column_stack([block[met[:, :2]], met[:, 2]]))
    # faces at a border belong to both blocks
    return _ascending(np.unique(np.concatenate(found), axis=0))


def _ascending(found: IntArray) -> Intersections:
    """Rows (face, face, kind) in any order."""
    pairs = np.sort(found[:, :2], axis=1)
    ascending = np.lexsort((pairs[:, 1], pairs[:, 0]))
    return Intersections(pairs[ascending], found[ascending, 2].astype(np.uint8))


def _meeting_in(tree: TriangleTree) -> IntArray:
    """(k, 3) int32 rows (face, face, kind), the lower face first, of the faces of a tree."""
    flat = np.concatenate(in_chunks(lambda first, last: flat_faces(tree.corners[first:last]), len(tree.order), 1 << 16))

    level = min(_TASK_LEVEL, tree.depth)

    def search(node: int, _: int) -> IntArray:
        found = np.empty((256, 3), np.int32)
        count = pairs_that_meet(tree.corners, flat, tree.boxes, tree.depth, level, node, found)
        if count > len(found):
            found = np.empty((count, 3), np.int32)
            pairs_that_meet(tree.corners, flat, tree.boxes, tree.depth, level, node, found)
        return found[:count]

    found = np.concatenate(in_chunks(search, 1 << level, 1))
    found[:, :2] = np.sort(tree.order[found[:, :2]], axis=1)
    return found


@kernel
def _triangle(corners, i):
    t = corners[i]
    return ((t[0], t[1], t[2]), (t[3], t[4], t[5]), (t[6], t[7], t[8]))


@inline_kernel
def _box_of(t):
    """Low and high corner of the box around a triangle (9,)."""
    return (
        min(t[0], t[3], t[6]), min(t[1], t[4], t[7]), min(t[2], t[5], t[8]),
        max(t[0], t[3], t[6]), max(t[1], t[4], t[7]), max(t[2], t[5], t[8]),
    )  # fmt: skip


@inline_kernel
def _apart(p, q):
    """Whether two boxes have no point in common."""
    return p[0] > q[3] or q[0] > p[3] or p[1] > q[4] or q[1] > p[4] or p[2] > q[5] or q[2] > p[5]


@kernel
def _projected_side(a, b, c, axis):
    """side_of_line of three points seen along an axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    return side_of_line(a[i], a[j], b[i], b[j], c[i], c[j])


@kernel
def _flat_axis(t):
    """An axis along which triangle t is seen with area, or -1 when it has none."""
    ux, uy, uz = t[1][0] - t[0][0], t[1][1] - t[0][1], t[1][2] - t[0][2]
    vx, vy, vz = t[2][0] - t[0][0], t[2][1] - t[0][1], t[2][2] - t[0][2]
    x, y, z = abs(uy * vz - uz * vy), abs(uz * vx - ux * vz), abs(ux * vy - uy * vx)
    widest = 0 if x >= y and x >= z else (1 if y >= z else 2)
    for k in range(3):
        axis = (widest + k) % 3
        if _projected_side(t[0], t[1], t[2], axis) != 0:
            return axis
    return -1


@kernel
def _coplanar(t, u):
    """Two triangles of one plane: OVERLAP with common area, TOUCHING with a common point, else APART."""
    axis = _flat_axis(t)
    result = OVERLAP
    for turn in range(2):
        first, second = (t, u) if turn == 0 else (u, t)
        inner = _projected_side(first[0], first[1], first[2], axis)
        for i in range(3):
            highest = -1
            for k in range(3):
                highest = max(highest, inner * _projected_side(first[i], first[(i + 1) % 3], second[k], axis))
            if highest < 0:
                return APART
            if highest == 0:
                result = TOUCHING
    return result


@kernel
def _lone_corner(s0, s1, s2):
    """The corner that its plane parts from the other two, and the side (1 or -1) that it counts to."""
    for i in range(3):
        s, q, r = (s0, s1, s2) if i == 0 else ((s1, s2, s0) if i == 1 else (s2, s0, s1))
        if s > 0 and q <= 0 and r <= 0:
            return i, 1
        if s < 0 and q >= 0 and r >= 0:
            return i, -1
    i = 0 if s0 == 0 else (1 if s1 == 0 else 2)
    return i, -(s0 + s1 + s2) // 2


@kernel
def meeting(t, u):
    """How triangles t and u, three points each and both with area, meet beyond the corners they share."""
    shared, t_sum, u_sum = 0, 0, 0
    for i in range(3):
        for j in range(3):
            if same_point(t[i], u[j]):
                shared, t_sum, u_sum = shared + 1, t_sum + i, u_sum + j
    if shared == 3:
        return OVERLAP
    if shared == 2:
        # corner indices add up to 3, so what is left names the corner that is not shared
        i, far = 3 - t_sum, u[3 - u_sum]
        if side_of_plane(t[0], t[1], t[2], far) != 0:
            return APART
        p, q, axis = t[(i + 1) % 3], t[(i + 2) % 3], _flat_axis(t)
        return OVERLAP if _projected_side(p, q, t[i], axis) == _projected_side(p, q, far, axis) else APART
    ua = side_of_plane(t[0], t[1], t[2], u[0])
    ub = side_of_plane(t[0], t[1], t[2], u[1])
    uc = side_of_plane(t[0], t[1], t[2], u[2])
    # the signs of all corners that are not shared agree: no point in common but the shared one
    if abs(ua + ub + uc) == 3 - shared:
        return APART
    if ua == 0 and ub == 0 and uc == 0:
        return _coplanar_meeting(t, u, shared)
    ta = side_of_plane(u[0], u[1], u[2], t[0])
    tb = side_of_plane(u[0], u[1], u[2], t[1])
    tc = side_of_plane(u[0], u[1], u[2], t[2])
    if abs(ta + tb + tc) == 3 - shared:
        return APART
    i, t_side = _lone_corner(ta, tb, tc)
    j, u_side = _lone_corner(ua, ub, uc)
    p1, q1, r1 = t[i], t[(i + 1) % 3], t[(i + 2) % 3]
    p2, q2, r2 = u[j], u[(j + 1) % 3], u[(j + 2) % 3]
    # wind both so that each one's lone corner is on the other's upper side
    if t_side < 0:
        q2, r2 = r2, q2
    if u_side < 0:
        q1, r1 = r1, q1
    start, end = side_of_plane(q1, q2, p2, p1), side_of_plane(p1, r2, p2, r1)
    if start > 0 or end > 0:
        return APART
    if start < 0 and end < 0:
        t_passes = min(ta, tb, tc) < 0 and max(ta, tb, tc) > 0
        u_passes = min(ua, ub, uc) < 0 and max(ua, ub, uc) > 0
        return CROSSING if t_passes and u_passes else TOUCHING
    return TOUCHING if shared == 0 else APART


@kernel
def _coplanar_meeting(t, u, shared):
    result = _coplanar(t, u)
    return APART if result == TOUCHING and shared > 0 else result


@kernel
def flat_faces(corners):
    """(m,) whether each triangle has no area, exactly."""
    flat = np.empty(len(corners), np.bool_)
    for i in range(len(corners)):
        flat[i] = _flat_axis(_triangle(corners, i)) < 0
    return flat


@kernel
def pairs_that_meet(corners, flat, boxes, depth, level, task, found):
    """Pairs (i, j, kind) of places in the tree, i < j, of which i lies below the node numbered `task` of `level`. Returns their number;
    those beyond the length of `found` are counted but not kept.

    Two nodes of one level are opened together where their boxes meet, so that a pair of faces is reached once, and far pairs never."""
    leaf_level = (1 << depth) - 1
    first = (1 << level) - 1
    waiting = np.empty((4 * (depth + 1), 2), np.int64)
    count = 0
    for start in range(first + task, 2 * first + 1):
        waiting[0, 0], waiting[0, 1] = first + task, start
        top = 1
        while top > 0:
            top -= 1
            a, b = waiting[top, 0], waiting[top, 1]
            if a != b and _apart(boxes[a], boxes[b]):
                continue
            if a >= leaf_level:
                count = _meetings_of_leaves(corners, flat, boxes[b], depth, a - leaf_level, b - leaf_level, found, count)
                continue
            for k in range(4):
                if a != b or k != 2:
                    waiting[top, 0], waiting[top, 1] = 2 * a + 1 + k // 2, 2 * b + 1 + k % 2
                    top += 1
    return count


@kernel
def _meetings_of_leaves(corners, flat, box, depth, a, b, found, count):
    """Adds the pairs of faces of leaves a <= b to `found`, of which `count` are known; `box` is that of leaf b. Returns their number."""
    n = len(corners)
    start, stop = (b * n) >> depth, ((b + 1) * n) >> depth
    for i in range((a * n) >> depth, ((a + 1) * n) >> depth):
        own = _box_of(corners[i])
        if flat[i] or _apart(own, box):
            continue
        for j in range(max(i + 1, start), stop):
            if flat[j] or _apart(own, _box_of(corners[j])):
                continue
            kind = meeting(_triangle(corners, i), _triangle(corners, j))
            if kind != APART:
                if count < len(found):
                    found[count, 0], found[count, 1], found[count, 2] = i, j, kind
                count += 1
    return count
