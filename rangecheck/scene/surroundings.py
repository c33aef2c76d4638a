"""What shines on the scene from infinitely far away, as radiance by direction.

Constant, gradient from below to above, stripes as used to inspect reflective bodies, or a measured panorama; to each, soft
boxes of light can be added. World frame; directions point away from the object. Radiance as of sources, one number per wavelength.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray, require
from rangecheck.errors import SceneError
from rangecheck.kernels import inline_kernel, kernel, stage_kernel
from rangecheck.scene.sources import checked_radiance

CONSTANT, GRADIENT, STRIPES, PANORAMA = 0, 1, 2, 3
_BOX_NUMBERS = 12


class SurroundingsArrays(NamedTuple):
    """Surroundings as kernels read them. frame (3, 3): rows right, up, back; boxes (k, 12): three axes, tangents of the half
    sizes, softness; glow (k, c)."""

    kind: int
    frame: FloatArray
    period: float
    softness: float
    low: FloatArray
    high: FloatArray
    picture: FloatArray
    boxes: FloatArray
    glow: FloatArray


@dataclass(frozen=True, eq=False)
class Softbox:
    """A rectangle of light at infinity: `towards` its middle (3,), full width and height in degrees, radiance (c,).

    `softness` is the share of each half size over which its edge fades, 0 to 1."""

    towards: FloatArray
    width_deg: float
    height_deg: float
    radiance: FloatArray
    softness: float = 0.2
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)

    def __post_init__(self) -> None:
        towards = require("softbox towards", self.towards, (3,), finite=True)
        if not np.linalg.norm(towards) > 0:
            raise SceneError("softbox towards has length 0; it needs a direction")
        if not (0 < self.width_deg < 170 and 0 < self.height_deg < 170 and 0 <= self.softness <= 1):
            raise SceneError(
                f"softbox is {self.width_deg} x {self.height_deg} degrees with softness {self.softness}; "
                "sizes must lie between 0 and 170, softness between 0 and 1"
            )
        object.__setattr__(self, "towards", towards / np.linalg.norm(towards))
        object.__setattr__(self, "radiance", checked_radiance("softbox radiance", self.radiance))

    def numbers(self) -> FloatArray:
        """(12,) the middle, the right and the up axis, tangents of the half sizes, softness."""
        frame = _frame(self.up, self.towards)
        half = [math.tan(math.radians(size) / 2) for size in (self.width_deg, self.height_deg)]
        return np.concatenate([self.towards, frame[0], np.cross(self.towards, frame[0]), half, [self.softness]])


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Radiance by direction; made by `constant`, `gradient`, `stripes`, `panorama`, and `with_boxes`."""

    kind: int
    low: FloatArray
    high: FloatArray
    up: FloatArray = field(default_factory=lambda: np.array([0.0, 1.0, 0.0]))
    period_deg: float = 0.0
    softness: float = 0.0
    picture: FloatArray | None = field(default=None, repr=False)
    boxes: tuple[Softbox, ...] = ()
    ahead: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))

    def __post_init__(self) -> None:
        up = require("surroundings up", self.up, (3,), finite=True)
        if not np.linalg.norm(up) > 0:
            raise SceneError("surroundings up has length 0; it needs a direction")
        object.__setattr__(self, "up", up / np.linalg.norm(up))

    def with_boxes(self, *boxes: Softbox) -> Surroundings:
        """The same with soft boxes added; their radiance adds to what is there."""
        return replace(self, boxes=self.boxes + boxes)

    def turned(self, rotation: FloatArray) -> Surroundings:
        """The same, carried round by a rotation (3, 3)."""
        boxes = []
        for box in self.boxes:
            x, y, z = (float(c) for c in rotation @ np.asarray(box.up, float))
            boxes.append(replace(box, towards=rotation @ box.towards, up=(x, y, z)))
        return replace(self, up=rotation @ self.up, ahead=rotation @ self.ahead, boxes=tuple(boxes))

    @property
    def wavelengths(self) -> int:
        """How many numbers per radiance it needs: 1 when all are grey."""
        counts = [len(self.low), len(self.high), *(len(box.radiance) for box in self.boxes)]
        return max(counts + ([self.picture.shape[2]] if self.picture is not None else []))

    def arrays(self, channels: int) -> SurroundingsArrays:
        """As kernels read it, for `channels` wavelengths. Raises SceneError when it holds another number of them."""

        def spread(name: str, values: FloatArray) -> FloatArray:
            if values.shape[-1] not in (1, channels):
                raise SceneError(f"{name} has {values.shape[-1]} wavelengths and the scene has {channels}; give 1 or {channels}")
            # read-only whatever they come from, so that stages are compiled once
            whole = np.ascontiguousarray(np.broadcast_to(values, values.shape[:-1] + (channels,))).view()
            whole.flags.writeable = False
            return whole

        picture = self.picture if self.picture is not None else np.zeros((1, 1, 1), np.float32)
        return SurroundingsArrays(
            kind=self.kind,
            frame=_frame(self.up, self.ahead),
            period=math.radians(self.period_deg) if self.period_deg else 1.0,
            softness=self.softness,
            low=spread("surroundings radiance", self.low),
            high=spread("surroundings radiance", self.high),
            picture=spread("panorama", picture.astype(np.float32)),
            boxes=np.array([box.numbers() for box in self.boxes]).reshape(-1, _BOX_NUMBERS),
            glow=np.array([spread("softbox radiance", box.radiance) for box in self.boxes]).reshape(-1, channels),
        )

    def radiance(self, directions: FloatArray) -> FloatArray:
        """Radiance (..., c) seen along unit directions (..., 3)."""
        directions = np.asarray(directions, float)
        arrays = self.arrays(self.wavelengths)
        flat = np.ascontiguousarray(directions.reshape(-1, 3))
        return _radiance_of(arrays, flat, self.wavelengths).reshape(directions.shape[:-1] + (self.wavelengths,))

    def brightest(self) -> FloatArray:
        """(c,) a bound on its radiance in any direction."""
        base = np.maximum(self.low, self.high)
        if self.picture is not None:
            base = base + self.picture.max(axis=(0, 1))
        return np.asarray(base + sum((box.radiance for box in self.boxes), np.zeros(1)))


