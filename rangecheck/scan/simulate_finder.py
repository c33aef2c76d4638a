"""The numbers of a range finder, each a plain argument with its unit in its name. Millimetres; the camera's frame is x right, y down,
z forward. Light is relative to that of a white matt surface facing the source at the working distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from rangecheck.arrays import FloatArray
from rangecheck.errors import SettingError
from rangecheck.scan.simulate_noise import quadratic_noise

KINDS = ("stripe", "gray-code", "time-of-flight")
NOISE_MODELS = ("quadratic", "speckle", "photon", "kinect")


@dataclass(frozen=True)
class RangeFinder:
    """The instrument and the light it works in.

    source_mm            where the light source is, in the camera's frame; its distance from the camera is the baseline
    working_distance_mm  range at which `noise_mm` holds and light counts as 1
    noise_mm             standard deviation of range there, at normal incidence on white matt, for the models that take one
    fade_deg, limit_deg  cells are lost at random between these angles of incidence (the more oblique of camera and source),
                         with a chance that rises from 0 to 1 as a smooth step; all are lost beyond
    lost_share           share of cells lost at random besides
    step_mm              depth (range, where the camera has no depth axis) is rounded to multiples of this; 0 = not rounded
    nearest_mm, farthest_mm  ranges outside are not returned
    kind                 stripe, gray-code or time-of-flight
    noise_model          quadratic, speckle, photon or kinect (see `simulate_noise`); time of flight takes photon's, whatever is said
    ambient              constant light on the surface; noise grows by sqrt(1 + ambient / signal)
    least_signal, most_signal  cells with less light are too dark, with more (signal and ambient together) saturated
    least_contrast       cells where signal / (signal + ambient) is less are too dark
    sweep_deg_s          speed of the sheet of light (stripe); with a moving subject, when each cell is measured
    columns, column_noise    projector columns across the camera's field of view at the working distance (gray-code), and the
                         standard deviation of a decoded column before it is rounded
    disparity_step_px    disparity is rounded to multiples of this many pixels of a pinhole camera; 0 = not rounded
    wavelength_um, aperture_mm, speckle_contrast  for the speckle model
    modulation_mhz, subrays, sample_s  time of flight: frequency, rays along each side of a pixel, time between its four samples
    """

    source_mm: tuple[float, float, float] = (150.0, 0.0, 0.0)
    working_distance_mm: float = 600.0
    noise_mm: float = 0.2
    fade_deg: float = 65.0
    limit_deg: float = 82.0
    lost_share: float = 0.0
    step_mm: float = 0.02
    nearest_mm: float = 0.0
    farthest_mm: float = math.inf
    kind: str = "stripe"
    noise_model: str = "quadratic"
    ambient: float = 0.0
    least_signal: float = 0.0
    most_signal: float = math.inf
    least_contrast: float = 0.0
    sweep_deg_s: float = 30.0
    columns: int = 1024
    column_noise: float = 0.1
    disparity_step_px: float = 0.0
    wavelength_um: float = 0.66
    aperture_mm: float = 8.0
    speckle_contrast: float = 1.0
    modulation_mhz: float = 60.0
    subrays: int = 3
    sample_s: float = 0.0

    def __post_init__(self) -> None:
        if len(self.source_mm) != 3 or not all(math.isfinite(c) for c in self.source_mm):
            raise SettingError(f"source_mm is {self.source_mm}; it must be three finite coordinates", key="source_mm")
        for key, allowed in (("kind", KINDS), ("noise_model", NOISE_MODELS)):
            if getattr(self, key) not in allowed:
                raise SettingError(f"{key} is {getattr(self, key)!r}; it must be one of {', '.join(allowed)}", key=key)
        for key, low, high in _RANGES:
            value = getattr(self, key)
            if not low <= value <= high:
                raise SettingError(f"{key} is {value}; it must lie between {low:g} and {high:g}", key=key, value=value)
        if self.fade_deg > self.limit_deg:
            raise SettingError(
                f"fade_deg {self.fade_deg} exceeds limit_deg {self.limit_deg}; cells fade before the limit", key="fade_deg"
            )
        if self.kind != "time-of-flight" and not any(self.source_mm):
            raise SettingError("source_mm is at the camera; triangulation needs a baseline", key="source_mm")

    def noise_at(self, range_mm: FloatArray, cos_camera: FloatArray) -> FloatArray:
        """Standard deviation of range by the quadratic model at these ranges and cosines of incidence."""
        return quadratic_noise(self.noise_mm, range_mm, cos_camera, self.working_distance_mm)


_ANY = math.inf
_RANGES = (
    ("working_distance_mm", 1e-9, 1e12), ("noise_mm", 0.0, 1e12), ("fade_deg", 0.0, 90.0), ("limit_deg", 0.0, 90.0),
    ("lost_share", 0.0, 1.0), ("step_mm", 0.0, 1e12), ("nearest_mm", 0.0, _ANY), ("farthest_mm", 0.0, _ANY), ("ambient", 0.0, 1e12),
    ("least_signal", 0.0, 1e12), ("most_signal", 0.0, _ANY), ("least_contrast", 0.0, 1.0), ("sweep_deg_s", 1e-9, 1e12),
    ("columns", 2, 65536), ("column_noise", 0.0, 1e6), ("disparity_step_px", 0.0, 1e6), ("wavelength_um", 1e-3, 1e3),
    ("aperture_mm", 1e-6, 1e6), ("speckle_contrast", 0.0, 1.0), ("modulation_mhz", 1e-6, 1e6), ("subrays", 1, 32), ("sample_s", 0.0, 1e6),
)  # fmt: skip

#: the first Kinect: baseline 75 mm, disparity in eighths of a pixel
KINECT = RangeFinder(
    source_mm=(75.0, 0.0, 0.0), working_distance_mm=1000.0, noise_mm=0.0, noise_model="kinect", step_mm=1.0, disparity_step_px=0.125,
    nearest_mm=400.0, farthest_mm=4500.0,
)  # fmt: skip


def finder_to_dict(finder: RangeFinder) -> dict[str, object]:
    """The instrument's numbers, ready for JSON."""
    return {item.name: getattr(finder, item.name) for item in fields(finder)}
