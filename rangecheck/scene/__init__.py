"""What a picture is taken of: surface, materials, sources, surroundings."""

from rangecheck.scene.scene import Scene
from rangecheck.scene.sources import Source
from rangecheck.scene.studio import studio
from rangecheck.scene.surroundings import DARKNESS, Softbox, Surroundings, constant, gradient, panorama, stripes

__all__ = ["DARKNESS", "Scene", "Softbox", "Source", "Surroundings", "constant", "gradient", "panorama", "stripes", "studio"]
