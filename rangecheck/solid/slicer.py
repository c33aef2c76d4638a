"""What a slicer makes of a file: STL's corners come without indices, so every program welds them by its own rule.

Some weld equal corners only; others weld what lies within a small distance, and so join sheets that nearly touch and close short edges.
A part is safe when it stays a closed manifold under both.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rangecheck.arrays import float32_spacing_mm
from rangecheck.solid.findings import Finding, finding
from rangecheck.surface import topology as topo
from rangecheck.surface.surface import Surface

#: default distance within which corners are welded, in float32 steps at the part's farthest coordinate
WELD_STEPS = 64


def weld_distance_mm(surface: Surface) -> float:
    """The distance within which `welded_within` joins corners unless told otherwise."""
    return WELD_STEPS * float32_spacing_mm(float(np.abs(surface.bounds_mm).max()))


def welded_within(surface: Surface, distance_mm: float) -> Surface:
    """`surface` with vertices nearer than `distance_mm` to each other made one (chains of them too), faces that closes left out."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    near = cKDTree(surface.vertices).query_pairs(distance_mm, output_type="ndarray")
    if not len(near):
        return surface
    n = len(surface.vertices)
    _, group = connected_components(coo_matrix((np.ones(len(near), np.int8), (near[:, 0], near[:, 1])), shape=(n, n)), False)
    _, first = np.unique(group, return_index=True)
    faces = first[group[surface.faces]]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return Surface(surface.vertices, faces[whole], surface.part_of_face[whole], surface.origin_of_face[whole], surface.part_names)


def weld_findings(
    surface: Surface, distance_mm: float | None = None, severities: Mapping[str, str] | None = None
) -> list[Finding]:
    """What is no longer a closed manifold once corners within `distance_mm` (None: WELD_STEPS float32 steps) are welded."""
    distance = weld_distance_mm(surface) if distance_mm is None else distance_mm
    welded = welded_within(surface, distance)
    if welded is surface:
        return []
    places = []
    words = []
    for find, what in (
        (topo.boundary_edges, "open edges"),
        (topo.non_manifold_edges, "edges with more than two faces"),
        (topo.inconsistent_edges, "edges between faces that face opposite ways"),
    ):
        culprits = find(welded)
        if len(culprits):
            words.append(f"{len(culprits)} {what}")
            places.append(welded.vertices[culprits].mean(axis=1))
    vertices = topo.non_manifold_vertices(welded)
    if len(vertices):
        words.append(f"{len(vertices)} vertices that join sheets in a point")
        places.append(welded.vertices[vertices])
    if not words:
        return []
    joined = len(np.unique(surface.faces)) - len(np.unique(welded.faces))
    message = (
        f"welding corners within {distance:.2g} mm, as some slicers do, joins {joined} vertices and leaves {', '.join(words)}"
    )
    where = np.concatenate(places)
    return [finding("weld-sensitive", len(where), message, where, None, severities, distance_mm=distance)]
