"""Ray engines on the same triangles and rays: how many rays a second, whether they agree, and what threads bring.

Coherent rays are a picture's, row by row; incoherent ones start all over the surface in directions that have nothing in common.
Truth is the float64 test of every triangle, for a sample of the rays. All engines get float32 rays about the object's middle.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import DependencyMissing
from rangecheck.kernels import in_chunks, thread_count, threads
from rangecheck.optics import PinholeCamera
from rangecheck.raycast import BruteCaster, EmbreeCaster
from rangecheck.studies.scenes import bust_relief
from rangecheck.study import Candidate, Part, SpeedChart, measure, study_of_parts
from rangecheck.surface import Surface

_CHUNK = 16384
Engine = Callable[[FloatArray, FloatArray], tuple[IntArray, FloatArray]]


def _subject(quick: bool) -> Surface:
    return bust_relief(100, 120) if quick else bust_relief(400, 480)


def _rays(surface: Surface, caster: EmbreeCaster, count: int) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Local float32 origins and directions (n, 3): coherent and incoherent, about as many."""
    side = int(np.sqrt(count))
    camera = PinholeCamera.from_field_of_view(side, side, 24.0)
    pose = rigid.look_at(np.array([0.0, 20.0, 290.0]), np.zeros(3))
    origins, directions = (a.reshape(-1, 3) for a in camera.pixel_rays())
    origins, directions = rigid.move_points(pose, origins), rigid.move_directions(pose, directions)
    rng = np.random.default_rng(8)
    faces = rng.integers(0, len(surface.faces), side * side)
    normals = surface.face_normals[faces]
    ways = rng.standard_normal((side * side, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    ways *= np.sign(np.einsum("ij,ij->i", ways, normals))[:, None]
    starts = surface.triangles[faces].mean(axis=1) + caster.skin_mm * normals

    def local(points: FloatArray) -> FloatArray:
        return np.ascontiguousarray((points - caster.centre_mm) / caster.scale_mm, np.float32)

    near = np.maximum(np.linalg.norm(origins - caster.centre_mm, axis=1) - 2.0 * caster.scale_mm, 0.0)
    coherent = local(origins + near[:, None] * directions), np.ascontiguousarray(directions, np.float32)
    return {"coherent": coherent, "incoherent": (local(starts), np.ascontiguousarray(ways, np.float32))}


def _ours(caster: EmbreeCaster, coherent: bool) -> Engine:
    def cast(origins: FloatArray, directions: FloatArray) -> tuple[IntArray, FloatArray]:
        n = len(origins)
        far, face = np.full(n, np.inf, np.float32), np.empty(n, np.int32)
        u, v = np.empty(n, np.float32), np.empty(n, np.float32)

        def chunk(start: int, stop: int) -> None:
            s = slice(start, stop)
            caster.closest_local(origins[s], directions[s], far[s], face[s], u[s], v[s], coherent=coherent)

        in_chunks(chunk, n, _CHUNK)
        return face, np.where(face >= 0, far, np.inf)

    return cast


def _embreex(vertices: FloatArray, faces: IntArray) -> Engine:
    from embreex import mesh_construction, rtcore_scene

    scene = rtcore_scene.EmbreeScene()
    mesh = mesh_construction.TriangleMesh(scene, vertices, faces)
    scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))

    def cast(origins: FloatArray, directions: FloatArray) -> tuple[IntArray, FloatArray]:
        assert mesh is not None  # it must outlive the scene
        n = len(origins)
        face, far = np.empty(n, np.int32), np.empty(n, np.float32)

        def chunk(start: int, stop: int) -> None:
            s = slice(start, stop)
            found = scene.run(origins[s], directions[s], dists=np.full(stop - start, 1e30, np.float32), output=True)
            face[s], far[s] = found["primID"], found["tfar"]

        in_chunks(chunk, n, _CHUNK)
        return face, np.where(face >= 0, far, np.inf)

    return cast


def _open3d(vertices: FloatArray, faces: IntArray) -> Engine:
    try:
        import open3d
    except ImportError:
        raise DependencyMissing("open3d", "comparison of ray engines", "pip install 'rangecheck[engines]'") from None
    o3d: Any = open3d
    scene = o3d.t.geometry.RaycastingScene(nthreads=thread_count())
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces.astype(np.uint32)))

    def cast(origins: FloatArray, directions: FloatArray) -> tuple[IntArray, FloatArray]:
        answer = scene.cast_rays(o3d.core.Tensor(np.hstack([origins, directions])), nthreads=thread_count())
        far = answer["t_hit"].numpy()
        return np.where(np.isfinite(far), answer["primitive_ids"].numpy().astype(np.int64), -1).astype(np.int32), far

    return cast


def _engines(surface: Surface, caster: EmbreeCaster) -> dict[str, Engine]:
    vertices = np.ascontiguousarray(caster.vertices, np.float32)
    return {
        "Embree called directly, 16 at a time": _ours(caster, True),
        "Embree called directly, one by one": _ours(caster, False),
        "embreex in threads": _embreex(vertices, caster.faces),
        "open3d RaycastingScene": _open3d(vertices, caster.faces),
    }


