"""A range finder that measures a known surface: what it would have returned, and the truth beside it.

Three kinds. `stripe`: a camera and a swept sheet of light at a baseline; `gray-code`: the same with a projector, whose columns cut range
into steps; `time-of-flight`: the phase of modulated light, mixed over each pixel. A cell returns a distance only where the camera sees
the surface, the source lights it, it is not too oblique to either, and enough light comes back.

World frame and millimetres; the scan's camera frame is x right, y down, z forward; angles are from the surface normal. Light is
relative to that of a white matt surface facing the source at the working distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray, require
from rangecheck.errors import SettingError
from rangecheck.optics import Camera
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.simulate_finder import KINDS, KINECT, NOISE_MODELS, RangeFinder, finder_to_dict
from rangecheck.scan.simulate_noise import photon_noise
from rangecheck.scan.simulate_time_of_flight import footprint_mm, phases
from rangecheck.scan.simulate_triangulation import lost_at, on_columns, rounded, swept, triangulation_noise
from rangecheck.scan.simulate_view import MATT, Caster, Finish, Motion, camera_rays, look

__all__ = [
    "KINDS", "KINECT", "MATT", "NOISE_MODELS", "REASONS", "Caster", "Finish", "Motion", "RangeFinder", "SimulatedScan",
    "finder_to_dict", "ring_of_poses", "simulate_scan",
]  # fmt: skip

#: why a cell holds no distance; FLYING holds one, which is false
MEASURED, NOTHING_THERE, IN_SHADOW, TOO_OBLIQUE, LOST, TOO_DARK, SATURATED, FLYING = range(8)
REASONS = (
    "measured", "nothing there", "source's shadow", "too oblique", "lost at random", "too dark", "saturated", "mixed across an edge",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """A scan and the truth behind it, all on the camera's grid.

    scan           what the instrument returned
    true_range_mm  (h, w) float64 range of the surface at time 0, NaN where the ray meets nothing
    true_normal    (h, w, 3) float64 outward unit normal in the world frame, NaN there too
    noise_mm       (h, w) float64 standard deviation of the error that was drawn, before rounding
    reason         (h, w) uint8 index into REASONS
    signal         (h, w) float64 light that came back
    time_s         (h, w) float64 when the cell was measured; 0 unless the subject moves
    """

    scan: RangeScan
    true_range_mm: FloatArray = field(repr=False)
    true_normal: FloatArray = field(repr=False)
    noise_mm: FloatArray = field(repr=False)
    reason: IntArray = field(repr=False)
    signal: FloatArray = field(repr=False)
    time_s: FloatArray = field(repr=False)


def simulate_scan(
    caster: Caster,
    camera: Camera,
    world_from_scan: FloatArray,
    finder: RangeFinder,
    seed: int,
    *,
    scan_index: int = 0,
    name: str = "scan",
    with_brightness: bool = False,
    finish: Finish = MATT,
    motion: Motion | None = None,
) -> SimulatedScan:
    """One scan of the surface behind `caster` by `finder`, whose camera stands at `world_from_scan` (4, 4).

    Random numbers come from (seed, scan_index) alone. `with_brightness` adds the camera's picture of the surface under the source
    (and the ambient light), in 0..1. `motion` moves the subject while it is scanned; a gray-code scan of a moving subject is not a
    range image but a set of pictures: see `simulate_gray_code`. Raises SettingError or ArrayError."""
    if motion is not None and finder.kind == "gray-code":
        raise SettingError(
            "a moving subject spoils the code itself; make its pictures with simulate_gray_code and decode them", key="motion"
        )
    pose = rigid.checked(world_from_scan, "world_from_scan")
    shape = (camera.height, camera.width)
    local_origins, local_rays = camera.pixel_rays()
    origins, rays = camera_rays(pose, (local_origins, local_rays))
    source = rigid.move_points(pose, np.asarray(finder.source_mm))
    truth = look(caster, origins, rays, source, finish=finish)
    random = np.random.Generator(np.random.Philox(key=np.array([seed, scan_index], dtype=np.uint64)))
    draws = random.standard_normal(len(rays)), random.random(len(rays)), random.random(len(rays))

    view = truth
    time: FloatArray = np.zeros(len(rays))
    flying, settled = np.zeros(len(rays), bool), np.ones(len(rays), bool)
    if finder.kind == "time-of-flight":
        mixed = phases(
            caster, camera, pose, np.asarray(finder.source_mm), modulation_mhz=finder.modulation_mhz,
            working_distance_mm=finder.working_distance_mm, subrays=finder.subrays, finish=finish, motion=motion, sample_s=finder.sample_s,
        )  # fmt: skip
        signal, ideal = mixed.amplitude, mixed.range_mm
        noise = photon_noise(finder.noise_mm, signal, finder.ambient)
        # a sloping surface spreads over a pixel too
        slope = np.sqrt(1.0 - np.minimum(view.cos_camera, 1.0) ** 2) / np.maximum(view.cos_camera, 0.1)
        spread = footprint_mm(camera, np.nan_to_num(ideal)) * (1.0 + np.nan_to_num(slope))
        flying = mixed.flying(3.0 * noise + spread)
        seen, lit = np.isfinite(ideal), np.isfinite(ideal)
    else:
        if motion is not None:
            view, time, settled = swept(caster, origins, rays, source, pose, finder, finish, motion)
        signal, ideal = view.signal(finder.working_distance_mm), view.distance_mm
        seen, lit = view.seen, view.lit
        noise = triangulation_noise(finder, view, pose, origins, rays, source, signal)
        if finder.kind == "gray-code":
            ideal, noise = on_columns(ideal, local_rays.reshape(-1, 3), finder, camera, draws[0])
    with np.errstate(invalid="ignore", over="ignore"):
        noise = np.where(seen, noise, np.nan)
        error = noise * draws[0] if finder.kind != "gray-code" else np.zeros(len(rays))
        erred = np.where(seen, ideal + np.where(np.isfinite(error), error, 0.0), np.inf).reshape(shape)
        measured = rounded(erred, local_origins[..., 2], local_rays[..., 2], camera, finder).ravel()
        oblique_deg = np.degrees(np.arccos(np.clip(np.minimum(view.cos_camera, view.cos_source), -1.0, 1.0)))
        away = view.seen & ((view.cos_camera <= 0) | (draws[1] < lost_at(oblique_deg, finder)))
        contrast = signal / np.maximum(signal + finder.ambient, np.finfo(float).tiny)

    reason = np.full(len(rays), MEASURED, np.uint8)
    reason[flying] = FLYING
    outside = (ideal < finder.nearest_mm) | (ideal > finder.farthest_mm) | ~(measured > 0) | ~np.isfinite(measured)
    reason[(draws[2] < finder.lost_share) | outside | ~settled] = LOST
    reason[signal + finder.ambient > finder.most_signal] = SATURATED
    reason[(signal < finder.least_signal) | (contrast < finder.least_contrast) | ~(np.isfinite(noise) | ~seen)] = TOO_DARK
    reason[away & ~flying] = TOO_OBLIQUE
    reason[~lit & view.seen] = IN_SHADOW
    reason[~seen & ~view.seen] = NOTHING_THERE
    brightness = None
    if with_brightness:
        picture = np.where(seen, signal + finder.ambient * finish.diffuse, 0.0)
        brightness = np.clip(picture, 0.0, 1.0).astype(np.float32).reshape(shape)
    scan = RangeScan(
        np.where((reason == MEASURED) | (reason == FLYING), measured, np.nan).astype(np.float32).reshape(shape),
        camera,
        pose,
        brightness=brightness,
        name=name,
        noise_mm=_stated(finder, noise, view.cos_camera, seen),
    )
    return SimulatedScan(
        scan,
        np.where(truth.seen, truth.distance_mm, np.nan).reshape(shape),
        truth.normals.reshape(*shape, 3),
        noise.reshape(shape),
        reason.reshape(shape),
        signal.reshape(shape),
        time.reshape(shape),
    )


def _stated(finder: RangeFinder, noise: FloatArray, cosine: FloatArray, seen: BoolArray) -> float | None:
    """Noise that the instrument states: the one it was given, where its model takes one, else what it comes to at normal incidence."""
    if finder.kind == "time-of-flight" or (finder.kind == "stripe" and finder.noise_model in ("quadratic", "photon")):
        return finder.noise_mm if finder.noise_mm > 0 else None
    with np.errstate(invalid="ignore"):
        head_on = (noise * cosine)[seen & np.isfinite(noise * cosine)]
    return float(np.median(head_on)) if len(head_on) and np.median(head_on) > 0 else None


def ring_of_poses(
    count: int,
    distance_mm: float,
    *,
    target_mm: Sequence[float] = (0.0, 0.0, 0.0),
    elevations_deg: Sequence[float] = (0.0,),
    first_deg: float = 0.0,
) -> list[FloatArray]:
    """`count` poses (4, 4) around the world's y axis through `target_mm`, all at `distance_mm` from it and looking at it.

    Azimuth 0 stands on +z and grows towards +x; elevations are taken in turn. Raises SettingError."""
    if count < 1 or not distance_mm > 0 or not elevations_deg or not all(-90 <= e <= 90 for e in elevations_deg):
        raise SettingError(
            f"a ring needs at least one pose, a positive distance and elevations between -90 and 90 degrees; "
            f"here {count}, {distance_mm} mm, {tuple(elevations_deg)}",
            key="count",
        )
    target = require("target_mm", target_mm, (3,), finite=True)
    poses = []
    for index in range(count):
        azimuth = math.radians(first_deg + 360.0 * index / count)
        elevation = math.radians(elevations_deg[index % len(elevations_deg)])
        outward = [math.sin(azimuth) * math.cos(elevation), math.sin(elevation), math.cos(azimuth) * math.cos(elevation)]
        poses.append(rigid.look_at(target + distance_mm * np.array(outward), target))
    return poses
