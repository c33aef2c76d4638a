"""A tree of boxes over a surface's faces: what distances and intersections share.

Faces are split at the median of their centroids along the widest axis, level by level, so that the tree is complete and needs no
pointers: node i has children 2 i + 1 and 2 i + 2, and leaf k of 2^depth holds the faces k n >> depth to (k + 1) n >> depth of
`order`. Float64 millimetres about a centre with few binary digits, so that distance from the origin costs no digits and moving
float32 coordinates to the centre rounds nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import SurfaceError
from rangecheck.kernels import in_chunks, kernel
from rangecheck.surface.surface import Surface

FACES_PER_LEAF = 4
#: levels split on one thread before subtrees are handed to several
_SHARED_LEVELS = 3
_CHUNK = 1 << 16
#: halves that together hold more than this many times their whole are not worth parting
_WORTH_PARTING = 1.25


@dataclass(frozen=True, eq=False)
class TriangleTree:
    """Boxes over m faces.

    order   (m,) int32 face in each place of the tree
    corners (m, 9) float64 its three corners, relative to `centre_mm`
    boxes   (2^(depth + 1) - 1, 6) float64 low and high corner of each node, relative to `centre_mm`
    depth   levels below the root
    """

    order: IntArray = field(repr=False)
    corners: FloatArray = field(repr=False)
    boxes: FloatArray = field(repr=False)
    depth: int
    centre_mm: FloatArray


_trees: WeakKeyDictionary[Surface, TriangleTree] = WeakKeyDictionary()


def triangle_tree(surface: Surface) -> TriangleTree:
    """The tree of `surface`, built once and kept as long as the surface lives. Raises SurfaceError without faces."""
    tree = _trees.get(surface)
    if tree is None:
        tree = _trees[surface] = _build(surface)
    return tree


def forget_tree(surface: Surface) -> None:
    """Keep the tree of a surface no longer: of a large mesh it is more than the mesh."""
    _trees.pop(surface, None)


def _build(surface: Surface) -> TriangleTree:
    if len(surface.faces) == 0:
        raise SurfaceError("the surface has no faces; there is nothing to measure against")
    centre = binary_centre(surface)
    return tree_over(surface.vertices - centre, surface.faces, centre)


def binary_centre(surface: Surface) -> FloatArray:
    """(3,) about the middle of a surface, with few binary digits."""
    step = 2.0 ** (math.floor(math.log2(max(surface.extent_mm, 2.0**-126))) - 2)
    centre: FloatArray = np.round(surface.bounds_mm.mean(axis=0) / step) * step
    return centre


def tree_over(local: FloatArray, faces: IntArray, centre_mm: FloatArray) -> TriangleTree:
    """The tree over faces (n, 3), at least one, of vertices that are given relative to `centre_mm`."""
    n = len(faces)
    depth = max(0, math.ceil(math.log2(n / FACES_PER_LEAF)))
    keys, corners = np.empty((n, 3)), np.empty((n, 9))
    in_chunks(lambda first, last: sums_of_corners(local, faces, first, last, keys), n, _CHUNK)
    order = np.arange(n, dtype=np.int32)
    shared = min(_SHARED_LEVELS, depth)
    arrange(keys, order, 0, 0, shared, depth)
    if depth > shared:
        in_chunks(lambda first, _: arrange(keys, order, shared, first, depth, depth), 1 << shared, 1)
    in_chunks(lambda first, last: gathered(local, faces, order, first, last, corners), n, _CHUNK)
    boxes = np.empty(((2 << depth) - 1, 6))
    leaves = 1 << depth
    in_chunks(lambda first, last: leaf_boxes(corners, depth, first, last, boxes), leaves, 1 << 14)
    for level in range(depth - 1, -1, -1):
        below = boxes[(2 << level) - 1 : (4 << level) - 1].reshape(-1, 2, 6)
        here = boxes[(1 << level) - 1 : (2 << level) - 1]
        np.minimum(below[:, 0, :3], below[:, 1, :3], out=here[:, :3])
        np.maximum(below[:, 0, 3:], below[:, 1, 3:], out=here[:, 3:])
    return TriangleTree(order, corners, boxes, depth, centre_mm)


def blocks_of(vertices: FloatArray, faces: IntArray, most: int) -> Iterator[IntArray]:
    """Faces (k,) int32, about `most` at a time, so that any two that have a point in common come together at least once: halved at planes,
    those that a plane cuts or touches on both sides. Where planes part little, as of a fan around one vertex, there are more at a time."""
    waiting: list[IntArray] = [np.arange(len(faces), dtype=np.int32)]
    while waiting:
        mine = waiting.pop()
        halves = _parted(vertices, faces, mine) if len(mine) > most else None
        if halves is None:
            yield mine
        else:
            waiting += halves


def _parted(vertices: FloatArray, faces: IntArray, mine: IntArray) -> list[IntArray] | None:
    low, high = np.empty(len(mine)), np.empty(len(mine))
    bounds = bounds_of_faces(vertices, faces, mine)
    for axis in np.argsort(bounds[0] - bounds[1], kind="stable"):
        extremes_of_faces(vertices, faces, mine, axis, low, high)
        plane = np.partition(low, len(low) // 2)[len(low) // 2]
        before, behind = mine[low <= plane], mine[high >= plane]
        if len(before) + len(behind) <= _WORTH_PARTING * len(mine):
            return [behind, before]
    return None


@kernel
def bounds_of_faces(vertices, faces, chosen):
    """(2, 3) low and high corner of the box around some faces."""
    bounds = np.empty((2, 3))
    bounds[0], bounds[1] = np.inf, -np.inf
    for f in chosen:
        for corner in range(3):
            for axis in range(3):
                value = vertices[faces[f, corner], axis]
                bounds[0, axis], bounds[1, axis] = min(bounds[0, axis], value), max(bounds[1, axis], value)
    return bounds


@kernel
def extremes_of_faces(vertices, faces, chosen, axis, low, high):
    """Lowest and highest coordinate of some faces along an axis."""
    for k in range(len(chosen)):
        f = chosen[k]
        a, b, c = vertices[faces[f, 0], axis], vertices[faces[f, 1], axis], vertices[faces[f, 2], axis]
        low[k], high[k] = min(a, b, c), max(a, b, c)


@kernel
def sums_of_corners(vertices, faces, first, last, keys):
    """Three times the centroids of the faces first:last."""
    for f in range(first, last):
        for axis in range(3):
            keys[f, axis] = vertices[faces[f, 0], axis] + vertices[faces[f, 1], axis] + vertices[faces[f, 2], axis]


@kernel
def gathered(vertices, faces, order, first, last, corners):
    """Corners of the faces in the places first:last of the tree."""
    for place in range(first, last):
        for corner in range(3):
            for axis in range(3):
                corners[place, 3 * corner + axis] = vertices[faces[order[place], corner], axis]


@kernel
def arrange(keys, order, level, node, stop_level, depth):
    """Sort `order` (and `keys` with it) so that the subtree of `node` at `level` is split down to `stop_level`."""
    n = len(order)
    for current in range(level, stop_level):
        first = node << (current - level)
        for k in range(first, first + (1 << (current - level))):
            start, middle, stop = (k * n) >> current, ((2 * k + 1) * n) >> (current + 1), ((k + 1) * n) >> current
            widest, axis = -1.0, 0
            for a in range(3):
                low = high = keys[start, a]
                for i in range(start + 1, stop):
                    value = keys[i, a]
                    if value < low:
                        low = value
                    elif value > high:
                        high = value
                if high - low > widest:
                    widest, axis = high - low, a
            _select(keys, order, start, middle, stop - 1, axis)


@kernel
def _select(keys, order, left, middle, right, axis):
    """Hoare's selection: afterwards nothing before `middle` is larger along `axis` than anything from it on."""
    while left < right:
        a, b, c = keys[left, axis], keys[(left + right) >> 1, axis], keys[right, axis]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = left, right
        while i <= j:
            while keys[i, axis] < pivot:
                i += 1
            while keys[j, axis] > pivot:
                j -= 1
            if i <= j:
                for k in range(3):
                    keys[i, k], keys[j, k] = keys[j, k], keys[i, k]
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            right = j
        elif middle >= i:
            left = i
        else:
            return


@kernel
def leaf_boxes(corners, depth, first, last, boxes):
    """Boxes of the leaves `first` to `last`."""
    n = len(corners)
    for leaf in range(first, last):
        node = (1 << depth) - 1 + leaf
        for axis in range(3):
            low, high = np.inf, -np.inf
            for i in range((leaf * n) >> depth, ((leaf + 1) * n) >> depth):
                for corner in range(3):
                    value = corners[i, 3 * corner + axis]
                    low, high = min(low, value), max(high, value)
            boxes[node, axis], boxes[node, 3 + axis] = low, high