def _agreement(surface: Surface, caster: EmbreeCaster, engines: dict[str, Engine], rays: Any, count: int) -> list[dict[str, Any]]:
    """Share of rays that each engine answers otherwise than float64 does: hit or miss, and by how much distances differ, mm."""
    rows = []
    for kind, (origins, directions) in rays.items():
        chosen = np.linspace(0, len(origins) - 1, count).astype(int)
        ways = directions[chosen].astype(np.float64)
        truth = BruteCaster(caster.vertices, caster.faces).closest(origins[chosen].astype(np.float64), ways)
        for name, cast in engines.items():
            face, far = cast(origins, directions)
            hit, true_hit = face[chosen] >= 0, truth.face >= 0
            both = hit & true_hit
            gap = np.abs(far[chosen][both] - truth.distance_mm[both]) * caster.scale_mm
            rows.append(
                {
                    "rays": kind, "engine": name, "asked": count, "hit_or_miss_wrong": float((hit != true_hit).mean()),
                    "other_face": float((face[chosen][both] != truth.face[both]).mean()) if both.any() else 0.0,
                    "distance_median_mm": float(np.median(gap)) if both.any() else 0.0,
                    "distance_worst_mm": float(gap.max()) if both.any() else 0.0,
                }
            )  # fmt: skip
    return rows


def _engines_part(quick: bool) -> Part:
    """Rays a second of every engine on all threads and on one, and whether they agree with float64."""
    surface = _subject(quick)
    caster = EmbreeCaster(surface.vertices, surface.faces)
    rays = _rays(surface, caster, 16_384 if quick else 1_048_576)
    engines = _engines(surface, caster)
    agreement = _agreement(surface, caster, engines, rays, 20 if quick else 400)
    wrong = {(row["rays"], row["engine"]): row["hit_or_miss_wrong"] + row["distance_worst_mm"] for row in agreement}
    charts, rows, said = [], [], []
    many = thread_count()
    for kind, (origins, directions) in rays.items():
        measured = {}
        for count in sorted({1, many}):
            with threads(count):
                candidates = [
                    Candidate(name, f"{count} threads", partial(_cast, cast, origins, directions, (kind, name)))
                    for name, cast in engines.items()
                ]
                measured[count] = measure(candidates, lambda key: max(wrong[key], 1e-9), rounds=3 if quick else 7)
        charts.append(
            SpeedChart(
                f"engines-{kind}",
                f"Ray engines, {kind} rays, {len(surface.faces):,} faces",
                "wrong hits (share) + worst distance (mm)",
                "ns per ray",
                [m for group in measured.values() for m in group],
                work=len(origins),
                scale=1e9,
            )
        )
        for one, all_of_them in zip(measured[1], measured[many]):
            fast, slow = len(origins) / all_of_them.seconds / 1e6, len(origins) / one.seconds / 1e6
            rows.append(
                {
                    "rays": kind,
                    "engine": one.method,
                    "million_per_s": fast,
                    "million_per_s_on_one": slow,
                    "speedup": fast / slow,
                    "threads": many,
                }
            )
            said.append(
                f"{kind} rays, {one.method}: {fast:.3g} million a second on {many} threads, {slow:.3g} on one ({fast / slow:.2f} times)"
            )
    for row in agreement:
        said.append(
            f"{row['rays']} rays, {row['engine']}: of {row['asked']} rays {100 * row['hit_or_miss_wrong']:.2g} % hit or missed wrongly, "
            f"{100 * row['other_face']:.2g} % named another face, distances off by {row['distance_median_mm']:.2g} mm (median), "
            f"{row['distance_worst_mm']:.2g} mm (worst)"
        )
    return Part(charts, said, {"engines": rows, "agreement": agreement})


def _cast(cast: Engine, origins: FloatArray, directions: FloatArray, key: tuple[str, str]) -> tuple[str, str]:
    cast(origins, directions)
    return key


def _chunks_part(quick: bool) -> Part:
    """What cutting rays into chunks for threads costs: the same rays in chunks of many sizes."""
    surface = _subject(quick)
    caster = EmbreeCaster(surface.vertices, surface.faces)
    origins, directions = _rays(surface, caster, 16_384 if quick else 262_144)["coherent"]
    n = len(origins)
    far, face, u, v = np.empty(n, np.float32), np.empty(n, np.int32), np.empty(n, np.float32), np.empty(n, np.float32)

    def cast(size: int) -> int:
        far[:] = np.inf

        def chunk(start: int, stop: int) -> None:
            s = slice(start, stop)
            caster.closest_local(origins[s], directions[s], far[s], face[s], u[s], v[s], coherent=True)

        in_chunks(chunk, n, size)
        return size

    sizes = (256, 1024, 4096, 16384, 65536)
    candidates = [Candidate("coherent rays", f"{size}", partial(cast, size)) for size in sizes]
    measured = measure(candidates, float, rounds=3 if quick else 9)
    best = min(m.seconds for m in measured)
    rows = [{"chunk": int(m.error), "ns_per_ray": m.seconds / n * 1e9, "over_best": m.seconds / best} for m in measured]
    said = [
        f"chunks of {row['chunk']} rays: {row['ns_per_ray']:.3g} ns per ray, {row['over_best']:.2f} times the best"
        for row in rows
    ]
    return Part((), said, {"chunks": rows})


_PARTS = {"engines": _engines_part, "chunks": _chunks_part}
PARTS = tuple(_PARTS)
study = study_of_parts("rays", "Ray engines: speed, agreement, threads", _PARTS)
