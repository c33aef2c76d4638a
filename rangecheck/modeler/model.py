"""`Model`: a modelled scene as a surface whose parts are the numbered faces, with the true surface behind every facet."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.modeler.body import Body
from rangecheck.modeler.true_faces import TrueFace
from rangecheck.optics import PinholeCamera
from rangecheck.surface import MEASURED, Surface
from rangecheck.surface.attributes import barycentric


@dataclass(frozen=True)
class Lamp:
    """A spherical source: centre, radius in mm, radiance in any unit that is the same everywhere."""

    centre_mm: tuple[float, float, float]
    radius_mm: float
    radiance: float


@dataclass(frozen=True, eq=False)
class Model:
    """A scene.

    surface          triangles; part k is face k of the model, named "body/face"; its ID in maps is k + 1. Numbers follow the order in
                     which bodies and faces were written down, whatever the booleans left of them
    true_faces       the analytic surface of each part
    material_of_part the name of each part's material, "" where none was said
    tolerance_mm     bound of the distance between facets and true surface
    camera, world_from_camera, lamps: what the scene's file says of them, or None and ()
    """

    surface: Surface
    true_faces: tuple[TrueFace, ...] = field(repr=False)
    material_of_part: tuple[str, ...] = field(repr=False)
    tolerance_mm: float
    name: str = "model"
    camera: PinholeCamera | None = None
    world_from_camera: FloatArray | None = field(default=None, repr=False)
    lamps: tuple[Lamp, ...] = ()

    @cached_property
    def corner_normals(self) -> FloatArray:
        """(m, 3, 3) unit normals of the true surface at each facet's corners, on the facet's outer side. A mesh's are interpolated
        over its own faces; where the true surface has none (a cone's apex) the facet's stands."""
        surface = self.surface
        normals = np.repeat(surface.face_normals[:, None], 3, axis=1)
        for part, true in enumerate(self.true_faces):
            mine = np.flatnonzero(surface.part_of_face == part)
            if not len(mine):
                continue
            if true.kind == "mesh":
                normals[mine] = surface.with_faces(mine).vertex_normals[_renumbered(surface.faces[mine])]
            else:
                corners = surface.triangles[mine].reshape(-1, 3)
                normals[mine] = _turned(true.normals(corners).reshape(-1, 3, 3), surface.face_normals[mine][:, None])
        return normals

    def normals_at(self, points_mm: FloatArray, face: IntArray) -> FloatArray:
        """(n, 3) unit normals of the true surface at points (n, 3) on facets (n,), on the facet's outer side."""
        facet = self.surface.face_normals[face]
        normals = facet.copy()
        part = self.surface.part_of_face[face]
        for k in np.unique(part):
            mine = part == k
            true = self.true_faces[k]
            if true.kind == "mesh":
                weights = barycentric(self.surface, points_mm[mine], face[mine])
                normals[mine] = np.einsum("nk,nkj->nj", weights, self.corner_normals[face[mine]])
                normals[mine] /= np.linalg.norm(normals[mine], axis=1, keepdims=True)
            else:
                normals[mine] = _turned(true.normals(points_mm[mine]), facet[mine])
        return normals

    def tessellation_error_mm(self) -> float:
        """Largest distance of the facets from the true surface, at their corners, edges' middles and centroids."""
        surface = self.surface
        worst = 0.0
        for part, true in enumerate(self.true_faces):
            corners = surface.triangles[surface.part_of_face == part]
            if not len(corners):
                continue
            middles = 0.5 * (corners + np.roll(corners, -1, axis=1))
            points = np.concatenate([corners.reshape(-1, 3), middles.reshape(-1, 3), corners.mean(axis=1)])
            worst = max(worst, float(np.abs(true.distance_mm(points)).max()))
        return worst


def _turned(normals: FloatArray, facet: FloatArray) -> FloatArray:
    """Normals on the facet's side; the facet's own where there is none."""
    side = np.where((normals * facet).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0)
    return np.where(np.isnan(normals), facet, side * normals)


def _renumbered(faces: IntArray) -> IntArray:
    return np.unique(faces, return_inverse=True)[1].reshape(-1, 3)


def model_of(
    bodies: list[Body], materials: list[tuple[str, ...]], tolerance_mm: float, name: str = "model", **scene: object
) -> Model:
    """One model of several bodies side by side; materials[k] names the material of each face of bodies[k]."""
    first_vertex = np.cumsum([0] + [len(b.vertices) for b in bodies])
    first_name = np.cumsum([0] + [len(b.names) for b in bodies])
    surface = Surface(
        vertices=np.concatenate([b.vertices for b in bodies]),
        faces=np.concatenate([b.faces + offset for b, offset in zip(bodies, first_vertex)]),
        part_of_face=np.concatenate([b.label + offset for b, offset in zip(bodies, first_name)]).astype(np.int32),
        origin_of_face=np.full(sum(len(b.faces) for b in bodies), MEASURED, np.uint8),
        part_names=tuple(n for b in bodies for n in b.names),
    )
    true_faces = tuple(f for b in bodies for f in b.true_faces)
    return Model(surface, true_faces, tuple(m for ms in materials for m in ms), tolerance_mm, name, **scene)  # type: ignore[arg-type]
