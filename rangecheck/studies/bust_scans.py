"""Scans for the studies of scanning and meshing: the sample bust, or other people's meshes, seen by the simulated range finder.

World frame, millimetres. Real data is found through the environment variable RANGECHECK_DATA and is never part of the project.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.errors import InputError
from rangecheck.optics import PinholeCamera
from rangecheck.raycast import EmbreeCaster, Hits
from rangecheck.raycast.implicit import ImplicitCaster
from rangecheck.scan import RangeScan
from rangecheck.scan.sample import TARGET_MM, sample_view
from rangecheck.scan.simulate import Caster, RangeFinder, ring_of_poses, simulate_scan
from rangecheck.surface.surface import Surface

#: the sample finder's distance and field of view, in which the bust fills the picture
DISTANCE_MM, FOCAL_IN_WIDTHS = 600.0, 870.0 / 640.0


def real_data(name: str) -> Path:
    """The folder `name` of the real data. Raises InputError where there is none."""
    folder = os.environ.get("RANGECHECK_DATA", "")
    path = Path(folder) / name
    if not folder or not path.exists():
        raise InputError(name, "is real data that is not shipped; set RANGECHECK_DATA to the folder that holds it")
    return path


@lru_cache(maxsize=1)
def sample_scans() -> tuple[RangeScan, ...]:
    """The eight views of the sample data: 640 x 480, noise 0.2 mm."""
    return tuple(sample_view(index).scan for index in range(8))


class _Remembered:
    """The bust itself, that knows again the rays it was asked for last: a study turns knobs that move no ray."""

    #: of up to 16384 rays each
    MOST = 384

    def __init__(self, caster: ImplicitCaster) -> None:
        self._caster, self._known = caster, dict[tuple[object, ...], Any]()
        self.skin_mm = caster.skin_mm

    def closest(self, origins_mm: FloatArray, directions: FloatArray) -> Hits:
        return self._once(self._caster.closest, origins_mm, directions)

    def occluded(self, origins_mm: FloatArray, directions: FloatArray, reach_mm: FloatArray | float = np.inf) -> BoolArray:
        return self._once(self._caster.occluded, origins_mm, directions, np.asarray(reach_mm))

    def normals(self, points_mm: FloatArray) -> FloatArray:
        return self._once(self._caster.normals, points_mm)

    def _once(self, ask: Callable[..., Any], *arrays: FloatArray) -> Any:
        from hashlib import blake2b

        key = (ask.__name__, *(blake2b(a.tobytes(), digest_size=16).digest() for a in arrays))
        found = self._known.get(key)
        if found is None:
            found = ask(*arrays)
            if len(self._known) >= self.MOST:
                self._known.clear()
            self._known[key] = found
        return found


@cache
def _bust() -> _Remembered:
    return _Remembered(ImplicitCaster.of_bust())


@cache
def _bust_in_triangles() -> EmbreeCaster:
    """The bust to 0.01 mm, for scans of which only the number of points matters: triangles are met thirty times as fast."""
    from rangecheck.surface.meshing import fuse

    surface = fuse(bust_ring(width=240, noise_mm=0.01, step_mm=0.001))
    return EmbreeCaster(surface.vertices, surface.faces)


def bust_ring(
    views: int = 8, *, width: int = 320, noise_mm: float = 0.2, step_mm: float = 0.02, seed: int = 7, lost_share: float = 0.0,
    in_triangles: bool = False,
) -> list[RangeScan]:  # fmt: skip
    """`views` scans around the sample bust by the sample finder with these changes, `width` by 3/4 `width` cells each."""
    poses = ring_of_poses(views, DISTANCE_MM, target_mm=TARGET_MM, elevations_deg=(-12.0, 38.0))
    return _scanned(poses, width, noise_mm, step_mm, seed, lost_share, _bust_in_triangles() if in_triangles else _bust())


def bust_views(azimuths_deg: Sequence[float], *, width: int = 320, noise_mm: float = 0.2, seed: int = 7) -> list[RangeScan]:
    """Level scans of the sample bust from these azimuths."""
    poses = [ring_of_poses(1, DISTANCE_MM, target_mm=TARGET_MM, first_deg=azimuth)[0] for azimuth in azimuths_deg]
    return _scanned(poses, width, noise_mm, 0.02, seed, 0.0, _bust())


def _scanned(
    poses: Sequence[FloatArray], width: int, noise_mm: float, step_mm: float, seed: int, lost_share: float, caster: Caster
) -> list[RangeScan]:
    height = width * 3 // 4
    camera = PinholeCamera(width, height, FOCAL_IN_WIDTHS * width, FOCAL_IN_WIDTHS * width, 0.5 * (width - 1), 0.5 * (height - 1))
    finder = RangeFinder(
        source_mm=(150.0, 0.0, 0.0), working_distance_mm=DISTANCE_MM, noise_mm=noise_mm, step_mm=step_mm, lost_share=lost_share
    )
    return [simulate_scan(caster, camera, p, finder, seed, scan_index=k, name=f"view_{k}").scan for k, p in enumerate(poses)]


@dataclass(frozen=True)
class Subject:
    """A mesh whose scans are simulated: `caster` finds it, `extent_mm` is the length of its box's diagonal."""

    name: str
    surface: Surface
    caster: EmbreeCaster
    extent_mm: float


def subject_of(name: str, path: Path) -> Subject:
    """The mesh at `path` (millimetres)."""
    from rangecheck.surface.mesh_files import read_mesh

    surface = read_mesh(path, "mm")
    return Subject(
        name, surface, EmbreeCaster(surface.vertices, surface.faces), float(np.linalg.norm(np.diff(surface.bounds_mm, axis=0)))
    )


def ring_around(subject: Subject, *, views: int, width: int, noise_mm: float, seed: int) -> list[RangeScan]:
    """Scans of a subject from a ring of views that hold it whole."""
    low, high = subject.surface.bounds_mm
    camera = PinholeCamera.from_field_of_view(width, width, 28.0)
    distance = 0.5 * subject.extent_mm / np.sin(np.radians(14.0))
    finder = RangeFinder(
        source_mm=(distance / 4, 0.0, 0.0),
        working_distance_mm=distance,
        noise_mm=noise_mm,
        step_mm=noise_mm / 10,
        farthest_mm=1e9,
    )
    poses = ring_of_poses(views, distance, target_mm=0.5 * (low + high), elevations_deg=(-12.0, 38.0))
    return [
        simulate_scan(subject.caster, camera, p, finder, seed, scan_index=k, name=f"view_{k}").scan for k, p in enumerate(poses)
    ]


def near_samples(points_mm: FloatArray, scans: Sequence[RangeScan], within_mm: float) -> FloatArray:
    """(n,) bool: points with a sample within `within_mm`, whoever made them."""
    from rangecheck.surface.meshing.samples import distance_to_samples, sample_grid

    grid = sample_grid(np.concatenate([s.points_mm() for s in scans]), within_mm)
    return np.isfinite(distance_to_samples(grid, points_mm, within_mm))
