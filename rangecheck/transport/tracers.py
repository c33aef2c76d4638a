"""Pictures of one surface in several lights and materials: what is large, its tree and its corners, is made once."""

from __future__ import annotations

from rangecheck.scene import Scene
from rangecheck.transport.tracer import Tracer


class Tracers:
    """Tracers of scenes one after another; those of one surface share its tree and corners."""

    def __init__(self) -> None:
        self._last: Tracer | None = None

    def of(self, scene: Scene) -> Tracer:
        """A tracer of `scene`."""
        if self._last is None or not _same_shape(self._last.scene, scene):
            self._last = None  # gone before the next is built
            self._last = Tracer(scene)
        return self._last if self._last.scene is scene else self._last.lit_as(scene)


def _same_shape(a: Scene, b: Scene) -> bool:
    """Whether two scenes differ in lights and materials alone."""
    shapes = ((s.material_of_part, s.smooth, s.smooth_of_part) for s in (a, b))
    return a.surface is b.surface and a.vertex_normals is b.vertex_normals and len(set(shapes)) == 1
