"""Surfaces to manifold3d (3.5) and back, keeping which face came from which; how it is loaded and read is the modeler's adapter.

Its traps: float32 `Mesh` rounds, so `Mesh64` is used throughout; a refused mesh becomes an empty solid whose `status()` says why and
which empties whatever it meets; `simplify` collapses edges between faces of the same `face_id` only, so every face gets its own unless
that is wanted;
vertices must be shared by index; booleans drop what is thinner than its tolerance (about 1e-12 of the extent in double precision).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import NotSolid
from rangecheck.modeler.engine import manifold3d_module, mesh_of, triangulate
from rangecheck.surface.surface import INVENTED, Surface

#: what manifold3d takes of a face (measured from 2e5 to 6e6 faces: 360 to 405), and the tables that stand beside it
BYTES_A_FACE = 405 + 75
__all__ = ["cross_section", "from_engine", "hull_of", "needed_mb", "prism", "simplified", "to_engine", "triangulate", "united"]


def to_engine(surface: Surface, face_id: IntArray | None = None) -> tuple[Any, int]:
    """The surface as a manifold3d solid, and the number by which its faces are known in later results.

    `face_id` (m,) names faces that may be merged with their like by `simplify`; by default every face has its own name.
    Raises NotSolid, with the engine's word, when it is refused."""
    m3d = manifold3d_module()
    name = int(m3d.Manifold.reserve_ids(1))
    faces = np.ascontiguousarray(surface.faces, np.uint64)
    mesh = m3d.Mesh64(
        vert_properties=np.array(surface.vertices),
        tri_verts=faces,
        run_index=np.array([0, 3 * len(faces)], np.uint64),
        run_original_id=np.array([name], np.uint32),
        face_id=np.arange(len(faces), dtype=np.uint64) if face_id is None else np.ascontiguousarray(face_id, np.uint64),
    )
    solid = m3d.Manifold(mesh)
    status = solid.status()
    if status != m3d.Error.NoError or solid.is_empty():
        word = status.name if status != m3d.Error.NoError else "empty"
        raise NotSolid(
            f"manifold3d refuses the surface ({word}); check_solid() says where it is not solid", word=word, findings=()
        )
    return solid, name


def needed_mb(faces: int) -> float:
    """About what the engine takes for so many faces, megabytes (10^6 bytes)."""
    return BYTES_A_FACE * faces / 1e6


def simplified(surface: Surface, tolerance_mm: float) -> Surface:
    """`surface` with edges collapsed while its faces stay within about `tolerance_mm`; faces of different part or origin stay apart.

    Raises NotSolid when the engine refuses the surface."""
    kinds, kind = np.unique(np.stack([surface.part_of_face, surface.origin_of_face], axis=1), axis=0, return_inverse=True)
    kind = kind.reshape(-1)
    solid, number = to_engine(surface, kind)
    # one face stands for each kind: what from_engine looks up is its part and origin
    legend = Surface(np.zeros((1, 3)), np.zeros((len(kinds), 3), np.int32), kinds[:, 0], kinds[:, 1], surface.part_names)
    return from_engine(solid.simplify(tolerance_mm), [(number, legend)], surface.part_names[0])


def from_engine(solid: Any, sources: Sequence[tuple[int, Surface]], new_part: str, new_origin: int = INVENTED) -> Surface:
    """The engine's solid as a surface. Faces that came from `sources` (number, surface) keep part and origin; all others belong
    to `new_part` and are of `new_origin`."""
    vertices, faces, mesh = mesh_of(solid)
    source_of, face_of = _provenance(mesh, len(faces))
    names: list[str] = []
    part = np.zeros(len(faces), np.int32)
    origin = np.full(len(faces), new_origin, np.uint8)
    known = np.zeros(len(faces), bool)
    for number, surface in sources:
        here = source_of == number
        known |= here
        origin[here] = surface.origin_of_face[face_of[here]]
        for i, name in enumerate(surface.part_names):
            mine = here & (surface.part_of_face[np.minimum(face_of, len(surface.faces) - 1)] == i)
            if mine.any():
                part[mine] = _index_of(names, name)
    if not known.all():
        part[~known] = _index_of(names, new_part)
    used, place = np.unique(faces, return_inverse=True)
    return Surface(vertices[used], place.reshape(-1, 3), part, origin, tuple(names))


def _index_of(names: list[str], name: str) -> int:
    if name not in names:
        names.append(name)
    return names.index(name)


def _provenance(mesh: Any, count: int) -> tuple[IntArray, IntArray]:
    """Number of the source solid and face within it, of each face of an engine's mesh."""
    runs = np.asarray(mesh.run_index, np.int64) // 3
    source = np.repeat(np.asarray(mesh.run_original_id, np.int64), np.diff(runs))
    face = np.asarray(mesh.face_id, np.int64)
    if len(source) != count or len(face) != count:
        return np.full(count, -1), np.zeros(count, np.int64)
    return source, face


def cross_section(points: FloatArray | Sequence[FloatArray], margin_mm: float) -> Any:
    """Plane shape: the hull of points (n, 2) widened by a rounded margin, or rings with their holes where a sequence is given."""
    m3d = manifold3d_module()
    if not isinstance(points, np.ndarray):
        return m3d.CrossSection([np.ascontiguousarray(r, np.float64) for r in points], m3d.FillRule.EvenOdd)
    hull = m3d.CrossSection.hull_points(np.ascontiguousarray(points, np.float64))
    return hull.offset(margin_mm, m3d.JoinType.Round, circular_segments=64) if margin_mm else hull


def prism(section: Any, low_mm: float, high_mm: float) -> Any:
    """A plane shape from one height to another along z."""
    return section.extrude(high_mm - low_mm).translate((0.0, 0.0, low_mm))


def hull_of(solids: Sequence[Any]) -> Any:
    """The convex hull of the engine's solids."""
    return manifold3d_module().Manifold.batch_hull(list(solids))


def united(surface: Surface, new_part: str = "united") -> Surface:
    """The union of all shells of a surface, each closed and manifold by itself; faces keep part and origin. Raises NotSolid, with the engine's
    word, where a shell is not."""
    solid, number = to_engine(surface)
    whole = manifold3d_module().Manifold.batch_boolean(solid.decompose(), manifold3d_module().OpType.Add)
    return from_engine(whole, [(number, surface)], new_part)
