"""The methods that the study of meshing compares: ours, and the engines with all their threads, which ours never give them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.scan import RangeScan
from rangecheck.surface.meshing import fuse, pivot
from rangecheck.surface.meshing.oriented import open3d, oriented_points
from rangecheck.surface.meshing.poisson import BOX_SCALE
from rangecheck.surface.surface import Surface


def open3d_poisson(scans: Sequence[RangeScan], depth: int) -> Surface:
    """open3d's screened Poisson on all threads, its normals included."""
    engine = open3d()
    points, normals = oriented_points(scans)
    cloud = engine.geometry.PointCloud(engine.utility.Vector3dVector(points))
    cloud.normals = engine.utility.Vector3dVector(normals)
    with engine.utility.VerbosityContextManager(engine.utility.VerbosityLevel.Error):
        mesh, _ = engine.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, scale=BOX_SCALE, n_threads=-1)
    return _surface(np.asarray(mesh.vertices), np.asarray(mesh.triangles))


def meshlab_poisson(scans: Sequence[RangeScan], depth: int) -> Surface:
    """MeshLab's screened Poisson on all threads, the normals included."""
    import os

    import pymeshlab

    points, normals = oriented_points(scans)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=points, v_normals_matrix=normals))
    meshes.generate_surface_reconstruction_screened_poisson(depth=depth, scale=BOX_SCALE, threads=os.cpu_count() or 1)
    made = meshes.current_mesh()
    return _surface(made.vertex_matrix(), made.face_matrix())


def _surface(vertices: FloatArray, faces: IntArray) -> Surface:
    surface = Surface(np.array(vertices, float), np.asarray(faces).astype(np.int32))
    return surface.with_faces(np.arange(len(surface.faces)))


Method = Callable[[Sequence[RangeScan]], Surface]


def methods(depths: Sequence[int]) -> dict[tuple[str, str], Method]:
    """Every method that takes several scans, by name and setting."""
    found: dict[tuple[str, str], Method] = {("fuse", ""): fuse}
    for depth in depths:
        found["Poisson, open3d", f"depth {depth}"] = partial(open3d_poisson, depth=depth)
        found["Poisson, MeshLab", f"depth {depth}"] = partial(meshlab_poisson, depth=depth)
    return found | {("pivot", ""): pivot}
