"""The zero set of a sparse grid as triangles: dual marching cubes (see `cells` for why the result is a closed 2-manifold)."""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.kernels import in_chunks, kernel
from rangecheck.surface.meshing.blocks import Grid, find, gather
from rangecheck.surface.meshing.cells import edges_of_cell, sheets
from rangecheck.surface.meshing.distance import CORNERS, SEEN

#: a vertex keeps this share of a step away from the faces of its cell, so that no two meet after rounding
MARGIN = 0.03


@kernel
def _cases(near, place, field, coarse, count, first, last, case, vertices):
    box = np.empty((9, 9, 9), np.float32)
    for b in range(first, last):
        gather(near, place, field, coarse, b, 0, box)
        total = 0
        for corner in range(CORNERS):
            i, j, k = corner & 7, corner >> 3 & 7, corner >> 6
            code = 0
            for c in range(8):
                if box[i + (c & 1), j + (c >> 1 & 1), k + (c >> 2)] < 0.0:
                    code |= 1 << c
            case[b, corner] = code
            total += count[code]
        vertices[b] = total


@kernel
def _vertices(
    near, place, field, state, coarse, case, start, count, sheet_of_edge, edges, origin, step, first, last,
    number, points, normals, cell_low, seen,
):  # fmt: skip
    """One vertex per sheet: the mean of its edge crossings. `seen`: all values it came from were measured."""
    box = np.empty((9, 9, 9), np.float32)
    known = np.empty((9, 9, 9), np.float32)
    sums = np.empty((4, 4))
    for b in range(first, last):
        if start[b + 1] == start[b]:
            continue
        gather(near, place, field, coarse, b, 0, box)
        gather(near, place, state, coarse, b, 0, known)
        at = start[b]
        for corner in range(CORNERS):
            code = case[b, corner]
            number[b, corner] = at
            if count[code] == 0:
                continue
            i, j, k = corner & 7, corner >> 3 & 7, corner >> 6
            sums[:] = 0.0
            whole = True
            for e in range(12):
                sheet = sheet_of_edge[code, e]
                if sheet < 0:
                    continue
                p, q = edges[e, 0], edges[e, 1]
                fp = box[i + (p & 1), j + (p >> 1 & 1), k + (p >> 2)]
                fq = box[i + (q & 1), j + (q >> 1 & 1), k + (q >> 2)]
                t = min(max(fp / (fp - fq), 0.0), 1.0)
                sums[sheet, 0] += (p & 1) + t * ((q & 1) - (p & 1))
                sums[sheet, 1] += (p >> 1 & 1) + t * ((q >> 1 & 1) - (p >> 1 & 1))
                sums[sheet, 2] += (p >> 2) + t * ((q >> 2) - (p >> 2))
                sums[sheet, 3] += 1.0
                whole = whole and known[i + (p & 1), j + (p >> 1 & 1), k + (p >> 2)] == SEEN
                whole = whole and known[i + (q & 1), j + (q >> 1 & 1), k + (q >> 2)] == SEEN
            gx = gy = gz = 0.0
            for c in range(8):
                value = box[i + (c & 1), j + (c >> 1 & 1), k + (c >> 2)]
                gx += value if c & 1 else -value
                gy += value if c >> 1 & 1 else -value
                gz += value if c >> 2 else -value
            length = np.sqrt(gx * gx + gy * gy + gz * gz) + 1e-30
            low = (8 * place[b, 0] + i, 8 * place[b, 1] + j, 8 * place[b, 2] + k)
            for sheet in range(count[code]):
                for axis in range(3):
                    cell_low[at, axis] = origin[axis] + step * low[axis]
                    inside = min(max(sums[sheet, axis] / sums[sheet, 3], MARGIN), 1.0 - MARGIN)
                    points[at, axis] = cell_low[at, axis] + step * inside
                normals[at, 0], normals[at, 1], normals[at, 2] = gx / length, gy / length, gz / length
                seen[at] = whole and count[code] == 1
                at += 1


