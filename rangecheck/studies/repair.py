"""Repair: damage of growing size, by what it is, against four methods; time, deviation from what was there before, and where each fails.

The subject is a ball of 50 mm with shallow bumps, of known shape. A repair succeeds when the result passes our check of solids and lies
nowhere farther from the undamaged ball, nor the ball from it, than ALLOWED_MM. All chance is seeded. MeshLab runs in a process of its own.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np

from rangecheck.errors import SurfaceError
from rangecheck.export.meshes import write_mesh
from rangecheck.solid.engine import united
from rangecheck.solid.repair import repair
from rangecheck.solid.solid import check_solid
from rangecheck.study import Candidate, EdgeChart, SpeedChart, find_edge, measure
from rangecheck.study.charts import Chart
from rangecheck.study.parts import Part, study_of_parts
from rangecheck.surface.distance import SurfaceDistance
from rangecheck.surface.mesh_files import read_mesh
from rangecheck.surface.surface import Surface, join

RADIUS_MM, ALLOWED_MM = 50.0, 1.0

_MESHLAB = """
import sys
import pymeshlab
m = pymeshlab.MeshSet(verbose=False)
m.load_new_mesh(sys.argv[1])
m.meshing_remove_duplicate_vertices()
m.meshing_remove_duplicate_faces()
m.meshing_remove_null_faces()
for _ in range(2):
    m.compute_selection_by_self_intersections_per_face()
    if m.current_mesh().selected_face_number():
        m.meshing_remove_selected_faces()
    m.meshing_repair_non_manifold_edges()
    m.meshing_repair_non_manifold_vertices()
    m.meshing_re_orient_faces_coherently()
    m.meshing_close_holes(maxholesize=100000)
