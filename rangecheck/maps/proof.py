"""A map proves itself: its pixels, sent back into space, must lie on the surface they were measured on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.maps.trace import Maps, require_same
from rangecheck.rigid import move_points
from rangecheck.surface import Surface

#: stated bound of back-projection, as a share of the surface's extent
BOUND = 1e-6


@dataclass(frozen=True)
class BackProjection:
    """How far back-projected pixels lie from the faces they hit, from the distance map and from the depth map.

    An upper bound of the distance to the surface. `bound_mm` is what the maps promise; `holds` says whether they keep it."""

    pixels: int
    distance_max_mm: float
    distance_rms_mm: float
    depth_max_mm: float
    bound_mm: float

    @property
    def holds(self) -> bool:
        """Whether every pixel keeps the bound."""
        return max(self.distance_max_mm, self.depth_max_mm) <= self.bound_mm


def point_triangle_mm(points_mm: FloatArray, triangles: FloatArray) -> FloatArray:
    """Distance (n,) of each point (n, 3) to its own triangle (n, 3, 3) (Ericson, *Real-Time Collision Detection*, 5.1.5)."""
    corners = [triangles[:, k] for k in range(3)]
    edges = [corners[(k + 1) % 3] - corners[k] for k in range(3)]
    normal = np.cross(edges[0], -edges[2])
    area = np.sqrt((normal * normal).sum(axis=1))
    inside = area > 0
    nearest = np.full(len(points_mm), np.inf)
    for corner, edge in zip(corners, edges):
        to_point = points_mm - corner
        inside &= (np.cross(edge, to_point) * normal).sum(axis=1) >= 0
        length2 = (edge * edge).sum(axis=1)
        along = np.clip((to_point * edge).sum(axis=1) / np.where(length2 > 0, length2, 1.0), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(to_point - along[:, None] * edge, axis=1))
    off_plane = np.abs(((points_mm - corners[0]) * normal).sum(axis=1)) / np.where(area > 0, area, 1.0)
    return np.where(inside, off_plane, nearest)


def back_projection_error(surface: Surface, maps: Maps) -> BackProjection:
    """Send every pixel back, once by its distance and once by its depth, and measure how far it lands from the face it hit."""
    require_same(surface, maps.face)
    origins, directions = maps.camera.pixel_rays()
    axial = directions[..., 2]
    hit = maps.hit
    triangles = surface.triangles[maps.face[hit]]

    def errors(along: FloatArray) -> FloatArray:
        points = move_points(maps.world_from_camera, origins[hit] + along[:, None] * directions[hit])
        return point_triangle_mm(points, triangles)

    by_distance = errors(maps.distance_mm[hit])
    # a ray across the optical axis has no depth to go back by
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (maps.depth_mm[hit] - origins[hit][:, 2]) / axial[hit]
    by_depth = errors(np.where(np.abs(axial[hit]) > 1e-3, reach, maps.distance_mm[hit]))
    return BackProjection(
        pixels=int(hit.sum()),
        distance_max_mm=float(by_distance.max(initial=0.0)),
        distance_rms_mm=float(np.sqrt((by_distance**2).mean())) if len(by_distance) else 0.0,
        depth_max_mm=float(by_depth.max(initial=0.0)),
        bound_mm=BOUND * surface.extent_mm,
    )