@kernel
def _quads(near, field, case, number, sheet_of_edge, edge_number, first, last, start, quads):
    """Count (when quads is empty) or write the quadrilaterals of the edges whose lowest corner lies in each block."""
    write = len(quads) > 0
    corners = np.empty(4, np.int64)
    for b in range(first, last):
        n = start[b] if write else 0
        for corner in range(CORNERS):
            i, j, k = corner & 7, corner >> 3 & 7, corner >> 6
            here = field[b, corner] < 0.0
            for axis in range(3):
                row, other = find(near, b, i + (axis == 0), j + (axis == 1), k + (axis == 2))
                if row < 0 or here == (field[row, other] < 0.0):
                    continue
                if write:
                    whole = True
                    for c in range(4):
                        # counter-clockwise seen from the far end of the edge
                        back_1, back_2 = (1, 0, 0, 1)[c], (1, 1, 0, 0)[c]
                        one, two = (axis + 1) % 3, (axis + 2) % 3
                        x = i - (back_1 * (one == 0) + back_2 * (two == 0))
                        y = j - (back_1 * (one == 1) + back_2 * (two == 1))
                        z = k - (back_1 * (one == 2) + back_2 * (two == 2))
                        cell_row, cell = find(near, b, x, y, z)
                        if cell_row < 0:
                            whole = False
                            break
                        sheet = sheet_of_edge[case[cell_row, cell], edge_number[axis, back_1, back_2]]
                        corners[c if here else 3 - c] = number[cell_row, cell] + sheet
                    for c in range(4):
                        quads[n, c] = corners[c] if whole else 0
                n += 1
        if not write:
            start[b] = n


def edge_numbers() -> IntArray:
    """(3, 2, 2): number of the edge along an axis that lies at side a of the next axis and side b of the one after."""
    table = np.empty((3, 2, 2), np.int64)
    edges = edges_of_cell()
    for axis in range(3):
        for a in range(2):
            for b in range(2):
                corner = a << (axis + 1) % 3 | b << (axis + 2) % 3
                table[axis, a, b] = next(e for e in range(4 * axis, 4 * axis + 4) if edges[e, 0] == corner)
    return table


def zero_set(grid: Grid, coarse: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, IntArray]:
    """Vertices (n, 3) mm, unit normals (n, 3), low corners of their cells (n, 3), seen (n,) bool, and quadrilaterals (m, 4),
    counter-clockwise from outside."""
    blocks = len(grid.place)
    count, sheet_of_edge = sheets()
    edges, table = edges_of_cell(), edge_numbers()
    case, per_block = np.empty((blocks, CORNERS), np.uint8), np.zeros(blocks, np.int64)
    in_chunks(lambda i, j: _cases(grid.near, grid.place, grid.field, coarse, count, i, j, case, per_block), blocks, 256)
    start = np.concatenate([[0], np.cumsum(per_block)])
    n = int(start[-1])
    number = np.zeros((blocks, CORNERS), np.int32)
    points, normals, low, seen = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3)), np.zeros(n, bool)
    in_chunks(
        lambda i, j: _vertices(
            grid.near, grid.place, grid.field, grid.state, coarse, case, start, count, sheet_of_edge, edges,
            grid.origin_mm, grid.step_mm, i, j, number, points, normals, low, seen,
        ),
        blocks, 256,
    )  # fmt: skip
    none = np.empty((0, 4), np.int32)
    faces_start = np.zeros(blocks, np.int64)
    in_chunks(
        lambda i, j: _quads(grid.near, grid.field, case, number, sheet_of_edge, table, i, j, faces_start, none), blocks, 256
    )
    ends = np.cumsum(faces_start)
    quads = np.empty((int(ends[-1]), 4), np.int32)
    starts = ends - faces_start
    in_chunks(lambda i, j: _quads(grid.near, grid.field, case, number, sheet_of_edge, table, i, j, starts, quads), blocks, 256)
    return points, normals, low, seen, quads


@kernel
def _split(points, quads, first, last, faces):
    for q in range(first, last):
        a, b, c, d = quads[q, 0], quads[q, 1], quads[q, 2], quads[q, 3]
        ac = bd = 0.0
        for axis in range(3):
            ac += (points[a, axis] - points[c, axis]) ** 2
            bd += (points[b, axis] - points[d, axis]) ** 2
        if ac <= bd:
            faces[2 * q, 0], faces[2 * q, 1], faces[2 * q, 2] = a, b, c
            faces[2 * q + 1, 0], faces[2 * q + 1, 1], faces[2 * q + 1, 2] = a, c, d
        else:
            faces[2 * q, 0], faces[2 * q, 1], faces[2 * q, 2] = a, b, d
            faces[2 * q + 1, 0], faces[2 * q + 1, 1], faces[2 * q + 1, 2] = b, c, d


def split_quads(points_mm: FloatArray, quads: IntArray) -> IntArray:
    """(2 m, 3) triangles: each quadrilateral cut along its shorter diagonal."""
    faces = np.empty((2 * len(quads), 3), np.int32)
    in_chunks(lambda i, j: _split(points_mm, quads, i, j, faces), len(quads), 65536)
    return faces
