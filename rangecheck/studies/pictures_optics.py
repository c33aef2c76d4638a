"""Cameras against the formulas of their makers: distortion there and back, discs of confusion, fall of light towards the corners.

Distortion: the rays of pixels all over the frame, projected again. Defocus: the share of each pixel's bundle that meets a small ball, its
second moment against that of the thin lens's disc. Fall of light: the radiance of the exit pupil summed over its area at a point of the
sensor, equation (15) of Fujiwara, Nayar, Ikeuchi 1991 from first principles.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from rangecheck.errors import InputError
from rangecheck.optics import PinholeCamera, ThinLens
from rangecheck.studies.bust_scans import real_data
from rangecheck.study import Part

ROUND_TRIP_PX, DISC_SHARE, FALL_SHARE = 1e-6, 0.02, 1e-4
#: lenses that were never built: barrel, pincushion, rational
LENSES = {
    "barrel": PinholeCamera(640, 480, 500, 500, 319.5, 239.5, (-0.28, 0.11, 0.0007, -0.0011, -0.02)),
    "pincushion": PinholeCamera(640, 480, 500, 500, 319.5, 239.5, (0.2, 0.05)),
    "rational": PinholeCamera(640, 480, 500, 500, 319.5, 239.5, (0.5, -0.2, 0.001, 0.002, 0.05, 0.6, -0.1, 0.02)),
}


def calibrated(folder: Path, side: str) -> PinholeCamera:
    """A camera of the structured-light pictures in `folder`, at full resolution; side: left or right."""
    where = folder / f"{side}Cam"
    k = np.loadtxt(where / "cam_matrix.txt")
    distortion = tuple(float(x) for x in np.loadtxt(where / "cam_distortion.txt").ravel())
    return PinholeCamera(4896, 3264, float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]), distortion)


def round_trip_px(camera: PinholeCamera) -> tuple[float, float]:
    """How far, px, pixels all over the frame come back at most when their rays are projected; share of the pixels that have a ray."""
    v, u = np.mgrid[0 : camera.height : 60j, 0 : camera.width : 80j]
    _, directions = camera.rays(u, v)
    known = np.isfinite(directions).all(axis=-1)
    back, _ = camera.project(1000.0 * directions[known])
    return float(np.abs(back - np.stack([u, v], axis=-1)[known]).max()), float(known.mean())


def disc_px(lens: ThinLens, depth_mm: float, ball_mm: float = 1.5, rays: int = 600) -> float:
    """Diameter, px, of the disc that a small ball at `depth_mm` on the axis is spread over by traced bundles."""
    camera = lens.camera
    middle = np.array([0.0, 0.0, depth_mm])
    reach = math.ceil(float(lens.circle_of_confusion_px(np.array(depth_mm))) / 2 + camera.fx * ball_mm / depth_mm) + 2
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    origins, directions, passes = lens.bundle(u.ravel() + camera.cx, v.ravel() + camera.cy, lens.lens_points_mm(rays))
    along = ((middle - origins) * directions).sum(axis=-1)
    miss = np.linalg.norm(origins + along[..., None] * directions - middle, axis=-1)
    share = ((miss < ball_mm) & passes).mean(axis=1)
    # the second moment of a disc is half its radius squared; the ball's own is added to the lens's
    moment = 2 * float((share * (u.ravel() ** 2 + v.ravel() ** 2)).sum() / share.sum())
    return 2 * math.sqrt(max(moment - (camera.fx * ball_mm / depth_mm) ** 2, 0.0))


def irradiance(lens: ThinLens, tangent: float, points: int = 20000) -> float:
    """Irradiance at the sensor's point of field angle atan(tangent) under a scene of radiance 1, summed over the exit pupil."""
    at = np.array([lens.focal_length_mm * tangent, 0.0, lens.focal_length_mm])
    away = at - np.concatenate([lens.lens_points_mm(points), np.zeros((points, 1))], axis=1)
    distance2 = (away**2).sum(axis=1)
    return math.pi * (lens.aperture_mm / 2) ** 2 * float((away[:, 2] ** 2 / distance2**2).mean())


def cameras_part(quick: bool) -> Part:
    """Round trips, discs and the fall of light."""
    findings: list[str] = []
    trips, discs, falls = [], [], []
    lenses = dict(LENSES)
    try:
        folder = real_data("alexander_bust")
        lenses |= {f"alexander_bust, {side}": calibrated(folder, side) for side in ("left", "right")}
    except InputError as missing:
        findings.append(f"real calibrations: not tried; {missing}")
    for name, camera in lenses.items():
        back, known = round_trip_px(camera)
        trips.append({"camera": name, "largest_px": back, "share_with_ray": known})
        findings.append(
            f"distortion, {name}: pixels come back to within {back:.1e} px (bar {ROUND_TRIP_PX:g}: {_kept(back <= ROUND_TRIP_PX)}); "
            f"{100 * known:.1f} % of the frame has rays"
        )
    camera = PinholeCamera.from_field_of_view(101, 101, 20)
    for depth in (400.0, 800.0, 1000.0, 1500.0):
        lens = ThinLens(camera, aperture_mm=40.0, focus_mm=600.0)
        measured, formula = disc_px(lens, depth, rays=300 if quick else 2000), float(lens.circle_of_confusion_px(np.array(depth)))
        discs.append({"depth_mm": depth, "measured_px": measured, "formula_px": formula, "share": measured / formula - 1})
    worst = max(abs(float(row["share"])) for row in discs)
    findings.append(
        f"defocus: discs of {discs[0]['formula_px']:.1f} to {discs[-1]['formula_px']:.1f} px at four depths are the thin lens's within {100 * worst:.2f} % "
        f"(bar {100 * DISC_SHARE:.0f} %: {_kept(worst <= DISC_SHARE)})"
    )
    wide = ThinLens(PinholeCamera.from_field_of_view(901, 3, 80), aperture_mm=0.5, focus_mm=1e9)
    factor, middle = wide.irradiance_factor()[1], 450
    for column in (450, 560, 670, 780, 890):
        tangent = (column - middle) / wide.camera.fx
        off = float(factor[column]) / irradiance(wide, tangent) - 1
        fourth = float(factor[column] / factor[middle]) / math.cos(math.atan(tangent)) ** 4 - 1
        falls.append({"degrees": math.degrees(math.atan(tangent)), "off_first_principles": off, "off_cos4": fourth})
    worst = max(abs(float(row["off_first_principles"])) for row in falls)
    findings.append(
        f"fall of light: out to {falls[-1]['degrees']:.1f} degrees within {worst:.1e} of the exit pupil's sum, and of cos^4 within "
        f"{max(abs(float(row['off_cos4'])) for row in falls):.1e} (bar {FALL_SHARE:g}: {_kept(worst <= FALL_SHARE)})"
    )
    return Part(findings=findings, tables={"distortion": trips, "defocus": discs, "irradiance": falls})


def _kept(holds: bool) -> str:
    return "kept" if holds else "missed"
