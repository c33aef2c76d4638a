"""Orbits: where the camera stands in frame i of N, and the tightest orbit that keeps every vertex in every frame.

World frame: the orbit turns about `axis` (y up by default); azimuth 0 is the side of +z, growing towards +x (right-handed about
the axis). Camera axes as in optics.cameras. A loop is exact: azimuth 2 pi i / N, and frame N would be frame 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import FloatArray, require
from rangecheck.errors import CameraError, SceneError
from rangecheck.optics import Camera, OrthographicCamera, PinholeCamera
from rangecheck.rigid import about_axis, inverse, look_at, move_points
from rangecheck.surface import Surface

#: steepest elevation: beyond it "up" is along the view and the picture would spin
STEEPEST_DEG = 89.0


@dataclass(frozen=True)
class Orbit:
    """A camera that circles `centre_mm` at `distance_mm`, looking at it.

    elevation_deg is its height above the horizon; swing_deg lets it rise and fall once per loop (elevation + swing sin azimuth).
    start_deg is the azimuth of frame 0."""

    centre_mm: tuple[float, float, float]
    distance_mm: float
    elevation_deg: float
    frames: int
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)
    start_deg: float = 0.0
    swing_deg: float = 0.0

    def __post_init__(self) -> None:
        require("centre_mm", self.centre_mm, (3,), finite=True)
        if not (math.isfinite(self.distance_mm) and self.distance_mm > 0):
            raise CameraError(f"distance_mm is {self.distance_mm}; it must be a positive length", name="distance_mm")
        if not (isinstance(self.frames, int) and 0 < self.frames <= 100_000):
            raise CameraError(f"frames is {self.frames}; it must be 1 to 100000", name="frames")
        steepest = abs(self.elevation_deg) + abs(self.swing_deg)
        if not steepest <= STEEPEST_DEG:
            raise CameraError(
                f"the orbit rises to {steepest} degrees; at most {STEEPEST_DEG} keep 'up' defined", name="elevation_deg"
            )
        if not math.isfinite(self.start_deg):
            raise CameraError(f"start_deg is {self.start_deg}; it must be a number", name="start_deg")
        if not np.linalg.norm(require("axis", self.axis, (3,), finite=True)) > 0:
            raise CameraError("the orbit's axis has length 0; it needs a direction", name="axis")

    def azimuth_rad(self, index: int) -> float:
        """Azimuth of frame `index`; exact multiples, so that index and index + frames are the same picture."""
        return math.radians(self.start_deg) + 2 * math.pi * (index % self.frames) / self.frames

    def world_from_turned(self, index: int) -> FloatArray:
        """(4, 4) rotation about the orbit's axis that carries the camera of azimuth 0 to frame `index`.

        Sources that stand still in the room while the model turns on its table (and the camera stands still too) are moved by
        it: then `world_from_camera(index)` shows the turned model under fixed light."""
        centre = np.asarray(self.centre_mm, dtype=float)
        motion = about_axis(self.axis, self.azimuth_rad(index))
        motion[:3, 3] = centre - motion[:3, :3] @ centre
        return motion

    def world_from_camera(self, index: int) -> FloatArray:
        """(4, 4) pose of the camera in frame `index`."""
        axis = np.asarray(self.axis, dtype=float)
        axis = axis / np.linalg.norm(axis)
        front = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
        front = front - (front @ axis) * axis
        front /= np.linalg.norm(front)
        azimuth = self.azimuth_rad(index)
        outward = about_axis(axis, azimuth)[:3, :3] @ front
        elevation = math.radians(self.elevation_deg + self.swing_deg * math.sin(azimuth - math.radians(self.start_deg)))
        centre = np.asarray(self.centre_mm, dtype=float)
        eye = centre + self.distance_mm * (math.cos(elevation) * outward + math.sin(elevation) * axis)
        return look_at(eye, centre, axis)


def _view_limits(camera: Camera, margin: float) -> tuple[float, float, float, float]:
    """Tangents (left, right, top, bottom), all positive, of the largest undistorted rectangle inside the frame less its margin."""
    if not isinstance(camera, PinholeCamera):
        raise CameraError(f"framing an orbit needs a pinhole or orthographic camera, not a {camera.model} one")
    across, down = margin * camera.width, margin * camera.height
    u = np.linspace(-0.5 + across, camera.width - 0.5 - across, 65)
    v = np.linspace(-0.5 + down, camera.height - 0.5 - down, 65)

    def tangent(us: FloatArray, vs: FloatArray, axis: int) -> FloatArray:
        directions = camera.rays(us, vs)[1]
        return directions[..., axis] / directions[..., 2]

    limits = (
        -tangent(np.full(65, u[0]), v, 0).max(),
        tangent(np.full(65, u[-1]), v, 0).min(),
        -tangent(u, np.full(65, v[0]), 1).max(),
        tangent(u, np.full(65, v[-1]), 1).min(),
    )
    if not min(limits) > 0:
        raise CameraError(
            f"the optical axis leaves the frame less its margin of {margin:g} (limits {', '.join(f'{x:.4g}' for x in limits)}); "
            "an orbit looks along it, so choose another camera or a smaller margin"
        )
    return limits


def orbit_around(
    surface: Surface,
    camera: Camera,
    *,
    frames: int,
    elevation_deg: float = 10.0,
    margin: float = 0.05,
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0),
    start_deg: float = 0.0,
    swing_deg: float = 0.0,
) -> Orbit:
    """The orbit of least distance whose every frame holds every vertex, `margin` (share of width and height) from its border.

    Exact: "vertex p is on the inner side of a frame's border" is linear in the centre and the distance, so the tightest orbit is
    a linear programme with one row per frame and border, in which only the extreme vertex of each counts. Among the tightest
    orbits the one with the most room on the other borders is taken. Raises SceneError for a surface without vertices, CameraError
    for a camera that cannot frame."""
    from scipy.optimize import linprog

    if not len(surface.faces):
        raise SceneError("the surface has no faces; there is nothing to frame")
    if not 0 <= margin < 0.5:
        raise CameraError(f"margin is {margin}; it must be at least 0 and below 0.5", name="margin")
    points = _extreme_points(surface.vertices[np.unique(surface.faces)])
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = float(np.linalg.norm(points - middle, axis=1).max()) or 1.0
    unit = Orbit((0.0, 0.0, 0.0), 1.0, elevation_deg, frames, axis, start_deg, swing_deg)
    if isinstance(camera, OrthographicCamera):
        return _orthographic_orbit(points, middle, radius, unit, camera, margin)
    left, right, top, bottom = _view_limits(camera, margin)
    # borders' inward conditions n . (p - c) <= d * tangent, p and c in units of the radius around the middle
    borders = np.array([[-1.0, 0.0, -left], [1.0, 0.0, -right], [0.0, -1.0, -top], [0.0, 1.0, -bottom]])
    tangents = np.array([left, right, top, bottom])
    rotations = np.stack([unit.world_from_camera(i)[:3, :3] for i in range(frames)])
    normals = np.einsum("kj,fij->fki", borders, rotations).reshape(-1, 3)
    reach = ((points - middle) / radius @ normals.T).max(axis=0)
    tangent = np.tile(tangents, frames)
    # unknowns: centre (3), distance, room at the sides, room at top and bottom; n.p - n.c - d tangent + room * tangent <= 0
    sideways = np.tile([1.0, 1.0, 0.0, 0.0], frames)
    rows = np.column_stack([-normals, -tangent])
    bounds = [(-4.0, 4.0)] * 3 + [(0.0, None)]
    tightest = linprog([0, 0, 0, 1.0], A_ub=rows, b_ub=-reach, bounds=bounds, method="highs")
    if tightest.status != 0:
        raise CameraError(f"no orbit frames the surface ({tightest.message}); choose a wider camera or another elevation")
    distance = float(tightest.x[3]) * (1 + 1e-9) + 1e-9
    roomy = linprog(
        [0, 0, 0, -1.0, -1.0],
        A_ub=np.column_stack([-normals, sideways * tangent, (1 - sideways) * tangent]),
        b_ub=distance * tangent - reach,
        bounds=[(-4.0, 4.0)] * 3 + [(0.0, 4.0)] * 2,
        method="highs",
    )
    centre = middle + radius * (roomy.x if roomy.status == 0 else tightest.x)[:3]
    return _orbit_at(unit, centre, distance * radius)


def _extreme_points(points: FloatArray) -> FloatArray:
    """The corners of the points' convex hull: no other point is ever the one furthest out. All points where they are few or flat."""
    from scipy.spatial import ConvexHull, QhullError

    if len(points) < 64:
        return points
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        return points


