"""A map proves itself: its pixels, sent back into space, must lie on the surface they were measured on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.kernels import in_chunks
from rangecheck.maps.trace import Maps, require_same
from rangecheck.rigid import move_points
from rangecheck.surface import Surface

#: stated bound of back-projection, as a share of the surface's extent
BOUND = 1e-6
#: pixels that are sent back in one go
PIXELS_AT_ONCE = 1 << 16


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
    height, width = maps.face.shape
    rows = max(1, PIXELS_AT_ONCE // width)
    bands = in_chunks(lambda first, last: _band(surface, maps, first, last), height, rows)
    pixels = sum(band.pixels for band in bands)
    return BackProjection(
        pixels=pixels,
        distance_max_mm=max(band.distance_max_mm for band in bands),
        distance_rms_mm=math.sqrt(sum(band.distance_squares for band in bands) / max(pixels, 1)),
        depth_max_mm=max(band.depth_max_mm for band in bands),
        bound_mm=BOUND * surface.extent_mm,
    )


class _Band(NamedTuple):
    pixels: int
    distance_max_mm: float
    distance_squares: float
    depth_max_mm: float


def _band(surface: Surface, maps: Maps, first: int, last: int) -> _Band:
    """Rows first .. last - 1: what all pixels need at once would be many times the maps themselves."""
    face = maps.face[first:last]
    row, column = np.nonzero(face >= 0)
    camera_origins, camera_rays = maps.camera.rays(column.astype(float), (row + first).astype(float))
    corners = surface.vertices[surface.faces[face[row, column]]]
    distance, depth = maps.distance_mm[first:last][row, column], maps.depth_mm[first:last][row, column]

    def errors(along: FloatArray) -> FloatArray:
        return point_triangle_mm(move_points(maps.world_from_camera, camera_origins + along[:, None] * camera_rays), corners)

    by_distance = errors(distance)
    axial = camera_rays[:, 2]
    # a ray across the optical axis has no depth to go back by
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (depth - camera_origins[:, 2]) / axial
    by_depth = errors(np.where(np.abs(axial) > 1e-3, reach, distance))
    return _Band(len(row), float(by_distance.max(initial=0.0)), float((by_distance**2).sum()), float(by_depth.max(initial=0.0)))
