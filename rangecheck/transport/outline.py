"""Which pixels of a picture can see anything at all: rays outside the outline of the scene need not be cast.

The faces are gathered in cells of a grid, once for a scene. A picture looks where the corners of the cells' bounding boxes appear: a box
is convex, so that what it holds appears within the rectangle around them. Everything is local (see `geometry`); the answer is on the safe
side by a cell and a pixel.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.kernels import stage_kernel
from rangecheck.transport.geometry import SourceArrays

#: cells along an edge of the unit box
_CELLS = 64
#: what is nearer to the camera's plane than this has no place in the picture that could be trusted
_NEAR = 1e-4


def boxes_of(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(k, 6) float32 low and high corners of boxes that together hold the faces (m, 3) over vertices (n, 3)."""
    boxes = np.empty((_CELLS**3, 6), np.float32)
    boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
    _gather(vertices, faces, _CELLS, boxes)
    return np.ascontiguousarray(boxes[boxes[:, 0] <= boxes[:, 3]])


def boxes_around(sources: SourceArrays) -> FloatArray:
    """(s, 6) float32 boxes around spherical sources, a little wider than they are."""
    radius = 1.001 * sources.radius[:, None]
    return np.hstack([sources.centre - radius, sources.centre + radius]).astype(np.float32)


def pixels_of(boxes: FloatArray, camera: FloatArray, rotation: FloatArray, eye: FloatArray, width: int, height: int) -> BoolArray:
    """(width height,) whether a pixel may see what is in the boxes (k, 6), for a camera (parallel, fx, fy, cx, cy) as of
    `camera_rays`; all of them where a box reaches through the camera's plane."""
    seen = np.zeros((height, width), np.bool_)
    if not _mark(boxes, camera, rotation, eye, seen):
        seen[:] = True
    return seen.ravel()


@stage_kernel
def _gather(vertices, faces, cells, boxes):
    """Widen the box of the cell in which each face has its first corner."""
    for face in range(len(faces)):
        cell = np.int64(0)
        for axis in range(3):
            step = np.int64((vertices[faces[face, 0], axis] + 1.0) * 0.5 * cells)
            cell = cell * cells + min(max(step, np.int64(0)), np.int64(cells - 1))
        for corner in range(3):
            for axis in range(3):
                value = vertices[faces[face, corner], axis]
                boxes[cell, axis] = min(boxes[cell, axis], value)
                boxes[cell, axis + 3] = max(boxes[cell, axis + 3], value)


@stage_kernel
def _mark(boxes, camera, rotation, eye, seen):
    """Mark the rectangles of pixels in which boxes appear; False where one has no such rectangle."""
    height, width = seen.shape
    parallel, fx, fy, cx, cy = camera[0] == 1.0, camera[1], camera[2], camera[3], camera[4]
    for k in range(len(boxes)):
        left, right, top, bottom = math.inf, -math.inf, math.inf, -math.inf
        nearest, farthest = math.inf, -math.inf
        # how far the box reaches inwards of each border's plane: those planes hold for what crosses the camera's own, too
        in_left = in_right = in_top = in_bottom = -math.inf
        for corner in range(8):
            x = float(boxes[k, 0 if corner & 1 else 3]) - eye[0]
            y = float(boxes[k, 1 if corner & 2 else 4]) - eye[1]
            z = float(boxes[k, 2 if corner & 4 else 5]) - eye[2]
            across = rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0] * z
            down = rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1] * z
            depth = rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z
            nearest, farthest = min(nearest, depth), max(farthest, depth)
            across, down = (across / fx, down / fy) if parallel else (across * fx, down * fy)
            size = 1.0 if parallel else depth
            in_left, in_right = max(in_left, across + (cx + 1.0) * size), max(in_right, (width - cx) * size - across)
            in_top, in_bottom = max(in_top, down + (cy + 1.0) * size), max(in_bottom, (height - cy) * size - down)
            if size > 0.0:
                left, right = min(left, cx + across / size), max(right, cx + across / size)
                top, bottom = min(top, cy + down / size), max(bottom, cy + down / size)
        if farthest <= 0.0 or min(min(in_left, in_right), min(in_top, in_bottom)) < 0.0:
            continue
        if nearest <= _NEAR and not parallel:
            return False
        for row in range(max(np.int64(top - 1.0), np.int64(0)), min(np.int64(bottom + 2.0), np.int64(height - 1)) + 1):
            for column in range(max(np.int64(left - 1.0), np.int64(0)), min(np.int64(right + 2.0), np.int64(width - 1)) + 1):
                seen[row, column] = True
    return True


@stage_kernel
def keep_seeing(outline, pixels, counts, observed, rows):
    """Write rows of pixels inside the outline to `rows`, return how many; the others have seen darkness counts[i] (or counts[0]) times."""
    kept, many = np.int64(0), len(counts) > 1
    for i in range(len(pixels)):
        if outline[pixels[i]]:
            rows[kept] = i
            kept += 1
        else:
            observed[pixels[i]] += counts[i if many else 0]
    return kept
