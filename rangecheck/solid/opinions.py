"""Second opinions on the same bytes: trimesh, MeshLab and manifold3d, each by its own reader and rules, and why they differ.

Rules: rangecheck welds corners whose float32 bits are equal. trimesh merges vertices equal to 8 decimals of the file's unit, drops
faces that closes, and calls a mesh watertight when each edge has two faces, whichever way they run. MeshLab merges equal vertices.
manifold3d takes the welded mesh and asks for two opposite half-edges everywhere. MeshLab runs in a process of its own, so that its
crash is an answer and not ours.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.errors import NotSolid
from rangecheck.solid.engine import to_engine
from rangecheck.solid.findings import Finding, finding
from rangecheck.surface import topology as topo
from rangecheck.surface.surface import Surface
from rangecheck.surface.weld import weld_exactly

#: decimals to which trimesh merges vertices, in the file's unit
TRIMESH_DECIMALS = 8
TIMEOUT_S = 120
Asked = subprocess.Popen[str]

_MESHLAB = """
import json, sys
import pymeshlab
meshes = pymeshlab.MeshSet(verbose=False)
meshes.load_new_mesh(sys.argv[1])
meshes.meshing_remove_duplicate_vertices()
facts = meshes.get_topological_measures()
kept = ("boundary_edges", "non_two_manifold_edges", "non_two_manifold_vertices", "connected_components_number", "is_mesh_two_manifold")
answer = {name: int(facts[name]) for name in kept}
if sys.argv[2] == "1":
    meshes.compute_selection_by_self_intersections_per_face()
    answer["self_intersecting_faces"] = int(meshes.current_mesh().selected_face_number())
print(json.dumps(answer))
"""


@dataclass(frozen=True)
class Opinion:
    """What one program says: whether the mesh is closed (None where it gave no answer), what it counted, and its error if any."""

    program: str
    closed: bool | None
    facts: Mapping[str, Any] = field(default_factory=dict)
    error: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {"program": self.program, "closed": self.closed, "facts": dict(self.facts), "error": self.error}


def second_opinions(path: str | Path, surface: Surface, *, intersections: bool = True) -> list[Opinion]:
    """Our opinion of `surface`, which was read from `path`, then those of trimesh, MeshLab and manifold3d."""
    return opinions_with(ask_meshlab(path, intersections=intersections), path, surface)


def opinions_with(meshlab: Asked, path: str | Path, surface: Surface) -> list[Opinion]:
    """As `second_opinions`, where MeshLab was asked before and had time to think."""
    ours = Opinion("rangecheck", topo.is_closed(surface), {"vertices": len(surface.vertices), "faces": len(surface.faces)})
    opinions = [ours, trimesh_opinion(path), manifold_opinion(surface)]
    return [*opinions[:2], meshlab_answer(meshlab), opinions[2]]


def trimesh_opinion(path: str | Path) -> Opinion:
    """What trimesh makes of the file."""
    try:
        import trimesh
    except ImportError:
        return Opinion("trimesh", None, error="not installed; pip install trimesh")
    try:
        mesh = trimesh.load_mesh(path)
        if not len(mesh.faces):
            return Opinion("trimesh", None, error="found no faces")
        facts = {
            "vertices": len(mesh.vertices),
            "faces": len(mesh.faces),
            "winding_consistent": bool(mesh.is_winding_consistent),
            "volume": float(mesh.volume) if mesh.is_watertight else None,
        }
        return Opinion("trimesh", bool(mesh.is_watertight), facts)
    except Exception as error:  # a foreign reader may raise anything
        return Opinion("trimesh", None, error=f"{type(error).__name__}: {error}"[:200])


def ask_meshlab(path: str | Path, *, intersections: bool = True) -> Asked:
    """MeshLab's process, begun on the file."""
    command = [sys.executable, "-c", _MESHLAB, str(Path(path).resolve()), "1" if intersections else "0"]
    quiet = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=quiet)


def meshlab_answer(process: Asked) -> Opinion:
    """What MeshLab says, when it is done."""
    try:
        out, errors = process.communicate(timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return Opinion("MeshLab", None, error=f"gave no answer in {TIMEOUT_S} s")
    if process.returncode != 0:
        last = errors.strip().splitlines()[-1:] or [f"ended with status {process.returncode}"]
        return Opinion("MeshLab", None, error=last[0][:200])
    facts = json.loads(out.strip().splitlines()[-1])
    closed = facts["boundary_edges"] == 0 and facts["non_two_manifold_edges"] == 0
    return Opinion("MeshLab", closed, facts)


def manifold_opinion(surface: Surface) -> Opinion:
    """What manifold3d makes of the welded surface."""
    try:
        solid, _ = to_engine(surface)
    except NotSolid as refusal:
        return Opinion("manifold3d", False, {"status": refusal.measured["word"]})
    return Opinion("manifold3d", True, {"status": "NoError", "volume_mm3": float(solid.volume()), "genus": int(solid.genus())})


def disagreements(
    surface: Surface, opinions: list[Opinion], unit_mm: float, severities: Mapping[str, str] | None = None
) -> list[Finding]:
    """One finding per program that judges closedness otherwise than rangecheck, with the cause as far as it can be proved."""
    ours = opinions[0].closed
    found = []
    for other in opinions[1:]:
        if other.closed is None or other.closed == ours:
            continue
        cause = _cause(surface, other, unit_mm)
        message = f"{other.program} calls it {'closed' if other.closed else 'not closed'}, rangecheck {'closed' if ours else 'not closed'}: {cause}"
        edges = topo.boundary_edges(surface)
        found.append(
            finding("opinions-differ", 1, message, surface.vertices[edges].mean(axis=1), None, severities, program=other.program)
        )
    return found


def _cause(surface: Surface, other: Opinion, unit_mm: float) -> str:
    table = topo.edge_table(surface)
    if other.closed and not len(topo.boundary_edges(surface)) and not len(topo.non_manifold_edges(surface)):
        return f"winding: {len(topo.inconsistent_edges(surface))} edges have two faces that run the same way, which it does not look at"
    rounded = np.round(surface.vertices / unit_mm, TRIMESH_DECIMALS)
    first, number = weld_exactly(rounded)
    faces = number[surface.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    merged = topo.edge_table(faces[whole])
    gone = len(surface.vertices) - len(first)
    if other.closed and gone and len(merged.uses) and (merged.uses % 2 == 0).all():
        return (
            f"merge rule: it merges vertices equal to {TRIMESH_DECIMALS} decimals, which joins {gone} vertices that differ in their "
            f"bits and closes {int((table.uses == 1).sum())} edges"
        )
    flat = topo.degenerate_faces(surface)
    if len(flat):
        kept = np.ones(len(surface.faces), bool)
        kept[flat] = False
        if topo.is_closed(surface.faces[kept]) == other.closed:
            return f"degenerate faces: it leaves out {len(flat)} faces without area"
    if topo.is_closed(surface) and not other.closed:
        return "its reader merges or drops what rangecheck keeps apart"
    if other.closed and len(topo.non_manifold_edges(surface)):
        return f"non-manifold edges: {int((table.uses > 2).sum())} edges have more than two faces, which it pairs up"
    return "its merge rule differs; no single step of ours reproduces it"