def constant(radiance: npt.ArrayLike) -> Surroundings:
    """The same radiance (c,) from everywhere."""
    value = checked_radiance("surroundings radiance", radiance)
    return Surroundings(CONSTANT, value, value)


DARKNESS = constant(0.0)


def gradient(below: npt.ArrayLike, above: npt.ArrayLike, up: npt.ArrayLike = (0.0, 1.0, 0.0)) -> Surroundings:
    """From `below` to `above`, linear in the cosine to `up`."""
    low, high = checked_radiance("gradient below", below), checked_radiance("gradient above", above)
    return Surroundings(GRADIENT, low, high, np.asarray(up, float))


def stripes(
    dark: npt.ArrayLike,
    bright: npt.ArrayLike,
    period_deg: float = 20.0,
    up: npt.ArrayLike = (0.0, 1.0, 0.0),
    softness: float = 0.1,
) -> Surroundings:
    """Bands of equal width around the axis `up`, one dark and one bright per `period_deg` of polar angle.

    `softness` is the share of a band over which it fades into the next (0 to 1)."""
    if not 0 < period_deg <= 180 or not 0 <= softness <= 1:
        raise SceneError(
            f"stripes have a period of {period_deg} degrees and softness {softness}; allowed are 0 to 180 and 0 to 1"
        )
    low, high = checked_radiance("stripes dark", dark), checked_radiance("stripes bright", bright)
    return Surroundings(STRIPES, low, high, np.asarray(up, float), period_deg, softness)


def panorama(picture: npt.ArrayLike, up: npt.ArrayLike = (0.0, 1.0, 0.0)) -> Surroundings:
    """A measured radiance map (h, w, c) in equal steps of angle: the first row at `up`, the middle column ahead (-back), growing
    to the right. Between samples it is bilinear."""
    values = require("panorama", picture, (None, None, None), np.float32, finite=True)
    if values.size == 0 or (values < 0).any():
        raise SceneError(f"panorama of shape {values.shape} must hold radiances >= 0")
    return Surroundings(PANORAMA, np.zeros(1), np.zeros(1), np.asarray(up, float), picture=values)


def _frame(up: npt.ArrayLike, towards: FloatArray | None) -> FloatArray:
    """(3, 3) rows right, up, back: right is across `towards` (ahead, -z unless given), level with `up`."""
    top = np.asarray(up, float) / np.linalg.norm(up)
    ahead = np.array([0.0, 0.0, -1.0]) if towards is None else towards
    if abs(float(ahead @ top)) > 0.999:
        ahead = np.eye(3)[int(np.argmin(np.abs(top)))]
    right = np.cross(ahead, top)
    right /= np.linalg.norm(right)
    return np.ascontiguousarray(np.stack([right, top, np.cross(right, top)]))


