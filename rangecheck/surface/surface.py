"""`Surface`: an immutable triangle mesh whose faces carry their part and their origin.

Millimetres; faces are counter-clockwise seen from outside. Origin says how far to trust a face: measured (spanned by range
samples), interpolated (between samples, within a stated distance), invented (nothing was measured there).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray, require, unit_vectors
from rangecheck.errors import ArrayError
from rangecheck.surface.normals import angle_weighted_into, area_vectors_into

MEASURED, INTERPOLATED, INVENTED = 0, 1, 2
#: of large meshes
FACES_AT_ONCE = 1 << 20
ORIGIN_NAMES = ("measured", "interpolated", "invented")


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles.

    vertices        (n, 3) float64 mm
    faces           (m, 3) int32 indices into vertices
    part_of_face    (m,) int32 index into part_names
    origin_of_face  (m,) uint8: MEASURED, INTERPOLATED or INVENTED
    part_names      names of the parts; IDs in maps are part index + 1, 0 means none
    vertex_error_mm (n,) float64 expected standard error of each vertex along the normal, or None
    refined_of_face (m,) bool whether a picture had a say in the face's heights, or None
    """

    vertices: FloatArray = field(repr=False)
    faces: IntArray = field(repr=False)
    part_of_face: IntArray = field(default_factory=lambda: np.empty(0, np.int32), repr=False)
    origin_of_face: IntArray = field(default_factory=lambda: np.empty(0, np.uint8), repr=False)
    part_names: tuple[str, ...] = ("surface",)
    vertex_error_mm: FloatArray | None = field(default=None, repr=False)
    refined_of_face: BoolArray | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        vertices = require("vertices", self.vertices, (None, 3), finite=True)
        faces = require("faces", np.asarray(self.faces).reshape(-1, 3), (None, 3), np.int32)
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise ArrayError(f"faces name vertices {faces.min()} to {faces.max()}; there are {len(vertices)}", name="faces")
        parts = self.part_of_face if len(self.part_of_face) else np.zeros(len(faces), np.int32)
        origins = self.origin_of_face if len(self.origin_of_face) else np.zeros(len(faces), np.uint8)
        parts = require("part_of_face", parts, (len(faces),), np.int32)
        if len(parts) and (parts.min() < 0 or parts.max() >= len(self.part_names)):
            raise ArrayError(f"part_of_face names part {parts.max()}; there are {len(self.part_names)}", name="part_of_face")
        checked: dict[str, Any] = {
            "vertices": vertices,
            "faces": faces,
            "part_of_face": parts,
            "origin_of_face": require("origin_of_face", origins, (len(faces),), np.uint8),
        }
        if self.vertex_error_mm is not None:
            checked["vertex_error_mm"] = require("vertex_error_mm", self.vertex_error_mm, (len(vertices),))
        if self.refined_of_face is not None:
            checked["refined_of_face"] = require("refined_of_face", self.refined_of_face, (len(faces),), np.bool_)
        for name, array in checked.items():
            array = array.view()
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @cached_property
    def triangles(self) -> FloatArray:
        """(m, 3, 3) corner positions."""
        return self.vertices[self.faces]

    @cached_property
    def area_vectors(self) -> FloatArray:
        """(m, 3) outward normal times face area, mm^2."""
        vectors = np.empty((len(self.faces), 3))
        area_vectors_into(self.vertices, self.faces, vectors)
        return vectors

    @cached_property
    def face_areas(self) -> FloatArray:
        """(m,) mm^2."""
        areas = np.empty(len(self.faces))
        for piece in self.pieces():
            areas[piece] = np.linalg.norm(self.area_vectors_of(piece), axis=1)
        return areas

    @cached_property
    def face_normals(self) -> FloatArray:
        """(m, 3) unit outward normals; NaN for faces without area."""
        return unit_vectors(self.area_vectors)

    @cached_property
    def vertex_normals(self) -> FloatArray:
        """(n, 3) unit normals, faces weighted by their angle at the vertex (Thurmer & Wuthrich 1998)."""
        return self.made_vertex_normals()

    def made_vertex_normals(self) -> FloatArray:
        """`vertex_normals`, not kept: for who needs those of a large mesh once."""
        normals = np.zeros_like(self.vertices)
        for piece in self.pieces():
            angle_weighted_into(self.vertices, self.faces[piece], self.normals_of(piece), normals)
        with np.errstate(invalid="ignore", divide="ignore"):
            normals /= np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None]
        return np.nan_to_num(normals, copy=False)

    def pieces(self) -> Iterator[slice]:
        """All faces, in order, so many at a time that what is made of them on the way stays small."""
        return (slice(first, first + FACES_AT_ONCE) for first in range(0, len(self.faces), FACES_AT_ONCE))

    def normals_of(self, chosen: slice | IntArray) -> FloatArray:
        """(k, 3) `face_normals` of some faces; those of all are not kept for it."""
        if "face_normals" in self.__dict__:
            return self.face_normals[chosen]
        return unit_vectors(self.area_vectors_of(chosen))

    def area_vectors_of(self, chosen: slice | IntArray) -> FloatArray:
        """(k, 3) `area_vectors` of some faces; those of all are not kept for it."""
        if "area_vectors" in self.__dict__:
            return self.area_vectors[chosen]
        faces = self.faces[chosen]
        vectors = np.empty((len(faces), 3))
        area_vectors_into(self.vertices, faces, vectors)
        return vectors

    @property
    def area_mm2(self) -> float:
        """Total area."""
        return float(self.face_areas.sum())

    def areas_without_wrinkles(self) -> FloatArray:
        """(m,) mm^2 of the faces as seen along the normals around each: noise, which turns every face another way, adds to an area of a fold's
        size what this leaves out."""
        normals, areas = self.made_vertex_normals(), np.empty(len(self.faces))
        for piece in self.pieces():
            around = unit_vectors(normals[self.faces[piece]].sum(axis=1))
            areas[piece] = np.maximum(np.nan_to_num(np.einsum("ij,ij->i", self.area_vectors_of(piece), around)), 0.0)
        return areas

    @property
    def volume_mm3(self) -> float:
        """Signed volume enclosed by the faces (divergence theorem); meaningful for closed surfaces only."""
        if not len(self.faces):
            return 0.0
        middle = self.vertices.mean(axis=0)

        def six_volumes(piece: slice) -> float:
            local = self.vertices[self.faces[piece]] - middle
            return float(np.einsum("ij,ij->i", local[:, 0], np.cross(local[:, 1], local[:, 2])).sum())

        return sum(map(six_volumes, self.pieces())) / 6.0

    @cached_property
    def bounds_mm(self) -> FloatArray:
        """(2, 3) lowest and highest corner of the box around the vertices."""
        # column by column: numpy takes extremes along the first axis of narrow arrays five times slower
        columns = self.vertices.T if len(self.vertices) else np.zeros((3, 1))
        bounds = np.array([[column.min() for column in columns], [column.max() for column in columns]])
        bounds.flags.writeable = False
        return bounds

    @property
    def extent_mm(self) -> float:
        """Diagonal of the box around the vertices."""
        low, high = self.bounds_mm
        return float(np.linalg.norm(high - low))

    def share_of_area(self, origin: int) -> float:
        """Share (0..1) of the area whose faces have this origin."""
        total = self.area_mm2
        return float(self.face_areas[self.origin_of_face == origin].sum() / total) if total > 0 else 0.0

    def _repr_png_(self) -> bytes:
        """A notebook's look at the surface from the front (+z), a little from above and from its left."""
        from rangecheck.surface.look import look_at_faces

        return look_at_faces(self.vertices, self.faces, self.face_normals, self.vertex_normals)

    def moved(self, motion: FloatArray) -> Surface:
        """The same surface after a rigid motion (4, 4)."""
        return replace(self, vertices=self.vertices @ motion[:3, :3].T + motion[:3, 3])

    def with_faces(self, keep: IntArray) -> Surface:
        """Only the faces selected by mask or index, without the vertices that no face uses any more."""
        faces = self.faces[keep]
        used = np.zeros(len(self.vertices), bool)
        used[faces] = True
        number = np.cumsum(used) - 1
        return replace(
            self,
            vertices=self.vertices[used],
            faces=number[faces].astype(np.int32),
            part_of_face=self.part_of_face[keep],
            origin_of_face=self.origin_of_face[keep],
            vertex_error_mm=None if self.vertex_error_mm is None else self.vertex_error_mm[used],
            refined_of_face=None if self.refined_of_face is None else self.refined_of_face[keep],
        )


def join(surfaces: list[Surface]) -> Surface:
    """All surfaces as one; parts of the same name become one part."""
    names: list[str] = []
    for surface in surfaces:
        names.extend(name for name in surface.part_names if name not in names)
    offsets = np.cumsum([0] + [len(s.vertices) for s in surfaces])
    errors = [s.vertex_error_mm for s in surfaces]
    return Surface(
        vertices=np.concatenate([s.vertices for s in surfaces]),
        faces=np.concatenate([s.faces + offset for s, offset in zip(surfaces, offsets)]),
        part_of_face=np.concatenate(
            [np.array([names.index(n) for n in s.part_names], np.int32)[s.part_of_face] for s in surfaces]
        ),
        origin_of_face=np.concatenate([s.origin_of_face for s in surfaces]),
        part_names=tuple(names),
        vertex_error_mm=np.concatenate([e for e in errors if e is not None]) if all(e is not None for e in errors) else None,
    )
