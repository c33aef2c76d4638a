"""Fewer triangles of any surface, solid or not: vertices of one cell become one (Rossignac and Borrel, *Multi-resolution 3D approximations
for rendering complex scenes*, 1993). Millimetres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangecheck.errors import SettingError
from rangecheck.surface.surface import Surface


def clustered(surface: Surface, cell_mm: float) -> Surface:
    """`surface` with all vertices of one cubic cell joined at their mean, and without the faces that lose their area by it; nothing moves
    farther than the cell's diagonal. Neither closedness nor topology is kept. Raises SettingError for a cell that is no length."""
    if not (np.isfinite(cell_mm) and cell_mm > 0):
        raise SettingError(f"cell_mm is {cell_mm}; a positive length is needed", key="cell_mm")
    if not len(surface.faces):
        return surface
    cell = np.floor((surface.vertices - surface.vertices.min(axis=0)) / cell_mm).astype(np.int64)
    _, place = np.unique(cell, axis=0, return_inverse=True)
    place = place.reshape(-1)
    number = np.bincount(place)
    middle = np.stack([np.bincount(place, surface.vertices[:, axis]) / number for axis in range(3)], axis=1)
    error = surface.vertex_error_mm
    joined = replace(
        surface,
        vertices=middle,
        faces=place[surface.faces].astype(np.int32),
        vertex_error_mm=None if error is None else np.bincount(place, error) / number,
    )
    a, b, c = joined.faces.T
    return joined.with_faces(np.flatnonzero((a != b) & (b != c) & (c != a)))
