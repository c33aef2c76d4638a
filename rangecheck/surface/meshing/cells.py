"""The 256 ways a surface can cross a cell, generated, and the faces between neighbouring cells that leave two ways open.

Corner c of a cell lies at (c & 1, c >> 1 & 1, c >> 2). A case is the byte of its corners inside (field < 0). Edge e = 4 axis + k
runs along `axis` from the k-th corner whose bit of that axis is 0, in ascending order. Nielson (2004), "Dual marching cubes":
one vertex per separate sheet of surface in a cell, one quadrilateral per grid edge that the surface crosses.

Where the four corners of a face alternate, two sheets could be joined either way, and both joined twice would make an edge of
four faces. No such face is left: the field is mended first (see `blocks.part_touching`). Then every face carries at most one
arc, two cells share at most one edge of the mesh, and the quadrilaterals around a vertex follow the one loop of its sheet: the
mesh is a closed 2-manifold by construction.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rangecheck.arrays import IntArray


def edges_of_cell() -> IntArray:
    """(12, 2) corners at the ends of each edge."""
    edges = []
    for axis in range(3):
        edges += [(c, c | 1 << axis) for c in range(8) if not c >> axis & 1]
    return np.array(edges, np.int64)


@lru_cache(maxsize=1)
def sheets() -> tuple[IntArray, IntArray]:
    """count (256,) sheets in each case; sheet_of_edge (256, 12): which sheet crosses each edge, -1 for none.

    Two crossed edges belong to one sheet when they lie on a common face (an alternating face, which never remains, keeps its
    inside corners apart)."""
    edges = edges_of_cell()
    count, sheet_of_edge = np.zeros(256, np.uint8), np.full((256, 12), -1, np.int8)
    faces = [[c for c in range(8) if (c >> axis & 1) == side] for axis in range(3) for side in (0, 1)]
    for case in range(256):
        inside = [bool(case >> c & 1) for c in range(8)]
        crossed = [e for e, (a, b) in enumerate(edges) if inside[a] != inside[b]]
        parent = {e: e for e in crossed}

        def root(e: int, parent: dict[int, int] = parent) -> int:
            while parent[e] != e:
                e = parent[e]
            return e

        for face in faces:
            on_face = [e for e in crossed if edges[e][0] in face and edges[e][1] in face]
            if len(on_face) == 2:
                parent[root(on_face[0])] = root(on_face[1])
            elif len(on_face) == 4:
                for corner in (c for c in face if inside[c]):
                    a, b = (e for e in on_face if corner in edges[e])
                    parent[root(a)] = root(b)
        roots = sorted({root(e) for e in crossed})
        count[case] = len(roots)
        for e in crossed:
            sheet_of_edge[case, e] = roots.index(root(e))
    return count, sheet_of_edge
