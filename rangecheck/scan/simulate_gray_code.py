"""The pictures that a camera takes of a subject under projected Gray-code patterns, and the code each pixel should decode to.

Patterns, in this order: white, black, the rows' bits and the columns' bits, most significant first, each followed by its inverse. Bit b of
row or column k is bit b of k ^ (k >> 1) (Gray, US patent 2632058, 1953; Inokuchi, Sato, Matsuda, *Range imaging system for 3-D object
recognition*, ICPR 1984). Pixel coordinates have their integers at pixel centres, in the camera as in the projector, so that
projector pixel k covers k - 0.5 to k + 0.5. World frame, millimetres; light is relative to that of a white matt surface facing the
projector at the working distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, IntArray
from rangecheck.errors import SettingError
from rangecheck.optics import Camera
from rangecheck.scan.simulate_view import MATT, Caster, Finish, Motion, camera_rays, look

#: samples per projector pixel in the blurred patterns
_FINE = 16


@dataclass(frozen=True)
class Capture:
    """How the pictures are taken.

    working_distance_mm  distance from the projector at which light counts as 1
    full_scale           light that fills the sensor: brighter pixels saturate
    ambient              constant light on the subject
    leak                 light of a black projector pixel
    blur_px              standard deviation of the projector's blur, projector pixels
    electrons            electrons of a full sensor: shot noise;  read_electrons: standard deviation of reading
    bits                 of a picture's count, 1 to 16
    subrays              rays along each side of a camera pixel
    interval_s           time between pictures, for a moving subject; the middle of the series is time 0
    """

    working_distance_mm: float = 600.0
    full_scale: float = 1.3
    ambient: float = 0.03
    leak: float = 0.01
    blur_px: float = 0.4
    electrons: float = 10000.0
    read_electrons: float = 8.0
    bits: int = 8
    subrays: int = 2
    interval_s: float = 0.1

    def __post_init__(self) -> None:
        for key, low, high in (
            ("working_distance_mm", 1e-9, 1e12), ("full_scale", 1e-9, 1e12), ("ambient", 0.0, 1e12), ("leak", 0.0, 1.0), ("blur_px", 0.0, 100.0),
            ("electrons", 1.0, 1e12), ("read_electrons", 0.0, 1e12), ("bits", 1, 16), ("subrays", 1, 16), ("interval_s", 0.0, 1e6),
        ):  # fmt: skip
            value = getattr(self, key)
            if not low <= value <= high:
                raise SettingError(f"{key} is {value}; it must lie between {low:g} and {high:g}", key=key, value=value)


@dataclass(frozen=True, eq=False)
class GrayCodePictures:
    """Pictures and the truth behind them, on the camera's grid.

    pictures     (n, h, w) uint8, or uint16 above 8 bits
    names        n names: white, black, row_9, row_9_inverse, ..., column_9, column_9_inverse, ...; the number is the bit
    true_column, true_row  (h, w) float64 projector coordinates at the pixel's centre, NaN where the projector does not reach
    true_range_mm (h, w) float64, NaN where nothing is met;  both at time 0
    """

    pictures: IntArray = field(repr=False)
    names: tuple[str, ...]
    true_column: FloatArray = field(repr=False)
    true_row: FloatArray = field(repr=False)
    true_range_mm: FloatArray = field(repr=False)


def gray_code_patterns(width: int, height: int) -> tuple[tuple[str, ...], IntArray, IntArray]:
    """Names of the n patterns, and their values 0 or 1 along the projector's columns (n, width) and rows (n, height); the pattern is the
    product of both."""
    if not (2 <= width <= 65536 and 2 <= height <= 65536):
        raise SettingError(f"projector is {width} x {height} pixels; both must be 2 to 65536", key="projector")
    names, along_columns, along_rows = ["white", "black"], [np.ones(width, int), np.zeros(width, int)], [np.ones(height, int)] * 2
    for axis, size, own, other in (("row", height, along_rows, along_columns), ("column", width, along_columns, along_rows)):
        index = np.arange(size)
        code = index ^ (index >> 1)
        for bit in reversed(range(math.ceil(math.log2(size)))):
            value = (code >> bit) & 1
            names += [f"{axis}_{bit}", f"{axis}_{bit}_inverse"]
            own += [value, 1 - value]
            other += [np.ones(width if axis == "row" else height, int)] * 2
    return tuple(names), np.array(along_columns), np.array(along_rows)


def simulate_gray_code(
    caster: Caster,
    camera: Camera,
    world_from_camera: FloatArray,
    projector: Camera,
    world_from_projector: FloatArray,
    capture: Capture,
    seed: int,
    *,
    camera_index: int = 0,
    finish: Finish = MATT,
    motion: Motion | None = None,
) -> GrayCodePictures:
    """Pictures of the surface behind `caster` under each pattern of `projector` (any camera model, used backwards).

    For several cameras call it once for each, with its own `camera_index`; random numbers come from (seed, camera_index, picture).
    A moving subject is somewhere else in each picture. Raises SettingError or ArrayError."""
    pose = rigid.checked(world_from_camera, "world_from_camera")
    projector_from_world = rigid.inverse(rigid.checked(world_from_projector, "world_from_projector"))
    names, along_columns, along_rows = gray_code_patterns(projector.width, projector.height)
    columns = [_blurred(values, capture.blur_px) for values in along_columns]
    rows = [_blurred(values, capture.blur_px) for values in along_rows]
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    offsets = (np.arange(capture.subrays) + 0.5) / capture.subrays - 0.5
    bundles = [camera_rays(pose, camera.rays(u + du, v + dv)) for dv in offsets for du in offsets]
    source = np.asarray(world_from_projector)[:3, 3]

    def lit(
        bundle: tuple[FloatArray, FloatArray], time: float | None
    ) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        times = None if time is None else np.full(u.size, time)
        view = look(caster, *bundle, source, finish=finish, motion=motion, time_s=times)
        with np.errstate(invalid="ignore"):
            points = bundle[0] + np.where(view.seen, view.distance_mm, np.nan)[:, None] * bundle[1]
        uv, _ = projector.project(rigid.move_points(projector_from_world, points))
        with np.errstate(invalid="ignore"):
            inside = np.abs(uv + 0.5 - 0.5 * np.array([projector.width, projector.height])) <= 0.5 * np.array(
                [projector.width, projector.height]
            )
        reached = np.nonzero(inside.all(axis=-1) & view.lit)[0]
        signal = view.signal(capture.working_distance_mm)[reached]
        ambient = np.where(view.seen, capture.ambient * finish.diffuse, 0.0)
        return reached, uv[reached], signal, ambient, view.distance_mm

    still = [lit(bundle, None) for bundle in bundles] if motion is None else []
    counts = 2**capture.bits - 1
    pictures = np.empty((len(names), camera.height, camera.width), np.uint8 if capture.bits <= 8 else np.uint16)
    for index in range(len(names)):
        time = (index - 0.5 * (len(names) - 1)) * capture.interval_s
        light = np.zeros(u.size)
        for k, bundle in enumerate(bundles):
            reached, uv, signal, ambient, _ = still[k] if motion is None else lit(bundle, time)
            pattern = _read(columns[index], uv[:, 0]) * _read(rows[index], uv[:, 1])
            light += ambient
            light[reached] += signal * (capture.leak + (1.0 - capture.leak) * pattern)
        mean = capture.electrons * light / (len(bundles) * capture.full_scale)
        random = np.random.Generator(np.random.Philox(key=np.array([seed, camera_index * 65536 + index], dtype=np.uint64)))
        electrons = mean + np.sqrt(mean + capture.read_electrons**2) * random.standard_normal(u.size)
        pictures[index] = np.clip(np.rint(electrons / capture.electrons * counts), 0, counts).reshape(u.shape)

    reached, uv, _, _, distance = lit(camera_rays(pose, camera.pixel_rays()), None if motion is None else 0.0)
    truth = np.full((2, u.size), np.nan)
    truth[:, reached] = uv.T
    distance = np.where(np.isfinite(distance), distance, np.nan)
    return GrayCodePictures(pictures, names, truth[0].reshape(u.shape), truth[1].reshape(u.shape), distance.reshape(u.shape))


def _blurred(values: IntArray, blur_px: float) -> FloatArray:
    """A pattern along one axis at _FINE samples per projector pixel, blurred; its ends go on as they are."""
    fine = np.repeat(values.astype(float), _FINE)
    if blur_px == 0:
        return fine
    reach = math.ceil(4 * blur_px * _FINE)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / (blur_px * _FINE)) ** 2)
    return np.convolve(np.pad(fine, reach, mode="edge"), weights / weights.sum(), mode="valid")


def _read(profile: FloatArray, coordinate: FloatArray) -> FloatArray:
    """Values of a blurred pattern at projector coordinates within it."""
    place = np.clip((coordinate + 0.5) * _FINE - 0.5, 0.0, len(profile) - 1.0)
    left = np.minimum(place.astype(int), len(profile) - 2)
    share = place - left
    return (1.0 - share) * profile[left] + share * profile[left + 1]
