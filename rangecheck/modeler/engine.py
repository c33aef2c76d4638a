"""Booleans of numbered bodies through manifold3d (3.5): every output triangle keeps the number of the face it came from.

Its traps: a float32 `Mesh` rounds, so `Mesh64` is used; a refused mesh becomes an empty solid that empties whatever it meets, so its
status is asked; triangles of one `face_id` are merged where they are coplanar, which is wanted here: a planar face stays one face.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import DependencyMissing, SceneError
from rangecheck.modeler.body import Body

OPERATIONS = ("union", "difference", "intersection")


def manifold3d_module() -> Any:
    """manifold3d, loaded when first asked for. Raises DependencyMissing."""
    try:
        import manifold3d
    except ImportError:
        raise DependencyMissing("manifold3d", "solids", "pip install manifold3d") from None
    return manifold3d


def triangulate(rings: Sequence[FloatArray]) -> IntArray:
    """(k, 3) triangles over the points of plane rings (n, 2), outer counter-clockwise, holes clockwise."""
    return np.asarray(manifold3d_module().triangulate([np.ascontiguousarray(r, np.float64) for r in rings]), np.int64).reshape(
        -1, 3
    )


def _to_engine(body: Body, first: int, name: str) -> Any:
    m3d = manifold3d_module()
    mesh = m3d.Mesh64(
        vert_properties=np.ascontiguousarray(body.vertices, np.float64),
        tri_verts=np.ascontiguousarray(body.faces, np.uint64),
        face_id=np.ascontiguousarray(body.label + first, np.uint64),
    )
    solid = m3d.Manifold(mesh)
    if solid.status() != m3d.Error.NoError or solid.is_empty():
        raise SceneError(f"{name} is no solid ({solid.status().name}); only closed bodies can be combined")
    return solid


def combine(operation: str, bodies: Sequence[Body], names: Sequence[str], result: str) -> Body:
    """Union, difference (first less all others) or intersection of closed bodies. Faces of all operands keep their order and names,
    those that vanished too, so that numbers do not depend on the outcome. Raises SceneError when nothing is left."""
    m3d = manifold3d_module()
    firsts = np.cumsum([0] + [len(b.names) for b in bodies])
    solids = [_to_engine(body, int(first), name) for body, first, name in zip(bodies, firsts, names)]
    operator = {"union": m3d.OpType.Add, "difference": m3d.OpType.Subtract, "intersection": m3d.OpType.Intersect}[operation]
    outcome = m3d.Manifold.batch_boolean(solids, operator)
    if outcome.status() != m3d.Error.NoError or outcome.is_empty():
        raise SceneError(f"{result}: the {operation} of {', '.join(names)} is empty; move the bodies so that matter is left")
    vertices, faces, mesh = mesh_of(outcome)
    used, faces = np.unique(faces, return_inverse=True)
    return Body(
        vertices[used],
        faces.reshape(-1, 3),
        np.array(mesh.face_id, np.int64),
        tuple(n for b in bodies for n in b.names),
        tuple(f for b in bodies for f in b.true_faces),
    )


def mesh_of(solid: Any) -> tuple[FloatArray, IntArray, Any]:
    """Vertices (n, 3) and faces (m, 3) of the engine's solid, vertices that it keeps apart for its own ends made one; and its mesh, whose
    runs and face_id say where faces came from. Not every vertex is used."""
    mesh = solid.to_mesh64()
    vertices = np.array(mesh.vert_properties[:, :3], np.float64)
    faces = np.array(mesh.tri_verts, np.int64)
    merge_from, merge_to = np.asarray(mesh.merge_from_vert, np.int64), np.asarray(mesh.merge_to_vert, np.int64)
    if len(merge_from):
        target = np.arange(len(vertices))
        target[merge_from] = merge_to
        faces = target[faces]
    return vertices, faces, mesh


def common_volume_mm3(a: Body, b: Body) -> float:
    """Volume that two closed bodies share."""
    return float((_to_engine(a, 0, "a") ^ _to_engine(b, 0, "b")).volume())
