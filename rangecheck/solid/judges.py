"""One foreign program's opinion of one mesh, asked in a process of its own: a crash there is an answer, and its memory is given back.

Run as a script, `judges.py PROGRAM SOURCE ASK [MOST_MB]`, it writes one JSON document to stdout; ASK is "intersections" where MeshLab shall look for
these too, and MOST_MB bounds what it may take (10^6 bytes). SOURCE is a mesh file, or a folder with `vertices.npy` (n, 3) and `faces.npy` (m, 3): the records of an STL file whose corners
are equal bit for bit made one vertex. MeshLab and trimesh merge such corners themselves, and are asked to here too, so that this changes
nothing of what they say; it saves them from sorting millions of corners. Nothing of rangecheck is imported: what is to be loaded before the
first answer is the program itself.
"""

from __future__ import annotations

import importlib
import json
import resource
import sys
from pathlib import Path
from typing import Any

import numpy as np


def _arrays(source: Path) -> tuple[Any, Any]:
    return np.load(source / "vertices.npy"), np.load(source / "faces.npy")


def trimesh_says(source: Path, ask: str) -> dict[str, Any]:
    """By trimesh's merge rule, winding not asked for."""
    import trimesh

    # as its reader of STL makes them: vertices merged by its rule whatever normals they carry
    mesh = trimesh.Trimesh(*_arrays(source), process=True) if source.is_dir() else trimesh.load_mesh(source)
    if not len(mesh.faces):
        return {"error": "found no faces"}
    facts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "winding_consistent": bool(mesh.is_winding_consistent)}
    return {"closed": bool(mesh.is_watertight), "facts": facts}


def meshlab_says(source: Path, ask: str) -> dict[str, Any]:
    """By MeshLab's measures of topology, and its own search for faces that cross."""
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    if source.is_dir():
        meshes.add_mesh(pymeshlab.Mesh(*_arrays(source)))
    else:
        meshes.load_new_mesh(str(source))
    meshes.meshing_remove_duplicate_vertices()
    measured = meshes.get_topological_measures()
    kept = (
        "boundary_edges",
        "non_two_manifold_edges",
        "non_two_manifold_vertices",
        "connected_components_number",
        "is_mesh_two_manifold",
    )
    facts = {name: int(measured[name]) for name in kept}
    if ask == "intersections":
        meshes.compute_selection_by_self_intersections_per_face()
        facts["self_intersecting_faces"] = int(meshes.current_mesh().selected_face_number())
        named = np.flatnonzero(meshes.current_mesh().face_selection_array()).tolist()
    else:
        named = []
    closed = facts["boundary_edges"] == 0 and facts["non_two_manifold_edges"] == 0
    return {"closed": closed, "facts": facts, "crossing": named, "faces": int(meshes.current_mesh().face_number())}


def manifold_says(source: Path, ask: str) -> dict[str, Any]:
    """By manifold3d's demand for two opposite half-edges everywhere."""
    import manifold3d

    vertices, faces = _arrays(source)
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.uint64))
    )
    status = solid.status()
    if status != manifold3d.Error.NoError or solid.is_empty():
        return {"closed": False, "facts": {"status": status.name if status != manifold3d.Error.NoError else "empty"}}
    return {"closed": True, "facts": {"status": "NoError", "volume": float(solid.volume()), "genus": int(solid.genus())}}


PROGRAMS = {"trimesh": trimesh_says, "MeshLab": meshlab_says, "manifold3d": manifold_says}

if __name__ == "__main__":
    try:
        importlib.import_module(sys.argv[1].replace("MeshLab", "pymeshlab"))  # absent, or there: before memory may end
        if sys.argv[4:]:
            resource.setrlimit(resource.RLIMIT_AS, (int(float(sys.argv[4]) * 1e6),) * 2)
        said = PROGRAMS[sys.argv[1]](Path(sys.argv[2]), sys.argv[3])
    except ImportError as absent:
        said = {"error": f"not installed; pip install {absent.name}"}
    except Exception as raised:  # a foreign reader may raise anything
        said = {"error": f"{type(raised).__name__}: {raised}"[:200]}
    sys.stdout.write(json.dumps(said))
