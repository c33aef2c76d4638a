"""Maps against closed forms: distances of simple solids and of the sample bust, mirrored IDs of scenes that can be written down.

Distances: every point of a map lies off the true surface by no more than the tessellation's bound. Mirrored IDs: away from the borders
between faces every pixel's chain of reflections is the analytic one, exactly.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck import rigid
from rangecheck.analytic import shapes
from rangecheck.analytic.reflections import away_from_borders, ball_on_mirror_ids, box_corner_chain
from rangecheck.arrays import FloatArray
from rangecheck.errors import SceneError
from rangecheck.maps import back_projection_error, trace_chain, trace_maps
from rangecheck.modeler import Model, model_from_dict
from rangecheck.optics import PinholeCamera
from rangecheck.studies.pictures_lines import shipped
from rangecheck.studies.whole_commands import sample_mesh
from rangecheck.study import Part
from rangecheck.surface.mesh_files import read_mesh

SOLIDS: dict[str, tuple[dict[str, Any], shapes.Shape]] = {
    "sphere": ({"shape": "sphere", "radius_mm": 30}, shapes.Sphere(30)),
    "plane": ({"shape": "plane", "size_mm": [100, 80]}, shapes.Plane(1e9)),
    "cone": ({"shape": "cone", "radius_mm": 25, "height_mm": 60}, shapes.Cone(25, 60)),
    "torus": ({"shape": "torus", "major_mm": 30, "minor_mm": 10}, shapes.Torus(30, 10)),
}
FOCAL_POINTS = ((0.0, 60.0, 160.0), (120.0, -90.0, 70.0), (-2000.0, 1500.0, -1000.0))
INSIDE = {"sphere": (0.0, 0.0, 0.0), "cone": (0.0, -40.0, 0.0), "torus": (30.0, 0.0, 0.0)}
TOLERANCE_MM = 0.05
#: the sample bust's map may be off the surface by this share of its extent
BUST_SHARE = 1e-4
SIDE_MM = 100.0


def _scene(*bodies: dict[str, Any], tolerance_mm: float) -> Model:
    return model_from_dict({"tolerance_mm": tolerance_mm, "body": list(bodies)})


def _distances(quick: bool) -> tuple[list[str], list[dict[str, Any]]]:
    findings, rows = [], []
    size = 121 if quick else 481
    for name, (row, truth) in SOLIDS.items():
        model = _scene({"name": name} | row, tolerance_mm=TOLERANCE_MM)
        worst, pixels = 0.0, 0
        for point in FOCAL_POINTS:
            away = float(np.linalg.norm(point))
            camera = PinholeCamera.from_field_of_view(size, size, 2 * math.degrees(math.atan(70 / away)))
            maps = trace_maps(model.surface, camera, rigid.look_at(point, (0, 0, 0)))
            off = np.abs(truth.signed_distance(maps.points_mm()[maps.hit]))
            rows.append(
                {
                    "solid": name,
                    "focal_point_mm": point,
                    "pixels": len(off),
                    "largest_mm": float(off.max()),
                    "bound_mm": TOLERANCE_MM,
                }
            )
            worst, pixels = max(worst, float(off.max())), pixels + len(off)
        kept = "kept" if worst <= TOLERANCE_MM + 1e-9 * 2700 else "missed"
        findings.append(
            f"{name}: {pixels:,} pixels from 3 focal points lie within {worst:.4f} mm of the closed form (bound of the facets {TOLERANCE_MM:g} mm: {kept})"
        )
        if name in INSIDE:
            findings.append(f"{name}: a focal point inside it is {_refused(model, INSIDE[name])}")
    return findings, rows


def _refused(model: Model, point: tuple[float, float, float]) -> str:
    try:
        trace_maps(model.surface, PinholeCamera.from_field_of_view(9, 9, 40), rigid.look_at(point, np.add(point, (0, 0, 50.0))))
    except SceneError as error:
        return f"refused ({error})"
    return "NOT refused"


def _bust(quick: bool) -> tuple[str, dict[str, Any]]:
    with tempfile.TemporaryDirectory() as name:
        surface = read_mesh(sample_mesh(Path(name), 4.0 if quick else None), "mm")
    middle = surface.bounds_mm.mean(axis=0)
    camera = PinholeCamera.from_field_of_view(640, 640, 32)
    maps = trace_maps(surface, camera, rigid.look_at(middle + [60.0, 100.0, 900.0], middle))
    proof = back_projection_error(surface, maps)
    worst = max(proof.distance_max_mm, proof.depth_max_mm) / surface.extent_mm
    kept = "kept" if worst <= BUST_SHARE else "missed"
    said = (
        f"sample bust: {proof.pixels:,} pixels sent back by distance and by depth lie within {worst:.1e} of its extent of the surface "
        f"(bar {BUST_SHARE:g}: {kept})"
    )
    return said, {"pixels": proof.pixels, "distance_mm": proof.distance_max_mm, "depth_mm": proof.depth_max_mm, "share": worst}


def _corner(eye: tuple[float, float, float], size: int) -> dict[str, Any]:
    """Three mutually facing squares, three reflections."""
    half = 0.5 * SIDE_MM
    names = ("x wall", "floor", "z wall")
    turns, places = ([0, 0, -90], [0, 0, 0], [90, 0, 0]), ([0, half, half], [half, 0, half], [half, half, 0])
    model = _scene(
        *({"name": n, "shape": "plane", "size_mm": [SIDE_MM, SIDE_MM], "turn_deg": t, "at_mm": p} for n, t, p in zip(names, turns, places)),
        tolerance_mm=TOLERANCE_MM,
    )  # fmt: skip
    camera, pose = PinholeCamera.from_field_of_view(size, size * 5 // 6, 45), rigid.look_at(eye, (35, 35, 35))
    maps = trace_maps(model.surface, camera, pose)
    chain = trace_chain(model.surface, maps, bounces=3)
    directions = _world_directions(camera, pose).reshape(-1, 3)
    ids, clearance = box_corner_chain(np.tile(eye, (len(directions), 1)), directions, SIDE_MM, 3)
    found = np.concatenate([maps.part_id[None], chain.part_ids]).reshape(4, -1)
    return _counted("box corner, three reflections", found, ids, clearance > 1e-4 * SIDE_MM)


def _ball(eye: tuple[float, float, float], size: int) -> dict[str, Any]:
    radius, half = 30.0, 150.0
    model = _scene(
        {"name": "ball", "shape": "sphere", "radius_mm": radius, "at_mm": [0, radius, 0]},
        {"name": "plane", "shape": "plane", "size_mm": [2 * half, 2 * half]},
        tolerance_mm=0.002,
    )
    camera, pose = PinholeCamera.from_field_of_view(size, size, 35), rigid.look_at(eye, (0, 20, 0))
    maps = trace_maps(model.surface, camera, pose)
    chain = trace_chain(model.surface, maps, normals=model.normals_at)
    expected = np.stack(ball_on_mirror_ids(np.array(eye), _world_directions(camera, pose), radius, half))
    return _counted("ball over plane", np.stack([maps.part_id, chain.secondary_id]), expected, away_from_borders(expected))


def _world_directions(camera: PinholeCamera, pose: FloatArray) -> FloatArray:
    return camera.pixel_rays()[1] @ pose[:3, :3].T


def _counted(scene: str, found: Any, expected: Any, away: Any) -> dict[str, Any]:
    right = (found == expected).all(axis=0)
    return {
        "scene": scene,
        "pixels": int(right.size),
        "away": int(away.sum()),
        "right_away": int(right[away].sum()),
        "right": int(right.sum()),
    }


def _booleans() -> str:
    """The faces of a block keep their IDs, whatever is taken out of it."""
    box = {"name": "box", "shape": "box", "size_mm": [60, 40, 50]}
    names = []
    for x in (-20.0, 0.0, 28.0):
        bore = {"name": "bore", "shape": "cylinder", "radius_mm": 9, "height_mm": 90, "at_mm": [x, 0, 0]}
        names.append(
            _scene({"name": "block", "shape": "difference", "of": [box, bore]}, tolerance_mm=TOLERANCE_MM).surface.part_names
        )
    same = len(set(names)) == 1
    return f"IDs of a block with a bore in three places: {'the same' if same else 'DIFFERENT'} {len(names[0])} in each, {', '.join(names[0][:3])} ..."


def maps_part(quick: bool) -> Part:
    """Distances, back-projection and mirrored IDs."""
    findings, distances = _distances(quick)
    said, bust = _bust(quick)
    findings.append(said)
    size = 161 if quick else 481
    chains = [_corner((160.0, 140.0, 170.0), size), _corner((300.0, 60.0, 90.0), size), _ball((60.0, 120.0, 260.0), size)]
    findings += [
        f"{row['scene']}: {row['right_away']:,} of {row['away']:,} pixels away from edges have exactly the analytic IDs; of all "
        f"{100 * row['right'] / row['pixels']:.3f} %"
        for row in chains
    ]
    findings.append(_booleans())
    model = shipped("workshop")
    assert model.camera is not None and model.world_from_camera is not None
    maps = trace_maps(model.surface, model.camera, model.world_from_camera)
    pairs = trace_chain(model.surface, maps, normals=model.normals_at).pairs(maps)
    table = [{"surface": seen, "mirrors": met, "pixels": count} for seen, met, count in pairs]
    mirrored = [row for row in table if row["mirrors"] != "nothing"]
    findings.append(f"workshop: {len(mirrored)} pairs of faces of which one mirrors the other; see the table")
    return Part(findings=findings, tables={"distances": distances, "bust": [bust], "chains": chains, "workshop": table})
