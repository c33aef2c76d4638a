"""The surface at a given depth inside a solid: the zero set of signed distance plus depth.

A grid is looked at in blocks of 16 cells a side, then of 8, 4 and 2. Distance changes by at most 1 mm per mm, so a block whose middle is
farther from the depth than half its diagonal holds no part of the zero set and is not looked at again. In those of 2 that are left every
cell is cut into six tetrahedra along its diagonal (Kuhn 1960), which fit together across cells, so that the zero set is closed and manifold by construction. Vertices are
interpolated along edges: exact for planes, off by step^2 / (8 radius) on curved walls; ridges, where the nearest side changes, are cut off
within a cell.
"""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import SurfaceError
from rangecheck.kernels import kernel
from rangecheck.surface.distance import SurfaceDistance
from rangecheck.surface.surface import INVENTED, Surface

COARSEST, BLOCK = 16, 2
#: corners of a cell as bits x, y, z; each path from corner 0 to corner 7 along three sides is one tetrahedron
_PATHS = np.array([[0, 1, 3, 7], [0, 1, 5, 7], [0, 2, 3, 7], [0, 2, 6, 7], [0, 4, 5, 7], [0, 4, 6, 7]])
#: whether each tetrahedron's corners, in this order, span a positive volume
_POSITIVE = np.array([True, False, False, True, True, False])


def inner_offset(surface: Surface, depth_mm: float, step_mm: float, *, most_blocks: int = 50_000) -> Surface | None:
    """The closed surface `depth_mm` inside a closed `surface`, facing outwards as a body of its own, on a grid of `step_mm`; None where
    nothing lies so deep. Raises SurfaceError when the grid would be too fine."""
    distance = SurfaceDistance(surface)
    low, high = surface.bounds_mm
    # an odd share of a step, so that flat faces do not fall onto nodes
    origin = low - np.array([0.37, 0.41, 0.43]) * step_mm
    shape = np.ceil((high - origin) / (COARSEST * step_mm)).astype(np.int64)
    if int(shape.prod()) > most_blocks:
        raise SurfaceError(f"a step of {step_mm:g} mm makes {int(shape.prod())} blocks; choose a larger one", step_mm=step_mm)
    block = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    size = COARSEST
    while True:
        middle = origin + (block + 0.5) * (size * step_mm)
        value = distance.signed_distance_mm(middle)[0] + depth_mm
        block = block[np.abs(value) <= 0.5 * np.sqrt(3.0) * size * step_mm]
        if not len(block):
            return None
        if size == BLOCK:
            break
        halves = np.stack(np.meshgrid(*(np.arange(2),) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        block = (2 * block[:, None] + halves).reshape(-1, 3)
        size //= 2
    nodes = shape * COARSEST + 1
    corner = np.stack(np.meshgrid(*(np.arange(BLOCK + 1),) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    index = (block[:, None] * BLOCK + corner).reshape(-1, 3)
    number = np.ravel_multi_index(tuple(index.T), tuple(nodes))
    unique, place = _numbered(number, int(nodes.prod()))
    at = np.stack(np.unravel_index(unique, tuple(nodes)), axis=1)
    values = distance.signed_distance_mm(origin + at * step_mm)[0] + depth_mm
    # a node exactly at the depth counts as outside: then every cut lies strictly between two nodes
    values[values == 0.0] = np.finfo(np.float64).tiny
    faces, ends = _march(values, place.reshape(len(block), -1))
    if not len(faces):
        return None
    key, corners = np.unique(ends[:, 0].astype(np.int64) * len(unique) + ends[:, 1], return_inverse=True)
    a, b = key // len(unique), key % len(unique)
    weight = values[a] / (values[a] - values[b])
    # no vertex nearer to a node than a thousandth of the edge: faces keep some area
    weight = np.clip(weight, 1e-3, 1 - 1e-3)[:, None]
    vertices = origin + step_mm * ((1 - weight) * at[a] + weight * at[b])
    faces = corners.reshape(-1, 3)
    return Surface(vertices, faces, origin_of_face=np.full(len(faces), INVENTED, np.uint8), part_names=("cavity",))


def _numbered(number: IntArray, most: int) -> tuple[IntArray, IntArray]:
    """Distinct numbers below `most`, ascending, and the place of each given one among them."""
    if most > 1 << 28:
        return np.unique(number, return_inverse=True)
    place = np.zeros(most, np.int32)
    place[number] = 1
    unique = np.flatnonzero(place)
    place[unique] = np.arange(len(unique), dtype=np.int32)
    return unique, place[number]


def _march(values: FloatArray, nodes_of_block: IntArray) -> tuple[IntArray, IntArray]:
    """Triangles as rows of three cut edges, and each cut edge's nodes (3k, 2), the lower first."""
    cell = np.stack(np.meshgrid(*(np.arange(BLOCK),) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    step = np.array([(BLOCK + 1) ** 2, BLOCK + 1, 1])
    bits = np.array([[(c >> 0) & 1, (c >> 1) & 1, (c >> 2) & 1] for c in range(8)])
    of_cell = (cell @ step)[:, None] + bits @ step
    ends = tetrahedra(values, nodes_of_block, of_cell, _PATHS, _POSITIVE)
    return np.arange(len(ends)).reshape(-1, 3), ends


@kernel
def tetrahedra(values, nodes_of_block, of_cell, paths, positive):
    """Cut edges (3k, 2) of all triangles; inside, where values are negative, lies behind each triangle."""
    count = 0
    ends = np.empty((1 << 16, 2), np.int64)
    inner, outer = np.empty(4, np.int64), np.empty(4, np.int64)
    for b in range(len(nodes_of_block)):
        for c in range(len(of_cell)):
            least, most = np.inf, -np.inf
            for k in range(8):
                value = values[nodes_of_block[b, of_cell[c, k]]]
                least, most = min(least, value), max(most, value)
            if least > 0.0 or most < 0.0:
                continue
            if count + 36 > len(ends):
                larger = np.empty((2 * len(ends), 2), np.int64)
                larger[:count] = ends[:count]
                ends = larger
            for t in range(6):
                n_in = n_out = 0
                # the parity of the order inner corners first, outer corners after, decides the winding
                swaps = 0
                for k in range(4):
                    node = nodes_of_block[b, of_cell[c, paths[t, k]]]
                    if values[node] < 0.0:
                        inner[n_in] = node
                        n_in += 1
                        swaps += n_out
                    else:
                        outer[n_out] = node
                        n_out += 1
                if n_in == 0 or n_out == 0:
                    continue
                even = (swaps % 2 == 0) == positive[t]
                if n_in == 1:
                    order = (0, 1, 2) if even else (0, 2, 1)
                    for k in range(3):
                        ends[count, 0], ends[count, 1] = inner[0], outer[order[k]]
                        count += 1
                elif n_in == 3:
                    order = (0, 1, 2) if even else (0, 2, 1)
                    for k in range(3):
                        ends[count, 0], ends[count, 1] = inner[order[k]], outer[0]
                        count += 1
                else:
                    # the quadrilateral inner-outer 00 01 11 10 as two triangles, or both turned over
                    for half in range(2):
                        for k in range(3):
                            j = k if even else (3 - k) % 3
                            i = (0, 0, 1, 0, 1, 1)[3 * half + j]
                            o = (0, 1, 1, 0, 1, 0)[3 * half + j]
                            ends[count, 0], ends[count, 1] = inner[i], outer[o]
                            count += 1
    for i in range(count):
        if ends[i, 0] > ends[i, 1]:
            ends[i, 0], ends[i, 1] = ends[i, 1], ends[i, 0]
    return ends[:count].copy()
