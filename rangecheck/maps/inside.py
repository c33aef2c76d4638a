"""Is a focal point inside the matter? Generalised winding number of triangles about a point.

The sum of the triangles' signed solid angles over 4 pi is 1 inside a closed surface with outward faces, 0 outside it and in its
cavities, and a fraction where the surface is open (Jacobson, Kavan, Sorkine-Hornung, *Robust inside-outside segmentation using
generalized winding numbers*, 2013).
"""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import FloatArray, require
from rangecheck.errors import SceneError
from rangecheck.optics import Camera
from rangecheck.rigid import move_points
from rangecheck.solid.containment import winding_numbers
from rangecheck.surface import Surface

#: a point that sees the back of the surface over more than half of all directions is inside it
INSIDE = 0.5
#: cameras whose rays do not share one point are tested at this many pixels per side
PIXELS_PER_SIDE = 5


def winding_number(surface: Surface, points_mm: FloatArray) -> FloatArray:
    """Winding number (n,) of the surface about points (n, 3) in the world frame: 1 inside a solid, 0 outside."""
    return winding_numbers(surface, require("points_mm", points_mm, (None, 3), finite=True))


def ray_origins_mm(camera: Camera) -> FloatArray:
    """(n, 3) camera-frame points that rays start from: the focal point, or a grid of origins where the rays share none."""
    u, v = np.meshgrid(
        np.linspace(0, camera.width - 1, PIXELS_PER_SIDE), np.linspace(0, camera.height - 1, PIXELS_PER_SIDE), indexing="ij"
    )
    origins = camera.rays(u, v)[0].reshape(-1, 3)
    return np.unique(origins[np.isfinite(origins).all(axis=1)], axis=0)


def require_outside(surface: Surface, camera: Camera, world_from_camera: FloatArray) -> None:
    """Raises SceneError when the camera's focal point lies inside the solid, where it would see only the matter's own back.

    An open surface has no inside; there a point is refused when it sees the back over more than half of all directions."""
    origins = move_points(world_from_camera, ray_origins_mm(camera))
    if not len(origins) or not len(surface.faces):
        return
    winding = winding_number(surface, origins)
    worst = int(np.argmax(np.abs(winding)))
    if abs(winding[worst]) > INSIDE:
        where = ", ".join(f"{x:.6g}" for x in origins[worst])
        raise SceneError(
            f"the focal point ({where}) mm is inside the solid (winding number {winding[worst]:.3f}; outside it is 0); "
            "move the camera out, or hollow the solid first",
            focal_point_mm=origins[worst],
            winding_number=float(winding[worst]),
        )