def _orbit_at(unit: Orbit, centre_mm: FloatArray, distance_mm: float) -> Orbit:
    x, y, z = (float(c) for c in centre_mm)
    return Orbit((x, y, z), distance_mm, unit.elevation_deg, unit.frames, unit.axis, unit.start_deg, unit.swing_deg)


def _orthographic_orbit(
    points: FloatArray, middle: FloatArray, radius: float, unit: Orbit, camera: OrthographicCamera, margin: float
) -> Orbit:
    orbit = _orbit_at(unit, middle, 2 * radius)
    worst = max(framing_error_px(points, camera, orbit.world_from_camera(i), margin) for i in range(orbit.frames))
    if worst > 0:
        needed = camera.pixel_mm * (1 + 2 * worst / (min(camera.width, camera.height) * (1 - 2 * margin)))
        raise CameraError(
            f"with pixels of {camera.pixel_mm} mm the surface reaches {worst:.1f} px past the frame; take pixels of {needed:.4g} mm",
            pixel_mm=needed,
        )
    return orbit


def framing_error_px(points_mm: FloatArray, camera: Camera, world_from_camera: FloatArray, margin: float = 0.0) -> float:
    """How many pixels the worst of points (n, 3) lies outside the frame less its margin; negative = room left, inf = unseen."""
    uv, _ = camera.project(move_points(inverse(world_from_camera), points_mm))
    if not np.isfinite(uv).all():
        return math.inf
    half = np.array([camera.width, camera.height]) * (0.5 - margin)
    middle = np.array([camera.width - 1, camera.height - 1]) / 2
    return float((np.abs(uv - middle) - half).max())
