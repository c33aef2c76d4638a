"""How far a surface is closed over what nobody measured: closed, half closed, or open. Millimetres.

A patch is a connected set of invented faces. Closed keeps all patches; half keeps those whose extent (the diagonal of the box around
them) is at most a stated size; open keeps none. Where taking patches away would leave two sheets meeting in one vertex, the faces
around that vertex go too, so that what remains is a manifold with borders.
"""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import SettingError
from rangecheck.surface.meshing.shells import shell_of_vertex
from rangecheck.surface.surface import INVENTED, Surface
from rangecheck.surface.topology import non_manifold_vertices

MODES = ("open", "half", "closed")


def opened(surface: Surface, closing: str, largest_hole_mm: float | None = None) -> Surface:
    """The surface without the invented patches that `closing` does not keep.

    Raises SettingError for an unknown mode, or for `half` without a positive `largest_hole_mm`."""
    if closing not in MODES:
        raise SettingError(f"closing is {closing!r}; it must be one of {', '.join(MODES)}", key="meshing.closing")
    if closing == "closed":
        return surface
    remove = surface.origin_of_face == INVENTED
    if closing == "half":
        if largest_hole_mm is None or not largest_hole_mm > 0:
            raise SettingError(
                f"closing is half and largest_hole_mm {largest_hole_mm}; say up to which size in mm holes are closed",
                key="meshing.largest_hole_mm",
            )
        remove[remove] = patch_extents(surface)[1] > largest_hole_mm
    if not remove.any():
        return surface
    kept = surface.with_faces(np.flatnonzero(~remove))
    while len(pinched := non_manifold_vertices(kept)):
        touching = np.isin(kept.faces, pinched).any(axis=1)
        kept = kept.with_faces(np.flatnonzero(~touching))
    return kept


def patch_extents(surface: Surface) -> tuple[IntArray, FloatArray]:
    """Of each invented face, in their order: (k,) number of its patch, (k,) extent of that patch in mm."""
    faces = surface.faces[surface.origin_of_face == INVENTED]
    used, local = np.unique(faces, return_inverse=True)
    local = local.reshape(-1, 3).astype(np.int32)
    patch = shell_of_vertex(local, len(used))
    count = int(patch.max()) + 1 if len(patch) else 0
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, patch, surface.vertices[used])
    np.maximum.at(high, patch, surface.vertices[used])
    extent = np.linalg.norm(high - low, axis=1)
    of_face = patch[local[:, 0]] if len(local) else np.empty(0, np.int32)
    return of_face, extent[of_face]
