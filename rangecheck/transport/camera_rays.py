"""From pixels to rays, in the caster's local frame (centred, scaled to the object), float32, unit directions.

Pixels are visited in tiles of 64 x 64, and within a tile in blocks of 4 x 4, so that sixteen neighbours in the list are neighbours
in the picture. Pixel coordinates as in `optics`: integers at pixel centres.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.kernels import inline_kernel, stage_kernel
from rangecheck.optics import Camera, OrthographicCamera, PinholeCamera
from rangecheck.transport.chance import PIXEL, fill_points, stream_of
from rangecheck.transport.outline import pixels_of
from rangecheck.transport.queues import CAMERA, Rays

TILE, BLOCK = 64, 4


@lru_cache(maxsize=8)
def pixel_order(width: int, height: int) -> IntArray:
    """(width height,) int32 pixel numbers (row width + column), tile by tile and block by block."""
    rows, columns = np.arange(height, dtype=np.int64), np.arange(width, dtype=np.int64)

    def keys(index: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        return index // TILE, index % TILE // BLOCK, index % BLOCK

    row, column = keys(rows), keys(columns)
    # a number that sorts by tile, block, place in block
    parts = [(r[:, None], c[None, :]) for r, c in zip(row, column)]
    sizes = (math.ceil(width / TILE), TILE // BLOCK, BLOCK)
    rank = np.zeros((height, width), np.int64)
    for (r, c), across, down in zip(parts, sizes, (math.ceil(height / TILE), TILE // BLOCK, BLOCK)):
        rank = (rank * down + r) * across + c
    order = np.argsort(rank.ravel(), kind="stable").astype(np.int32)
    order.flags.writeable = False
    return order


class PictureRays:
    """The rays of one camera at one pose, as the caster wants them."""

    def __init__(self, camera: Camera, world_from_camera: FloatArray, centre_mm: FloatArray, scale_mm: float) -> None:
        self.camera = camera
        self.rotation = np.ascontiguousarray(world_from_camera[:3, :3])
        self.eye = (world_from_camera[:3, 3] - centre_mm) / scale_mm
        self.scale_mm = scale_mm
        #: what a tracer found of the pixels that may see anything, once it did
        self.outline: list[BoolArray | None] = []
        if type(camera) is PinholeCamera and not any(camera.distortion):
            self._numbers = np.array([0.0, camera.fx, camera.fy, camera.cx, camera.cy])
        elif type(camera) is OrthographicCamera:
            self._numbers = np.array([1.0, camera.pixel_mm / scale_mm, camera.pixel_mm / scale_mm, camera.cx, camera.cy])
        else:
            self._numbers = np.empty(0)

    def may_see(self, boxes: FloatArray) -> BoolArray | None:
        """(width height,) whether a pixel may see what is in the boxes (k, 6) (see `outline`); None where this camera cannot tell."""
        if not len(self._numbers):
            return None
        return pixels_of(boxes, self._numbers, self.rotation, self.eye, self.camera.width, self.camera.height)

    def start(
        self, pixels: IntArray, numbers: IntArray, each: int, centre: bool, seed: int, places: FloatArray, rays: Rays
    ) -> None:
        """Start `each` rays of group numbers[i] through each of the pixels, spread evenly over it, or through its middle. `places`
        (2, n each) is room for their pixel coordinates."""
        seed &= 0xFFFFFFFF
        width = self.camera.width
        if len(self._numbers) and self._numbers[0] == 0.0:
            _start_pinhole(self._numbers, self.rotation, self.eye, pixels, numbers, width, each, centre, seed, places, rays)
        else:
            _start_rays(pixels, numbers, width, each, centre, seed, places, rays)
            self.fill(places[0], places[1], rays.origin, rays.direction)

    def fill(self, u: FloatArray, v: FloatArray, origins: FloatArray, directions: FloatArray) -> None:
        """Write the rays at pixel coordinates u, v (n,) float64 into origins and directions (n, 3) float32."""
        if len(self._numbers):
            _simple_rays(self._numbers, self.rotation, self.eye, u, v, origins, directions)
            return
        places, rays = self.camera.rays(u, v)
        _moved_rays(
            np.ascontiguousarray(places / self.scale_mm), np.ascontiguousarray(rays), self.rotation, self.eye, origins, directions
        )


@stage_kernel
def _begin_all(pixels, numbers, each, seed, rays):
    """Paths of group numbers[i] of `each` samples of pixel i, which together carry all the light that they find."""
    k, share = np.int64(0), 1.0 / each
    for i in range(len(pixels)):
        stream = stream_of(seed, pixels[i])
        for j in range(each):
            rays.far[k] = math.inf
            rays.pixel[k] = i
            rays.stream[k], rays.number[k] = stream, numbers[i] * each + j
            rays.kind[k] = rays.first[k] = CAMERA
            for c in range(rays.weight.shape[1]):
                rays.weight[k, c] = share
            k += 1


@stage_kernel
def _start_rays(pixels, numbers, width, each, centre, seed, places, rays):
    """Pixel coordinates places (2, n each) of group numbers[i] of `each` samples of pixel i, and rays that together carry all the
    light that they find. The samples of one group are spread evenly over the pixel; `centre` puts a single one in its middle."""
    _begin_all(pixels, numbers, each, seed, rays)
    count = len(pixels) * each
    if not centre:
        fill_points(rays.stream, rays.number, PIXEL, 0, count, places[0], places[1])
    for k in range(count):
        pixel = pixels[rays.pixel[k]]
        row = pixel // width
        u, v = float(pixel - row * width), float(row)
        places[0, k], places[1, k] = (u, v) if centre else (u + places[0, k] - 0.5, v + places[1, k] - 0.5)


@inline_kernel
def _put_ray(rotation, eye, px, py, pz, dx, dy, dz, origins, directions, i):
    """Turn a camera-frame ray into the local frame and start it near the object, so that float32 counts from there."""
    wx = rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2] * dz
    wy = rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2] * dz
    wz = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2] * dz
    ox = eye[0] + rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz
    oy = eye[1] + rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz
    oz = eye[2] + rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz
    skip = max(0.0, -(ox * wx + oy * wy + oz * wz) - 2.0)
    origins[i, 0], origins[i, 1], origins[i, 2] = ox + skip * wx, oy + skip * wy, oz + skip * wz
    directions[i, 0], directions[i, 1], directions[i, 2] = wx, wy, wz


@stage_kernel
def _simple_rays(numbers, rotation, eye, u, v, origins, directions):
    """Pinhole (x/z, y/z) and orthographic rays."""
    parallel, fx, fy, cx, cy = numbers[0] == 1.0, numbers[1], numbers[2], numbers[3], numbers[4]
    for i in range(len(u)):
        if parallel:
            _put_ray(rotation, eye, (u[i] - cx) * fx, (v[i] - cy) * fy, 0.0, 0.0, 0.0, 1.0, origins, directions, i)
        else:
            x, y = (u[i] - cx) / fx, (v[i] - cy) / fy
            size = 1.0 / math.sqrt(x * x + y * y + 1.0)
            _put_ray(rotation, eye, 0.0, 0.0, 0.0, x * size, y * size, size, origins, directions, i)


@stage_kernel
def _moved_rays(places, rays, rotation, eye, origins, directions):
    """Any other camera's rays, given in its own frame."""
    for i in range(len(places)):
        _put_ray(
            rotation, eye, places[i, 0], places[i, 1], places[i, 2], rays[i, 0], rays[i, 1], rays[i, 2], origins, directions, i
        )


