"""The one adapter of Embree (embreex 4.4).

Its traps, each tested: it computes in float32, so everything is centred and scaled to a unit box first; a miss is primID -1 and
distance 1e37; OCCLUDED answers 0 for blocked and -1 for free; an array given as `dists` is the reach and is overwritten; distances
count in units of |direction|; a ray with NaN is a silent miss; tnear is 0; it runs on one thread but without the interpreter lock,
so callers cast chunks in threads (`kernels.in_chunks`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import SurfaceError


class Hits(NamedTuple):
    """First hits of n rays.

    distance_mm (n,) float64 length from origin to hit, inf where missed
    face        (n,) int32 index of the face, -1 where missed
    u, v        (n,) float32 barycentric weights of the face's second and third corner
    """

    distance_mm: FloatArray
    face: IntArray
    u: FloatArray
    v: FloatArray


class EmbreeCaster:
    """First hits and occlusion against fixed triangles (n, 3) mm, (m, 3).

    `skin_mm` is how far a ray that leaves a surface must start off it so that it cannot hit the face it leaves: 64 steps of
    float32 at the size of the object. Directions must be unit vectors."""

    def __init__(self, vertices_mm: FloatArray, faces: IntArray) -> None:
        from embreex import mesh_construction, rtcore_scene

        if len(faces) == 0:
            raise SurfaceError("the surface has no faces; there is nothing to cast rays at")
        low, high = vertices_mm.min(axis=0), vertices_mm.max(axis=0)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise SurfaceError("the surface has vertices that are not finite; remove them first")
        self.centre_mm = 0.5 * (low + high)
        self.scale_mm = float(max((high - low).max() / 2, np.finfo(np.float32).tiny))
        self.skin_mm = float(64 * np.spacing(np.float32(1.0)) * self.scale_mm)
        self._scene = rtcore_scene.EmbreeScene()
        local = ((vertices_mm - self.centre_mm) / self.scale_mm).astype(np.float32)
        self._mesh = mesh_construction.TriangleMesh(self._scene, local, np.ascontiguousarray(faces, dtype=np.int32))
        # the acceleration structure is built at the first query, which must not happen in two threads at once
        self._scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))

    def _local(self, origins_mm: FloatArray) -> FloatArray:
        return ((origins_mm - self.centre_mm) / self.scale_mm).astype(np.float32)

    def closest(self, origins_mm: FloatArray, directions: FloatArray) -> Hits:
        """First hit of each ray; origins and unit directions (n, 3)."""
        if len(origins_mm) == 0:
            none = np.empty(0, np.float32)
            return Hits(np.empty(0), np.empty(0, np.int32), none, none)
        found = self._scene.run(self._local(origins_mm), np.ascontiguousarray(directions, dtype=np.float32), output=True)
        face = found["primID"]
        return Hits(np.where(face >= 0, found["tfar"] * self.scale_mm, np.inf), face, found["u"], found["v"])

    def occluded(self, origins_mm: FloatArray, directions: FloatArray, reach_mm: FloatArray | float = np.inf) -> BoolArray:
        """Whether anything lies on each ray between its origin and `reach_mm` (scalar or (n,))."""
        if len(origins_mm) == 0:
            return np.empty(0, bool)
        reach = np.minimum(np.asarray(reach_mm, dtype=np.float64) / self.scale_mm, 1e30)
        limit = np.array(np.broadcast_to(reach, len(origins_mm)), dtype=np.float32)
        answer = self._scene.run(
            self._local(origins_mm), np.ascontiguousarray(directions, dtype=np.float32), dists=limit, query="OCCLUDED"
        )
        return answer == 0
