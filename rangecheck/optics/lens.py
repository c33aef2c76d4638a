"""Thin lens: aperture, focus, circle of confusion, image irradiance.

Camera frame: the lens's centre is the pinhole camera's focal point, its plane is z = 0. A point at depth z is imaged sharply when
z is the focus distance; otherwise its light fills a disc whose diameter, measured in the plane of focus, is A |z - F| / z for the
aperture's diameter A. In pixels that is times fx / F: the focal length enters only through fx. Image irradiance is eq (15) of
Fujiwara, Nayar, Ikeuchi 1991 (after Horn, *Robot Vision*, 1986).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, require, unit_vectors
from rangecheck.errors import CameraError
from rangecheck.optics.cameras import PinholeCamera

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
#: discs of confusion below this diameter cannot be told from a point: a picture's own sampling blurs as much
SHARP_PX = 0.5


@dataclass(frozen=True)
class ThinLens:
    """An aperture of diameter aperture_mm before `camera`, focused at depth focus_mm.

    focal_length_mm is needed for irradiance only. A rim of diameter rim_mm at rim_distance_mm in front of the aperture cuts
    oblique bundles (mechanical vignetting); without it only cos^4 darkens the corners."""

    camera: PinholeCamera
    aperture_mm: float
    focus_mm: float
    focal_length_mm: float = 50.0
    rim_mm: float | None = None
    rim_distance_mm: float = 0.0

    def __post_init__(self) -> None:
        for name in ("aperture_mm", "focus_mm", "focal_length_mm"):
            value = getattr(self, name)
            if not (math.isfinite(value) and (value > 0 or (name == "aperture_mm" and value == 0))):
                raise CameraError(f"lens's {name} is {value}; it must be a positive length", name=name)
        if self.focus_mm <= self.focal_length_mm:
            raise CameraError(
                f"the lens is focused at {self.focus_mm} mm, not beyond its focal length of {self.focal_length_mm} mm; "
                "nothing there can be imaged",
                name="focus_mm",
            )
        if self.rim_mm is not None and not (self.rim_mm >= self.aperture_mm and self.rim_distance_mm >= 0):
            raise CameraError(
                f"the lens's rim is {self.rim_mm} mm wide at {self.rim_distance_mm} mm; "
                f"it must be at least as wide as the aperture ({self.aperture_mm} mm) and not behind it",
                name="rim_mm",
            )

    @property
    def image_distance_mm(self) -> float:
        """Lens to sensor when focused: 1/f = 1/F + 1/s."""
        return self.focus_mm * self.focal_length_mm / (self.focus_mm - self.focal_length_mm)

    @property
    def pixel_mm(self) -> float:
        """Pixel pitch on the sensor that gives the camera's fx at this focus."""
        return self.image_distance_mm / self.camera.fx

    def circle_of_confusion_px(self, depth_mm: FloatArray) -> FloatArray:
        """Diameter in pixels of the disc that a point at `depth_mm` (> 0) is spread over; NaN for NaN."""
        depth = np.asarray(depth_mm, dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(
                depth > 0, self.camera.fx * self.aperture_mm * np.abs(depth - self.focus_mm) / (depth * self.focus_mm), np.nan
            )

    def bundle(self, u: FloatArray, v: FloatArray, lens_points_mm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rays of pixels (u, v), each (n,), through lens points (k, 2): origins, unit directions (n, k, 3) and passes (n, k) bool.

        All rays of a pixel meet in its point of the plane of focus. A ray that the rim stops has passes False."""
        _, through_centre = self.camera.rays(np.asarray(u, float), np.asarray(v, float))
        points = require("lens_points_mm", lens_points_mm, (None, 2), finite=True)
        target = through_centre / through_centre[:, 2:] * self.focus_mm
        origins = np.zeros((len(target), len(points), 3))
        origins[..., :2] = points
        directions = unit_vectors(target[:, None] - origins)
        passes = np.ones(origins.shape[:2], bool)
        if self.rim_mm is not None:
            at_rim = points + self.rim_distance_mm * directions[..., :2] / directions[..., 2:]
            passes = np.hypot(at_rim[..., 0], at_rim[..., 1]) <= 0.5 * self.rim_mm
        return origins, directions, passes

    def lens_points_mm(self, count: int, turn_rad: float = 0.0) -> FloatArray:
        """(count, 2) points that cover the aperture evenly, equal areas each (Vogel's spiral), turned by `turn_rad`."""
        k = np.arange(count)
        radius = 0.5 * self.aperture_mm * np.sqrt((k + 0.5) / count)
        angle = GOLDEN_ANGLE * k + turn_rad
        return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)

    def defocused_pixels(self, depth_mm: FloatArray, threshold_px: float = SHARP_PX) -> BoolArray:
        """(h, w) True where a pixel takes part in a disc of confusion wider than `threshold_px`, its own or a neighbour's.

        The other pixels are the pinhole camera's to within that blur, and need one ray."""
        return _reached(self.circle_of_confusion_px(depth_mm), threshold_px)

    def irradiance_factor(self) -> FloatArray:
        """(h, w) image irradiance per scene radiance, sr: pi/4 (d/f)^2 cos^4 gamma of (15), times the share the rim lets through."""
        _, directions = self.camera.pixel_rays()
        cosine = directions[..., 2]
        tangent = np.hypot(directions[..., 0], directions[..., 1]) / cosine
        return 0.25 * math.pi * (self.aperture_mm / self.focal_length_mm) ** 2 * cosine**4 * self.rim_share(tangent)

    def rim_share(self, tangent: FloatArray) -> FloatArray:
        """Share (0..1) of the aperture that is seen through the rim from the field angle with this tangent."""
        if self.rim_mm is None:
            return np.ones_like(np.asarray(tangent, dtype=float))
        return common_area(0.5 * self.aperture_mm, 0.5 * self.rim_mm, self.rim_distance_mm * np.asarray(tangent, dtype=float)) / (
            math.pi * (0.5 * self.aperture_mm) ** 2
        )


def common_area(radius: float, other: float, apart: FloatArray) -> FloatArray:
    """Area that two circles share whose centres lie `apart`."""
    smaller = min(radius, other)
    with np.errstate(divide="ignore", invalid="ignore"):
        a = np.arccos(np.clip((apart**2 + radius**2 - other**2) / (2 * apart * radius), -1, 1))
        b = np.arccos(np.clip((apart**2 + other**2 - radius**2) / (2 * apart * other), -1, 1))
    lens = radius**2 * (a - np.sin(2 * a) / 2) + other**2 * (b - np.sin(2 * b) / 2)
    return np.where(apart >= radius + other, 0.0, np.where(apart <= abs(radius - other), math.pi * smaller**2, lens))


def _reached(diameter_px: FloatArray, threshold_px: float) -> BoolArray:
    """Pixels within half the diameter of a pixel whose disc is wider than the threshold (in octaves of radius, rounded up)."""
    import cv2

    blurred = np.nan_to_num(diameter_px, posinf=2.0 * max(diameter_px.shape)) > threshold_px
    radius = np.where(blurred, 0.5 * np.nan_to_num(diameter_px, posinf=2.0 * max(diameter_px.shape)), 0.0)
    reached = blurred.copy()
    reach = 1.0
    while blurred.any():
        ring = blurred & (radius <= reach)
        if ring.any():
            # distance of every pixel to the nearest one of this octave
            distance = cv2.distanceTransform((~ring).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            reached |= distance <= reach + 1.0
        blurred = blurred & ~ring
        reach *= 2.0
    return reached
