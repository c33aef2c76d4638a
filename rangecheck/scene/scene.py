"""`Scene`: a surface, what its parts are made of, and what shines on it. World frame, millimetres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import FloatArray, IntArray, require
from rangecheck.errors import SceneError
from rangecheck.reflectance import Material
from rangecheck.scene.sources import Source
from rangecheck.scene.surroundings import DARKNESS, Surroundings
from rangecheck.surface import Surface
from rangecheck.surface.normals import faces_apart, point_at_own
from rangecheck.surface.surface import FACES_AT_ONCE


class ShadingNormals(NamedTuple):
    """normals (k, 3) float32 unit vectors; row_of_corner (m, 3) int32, not to be written to: which of them each face's corners have. Where all is
    smooth these are the vertices' and the faces themselves, so that a large mesh takes no more."""

    normals: FloatArray
    row_of_corner: IntArray


@dataclass(frozen=True, eq=False)
class Scene:
    """What a picture is taken of.

    surface          the triangles
    materials        what there is to be made of
    material_of_part for each of the surface's parts an index into `materials`; empty: all parts are of the first
    sources          spheres of light
    surroundings     what shines from infinitely far away
    smooth           shade with normals interpolated between vertices instead of the faces' own
    smooth_of_part   the same, part by part, where given
    vertex_normals   unit normals to shade with where smooth, if they are known better than the triangles tell: (n, 3) one a vertex,
                     or (m, 3, 3) one a corner, for surfaces with sharp edges

    Radiances hold one number, or one per wavelength of the materials. Raises SceneError when the numbers of wavelengths differ,
    a part lacks its material, or a source touches the surface."""

    surface: Surface
    materials: tuple[Material, ...]
    material_of_part: tuple[int, ...] = ()
    sources: tuple[Source, ...] = ()
    surroundings: Surroundings = DARKNESS
    smooth: bool = False
    smooth_of_part: tuple[bool, ...] = ()
    vertex_normals: FloatArray | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        parts = len(self.surface.part_names)
        if not self.materials:
            raise SceneError("the scene has no material; give it at least one")
        if not self.material_of_part:
            object.__setattr__(self, "material_of_part", (0,) * parts)
        if len(self.material_of_part) != parts:
            raise SceneError(f"material_of_part names {len(self.material_of_part)} materials for the surface's {parts} parts")
        if any(not 0 <= m < len(self.materials) for m in self.material_of_part):
            raise SceneError(f"material_of_part is {self.material_of_part}; there are {len(self.materials)} materials, from 0")
        if self.smooth_of_part and len(self.smooth_of_part) != parts:
            raise SceneError(f"smooth_of_part has {len(self.smooth_of_part)} entries for the surface's {parts} parts")
        if len({m.wavelengths_um for m in self.materials}) > 1:
            said = ", ".join(f"{m.name} at {m.wavelengths_um} um" for m in self.materials)
            raise SceneError(f"the materials are given at different wavelengths ({said}); bring them together with Material.at()")
        counts = {f"source {k}": len(source.radiance) for k, source in enumerate(self.sources)}
        counts["surroundings"] = self.surroundings.wavelengths
        for name, count in counts.items():
            if count not in (1, self.channels):
                raise SceneError(
                    f"{name} has {count} radiances and the materials {self.channels} wavelengths; give 1 or {self.channels} radiances"
                )
        if self.vertex_normals is not None:
            cornerwise = np.ndim(self.vertex_normals) == 3
            shape = (len(self.surface.faces), 3, 3) if cornerwise else (len(self.surface.vertices), 3)
            known = require("vertex_normals", self.vertex_normals, shape, finite=True)
            object.__setattr__(self, "vertex_normals", known)
        for source in self.sources:
            self._keep_apart(source)

    def _keep_apart(self, source: Source) -> None:
        low, high = self.surface.bounds_mm
        outside = np.maximum(np.maximum(low - source.centre_mm, source.centre_mm - high), 0.0)
        if float(np.linalg.norm(outside)) > source.radius_mm or not len(self.surface.faces):
            return
        corners = (self.surface.vertices[self.surface.faces[piece]] for piece in self.surface.pieces())
        nearest = min(float(_distance_to_triangles(source.centre_mm, some).min()) for some in corners)
        if nearest <= source.radius_mm:
            raise SceneError(
                f"the source at {np.array2string(source.centre_mm, precision=4)} with radius {source.radius_mm:g} mm reaches into the "
                f"surface, {nearest:.4g} mm from its centre; points inside a source have no irradiance: move it away or make it smaller",
                nearest_mm=nearest,
            )

    @property
    def channels(self) -> int:
        """How many wavelengths the scene has: those of its materials."""
        return len(self.materials[0].wavelengths_um)

    @cached_property
    def material_of_face(self) -> IntArray:
        """(m,) int16 index into `materials`."""
        return np.asarray(self.material_of_part, np.int16)[self.surface.part_of_face]

    @property
    def corner_normals(self) -> FloatArray:
        """(m, 3, 3) float32 unit normals at each face's corners, as of `shading_normals`; made anew each time."""
        normals, rows = self.shading_normals
        return normals[rows]

    @cached_property
    def shading_normals(self) -> ShadingNormals:
        """The normals to shade with: the vertices' where smooth, else the face's own; faces without area get +z, which no ray ever sees."""
        smooth = np.asarray(self.smooth_of_part or (self.smooth,) * len(self.surface.part_names))[self.surface.part_of_face]
        known = self.vertex_normals
        if known is None:
            large = len(self.surface.faces) > FACES_AT_ONCE
            of_vertices = self.surface.made_vertex_normals if large else lambda: self.surface.vertex_normals
            known = of_vertices() if smooth.any() else np.zeros((len(self.surface.vertices), 3))
        if known.ndim == 3:
            blank = ~smooth[:, None, None] | (known == 0).all(axis=-1, keepdims=True)
            own = self._flat_normals(np.arange(len(known)))
            normals = np.where(blank, own[:, None, :], known).astype(np.float32).reshape(-1, 3)
            rows: IntArray = np.arange(len(normals), dtype=np.int32).reshape(-1, 3)
        else:
            faces = rows = self.surface.faces
            chosen = np.flatnonzero(faces_apart(faces, smooth, known))
            normals = known.astype(np.float32) if smooth.any() else np.empty((0, 3), np.float32)
            if len(chosen):
                rows = faces.copy()
                point_at_own(faces, chosen, smooth, known, len(normals), rows)
                normals = np.concatenate([normals, self._flat_normals(chosen)])
        rows = rows.view()
        rows.flags.writeable = False
        return ShadingNormals(normals, rows)

    def _flat_normals(self, chosen: IntArray) -> FloatArray:
        """(k, 3) float32 normals of faces, +z for those without area."""
        normals = np.empty((len(chosen), 3), np.float32)
        for first in range(0, len(chosen), FACES_AT_ONCE):
            some = slice(first, first + FACES_AT_ONCE)
            own = self.surface.normals_of(chosen[some])
            normals[some] = np.where(np.isnan(own[:, :1]), (0.0, 0.0, 1.0), own)
        return normals

    def at(self, wavelengths_um: Sequence[float]) -> Scene:
        """The same scene at other wavelengths; its lights must be grey or already have that many radiances."""
        return replace(self, materials=tuple(m.at(wavelengths_um) for m in self.materials))

    def grey(self) -> Scene:
        """At one wavelength, the middle one; what it shows is that wavelength's light."""
        middle = self.channels // 2

        def one(values: FloatArray) -> FloatArray:
            return values[..., middle : middle + 1] if values.shape[-1] > 1 else values

        sky = self.surroundings
        return replace(
            self,
            materials=tuple(m.at(m.wavelengths_um[middle : middle + 1]) for m in self.materials),
            sources=tuple(replace(source, radiance=one(source.radiance)) for source in self.sources),
            surroundings=replace(
                sky,
                low=one(sky.low),
                high=one(sky.high),
                picture=None if sky.picture is None else one(sky.picture),
                boxes=tuple(replace(box, radiance=one(box.radiance)) for box in sky.boxes),
            ),
        )

    def lit_by(self, sources: tuple[Source, ...], surroundings: Surroundings | None = None) -> Scene:
        """The same things under other light."""
        return replace(self, sources=sources, surroundings=self.surroundings if surroundings is None else surroundings)

    def lights_moved(self, motion: FloatArray) -> Scene:
        """The same things under the same lights, carried along by a rigid motion (4, 4)."""
        moved = tuple(replace(s, centre_mm=motion[:3, :3] @ s.centre_mm + motion[:3, 3]) for s in self.sources)
        return self.lit_by(moved, self.surroundings.turned(motion[:3, :3]))


def _distance_to_triangles(point: FloatArray, triangles: FloatArray) -> FloatArray:
    """(m,) distances of a point from triangles (m, 3, 3): to the plane where its foot lies inside, else to the nearest edge."""
    a = triangles
    edges = np.roll(a, -1, axis=1) - a
    away = point - a
    with np.errstate(invalid="ignore", divide="ignore"):
        along = np.clip(np.nan_to_num((away * edges).sum(-1) / (edges * edges).sum(-1)), 0.0, 1.0)
        to_edge = np.linalg.norm(away - along[..., None] * edges, axis=-1).min(axis=1)
        normal = np.cross(edges[:, 0], edges[:, 1])
        inside = (np.einsum("mij,mj->mi", np.cross(edges, away), normal) >= 0).all(axis=1)
        to_plane = np.abs((away[:, 0] * normal).sum(-1)) / np.linalg.norm(normal, axis=-1)
    return np.where(inside & np.isfinite(to_plane), np.fmin(to_plane, to_edge), to_edge)
