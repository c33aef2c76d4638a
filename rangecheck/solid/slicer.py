"""What a slicer makes of a file: STL's corners come without indices, so every program welds them by its own rule.

Some weld equal corners only; others weld what lies within a small distance, and so join sheets that nearly touch and close short edges.
A part is safe when it stays a closed manifold under both.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray, float32_spacing_mm
from rangecheck.solid.findings import Finding, finding
from rangecheck.surface import topology as topo
from rangecheck.surface.surface import FACES_AT_ONCE, Surface

#: default distance within which corners are welded, in float32 steps at the part's farthest coordinate
WELD_STEPS = 64


def weld_distance_mm(surface: Surface) -> float:
    """The distance within which `welded_within` joins corners unless told otherwise."""
    return WELD_STEPS * float32_spacing_mm(float(np.abs(surface.bounds_mm).max()))


def welded_within(surface: Surface, distance_mm: float) -> Surface:
    """`surface` with vertices nearer than `distance_mm` to each other made one (chains of them too), faces that closes left out."""
    target = _joined_to(surface.vertices, distance_mm)
    return surface if target is None else _with_faces(surface, target[surface.faces])


def _joined_to(vertices: FloatArray, distance_mm: float) -> IntArray | None:
    """(n,) int32 the vertex that each becomes, the lowest of those that are made one; None where none are."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    near = cKDTree(vertices).query_pairs(distance_mm, output_type="ndarray")
    if not len(near):
        return None
    # numbered among themselves: of a large mesh they are few
    joined, place = np.unique(near, return_inverse=True)
    place = place.reshape(-1, 2)
    n = len(joined)
    _, group = connected_components(coo_matrix((np.ones(len(near), np.int8), (place[:, 0], place[:, 1])), shape=(n, n)), False)
    _, first = np.unique(group, return_index=True)
    target: IntArray = np.arange(len(vertices), dtype=np.int32)
    target[joined] = joined[first[group]]
    return target


def _with_faces(surface: Surface, faces: IntArray) -> Surface:
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return Surface(surface.vertices, faces[whole])


def _faces_at(faces: IntArray, vertices: BoolArray) -> IntArray:
    """(k, 3) the faces that name one of some vertices."""
    pieces = (faces[first : first + FACES_AT_ONCE] for first in range(0, len(faces), FACES_AT_ONCE))
    return np.concatenate([piece[vertices[piece].any(axis=1)] for piece in pieces])


def weld_findings(
    surface: Surface, distance_mm: float | None = None, severities: Mapping[str, str] | None = None
) -> list[Finding]:
    """What of a closed manifold is none any longer once corners within `distance_mm` (None: WELD_STEPS float32 steps) are welded. Looked at are
    the faces around what was made one, and their neighbours: elsewhere nothing changes."""
    distance = weld_distance_mm(surface) if distance_mm is None else distance_mm
    target = _joined_to(surface.vertices, distance)
    if target is None:
        return []
    gone = np.flatnonzero(target != np.arange(len(target)))
    changed = np.zeros(len(target), bool)
    changed[gone] = changed[target[gone]] = True
    changed[_faces_at(surface.faces, changed)] = True
    before = _faces_at(surface.faces, changed)
    welded = _with_faces(surface, target[before])
    places = []
    words = []
    for find, what in (
        (topo.boundary_edges, "open edges"),
        (topo.non_manifold_edges, "edges with more than two faces"),
        (topo.inconsistent_edges, "edges between faces that face opposite ways"),
    ):
        culprits = find(welded)
        culprits = culprits[changed[culprits].any(axis=1)]
        if len(culprits):
            words.append(f"{len(culprits)} {what}")
            places.append(welded.vertices[culprits].mean(axis=1))
    vertices = topo.non_manifold_vertices(welded)
    vertices = vertices[changed[vertices]]
    if len(vertices):
        words.append(f"{len(vertices)} vertices that join sheets in a point")
        places.append(welded.vertices[vertices])
    if not words:
        return []
    joined = len(np.unique(before)) - len(np.unique(welded.faces))
    message = (
        f"welding corners within {distance:.2g} mm, as some slicers do, joins {joined} vertices and leaves {', '.join(words)}"
    )
    where = np.concatenate(places)
    return [finding("weld-sensitive", len(where), message, where, None, severities, distance_mm=distance)]
