"""Shadows, source by source: what is lit, what turns away, what is shaded, and by which part. And values carried by the surface.

Sources are (k, 4) homogeneous: (x, y, z, 1) a point in mm, (x, y, z, 0) a direction towards a source infinitely far away.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import BoolArray, FloatArray, IntArray, require, unit_vectors
from rangecheck.errors import ArrayError
from rangecheck.kernels import in_chunks
from rangecheck.maps.secondary import SKIN, NormalsAt
from rangecheck.maps.trace import PIXELS_PER_CHUNK, Caster, Maps, require_same
from rangecheck.raycast import EmbreeCaster
from rangecheck.surface import Surface
from rangecheck.surface.attributes import barycentric

NOTHING, LIT, TURNED_AWAY, SHADED = 0, 1, 2, 3
STATE_NAMES = ("nothing seen", "lit", "turned away", "shaded")


@dataclass(frozen=True, eq=False)
class Shadows:
    """state (k, h, w) uint8: NOTHING, LIT, TURNED_AWAY (attached shadow) or SHADED (cast shadow), for each of k sources.

    shaded_by (k, h, w) int32: part index + 1 of what the shadow ray meets first, 0 where the pixel is not SHADED."""

    state: npt.NDArray[np.uint8] = field(repr=False)
    shaded_by: IntArray = field(repr=False)

    @property
    def lit(self) -> BoolArray:
        """(k, h, w) whether source k lights the pixel."""
        return self.state == LIT

    @property
    def sources_seen(self) -> IntArray:
        """(h, w) uint32, bit k set where source k lights the pixel (the first 32 sources)."""
        bits = np.uint32(1) << np.arange(min(len(self.state), 32), dtype=np.uint32)
        return (self.lit[:32] * bits[:, None, None]).sum(axis=0, dtype=np.uint32)


def trace_shadows(
    surface: Surface,
    maps: Maps,
    sources: FloatArray,
    caster: Caster | None = None,
    *,
    normals: NormalsAt | None = None,
    lift_mm: float = 0.0,
) -> Shadows:
    """Cast a shadow ray from every seen point to every source's centre. The side that the camera sees is the side judged.

    Where facets stand for a curved surface, `normals` (see `trace_chain`) decide what turns away, and rays start `lift_mm` off the
    facets - twice the tessellation error clears the chords - so that the terminator is the true surface's and not the facets'."""
    lamps = require("sources", sources, (None, 4), finite=True)
    if not np.isin(lamps[:, 3], (0.0, 1.0)).all() or (np.linalg.norm(lamps[lamps[:, 3] == 0, :3], axis=1) == 0).any():
        raise ArrayError("sources must be points (x, y, z, 1) or directions (x, y, z, 0) that are not zero", name="sources")
    require_same(surface, maps.face)
    engine = caster if caster is not None else EmbreeCaster(surface.vertices, surface.faces)
    pixels = np.flatnonzero(maps.hit)
    points, seen_face = maps.points_mm().reshape(-1, 3)[pixels], maps.face.ravel()[pixels]
    back = maps.incidence_rad.ravel()[pixels] > np.pi / 2
    outward = surface.face_normals[seen_face] if normals is None else normals(points, seen_face)
    side = np.nan_to_num(outward) * np.where(back, -1.0, 1.0)[:, None]
    state = np.zeros((len(lamps), maps.face.size), np.uint8)
    shaded_by = np.zeros((len(lamps), maps.face.size), np.int32)
    start_mm = SKIN * surface.extent_mm + lift_mm

    def chunk(start: int, stop: int) -> None:
        here = slice(start, stop)
        origins = points[here] + start_mm * side[here]
        for k, lamp in enumerate(lamps):
            to_lamp = np.broadcast_to(lamp[:3], origins.shape) - lamp[3] * origins
            reach = np.linalg.norm(to_lamp, axis=1) if lamp[3] else np.full(len(origins), np.inf)
            directions = np.ascontiguousarray(unit_vectors(np.asarray(to_lamp, dtype=np.float64)))
            facing = (directions * side[here]).sum(axis=1) > 0
            hits = engine.closest(origins[facing], directions[facing])
            blocked = hits.distance_mm < reach[facing]
            found = np.full(stop - start, TURNED_AWAY, np.uint8)
            found[facing] = np.where(blocked, SHADED, LIT)
            state[k, pixels[here]] = found
            shaded_by[k, pixels[here][facing]] = np.where(blocked, surface.part_of_face[hits.face] + 1, 0)

    in_chunks(chunk, len(pixels), PIXELS_PER_CHUNK)
    shape = (len(lamps), *maps.face.shape)
    return Shadows(state.reshape(shape), shaded_by.reshape(shape))


def values_seen(surface: Surface, maps: Maps, values: FloatArray) -> FloatArray:
    """(h, w) float64 map of a value carried by the surface - deviation, expected error, wall thickness: one number per vertex
    (interpolated) or per face (as it is); NaN where nothing is seen. Raises ArrayError for any other length."""
    numbers = require("values", values, (None,))
    require_same(surface, maps.face)
    seen = np.full(maps.face.shape, np.nan)
    face = maps.face[maps.hit]
    if len(numbers) == len(surface.vertices):
        weights = barycentric(surface, maps.points_mm()[maps.hit], face)
        seen[maps.hit] = np.einsum("nk,nk->n", weights, numbers[surface.faces[face]])
    elif len(numbers) == len(surface.faces):
        seen[maps.hit] = numbers[face]
    else:
        raise ArrayError(
            f"values has {len(numbers)} entries; the surface has {len(surface.vertices)} vertices and {len(surface.faces)} faces",
            name="values",
        )
    return seen
