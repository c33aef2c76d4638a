"""Triangulation: when the sheet of light reaches a cell, how far the cell errs, and the steps that projector columns, disparities and
stored depth cut range into. Arrays are flat, one entry per cell, millimetres.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.errors import SettingError
from rangecheck.optics import Camera, PinholeCamera
from rangecheck.scan.simulate_finder import RangeFinder
from rangecheck.scan.simulate_noise import kinect_noise, photon_noise, speckle_noise
from rangecheck.scan.simulate_view import Caster, Finish, Motion, View, look

#: the sheet of light counts as on the point it meets within this angle, 1e-3 mm at 600 mm; and how often that is tried
_SETTLED_DEG, _SWEEPS = 1e-4, 10


def _sweep_frame(pose: FloatArray, source: FloatArray, finder: RangeFinder) -> tuple[FloatArray, FloatArray]:
    """World directions of the sheet's middle, towards the working point on the camera's axis, and of its travel."""
    middle = pose[:3, 3] + finder.working_distance_mm * pose[:3, 2] - source
    middle /= np.linalg.norm(middle)
    travel = np.cross(pose[:3, 1], middle)
    return middle, travel / np.linalg.norm(travel)


def swept(
    caster: Caster,
    origins: FloatArray,
    rays: FloatArray,
    source: FloatArray,
    pose: FloatArray,
    finder: RangeFinder,
    finish: Finish,
    motion: Motion,
) -> tuple[View, FloatArray, BoolArray]:
    """What each cell meets when the sheet of light passes it, when (n,), and whether that settled (n,): the time depends on the point, and
    the point on the time. A cell that meets now one part of the subject, now another, has no answer."""
    middle, travel = _sweep_frame(pose, source, finder)
    time = np.zeros(len(rays))
    view = look(caster, origins, rays, source, finish=finish)
    settled = ~view.seen
    for _ in range(_SWEEPS):
        with np.errstate(invalid="ignore"):
            to_point = origins + view.distance_mm[:, None] * rays - source
            angle = np.degrees(np.arctan2(to_point @ travel, to_point @ middle))
            settled = ~view.seen | (np.abs(angle - time * finder.sweep_deg_s) < _SETTLED_DEG)
        if settled.all():
            break
        time = np.where(view.seen, angle / finder.sweep_deg_s, time)
        view = look(caster, origins, rays, source, finish=finish, motion=motion, time_s=time)
    return view, np.where(view.seen, time, 0.0), settled


def triangulation_noise(
    finder: RangeFinder,
    view: View,
    pose: FloatArray,
    origins: FloatArray,
    rays: FloatArray,
    source: FloatArray,
    signal: FloatArray,
) -> FloatArray:
    """(n,) standard deviation of range by the finder's noise model, NaN where nothing is seen."""
    cos_camera = np.maximum(view.cos_camera, 1e-3)
    with np.errstate(invalid="ignore", divide="ignore"):
        if finder.noise_model == "kinect":
            sigma = kinect_noise(view.distance_mm * (rays @ pose[:3, 2]), np.arccos(np.minimum(cos_camera, 1.0)))
        elif finder.noise_model == "speckle":
            back = source - (origins + view.distance_mm[:, None] * rays)
            cos_phi = -(back * rays).sum(axis=1) / np.linalg.norm(back, axis=1)
            sigma = speckle_noise(
                finder.wavelength_um,
                finder.speckle_contrast,
                finder.aperture_mm,
                view.distance_mm,
                np.arccos(np.clip(cos_phi, -1, 1)),
            )
        elif finder.noise_model == "photon":
            sigma = finder.noise_at(view.distance_mm, cos_camera) * photon_noise(1.0, signal, finder.ambient)
            return np.where(view.seen, sigma, np.nan)
        else:
            sigma = finder.noise_at(view.distance_mm, cos_camera)
        if finder.ambient > 0:
            sigma = sigma * np.sqrt(1.0 + finder.ambient / signal)
    return np.where(view.seen, sigma, np.nan)


def on_columns(
    range_mm: FloatArray, local_rays: FloatArray, finder: RangeFinder, camera: Camera, draw: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Ranges (n,) where the rays meet the middle planes of the projector's columns, each column decoded with its error and rounded to a
    whole one, and the standard deviation of range that both make."""
    if not isinstance(camera, PinholeCamera):
        raise SettingError("a gray-code scan needs a pinhole camera; its columns are planes through the source", key="kind")
    source = np.asarray(finder.source_mm)
    middle, travel = _sweep_frame(rigid.identity(), source, finder)
    focal = 0.5 * finder.columns / (0.5 * camera.width / camera.fx)

    def meet(column: FloatArray) -> FloatArray:
        # the plane through the source that holds the column and the camera's y axis
        normal = travel - (column / focal)[:, None] * middle
        return (normal @ source) / (normal * local_rays).sum(axis=1)

    with np.errstate(invalid="ignore", divide="ignore"):
        to_point = np.where(np.isfinite(range_mm), range_mm, np.nan)[:, None] * local_rays - source
        column = np.rint(focal * (to_point @ travel) / (to_point @ middle) + finder.column_noise * draw)
        # a rounded number is off by 1/sqrt(12)
        return meet(column), np.abs(meet(column + 0.5) - meet(column - 0.5)) * math.sqrt(finder.column_noise**2 + 1.0 / 12.0)


def lost_at(angle_deg: FloatArray, finder: RangeFinder) -> FloatArray:
    """Chance that a cell at this angle of incidence returns nothing."""
    band = finder.limit_deg - finder.fade_deg
    t = np.clip((angle_deg - finder.fade_deg) / band, 0.0, 1.0) if band > 0 else (angle_deg >= finder.limit_deg).astype(float)
    return t * t * (3.0 - 2.0 * t)


def rounded(range_mm: FloatArray, origin_z: FloatArray, ray_z: FloatArray, camera: Camera, finder: RangeFinder) -> FloatArray:
    """Ranges (h, w) whose disparity and depth come in the finder's steps."""
    if finder.step_mm == 0 and finder.disparity_step_px == 0:
        return range_mm
    if camera.model == "cylindrical":
        return np.rint(range_mm / finder.step_mm) * finder.step_mm if finder.step_mm else range_mm
    depth = range_mm * ray_z + origin_z
    if finder.disparity_step_px and isinstance(camera, PinholeCamera):
        product = camera.fx * math.hypot(*finder.source_mm) / finder.disparity_step_px
        with np.errstate(divide="ignore"):
            depth = product / np.rint(product / depth)
    if finder.step_mm:
        depth = np.rint(depth / finder.step_mm) * finder.step_mm
    return (depth - origin_z) / ray_z