@stage_kernel
def _start_pinhole(camera, rotation, eye, pixels, numbers, width, each, centre, seed, places, rays):
    """`_start_rays` and `_simple_rays` in one pass, for the camera that most pictures are taken with."""
    origin, direction = rays.origin, rays.direction
    fx, fy, cx, cy = 1.0 / camera[1], 1.0 / camera[2], camera[3], camera[4]
    ax, ay, az = rotation[0, 0], rotation[1, 0], rotation[2, 0]
    bx, by, bz = rotation[0, 1], rotation[1, 1], rotation[2, 1]
    gx, gy, gz = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    ex, ey, ez = eye[0], eye[1], eye[2]
    per_row = 1.0 / width
    _begin_all(pixels, numbers, each, seed, rays)
    count = len(pixels) * each
    if not centre:
        fill_points(rays.stream, rays.number, PIXEL, 0, count, places[0], places[1])
    for k in range(count):
        pixel = pixels[rays.pixel[k]]
        # half a pixel keeps the product off whole numbers by more than it is rounded: exact, and far cheaper than dividing
        row = np.int64((pixel + 0.5) * per_row)
        u, v = float(pixel - row * width), float(row)
        if not centre:
            u, v = u + places[0, k] - 0.5, v + places[1, k] - 0.5
        x, y = (u - cx) * fx, (v - cy) * fy
        dx, dy, dz = x * ax + y * bx + gx, x * ay + y * by + gy, x * az + y * bz + gz
        size = 1.0 / math.sqrt(x * x + y * y + 1.0)
        dx, dy, dz = dx * size, dy * size, dz * size
        skip = max(0.0, -(ex * dx + ey * dy + ez * dz) - 2.0)
        origin[k, 0], origin[k, 1], origin[k, 2] = ex + skip * dx, ey + skip * dy, ez + skip * dz
        direction[k, 0], direction[k, 1], direction[k, 2] = dx, dy, dz
