"""Scenes that studies are made on: a ball, a ball on a table, a bowl, the sample bust's relief, of plaster and of steel, in several lights.

World frame, millimetres, y up, seen from +z. One wavelength, unless a study asks for more.
"""

from __future__ import annotations

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray
from rangecheck.errors import SettingError
from rangecheck.optics import PinholeCamera
from rangecheck.reflectance import GREY_UM, Material, load_material
from rangecheck.scene import DARKNESS, Scene, Source, constant, gradient, stripes
from rangecheck.surface import Surface
from rangecheck.surface.surface import join

RADIUS_MM = 50.0
SHAPES = ("ball", "table", "bowl", "bust")
MATERIALS = {"plaster": "plaster", "steel": "steel", "satin": "steel_satin", "ground": "steel_ground"}
LIGHTS = ("dark", "even", "sky", "stripes")
LAMPS = (Source(np.array([200.0, 260.0, 220.0]), 30.0, np.array([20.0])), Source(np.array([-260.0, 120.0, 160.0]), 25.0, np.array([8.0])))  # fmt: skip


def ball(subdivisions: int = 5, radius_mm: float = RADIUS_MM, inward: bool = False) -> Surface:
    """A sphere of 20 x 4^n faces whose vertices lie on it."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    points = np.asarray(mesh.vertices) / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    faces = np.asarray(mesh.faces, np.int32)
    return Surface(points * radius_mm, faces[:, ::-1] if inward else faces, part_names=("ball",))


def floor(size_mm: float = 200.0, y_mm: float = -RADIUS_MM) -> Surface:
    """A square that looks up."""
    corners = 0.5 * size_mm * np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], float) + [0, y_mm, 0]
    return Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]), part_names=("floor",))


def bust_relief(width: int = 200, height: int = 240) -> Surface:
    """The sample bust as a range finder without noise sees it from the front, brought to 100 mm about the origin."""
    from rangecheck.raycast.implicit import ImplicitCaster
    from rangecheck.scan.sample import TARGET_MM
    from rangecheck.scan.simulate import RangeFinder, simulate_scan
    from rangecheck.surface.meshing.grid import grid_mesh

    finder = RangeFinder(source_mm=(150.0, 0.0, 0.0), working_distance_mm=600.0, noise_mm=0.0, step_mm=0.0)
    camera = PinholeCamera(width, height, 1.8 * height, 1.8 * height, (width - 1) / 2, (height - 1) / 2)
    pose = rigid.look_at(np.array(TARGET_MM) + [0.0, 0.0, 600.0], TARGET_MM)
    mesh = grid_mesh(simulate_scan(ImplicitCaster.of_bust(), camera, pose, finder, 0).scan)
    return Surface((mesh.vertices - TARGET_MM) / 3.0, mesh.faces, part_names=("bust",))


def scene_named(name: str) -> Scene:
    """`shape material light`, such as "table satin sky"; `material` may be two, floor and ball, joined by +. Raises SettingError."""
    words = name.split()
    materials = words[1].split("+") if len(words) == 3 else []
    if len(words) != 3 or words[0] not in SHAPES or words[2] not in LIGHTS or not set(materials) <= set(MATERIALS):
        raise SettingError(
            f"there is no scene {name!r}; a scene is a shape ({', '.join(SHAPES)}), a material ({', '.join(MATERIALS)}) and a light "
            f"({', '.join(LIGHTS)})",
            key=name,
        )
    surface = _shape(words[0])
    parts = len(surface.part_names)
    made: tuple[Material, ...] = tuple(load_material(MATERIALS[m]).at(GREY_UM) for m in materials)
    around = {
        "dark": DARKNESS,
        "even": constant(0.3),
        "sky": gradient(0.05, 0.5),
        "stripes": stripes(0.05, 0.8, 30.0, softness=0.3),
    }[words[2]]
    return Scene(
        surface,
        made,
        material_of_part=tuple(range(parts)) if len(made) > 1 else (0,) * parts,
        sources=() if words[2] == "stripes" else LAMPS,
        surroundings=around,
        smooth_of_part=(False, True)[-parts:],
    )


def _shape(word: str) -> Surface:
    if word == "bust":
        return bust_relief()
    if word == "table":
        return join([floor(), ball(4)])
    whole = ball(4, inward=word == "bowl")
    return whole.with_faces(whole.triangles.mean(axis=1)[:, 2] < 0) if word == "bowl" else whole


def view(size: int, fov_deg: float = 26.0) -> tuple[PinholeCamera, FloatArray]:
    """A square picture of the things about the origin, from a little above."""
    return PinholeCamera.from_field_of_view(size, size, fov_deg), rigid.look_at(np.array([0.0, 60.0, 290.0]), np.zeros(3))
