"""What each pixel of a photograph sees of a known shape: place, normal, direction to the camera, footprint, and how they move with the pose.

World frame, millimetres. The pose's six numbers are a small turn (rad) of the camera and a small shift (mm) of it, both in world axes; it turns about
its own middle or about a pivot. About the middle of what it sees turn and shift act apart: there a turn changes the view, a shift the picture's place.
While it moves, the triangle that a pixel sees is held. On it the normal changes as the corners' normals are interpolated, so that the
derivatives are exact for what is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray, require
from rangecheck.errors import SceneError
from rangecheck.kernels import in_chunks
from rangecheck.optics import Camera
from rangecheck.raycast import EmbreeCaster
from rangecheck.recover.lights import Light
from rangecheck.scene import Scene

POSE_NUMBERS = 6
#: of what a pixel mirrors, sr, at least
_LEAST_SOLID_ANGLE = 1e-12


@dataclass(frozen=True, eq=False)
class Sight:
    """n pixels that see the shape.

    pixel       (n,) index into the flattened picture (row by row)
    face        (n,) int32 the triangle seen
    points      (n, 3) mm;  normals, facing (n, 3) unit, shading and the triangle's own, turned to the camera
    views       (n, 3) unit, to the camera
    footprints  (n,) angular radius, rad, of the disc as large as what the pixel mirrors; 0 where it is not known
    spans_mm    (n,) size of the pixel on the surface, across the view
    by_pose     (n, 3, 3, 6): derivative of point, normal, view by the camera's turn and shift;  footprints_by_pose (n, 6)
    shape       (height, width) of the picture
    """

    pixel: IntArray
    face: IntArray
    points: FloatArray
    normals: FloatArray
    facing: FloatArray
    views: FloatArray
    footprints: FloatArray
    spans_mm: FloatArray
    by_pose: FloatArray
    footprints_by_pose: FloatArray
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.pixel)

    def only(self, keep: IntArray | BoolArray) -> Sight:
        """The pixels chosen by index or mask."""
        chosen = {item.name: getattr(self, item.name)[keep] for item in fields(self) if item.name != "shape"}
        return Sight(**chosen, shape=self.shape)

    def moved(self, pose: FloatArray) -> Sight:
        """Seen from a camera moved by small turns and shifts (6,): to first order, normals and views kept at length 1."""
        moved = self.by_pose @ pose
        normals, views = self.normals + moved[:, 1], self.views + moved[:, 2]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        views /= np.linalg.norm(views, axis=1, keepdims=True)
        footprints = self.footprints + self.footprints_by_pose @ pose
        return replace(self, points=self.points + moved[:, 0], normals=normals, views=views, footprints=footprints)

    def spread(self, values: FloatArray, fill: float = np.nan) -> FloatArray:
        """Values (n, ...) put back into a picture (h, w, ...), `fill` where nothing is seen."""
        picture = np.full((self.shape[0] * self.shape[1], *values.shape[1:]), float(fill))
        picture[self.pixel] = values
        return picture.reshape(*self.shape, *values.shape[1:])


def see(
    scene: Scene, camera: Camera, world_from_camera: FloatArray, caster: EmbreeCaster | None = None, step: int = 1,
    pivot_mm: FloatArray | None = None,
) -> Sight:  # fmt: skip
    """What the middles of every `step`-th row and column of pixels see; `by_pose` is for turns about `pivot_mm` (3,), the camera's middle if not said.

    Raises SceneError where they see nothing."""
    pose = rigid.checked(world_from_camera, "world_from_camera")
    caster = caster or EmbreeCaster(scene.surface.vertices, scene.surface.faces)
    rows, columns = np.arange(0, camera.height, step), np.arange(0, camera.width, step)
    u, v = np.meshgrid(columns.astype(float), rows.astype(float))
    from_camera, along = camera.rays(u, v)
    origins = rigid.move_points(pose, from_camera).reshape(-1, 3)
    rays = rigid.move_directions(pose, along).reshape(-1, 3)
    known = np.asarray(np.isfinite(rays).all(axis=1) & np.isfinite(origins).all(axis=1))
    face, distance = _cast(caster, origins, np.where(known[:, None], rays, [0.0, 0.0, 1.0]))
    seen = np.flatnonzero((face >= 0) & known)
    if not len(seen):
        raise SceneError("the camera sees nothing of the surface; check the pose and the units")
    hit = face[seen]
    triangles = scene.surface.triangles[hit]
    corner_normals = scene.corner_normals[hit].astype(np.float64)
    points = origins[seen] + distance[seen, None] * rays[seen]
    facing = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    twice_area = np.linalg.norm(facing, axis=1)
    facing = facing / twice_area[:, None]
    # weights of the corners change across the triangle by these
    slopes = np.stack([np.cross(facing, triangles[:, (k + 2) % 3] - triangles[:, (k + 1) % 3]) for k in range(3)], axis=1)
    slopes /= twice_area[:, None, None]
    # in double precision, which the caster's own weights are not
    weight = 1.0 + np.einsum("nkx,nkx->nk", slopes, points[:, None, :] - triangles)
    mixed = np.einsum("nk,nkj->nj", weight, corner_normals)
    length = np.linalg.norm(mixed, axis=1)
    turned = np.einsum("nkj,nkx->njx", corner_normals, slopes)
    normals = mixed / length[:, None]
    by_place = (turned - normals[:, :, None] * np.einsum("nj,njx->nx", normals, turned)[:, None, :]) / length[:, None, None]
    back = (facing * rays[seen]).sum(1) > 0.0
    facing[back] *= -1.0
    opposed = (normals * facing).sum(1) < 0.0
    normals[opposed] *= -1.0
    by_place[opposed] *= -1.0
    h, w = len(rows), len(columns)
    pixel = (rows[seen // w] * camera.width + columns[seen % w]).astype(np.int64)
    by_pose = _by_pose(points, facing, by_place, origins[seen], rays[seen], pose[:3, 3])
    if pivot_mm is not None:
        # a turn about the pivot is one about the camera's middle, and the shift that takes the middle around
        by_pose[..., :3] += by_pose[..., 3:] @ np.cross(np.eye(3), pose[:3, 3] - pivot_mm).T
    spans, footprints, footprints_by_pose = _footprints(points, normals, rays[seen], by_pose, seen, (h, w))
    return Sight(
        pixel, hit, points, normals, facing, -rays[seen], footprints / step, spans / step, by_pose, footprints_by_pose / step,
        (camera.height, camera.width),
    )  # fmt: skip


def _cast(caster: EmbreeCaster, origins: FloatArray, rays: FloatArray) -> tuple[IntArray, FloatArray]:
    """Face (-1 where missed) and distance, ray by ray."""
    n = len(origins)
    face, distance = np.empty(n, np.int32), np.empty(n)

    def work(start: int, stop: int) -> None:
        found = caster.closest(origins[start:stop], rays[start:stop], coherent=True)
        face[start:stop], distance[start:stop] = found.face, found.distance_mm

    in_chunks(work, n, 16384)
    return face, distance


def _footprints(
    points: FloatArray, normals: FloatArray, rays: FloatArray, by_pose: FloatArray, seen: IntArray, shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sizes of the pixels across the view, mm, angular radii of the discs that they mirror, from their neighbours, and the radii's derivatives (n, 6)."""
    h, w = shape

    def neighbours(values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How (n, c) values differ to the right and down, (n, c) each."""
        flat = np.full((h * w, values.shape[1]), np.nan)
        flat[seen] = values
        grid = flat.reshape(h, w, -1)
        return _differences(grid, 1).reshape(h * w, -1)[seen], _differences(grid, 0).reshape(h * w, -1)[seen]

    cosine = (rays * normals).sum(1)[:, None]
    with np.errstate(invalid="ignore"):
        across = [d - (d * rays).sum(1)[:, None] * rays for d in neighbours(points)]
        spans = np.sqrt(np.linalg.norm(np.cross(*across), axis=1))
        right, down = neighbours(rays - 2.0 * cosine * normals)
        area = np.cross(right, down)
        solid_angle = np.linalg.norm(area, axis=1)
        # facets of one normal mirror parallel rays in parallel: there the footprint is next to nothing, but not nothing
        footprints = np.nan_to_num(np.sqrt(np.maximum(solid_angle, _LEAST_SOLID_ANGLE) / np.pi))
        # d |right x down| = d right . (down x area) + d down . (area x right), over |area|
        per = 1.0 / np.where(solid_angle > _LEAST_SOLID_ANGLE, 2.0 * np.pi * solid_angle * footprints, np.inf)[:, None]
        on_right, on_down = np.cross(down, area) * per, np.cross(area, right) * per
        to_right, to_below = (_difference_matrix(seen, shape, axis) for axis in (1, 0))
        slopes = np.zeros((len(seen), POSE_NUMBERS))
        for k in range(POSE_NUMBERS):
            by_normal, by_ray = by_pose[:, 1, :, k], -by_pose[:, 2, :, k]
            by_cosine = (by_ray * normals + rays * by_normal).sum(1)[:, None]
            by = by_ray - 2.0 * (by_cosine * normals + cosine * by_normal)
            slopes[:, k] = ((to_right @ by) * on_right + (to_below @ by) * on_down).sum(1)
    return np.nan_to_num(spans), footprints, np.nan_to_num(slopes)


def _differences(grid: FloatArray, axis: int) -> FloatArray:
    """Central differences along an axis, one-sided where only one neighbour is seen."""
    ahead, behind = np.full_like(grid, np.nan), np.full_like(grid, np.nan)
    low = [slice(None)] * 3
    high = [slice(None)] * 3
    low[axis], high[axis] = slice(None, -1), slice(1, None)
    step = grid[tuple(high)] - grid[tuple(low)]
    ahead[tuple(low)], behind[tuple(high)] = step, step
    both = 0.5 * (ahead + behind)
    return np.where(np.isnan(both), np.where(np.isnan(ahead), behind, ahead), both)


def _difference_matrix(seen: IntArray, shape: tuple[int, int], axis: int) -> Any:
    """(n, n) sparse: `_differences` of what the pixels `seen` hold; rows of pixels without a neighbour are empty."""
    from scipy.sparse import csr_array

    n, (h, w) = len(seen), shape
    place = np.full((h + 2, w + 2), -1)
    place[1 + seen // w, 1 + seen % w] = np.arange(n)
    step = (0, 1) if axis else (1, 0)
    after = place[1 + seen // w + step[0], 1 + seen % w + step[1]]
    before = place[1 + seen // w - step[0], 1 + seen % w - step[1]]
    each = np.where((after >= 0) & (before >= 0), 0.5, 1.0)
    ahead, behind = np.where(after >= 0, each, 0.0), np.where(before >= 0, each, 0.0)
    here = np.arange(n)
    columns = np.stack([np.maximum(before, 0), here, np.maximum(after, 0)], axis=1)
    weights = np.stack([-behind, behind - ahead, ahead], axis=1)
    return csr_array((weights.ravel(), columns.ravel(), np.arange(0, 3 * n + 1, 3)), shape=(n, n))


def _by_pose(
    points: FloatArray, facing: FloatArray, by_place: FloatArray, origins: FloatArray, rays: FloatArray, eye: FloatArray
) -> FloatArray:
    """(n, 3, 3, 6): how point, normal and view move when the camera is turned about its middle, then shifted."""
    n = len(points)
    result = np.zeros((n, 3, 3, POSE_NUMBERS))
    distance = ((points - origins) * rays).sum(1)
    against = (facing * rays).sum(1)
    for k in range(POSE_NUMBERS):
        if k < 3:
            axis = np.eye(3)[k]
            turned, shifted = np.cross(axis, rays), np.cross(axis, origins - eye)
        else:
            turned, shifted = np.zeros_like(rays), np.broadcast_to(np.eye(3)[k - 3], rays.shape)
        moved = shifted + distance[:, None] * turned
        slide = -(facing * moved).sum(1) / against
        moved = moved + slide[:, None] * rays
        result[:, 0, :, k] = moved
        result[:, 1, :, k] = np.einsum("njx,nx->nj", by_place, moved)
        result[:, 2, :, k] = -turned
    return result


def lit_by(sight: Sight, lights: tuple[Light, ...], caster: EmbreeCaster) -> BoolArray:
    """(n, s) whether nothing lies between each point and each light's middle, the horizon left to the form factor."""
    lit = np.zeros((len(sight), len(lights)), bool)
    start = sight.points + caster.skin_mm * sight.facing
    for s, light in enumerate(lights):
        towards = light.centre_mm - start
        distance = np.linalg.norm(towards, axis=1)
        directions = np.ascontiguousarray(towards / distance[:, None])
        reach = distance - light.radius_mm

        def work(first: int, stop: int, s: int = s, directions: FloatArray = directions, reach: FloatArray = reach) -> None:
            lit[first:stop, s] = ~caster.occluded(start[first:stop], directions[first:stop], reach[first:stop], coherent=True)

        in_chunks(work, len(sight), 16384)
        # a triangle that turns away is dark, but the rounded surface it stands for may not be
        lit[:, s] |= (sight.facing * directions).sum(1) <= 0.0
    return lit


def sphere_sight(centre_px: tuple[float, float], radius_px: float, shape: tuple[int, int], margin_px: float = 2.0) -> Sight:
    """A sphere of known outline under parallel view: x right, y up, z to the camera, one millimetre a pixel, the sphere's middle at the origin.

    `margin_px` at its rim is left out. Raises SceneError when the outline does not meet the picture."""
    middle = require("centre_px", centre_px, (2,), finite=True)
    if not (np.isfinite(radius_px) and radius_px > margin_px):
        raise SceneError(f"the sphere's radius is {radius_px} px; it must be above the margin of {margin_px} px")
    rows, columns = np.indices(shape)
    x, y = (columns - middle[0]).ravel() / radius_px, (middle[1] - rows).ravel() / radius_px
    pixel = np.flatnonzero(np.hypot(x, y) < 1.0 - margin_px / radius_px)
    if not len(pixel):
        raise SceneError(
            f"no pixel of the picture {shape[::-1]} lies inside the sphere at {tuple(middle)} px, radius {radius_px} px"
        )
    x, y = x[pixel], y[pixel]
    normals = np.stack([x, y, np.sqrt(1.0 - x * x - y * y)], axis=1)
    views = np.tile([0.0, 0.0, 1.0], (len(pixel), 1))
    points = radius_px * normals
    n = len(pixel)
    # a mirror ball spreads what it shows: the solid angle of mirrored directions is 4 times the disc's area over R^2
    footprints = np.full(n, 2.0 / radius_px / np.sqrt(np.pi))
    by_place = np.broadcast_to(np.eye(3) / radius_px, (n, 3, 3)) - normals[:, :, None] * normals[:, None, :] / radius_px
    origins = points + 1000.0 * views
    by_pose = _by_pose(points, normals, by_place, origins, -views, np.array([0.0, 0.0, 1000.0]))
    even = np.zeros((n, POSE_NUMBERS))
    return Sight(
        pixel, np.zeros(n, np.int32), points, normals, normals.copy(), views, footprints, np.ones(n), by_pose, even, shape
    )