@inline_kernel
def smooth_step(x):
    """0 below 0, 1 above 1, smooth between."""
    x = min(1.0, max(0.0, x))
    return x * x * (3.0 - 2.0 * x)


@inline_kernel
def box_share(boxes, k, x, y, z):
    """Share (0..1) of soft box k's radiance seen along (x, y, z)."""
    share = 0.0
    ahead = x * boxes[k, 0] + y * boxes[k, 1] + z * boxes[k, 2]
    if ahead > 1e-6:
        fade = max(boxes[k, 11], 1e-9)
        across = abs(x * boxes[k, 3] + y * boxes[k, 4] + z * boxes[k, 5]) / (ahead * boxes[k, 9])
        along = abs(x * boxes[k, 6] + y * boxes[k, 7] + z * boxes[k, 8]) / (ahead * boxes[k, 10])
        share = smooth_step((1.0 - across) / fade) * smooth_step((1.0 - along) / fade)
    return share


@inline_kernel
def mix_of(kind, frame, period, softness, x, y, z):
    """Share (0..1) of `high` in the radiance along (x, y, z); the rest is `low`."""
    mix = 0.0
    height = max(-1.0, min(1.0, x * frame[1, 0] + y * frame[1, 1] + z * frame[1, 2]))
    if kind == GRADIENT:
        mix = 0.5 * (1.0 + height)
    elif kind == STRIPES:
        phase = math.acos(height) / period
        # distance from the middle of the bright band, in half bands: 0 there, 1 at its edge, 2 in the middle of the dark
        away = 4.0 * abs(phase - math.floor(phase) - 0.5)
        mix = smooth_step(0.5 + (1.0 - away) / (2.0 * max(softness, 1e-9)))
    return mix


@stage_kernel
def picture_place(frame, height, width, x, y, z):
    """Columns, rows and weights (u0, u1, v0, v1, s, t) of the panorama's four samples around (x, y, z)."""
    right = x * frame[0, 0] + y * frame[0, 1] + z * frame[0, 2]
    up = x * frame[1, 0] + y * frame[1, 1] + z * frame[1, 2]
    back = x * frame[2, 0] + y * frame[2, 1] + z * frame[2, 2]
    u = (0.5 + math.atan2(right, -back) / (2.0 * math.pi)) * width - 0.5
    v = math.acos(max(-1.0, min(1.0, up))) / math.pi * height - 0.5
    u0, v0 = math.floor(u), math.floor(v)
    s, t = u - u0, v - v0
    return int(u0) % width, int(u0 + 1) % width, max(int(v0), 0), min(int(v0 + 1), height - 1), s, t


@inline_kernel
def add_surroundings(
    kind, frame, period, softness, low, high, picture, boxes, glow, x, y, z, weight, row, film, pixel
):  # fmt: skip
    """film[pixel, :] += weight[row, :] x the radiance along (x, y, z); returns the sum of what was added.

    The first nine arguments are those of SurroundingsArrays, taken apart: inside a loop that costs a third."""
    total = 0.0
    if kind == PANORAMA:
        u0, u1, v0, v1, s, t = picture_place(frame, picture.shape[0], picture.shape[1], x, y, z)
        for c in range(film.shape[1]):
            upper = (1.0 - s) * picture[v0, u0, c] + s * picture[v0, u1, c]
            lower = (1.0 - s) * picture[v1, u0, c] + s * picture[v1, u1, c]
            light = weight[row, c] * ((1.0 - t) * upper + t * lower)
            film[pixel, c] += light
            total += light
    else:
        mix = mix_of(kind, frame, period, softness, x, y, z)
        for c in range(film.shape[1]):
            light = weight[row, c] * (low[c] + mix * (high[c] - low[c]))
            film[pixel, c] += light
            total += light
    for k in range(len(boxes)):
        share = box_share(boxes, k, x, y, z)
        if share > 0.0:
            for c in range(film.shape[1]):
                light = weight[row, c] * share * glow[k, c]
                film[pixel, c] += light
                total += light
    return total


@kernel
def _radiance_of(surroundings, directions, channels):
    kind, frame, period, softness, low, high, picture, boxes, glow = surroundings
    result = np.zeros((len(directions), channels))
    one = np.ones((1, channels))
    for i in range(len(directions)):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        add_surroundings(kind, frame, period, softness, low, high, picture, boxes, glow, x, y, z, one, 0, result, i)
    return result
