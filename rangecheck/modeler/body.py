"""A body: triangles that know which true face each belongs to."""

from __future__ import annotations

from dataclasses import dataclass, field

from rangecheck import rigid
from rangecheck.arrays import FloatArray, IntArray
from rangecheck.modeler.true_faces import TrueFace


@dataclass(frozen=True, eq=False)
class Body:
    """Triangles with numbered faces: vertices (n, 3), faces (m, 3), label (m,) index into names and true_faces."""

    vertices: FloatArray = field(repr=False)
    faces: IntArray = field(repr=False)
    label: IntArray = field(repr=False)
    names: tuple[str, ...]
    true_faces: tuple[TrueFace, ...]

    def moved(self, motion: FloatArray) -> Body:
        """The body after a rigid motion."""
        return Body(
            rigid.move_points(motion, self.vertices),
            self.faces,
            self.label,
            self.names,
            tuple(f.moved(motion) for f in self.true_faces),
        )
