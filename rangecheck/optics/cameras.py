"""Cameras: which ray belongs to which pixel, and back.

Frame: x right, y down, z forward (OpenCV). Pixel coordinates (u, v) have their integers at pixel centres, u to the right along
columns, v down along rows. Millimetres. A *range* is the length along a pixel's ray from its origin; a *depth* is the z component.
Distortion: Brown-Conrady in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property, lru_cache
from typing import Any, ClassVar

import numpy as np

from rangecheck.arrays import FloatArray, require, unit_vectors
from rangecheck.errors import CameraError
from rangecheck.optics.distortion import distort, largest_shift, undistort
from rangecheck.optics.ray_law import RayLaw, fit_law


@dataclass(frozen=True)
class Camera:
    """Base of all cameras: a grid of `height` x `width` pixels, each with one ray."""

    width: int
    height: int
    model: ClassVar[str] = ""

    def __post_init__(self) -> None:
        if not (0 < self.width <= 65536 and 0 < self.height <= 65536):
            raise CameraError(f"camera is {self.width} x {self.height} pixels; both must be 1 to 65536")
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, float) and not math.isfinite(value):
                raise CameraError(f"camera's {item.name} is {value}; it must be a finite number", name=item.name)

    def rays(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Origins (..., 3) in mm and unit directions (..., 3), camera frame, of the rays at pixel coordinates u, v."""
        raise NotImplementedError

    def project(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixel coordinates (..., 2) and range along the ray (...,) in mm of camera-frame points; NaN where not seen."""
        raise NotImplementedError

    def pixel_rays(self) -> tuple[FloatArray, FloatArray]:
        """`rays` of all pixel centres, shapes (height, width, 3)."""
        u, v = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float))
        return self.rays(u, v)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready description that `camera_from_dict` reads back."""
        return {"model": self.model} | {
            item.name: (list(value) if isinstance(value, tuple) else value)
            for item in fields(self)
            if not isinstance(value := getattr(self, item.name), np.ndarray)
        }


@dataclass(frozen=True)
class PinholeCamera(Camera):
    """Central projection with focal lengths fx, fy and principal point cx, cy in pixels; optional Brown-Conrady distortion."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    model: ClassVar[str] = "pinhole"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.fx > 0 and self.fy > 0):
            raise CameraError(f"focal lengths are {self.fx}, {self.fy} pixels; both must be positive")
        if len(self.distortion) > 8 or not all(math.isfinite(k) for k in self.distortion):
            raise CameraError(f"distortion is {self.distortion}; it takes up to 8 finite numbers, k1 k2 p1 p2 k3 k4 k5 k6")

    @classmethod
    def from_field_of_view(cls, width: int, height: int, horizontal_deg: float) -> PinholeCamera:
        """Square pixels, principal point in the middle, `horizontal_deg` (0 to 180) across the full width."""
        if not (0 < horizontal_deg < 180 and max(width, height) < 2**31):
            raise CameraError(
                f"field of view is {horizontal_deg} degrees of {width}x{height} pixels; it must lie between 0 and 180, and pixels below 2^31"
            )
        focal = 0.5 * width / math.tan(math.radians(horizontal_deg) / 2)
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def distortion_px(self) -> float:
        """How many pixels distortion moves the worst of 33 x 33 points of the frame; inf where a pixel has no ray."""
        if not any(self.distortion):
            return 0.0
        u, v = np.linspace(-0.5, self.width - 0.5, 33), np.linspace(-0.5, self.height - 0.5, 33)
        us, vs = np.meshgrid(u, v)
        shift = largest_shift((us - self.cx) / self.fx, (vs - self.cy) / self.fy, self.distortion)
        return shift * max(self.fx, self.fy)

    def rays(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, y = (np.asarray(u) - self.cx) / self.fx, (np.asarray(v) - self.cy) / self.fy
        if any(self.distortion):
            x, y = undistort(x, y, self.distortion)
        directions = unit_vectors(np.stack([x, y, np.ones_like(x)], axis=-1))
        return np.zeros_like(directions), directions

    def pixel_rays(self) -> tuple[FloatArray, FloatArray]:
        return _distorted_rays(self) if any(self.distortion) else super().pixel_rays()

    def project(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        z = points_mm[..., 2]
        with np.errstate(invalid="ignore", divide="ignore"):
            x, y = (np.where(z > 0, points_mm[..., axis] / z, np.nan) for axis in (0, 1))
        if any(self.distortion):
            x, y = distort(x, y, self.distortion)
        uv = np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=-1)
        return uv, np.where(z > 0, np.linalg.norm(points_mm, axis=-1), np.nan)


@lru_cache(maxsize=1)
def _distorted_rays(camera: PinholeCamera) -> tuple[FloatArray, FloatArray]:
    """A distorted camera's pixel rays, kept for the camera that was asked last: each takes Newton's method. Not to be written into."""
    rays = Camera.pixel_rays(camera)
    for array in rays:
        array.setflags(write=False)
    return rays


@dataclass(frozen=True)
class OrthographicCamera(Camera):
    """Parallel rays along z from the plane z = 0; pixel (u, v) starts at ((u - cx), (v - cy)) pixel_mm."""

    pixel_mm: float
    cx: float
    cy: float
    model: ClassVar[str] = "orthographic"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.pixel_mm > 0:
            raise CameraError(f"pixel_mm is {self.pixel_mm}; it must be positive")

    def rays(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, y = (np.asarray(u) - self.cx) * self.pixel_mm, (np.asarray(v) - self.cy) * self.pixel_mm
        origins = np.stack([x, y, np.zeros_like(x)], axis=-1)
        return origins, np.broadcast_to([0.0, 0.0, 1.0], origins.shape)

    def project(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        uv = points_mm[..., :2] / self.pixel_mm + [self.cx, self.cy]
        return uv, points_mm[..., 2]


@dataclass(frozen=True)
class CylindricalCamera(Camera):
    """A scanner that turns around the y axis (Cyberware style): column u looks from radius_mm inwards at azimuth
    first_rad + u step_rad (0 along +z, growing towards +x), row v at height (v - cy) row_mm."""

    radius_mm: float
    step_rad: float
    row_mm: float
    cy: float
    first_rad: float = 0.0
    model: ClassVar[str] = "cylindrical"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (
            self.radius_mm > 0 and self.row_mm > 0 and self.step_rad != 0 and abs(self.step_rad) * self.width < 2 * math.pi + 1e-6
        ):
            raise CameraError(
                f"cylindrical camera has radius {self.radius_mm} mm, rows of {self.row_mm} mm and {self.width} steps of {self.step_rad} rad; "
                "radius and rows must be positive, and the columns may not pass one turn"
            )

    def rays(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        azimuth = self.first_rad + np.asarray(u) * self.step_rad
        height = (np.asarray(v) - self.cy) * self.row_mm
        outward = np.stack([np.sin(azimuth), np.zeros_like(azimuth), np.cos(azimuth)], axis=-1)
        origins = self.radius_mm * outward
        origins[..., 1] = height
        return origins, -outward

    def project(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, y, z = (points_mm[..., axis] for axis in range(3))
        turn = 2 * math.pi
        azimuth = np.mod(np.arctan2(x, z) - self.first_rad, math.copysign(turn, self.step_rad))
        u = azimuth / self.step_rad
        u = np.where(u > self.width - 0.5, u - turn / abs(self.step_rad), u)
        distance = self.radius_mm - np.hypot(x, z)
        return np.stack([u, y / self.row_mm + self.cy], axis=-1), np.where(distance > 0, distance, np.nan)


@dataclass(frozen=True, eq=False)
class RayGrid(Camera):
    """Any other grid of rays, as measured: unit `directions` and `origins_mm`, both (height, width, 3), camera frame.

    Cells whose ray is not known hold NaN. Between cells rays are interpolated, and `project` inverts exactly that interpolation
    (to 1e-3 cells; NaN where neighbouring rays cross); in cells without a ray it follows the law of the others. It needs rays that
    all run forward along z, as of light-stripe scanners and cameras, or that start in one point, as of scanners that turn.
    Other scanners' views can be read, but points cannot be projected into them."""

    origins_mm: FloatArray = field(repr=False)
    directions: FloatArray = field(repr=False)
    model: ClassVar[str] = "raygrid"

    def __post_init__(self) -> None:
        super().__post_init__()
        shape = (self.height, self.width, 3)
        require("origins_mm", self.origins_mm, shape)
        require("directions", self.directions, shape)

    def pixel_rays(self) -> tuple[FloatArray, FloatArray]:
        return self.origins_mm, unit_vectors(self.directions)

    def rays(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        column, row = np.clip(np.asarray(u), 0, self.width - 1), np.clip(np.asarray(v), 0, self.height - 1)
        c0, r0 = np.minimum(column.astype(int), max(self.width - 2, 0)), np.minimum(row.astype(int), max(self.height - 2, 0))
        c1, r1 = np.minimum(c0 + 1, self.width - 1), np.minimum(r0 + 1, self.height - 1)
        s, t = (column - c0)[..., None], (row - r0)[..., None]

        def between(grid: FloatArray) -> FloatArray:
            # a corner of weight zero must not spread its NaN
            corners = ((r0, c0, (1 - s) * (1 - t)), (r0, c1, s * (1 - t)), (r1, c0, (1 - s) * t), (r1, c1, s * t))
            return sum((np.where(w > 0, w * grid[r, c], 0.0) for r, c, w in corners), np.zeros(column.shape + (3,)))

        return between(self.origins_mm), unit_vectors(between(self.directions))

    @cached_property
    def law(self) -> RayLaw:
        """The closed-form law that the rays nearly follow (`law.a`, `law.s`, `law.start_mm`), with what each cell leaves over.

        Raises CameraError when the rays neither all run forward along z nor start in one point."""
        return fit_law(self.origins_mm, self.directions)

    def project(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.law.project(points_mm)


_MODELS: dict[str, type[Camera]] = {c.model: c for c in (PinholeCamera, OrthographicCamera, CylindricalCamera)}


def camera_from_dict(description: Mapping[str, Any]) -> Camera:
    """A camera from its JSON form, e.g. {"model": "pinhole", "width": 640, "height": 480, "fx": 525, ...}.

    Raises CameraError that names the missing, unknown or non-numeric entry."""
    if not isinstance(description, Mapping):
        raise CameraError(f"camera is {type(description).__name__}; it must be an object with a model and its numbers")
    numbers = dict(description)
    model = numbers.pop("model", "pinhole")
    if not isinstance(model, str) or model not in _MODELS:
        raise CameraError(f"camera model is {model!r}; known are {', '.join(_MODELS)}", name="model")
    kind = _MODELS[model]
    wanted = {item.name: item for item in fields(kind)}
    unknown = sorted(set(numbers) - set(wanted))
    if unknown:
        raise CameraError(
            f"camera has unknown entries {', '.join(unknown)}; a {model} camera takes {', '.join(wanted)}", name=unknown[0]
        )
    arguments: dict[str, Any] = {}
    for name, value in numbers.items():
        try:
            if name in ("width", "height"):
                if isinstance(value, bool) or int(value) != value:
                    raise ValueError
                arguments[name] = int(value)
            elif name == "distortion":
                arguments[name] = tuple(float(k) for k in value)
            else:
                arguments[name] = float(value)
        except (TypeError, ValueError, OverflowError):
            raise CameraError(f"camera's {name} is {value!r}; it must be a number", name=name) from None
    try:
        return kind(**arguments)
    except TypeError:
        missing = [n for n in wanted if n not in arguments and n not in ("distortion", "first_rad")]
        raise CameraError(f"camera lacks {', '.join(missing)}", name=missing[0] if missing else "") from None
