"""A photographer's studio, sized from the object: light in which plaster reads as plaster and steel as steel.

A white surface that faces the key light has a radiance of about 1. Steel shows its surroundings and nothing else, so its studio
is mostly surroundings: large soft boxes whose edges run over the form, above a dark floor.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray, require
from rangecheck.errors import SceneError
from rangecheck.reflectance import Material
from rangecheck.scene.scene import Scene
from rangecheck.scene.sources import Source
from rangecheck.scene.surroundings import DARKNESS, Softbox, Surroundings, gradient, stripes
from rangecheck.surface import Surface

KINDS = ("plaster", "steel", "stripes", "dark")


def studio(
    surface: Surface,
    materials: Material | tuple[Material, ...],
    kind: str = "plaster",
    *,
    front: npt.ArrayLike = (0.0, 0.0, 1.0),
    up: npt.ArrayLike = (0.0, 1.0, 0.0),
    smooth: bool = False,
    material_of_part: tuple[int, ...] = (),
) -> Scene:
    """The scene of `surface`, which looks towards `front`, in a studio of one of KINDS.

    plaster: key, fill and dim even surroundings; steel: soft boxes and a small bright source; stripes: inspection bands and
    nothing else; dark: the key and the fill alone."""
    if kind not in KINDS:
        raise SceneError(f"studio is {kind!r}; there are {', '.join(KINDS)}", kind=kind)
    axes = _axes(front, up)
    sources, surroundings = _light(surface, kind, axes)
    chosen = (materials,) if isinstance(materials, Material) else tuple(materials)
    return Scene(surface, chosen, material_of_part, sources, surroundings, smooth)


def _axes(front: npt.ArrayLike, up: npt.ArrayLike) -> FloatArray:
    """(3, 3) rows right (of somebody who looks at the object), up, front."""
    ahead = require("front", front, (3,), finite=True)
    right = np.cross(require("up", up, (3,), finite=True), ahead)
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(ahead) * np.linalg.norm(up):
        raise SceneError("the studio's front and up point the same way; they must differ")
    ahead, right = ahead / np.linalg.norm(ahead), right / np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


def _towards(axes: FloatArray, azimuth_deg: float, elevation_deg: float) -> FloatArray:
    """Unit direction: azimuth 0 in front, 90 to the viewer's right; elevation upwards."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(elevation)
    return np.array([math.sin(azimuth) * level, math.sin(elevation), math.cos(azimuth) * level]) @ axes


def _light(surface: Surface, kind: str, axes: FloatArray) -> tuple[tuple[Source, ...], Surroundings]:
    middle = surface.bounds_mm.mean(axis=0)
    away = 2.5 * max(surface.extent_mm, 1e-6)
    up = axes[1]

    def lamp(irradiance: float, azimuth: float, elevation: float, radius_deg: float) -> Source:
        return Source.giving(irradiance, middle, middle + away * _towards(axes, azimuth, elevation), radius_deg)

    def box(radiance: float, azimuth: float, elevation: float, width: float, height: float, softness: float = 0.25) -> Softbox:
        return Softbox(_towards(axes, azimuth, elevation), width, height, np.array([radiance]), softness, (up[0], up[1], up[2]))

    key, fill = lamp(0.85 * math.pi, -40, 35, 2.0), lamp(0.25 * math.pi, 55, 10, 4.0)
    if kind == "plaster":
        return (key, fill), gradient(0.05, 0.12, up)
    if kind == "dark":
        return (key, fill), DARKNESS
    if kind == "stripes":
        return (), stripes(0.02, 1.0, 15.0, up)
    room = gradient(0.03, 0.30, up).with_boxes(
        box(1.3, -60, 20, 50, 100),
        box(0.9, 75, 10, 22, 110),
        box(0.6, 0, 80, 90, 50),
        box(0.8, 165, 25, 40, 90),
    )
    return (lamp(0.06 * math.pi, -25, 45, 4.0),), room
