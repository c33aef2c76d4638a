"""Areas and normals of triangles, compiled: every stage asks for them, of a million faces.

Faces are counter-clockwise seen from outside; mm.
"""

from __future__ import annotations

import math

import numpy as np

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


@inline_kernel
def _blank(vertex_normals, vertex):
    return vertex_normals[vertex, 0] == 0.0 and vertex_normals[vertex, 1] == 0.0 and vertex_normals[vertex, 2] == 0.0


@kernel
def faces_apart(faces, smooth, vertex_normals):
    """(m,) bool: faces that need a normal of their own, for not being smooth or for a vertex whose normal is not known."""
    apart = np.empty(len(faces), np.bool_)
    for face in range(len(faces)):
        apart[face] = not smooth[face]
        for corner in range(3):
            apart[face] = apart[face] or _blank(vertex_normals, faces[face, corner])
    return apart


@kernel
def point_at_own(faces, chosen, smooth, vertex_normals, first, rows):
    """In rows (m, 3) the corners of `chosen` faces that have no vertex's normal to shade with name the face's own: row first + its place among the chosen."""
    for k in range(len(chosen)):
        face = chosen[k]
        for corner in range(3):
            if not smooth[face] or _blank(vertex_normals, faces[face, corner]):
                rows[face, corner] = first + k
