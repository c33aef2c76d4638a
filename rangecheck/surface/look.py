"""A quick look at a surface for notebooks: parallel rays, one light, parts told apart by nothing."""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.optics import OrthographicCamera
from rangecheck.quick_look import LONGEST, png, shaded_png
from rangecheck.raycast import EmbreeCaster
from rangecheck.rigid import look_at, move_directions, move_points


def look_at_faces(vertices: FloatArray, faces: IntArray, face_normals: FloatArray, vertex_normals: FloatArray) -> bytes:
    """PNG of faces (m, 3) from the front (+z), a little from above and from its left; a white picture where there are none."""
    if not len(faces):
        return png(np.full((64, 64), 255.0))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle = 0.5 * (low + high)
    radius = max(0.5 * float(np.linalg.norm(high - low)), 1e-9)
    pose = look_at(middle + 2 * radius * np.array([-0.35, 0.25, 0.9]), middle)
    half = 0.5 * (LONGEST - 1)
    camera = OrthographicCamera(LONGEST, LONGEST, pixel_mm=2.02 * radius / LONGEST, cx=half, cy=half)
    origins, directions = (array.reshape(-1, 3) for array in camera.pixel_rays())
    origins, directions = move_points(pose, origins), move_directions(pose, directions)
    hits = EmbreeCaster(vertices, faces).closest(origins, directions, coherent=True)
    normals = face_normals[hits.face]
    corners = faces[hits.face]
    weights = np.stack([1 - hits.u - hits.v, hits.u, hits.v], axis=1)
    smooth = np.einsum("ij,ijk->ik", weights, vertex_normals[corners])
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
    # creases stay sharp: where the mean of the corners strays far from the face, the face is right
    normals = np.where((smooth * normals).sum(axis=1, keepdims=True) > 0.8, smooth, normals)
    away = (normals * directions).sum(axis=1, keepdims=True) > 0
    normals = np.where(away, -normals, normals)
    normals[hits.face < 0] = np.nan
    return shaded_png((normals @ pose[:3, :3]).reshape(LONGEST, LONGEST, 3))
