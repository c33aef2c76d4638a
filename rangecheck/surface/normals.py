"""Areas and normals of triangles, compiled: every stage asks for them, of a million faces.

Faces are counter-clockwise seen from outside; mm.
"""

from __future__ import annotations

import math

from rangecheck.kernels import inline_kernel, kernel


@inline_kernel
def _edges_at(vertices, faces, face, corner):
    """From a corner of a face to the next and to the last, and their lengths."""
    here, after, before = faces[face, corner], faces[face, (corner + 1) % 3], faces[face, (corner + 2) % 3]
    ax, ay, az = (
        vertices[after, 0] - vertices[here, 0],
        vertices[after, 1] - vertices[here, 1],
        vertices[after, 2] - vertices[here, 2],
    )
    bx, by, bz = (
        vertices[before, 0] - vertices[here, 0],
        vertices[before, 1] - vertices[here, 1],
        vertices[before, 2] - vertices[here, 2],
    )
    return ax, ay, az, bx, by, bz


@kernel
def area_vectors_into(vertices, faces, vectors):
    """(m, 3) half the cross product of two sides."""
    for face in range(len(faces)):
        ax, ay, az, bx, by, bz = _edges_at(vertices, faces, face, 0)
        vectors[face, 0] = 0.5 * (ay * bz - az * by)
        vectors[face, 1] = 0.5 * (az * bx - ax * bz)
        vectors[face, 2] = 0.5 * (ax * by - ay * bx)


@kernel
def angle_weighted_into(vertices, faces, face_normals, normals):
    """Add each face's unit normal to its vertices (n, 3), weighted by its angle there (Thurmer & Wuthrich 1998); none where it has no area."""
    for face in range(len(faces)):
        nx, ny, nz = face_normals[face, 0], face_normals[face, 1], face_normals[face, 2]
        if math.isnan(nx):
            continue
        for corner in range(3):
            ax, ay, az, bx, by, bz = _edges_at(vertices, faces, face, corner)
            size = math.sqrt((ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz))
            angle = math.acos(min(1.0, max(-1.0, (ax * bx + ay * by + az * bz) / size))) if size > 0.0 else 0.0
            vertex = faces[face, corner]
            normals[vertex, 0] += angle * nx
            normals[vertex, 1] += angle * ny
            normals[vertex, 2] += angle * nz


@kernel
def corner_normals_into(faces, face_normals, smooth, vertex_normals, normals):
    """(m, 3, 3) float32: at each corner the vertex's normal where `smooth` and known, else the face's; +z for faces without area."""
    for face in range(len(faces)):
        x, y, z = face_normals[face, 0], face_normals[face, 1], face_normals[face, 2]
        if math.isnan(x):
            x, y, z = 0.0, 0.0, 1.0
        for corner in range(3):
            normals[face, corner, 0], normals[face, corner, 1], normals[face, corner, 2] = x, y, z
            if smooth[face]:
                vertex = faces[face, corner]
                if vertex_normals[vertex, 0] != 0.0 or vertex_normals[vertex, 1] != 0.0 or vertex_normals[vertex, 2] != 0.0:
                    for axis in range(3):
                        normals[face, corner, axis] = vertex_normals[vertex, axis]