m.save_current_mesh(sys.argv[2])
"""


@cache
def ball(around: int) -> Surface:
    """The undamaged subject: rings of a sphere with poles, `around` faces a ring."""
    rings = around // 2 - 1
    u = np.arange(around) * 2 * np.pi / around
    v = np.linspace(0, np.pi, rings + 2)[1:-1]
    way = np.stack([np.outer(np.sin(v), np.cos(u)), np.outer(np.sin(v), np.sin(u)), np.outer(np.cos(v), np.ones(around))], -1)
    way = np.concatenate([way.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    radius = RADIUS_MM + np.sin(6 * way[:, 0] + 1) * np.cos(5 * way[:, 1]) + 0.5 * np.sin(9 * way[:, 2])
    i, j = (x.ravel() for x in np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij"))
    a, b, c, d = i * around + j, (i + 1) * around + j, (i + 1) * around + (j + 1) % around, i * around + (j + 1) % around
    k, top = np.arange(around), np.full(around, rings * around)
    caps = [
        np.stack([top, k, (k + 1) % around], 1),
        np.stack([top + 1, (rings - 1) * around + (k + 1) % around, (rings - 1) * around + k], 1),
    ]
    return Surface(way * radius[:, None], np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1), *caps]))


def _edge_mm(whole: Surface) -> float:
    corners = whole.triangles
    return float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))


def _hole(whole: Surface, degrees: float) -> Surface:
    middle = whole.triangles.mean(axis=1)
    toward = np.array([0.48, 0.6, 0.64])
    cosine = middle @ toward / np.linalg.norm(middle, axis=1)
    return whole.with_faces(cosine < math.cos(math.radians(degrees)))


def _noise(whole: Surface, share: float) -> Surface:
    """Radial noise, in edges: from about half an edge on the surface runs through itself."""
    random = np.random.default_rng(5).standard_normal((len(whole.vertices), 3))
    return Surface(whole.vertices + share * _edge_mm(whole) * random, whole.faces)


def _overlap(whole: Surface, depth_mm: float) -> Surface:
    """Two balls that run into each other."""
    return join([whole, Surface(whole.vertices + [2 * RADIUS_MM - depth_mm, 1.0, 2.0], whole.faces)])


def _flipped(whole: Surface, share: float) -> Surface:
    turn = np.random.default_rng(6).random(len(whole.faces)) < share
    return Surface(whole.vertices, np.where(turn[:, None], whole.faces[:, ::-1], whole.faces))


def _doubled(whole: Surface, share: float) -> Surface:
    again = np.random.default_rng(7).random(len(whole.faces)) < share
    return Surface(whole.vertices, np.concatenate([whole.faces, whole.faces[again]]))


#: damage: how it is done, what its knob means, from where to where, logarithmically or not
DAMAGES: dict[str, tuple[Callable[[Surface, float], Surface], str, float, float, bool]] = {
    "hole": (_hole, "half opening angle of a hole, degrees", 4.0, 120.0, True),
    "noise": (_noise, "noise, standard deviation in edge lengths", 0.01, 1.0, True),
    "overlap": (_overlap, "depth by which two balls overlap, mm", 0.5, 50.0, True),
    "flipped": (_flipped, "share of faces turned over", 0.01, 0.6, True),
    "doubled": (_doubled, "share of faces laid twice", 0.01, 1.0, True),
}


def _ours(damaged: Surface) -> Surface:
    return repair(damaged, max_move_mm=ALLOWED_MM, max_vanished=0.05).surface


def _meshlab(damaged: Surface) -> Surface:
    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder) / "given.ply", Path(folder) / "made.ply"
        write_mesh(damaged, given)
        done = subprocess.run(
            [sys.executable, "-c", _MESHLAB, str(given), str(made)], capture_output=True, text=True, check=False
        )
        if done.returncode != 0:
            raise SurfaceError(f"MeshLab ended with status {done.returncode}")
        return read_mesh(made, "mm")


def _trimesh(damaged: Surface) -> Surface:
    import trimesh

    mesh = trimesh.Trimesh(damaged.vertices, damaged.faces, process=True)
    mesh.update_faces(mesh.unique_faces())
    mesh.update_faces(mesh.nondegenerate_faces())
    trimesh.repair.fill_holes(mesh)
    trimesh.repair.fix_normals(mesh, multibody=True)
    return Surface(np.asarray(mesh.vertices, float), np.asarray(mesh.faces))


METHODS: dict[str, Callable[[Surface], Surface]] = {
    "rangecheck": _ours,
    "MeshLab": _meshlab,
    "trimesh": _trimesh,
    "manifold3d": united,
}


def truth_of(damage: str, whole: Surface, knob: float) -> Surface:
    """What a perfect repair would give back: the undamaged ball; of two that overlap, their union; of noise, the noisy surface itself."""
    if damage == "overlap":
        return united(_overlap(whole, knob))
    return _noise(whole, knob) if damage == "noise" else whole


def error_mm(result: Surface, truth: Surface) -> float:
    """Farthest way between the two at their vertices and face middles, both ways; infinite for what is no solid."""
    if not len(result.faces) or not check_solid(result).fit:
        return math.inf
    far = 0.0
    for of, reference in ((result, truth), (truth, result)):
        probes = np.concatenate([of.vertices[np.unique(of.faces)], of.triangles.mean(axis=1)])
        far = max(far, float(SurfaceDistance(reference).distance_mm(probes)[0].max()))
    return far


def _error_at(damage: str, method: str, around: int, knob: float) -> float:
    whole = ball(around)
    result = METHODS[method](DAMAGES[damage][0](whole, knob))
    return error_mm(result, truth_of(damage, whole, knob))


def _edges(damage: str, quick: bool) -> Part:
    """Where each method first fails as one kind of damage grows, and what a repair of a quarter of the way costs."""
    make, knob_label, start, stop, logarithmic = DAMAGES[damage]
    around = 24 if quick else 96
    edges = []
    for method in METHODS:
        edges.append(
            find_edge(
                method, partial(_error_at, damage, method, around), start, stop, ALLOWED_MM,
                logarithmic=logarithmic, samples=3 if quick else 9, tolerance=0.2 if quick else 0.03,
            )
        )  # fmt: skip
    whole = ball(around)
    knob = start * (stop / start) ** 0.25
    damaged, truth = make(whole, knob), truth_of(damage, whole, knob)
    candidates = [Candidate(name, f"{knob:.3g}", partial(_tried, method, damaged)) for name, method in METHODS.items()]
    measured = measure(
        candidates, lambda result: math.nan if result is None else error_mm(result, truth), rounds=1 if quick else 3
    )
    chart = EdgeChart(f"{damage}-edges", f"Repair: {damage}", knob_label, "farthest deviation, mm; gap: no solid", edges)
    speed = SpeedChart(f"{damage}-speed", f"Repair: {damage}, {knob_label} {knob:.3g}", "farthest deviation, mm", "s", measured)
    rows = [
        {
            "damage": damage,
            "method": e.method,
            "holds_at": e.holds_at,
            "breaks_at": e.breaks_at,
            "seconds": m.seconds,
            "deviation_mm": m.error,
        }
        for e, m in zip(edges, measured)
    ]
    said = [f"{damage} ({knob_label}): {e.in_words}; {m.seconds:.2f} s at {knob:.3g}" for e, m in zip(edges, measured)]
    drawn: list[Chart] = [chart, speed] if any(math.isfinite(m.error) for m in measured) else [chart]
    return Part(drawn, said, {damage: rows})


def _tried(method: Callable[[Surface], Surface], damaged: Surface) -> Surface | None:
    try:
        return method(damaged)
    except SurfaceError:
        return None


_PARTS = {damage: partial(_edges, damage) for damage in DAMAGES}
PARTS = tuple(_PARTS)
study = study_of_parts("repair", "Repair of seeded damage: time, deviation, and where each method fails", _PARTS)
