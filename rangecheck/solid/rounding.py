"""What rounding to float32 does to a closed mesh, mended without moving a vertex.

Rounding can put several vertices on one point, and a vertex on its face's opposite edge. The first closes faces to lines: welding the
vertices and leaving those faces out keeps the mesh closed. The second leaves a face with three corners in line: exchanging the diagonal
with the neighbour across its longest edge gives both faces area again.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangecheck.arrays import IntArray
from rangecheck.surface import topology as topo
from rangecheck.surface.surface import Surface
from rangecheck.surface.weld import weld_exactly


def collapse_flat_faces(surface: Surface) -> Surface:
    """`surface` with equal vertices welded, faces closed to lines left out, and faces without area given some by turning diagonals.

    No vertex moves. What cannot be mended so is left for the check to name."""
    welded = _welded(surface)
    for _ in range(8):
        flat = topo.degenerate_faces(welded)
        if not len(flat):
            break
        turned = _turned_diagonals(welded, flat)
        if turned is None:
            break
        welded = replace(welded, faces=turned)
    return welded


def _welded(surface: Surface) -> Surface:
    first, number = weld_exactly(surface.vertices)
    # where all are different they were numbered as they are
    faces = number[surface.faces] if len(first) < len(number) else surface.faces
    keep = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    if len(first) == len(number) and keep.all():
        return replace(surface, refined_of_face=None)
    error = None if surface.vertex_error_mm is None else surface.vertex_error_mm[first]
    return Surface(
        surface.vertices[first], faces[keep], surface.part_of_face[keep], surface.origin_of_face[keep], surface.part_names, error
    )


def _turned_diagonals(surface: Surface, flat: IntArray) -> IntArray | None:
    """Faces with the longest edge of each flat face exchanged for the other diagonal; None when nothing could be turned."""
    table = topo.edge_table(surface)
    faces = surface.faces.copy()
    known = {tuple(e) for e in table.ends[np.isin(table.ends, faces[flat]).any(axis=1)].tolist()}
    touched: set[int] = set()
    for f in flat.tolist():
        corners = surface.vertices[faces[f]]
        side = int(np.argmax(((np.roll(corners, -1, axis=0) - corners) ** 2).sum(axis=1)))
        edge = table.edge_of_half[3 * f + side]
        if edge < 0 or table.uses[edge] != 2:
            continue
        g = int(table.halves[table.start[edge] : table.start[edge + 1]].sum()) - (3 * f + side)
        g, other = g // 3, g % 3
        a, b, tip = (int(faces[f, (side + k) % 3]) for k in range(3))
        far = int(faces[g, (other + 2) % 3])
        if f in touched or g in touched or tip == far or (min(tip, far), max(tip, far)) in known:
            continue
        faces[f], faces[g] = (a, far, tip), (far, b, tip)
        known.add((min(tip, far), max(tip, far)))
        touched |= {f, g}
    return faces if touched else None
