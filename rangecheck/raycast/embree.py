"""The one adapter of Embree (embreex 4.4).

Its traps, each tested: it computes in float32, so everything is centred and scaled to a unit box first; a miss is primID -1 and
distance 1e37; OCCLUDED answers 0 for blocked and -1 for free; an array given as `dists` is the reach and is overwritten; distances
count in units of |direction|; a ray with NaN is a silent miss; tnear is 0; it runs on one thread but without the interpreter lock,
so callers cast chunks in threads (`kernels.in_chunks`).

Where the library inside embreex can be called directly (`direct`), it is: watertight at shared edges, and several rays at a time where the caller
says that neighbours in the list are neighbours in space.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import SurfaceError
from rangecheck.kernels import inline_kernel, kernel
from rangecheck.raycast import direct

#: a hit nearer to grazing than this sine keeps Embree's distance: the plane of the face says nothing about it
_GRAZING = 1e-4
#: vertices that are brought into the local frame at once: of a large mesh a copy in double precision is much
_AT_ONCE = 1 << 18


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
    float32 at the size of the object. Directions must be unit vectors.

    Embree decides in float32 which face is hit; the distance is then that to the face's plane in float64, so that it is good to
    rounding at any distance of the camera. `local` arrays are in units of `scale_mm` about `centre_mm`."""

    def __init__(self, vertices_mm: FloatArray, faces: IntArray) -> None:
        if len(faces) == 0:
            raise SurfaceError("the surface has no faces; there is nothing to cast rays at")
        low, high = vertices_mm.min(axis=0), vertices_mm.max(axis=0)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise SurfaceError("the surface has vertices that are not finite; remove them first")
        self.centre_mm = 0.5 * (low + high)
        self.scale_mm = float(max((high - low).max() / 2, np.finfo(np.float32).tiny))
        self.skin = float(64 * np.spacing(np.float32(1.0)))
        self.skin_mm = self.skin * self.scale_mm
        self._vertices_mm = np.ascontiguousarray(vertices_mm, np.float64)
        self.faces = np.ascontiguousarray(faces, dtype=np.int32).view()
        self.faces.flags.writeable = False
        #: (n, 3) float32, as Embree sees them
        self.local = direct.with_room(len(vertices_mm))
        for first in range(0, len(self.local), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            self.local[some] = (self._vertices_mm[some] - self.centre_mm) / self.scale_mm
        self._direct = direct.DirectScene(self.local, self.faces) if direct.load() is not None else None
        if self._direct is None:
            from embreex import mesh_construction, rtcore_scene

            self._scene = rtcore_scene.EmbreeScene()
            self._mesh = mesh_construction.TriangleMesh(self._scene, self.local, self.faces)
            # the acceleration structure is built at the first query, which must not happen in two threads at once
            self._scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))

    @property
    def vertices(self) -> FloatArray:
        """(n, 3) `local` in double precision, made anew each time."""
        return (self._vertices_mm - self.centre_mm) / self.scale_mm

    def closest(self, origins_mm: FloatArray, directions: FloatArray, *, coherent: bool = False) -> Hits:
        """First hit of each ray; origins and unit directions (n, 3). `coherent` rays (a picture's, row by row) go faster."""
        n = len(origins_mm)
        hits = Hits(np.empty(n), np.empty(n, np.int32), np.empty(n, np.float32), np.empty(n, np.float32))
        if n == 0:
            return hits
        origins, rays, skip, far = self._near(origins_mm, directions, np.inf)
        self.closest_local(origins, rays, far, hits.face, hits.u, hits.v, coherent=coherent)
        _distances(
            np.ascontiguousarray(origins_mm, np.float64), np.ascontiguousarray(directions, np.float64), self.centre_mm,
            self.scale_mm, self._vertices_mm, self.faces, skip, far, hits.face, hits.distance_mm,
        )  # fmt: skip
        return hits

    def occluded(
        self,
        origins_mm: FloatArray,
        directions: FloatArray,
        reach_mm: FloatArray | float = np.inf,
        *,
        coherent: bool = False,
    ) -> BoolArray:
        """Whether anything lies on each ray between its origin and `reach_mm` (scalar or (n,))."""
        blocked = np.empty(len(origins_mm), np.bool_)
        if len(blocked):
            origins, rays, _, far = self._near(origins_mm, directions, reach_mm)
            self.occluded_local(origins, rays, far, blocked, coherent=coherent)
        return blocked

    def closest_local(
        self,
        origins: FloatArray,
        directions: FloatArray,
        far: FloatArray,
        face: IntArray,
        u: FloatArray,
        v: FloatArray,
        *,
        coherent: bool = False,
    ) -> None:
        """First hits of local float32 rays (n, 3), written into far, face, u, v; `far` comes in as each ray's reach."""
        if self._direct is not None:
            self._direct.closest(origins, directions, far, face, u, v, coherent)
            return
        found = self._scene.run(origins, directions, dists=np.minimum(far, np.float32(1e30)), output=True)
        face[:] = found["primID"]
        np.copyto(far, found["tfar"], where=face >= 0)
        u[:], v[:] = found["u"], found["v"]

    def occluded_local(
        self, origins: FloatArray, directions: FloatArray, far: FloatArray, blocked: BoolArray, *, coherent: bool = False
    ) -> None:
        """Whether anything lies within `far` (n,) of local float32 rays, written into `blocked`."""
        if self._direct is not None:
            self._direct.occluded(origins, directions, far, blocked, coherent)
            return
        reach = np.clip(far, np.float32(0), np.float32(1e30))
        blocked[:] = self._scene.run(origins, directions, dists=reach, query="OCCLUDED") == 0

    def _near(
        self, origins_mm: FloatArray, directions: FloatArray, reach_mm: FloatArray | float
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Local float32 rays that start where they come near the triangles, how far (local) that is, and their reach from there."""
        n = len(origins_mm)
        origins, rays = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
        skip, far = np.empty(n), np.empty(n, np.float32)
        reach = np.broadcast_to(np.asarray(reach_mm, np.float64), n)
        _approach(
            np.ascontiguousarray(origins_mm, np.float64), np.ascontiguousarray(directions, np.float64), np.ascontiguousarray(reach),
            self.centre_mm, self.scale_mm, origins, rays, skip, far,
        )  # fmt: skip
        return origins, rays, skip, far


@kernel
def _approach(origins_mm, directions, reach_mm, centre_mm, scale_mm, origins, rays, skip, far):
    """World rays to local ones, moved forward to the sphere around the unit box so that float32 counts from there."""
    for i in range(len(origins_mm)):
        along = 0.0
        for axis in range(3):
            along -= (origins_mm[i, axis] - centre_mm[axis]) / scale_mm * directions[i, axis]
        # 2 > sqrt(3), the box's corner
        skip[i] = along - 2.0 if along > 2.0 else 0.0
        for axis in range(3):
            origins[i, axis] = (origins_mm[i, axis] - centre_mm[axis]) / scale_mm + skip[i] * directions[i, axis]
            rays[i, axis] = directions[i, axis]
        left = reach_mm[i] / scale_mm - skip[i]
        far[i] = max(left, 0.0) if left < 1e30 else np.inf


@inline_kernel
def _local(vertices_mm, i, centre_mm, scale_mm):
    """Vertex i in the local frame."""
    return (
        (vertices_mm[i, 0] - centre_mm[0]) / scale_mm,
        (vertices_mm[i, 1] - centre_mm[1]) / scale_mm,
        (vertices_mm[i, 2] - centre_mm[2]) / scale_mm,
    )


@kernel
def _distances(origins_mm, directions, centre_mm, scale_mm, vertices_mm, faces, skip, far, face, distance_mm):
    """Lengths from the origins to the planes of the faces that were hit, in float64."""
    for i in range(len(face)):
        if face[i] < 0:
            distance_mm[i] = np.inf
            continue
        a, b, c = faces[face[i], 0], faces[face[i], 1], faces[face[i], 2]
        ax, ay, az = _local(vertices_mm, a, centre_mm, scale_mm)
        bx, by, bz = _local(vertices_mm, b, centre_mm, scale_mm)
        cx, cy, cz = _local(vertices_mm, c, centre_mm, scale_mm)
        px, py, pz, qx, qy, qz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
        nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        size = np.sqrt(nx * nx + ny * ny + nz * nz)
        across = nx * directions[i, 0] + ny * directions[i, 1] + nz * directions[i, 2]
        rough = skip[i] + far[i]
        if abs(across) > _GRAZING * size:
            ox = (origins_mm[i, 0] - centre_mm[0]) / scale_mm
            oy = (origins_mm[i, 1] - centre_mm[1]) / scale_mm
            oz = (origins_mm[i, 2] - centre_mm[2]) / scale_mm
            rough = (nx * (ax - ox) + ny * (ay - oy) + nz * (az - oz)) / across
        distance_mm[i] = max(rough, 0.0) * scale_mm
