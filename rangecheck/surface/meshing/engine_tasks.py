"""What open3d and MeshLab are asked when surfaces are made of points; their own words, and nothing of rangecheck.

Run as a script, `engine_tasks.py FOLDER [MOST_MB]` reads names of tasks, a line each, from stdin. The arguments of a task stand in FOLDER as
`in.npz`, its answers go to `out.npz`, and a JSON line on stdout says that it is done, or which error it raised; MOST_MB bounds what it
may take (10^6 bytes). All tasks give the same bytes again: with several threads open3d's do not, so it gets one.
"""

from __future__ import annotations

import importlib
import json
import resource
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

#: of arrays and numbers, by name
Arrays = dict[str, Any]


def _loaded(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except OSError as error:  # a system library is absent
        raise ImportError(str(error)) from None


def _cloud(points: Any, normals: Any = None) -> tuple[Any, Any]:
    engine = _loaded("open3d")
    cloud = engine.geometry.PointCloud(engine.utility.Vector3dVector(points))
    if normals is not None:
        cloud.normals = engine.utility.Vector3dVector(normals)
    return engine, cloud


def _mesh(mesh: Any) -> Arrays:
    return {"vertices": np.asarray(mesh.vertices).copy(), "faces": np.asarray(mesh.triangles).astype(np.int32)}


def covariances(points: Any, neighbours: Any) -> Arrays:
    """(n, 3, 3) covariances of the nearest neighbours of each point (n, 3), itself among them."""
    engine, cloud = _cloud(points)
    cloud.estimate_covariances(engine.geometry.KDTreeSearchParamKNN(int(neighbours)))
    return {"covariances": np.asarray(cloud.covariances).copy()}


def turned(points: Any, normals: Any, neighbours: Any) -> Arrays:
    """The normals (n, 3), turned so that neighbours agree (Hoppe et al. 1992)."""
    _, cloud = _cloud(points, normals)
    cloud.orient_normals_consistent_tangent_plane(int(neighbours))
    return {"normals": np.asarray(cloud.normals).copy()}


def poisson_open3d(points: Any, normals: Any, depth: Any, scale: Any, threads: Any = 1) -> Arrays:
    """Screened Poisson reconstruction in a box of `scale` extents, `depth` levels deep."""
    engine, cloud = _cloud(points, normals)
    with engine.utility.VerbosityContextManager(engine.utility.VerbosityLevel.Error):
        mesh, _ = engine.geometry.TriangleMesh.create_from_point_cloud_poisson(
            cloud, depth=int(depth), scale=float(scale), n_threads=int(threads)
        )
    mesh.remove_degenerate_triangles()
    return _mesh(mesh)


def poisson_meshlab(points: Any, normals: Any, depth: Any, scale: Any, threads: Any = 1) -> Arrays:
    """The same by MeshLab."""
    pymeshlab = _loaded("pymeshlab")
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=points, v_normals_matrix=normals))
    meshes.generate_surface_reconstruction_screened_poisson(depth=int(depth), scale=float(scale), threads=int(threads))
    made = meshes.current_mesh()
    return {"vertices": made.vertex_matrix(), "faces": made.face_matrix().astype(np.int32)}


def thinned(points: Any, normals: Any, cell: Any) -> Arrays:
    """One point, the mean, and its normal per cell of that width."""
    _, cloud = _cloud(points, normals)
    cloud = cloud.voxel_down_sample(float(cell))
    cloud.normalize_normals()
    return {"points": np.asarray(cloud.points).copy(), "normals": np.asarray(cloud.normals).copy()}


def pivoted(points: Any, normals: Any, radii: Any) -> Arrays:
    """Ball pivoting with balls of these radii."""
    engine, cloud = _cloud(points, normals)
    return _mesh(engine.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, engine.utility.DoubleVector(radii)))


TASKS: dict[str, Callable[..., Arrays]] = {
    task.__name__: task for task in (covariances, turned, poisson_open3d, poisson_meshlab, thinned, pivoted)
}


def _answer(folder: Path, task: str) -> dict[str, str]:
    try:
        with np.load(folder / "in.npz", allow_pickle=False) as given:
            asked = {name: given[name] for name in given.files}
        np.savez(folder / "out.npz", allow_pickle=False, **TASKS[task](**asked))
    except ImportError as absent:
        return {"absent": str(absent)}
    except Exception as raised:  # a foreign library may raise anything
        return {"error": f"{type(raised).__name__}: {raised}"[:200]}
    return {}


def main() -> None:
    """Answer tasks until stdin ends."""
    folder = Path(sys.argv[1])
    if sys.argv[2:]:
        resource.setrlimit(resource.RLIMIT_AS, (int(float(sys.argv[2]) * 1e6),) * 2)
    replies, sys.stdout = sys.stdout, sys.stderr  # what engines say is not an answer
    for line in sys.stdin:
        print(json.dumps(_answer(folder, line.strip())), file=replies, flush=True)


if __name__ == "__main__":
    main()
