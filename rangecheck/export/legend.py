"""Lettering, colours and the frame of a picture for people: title above, the picture, a scale with unit to its right.

Colour maps are perceptually uniform (viridis and its kin; van der Walt & Smith 2015), so that equal steps of the quantity look
equal; categories get hues a golden angle apart at even lightness in Oklab (Ottosson 2020).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray
from rangecheck.errors import ArrayError
from rangecheck.export.pictures import Picture, srgb

if TYPE_CHECKING:
    from PIL import Image, ImageDraw

PAPER = (255, 255, 255)
INK = (28, 30, 34)
FAINT = (104, 110, 118)
NOTHING = (233, 236, 239)
UNMIRRORED = (196, 202, 208)
SMALLEST_LETTER_PX = 13


@lru_cache
def font(size_px: int) -> Any:
    """The lettering at `size_px`, scalable and the same on every machine."""
    from PIL import ImageFont

    return ImageFont.load_default(size_px)


#: lightness, chroma and hue (degrees) in Oklab of the two ends of "relief": pale, so that lines and shading stay readable on it
RELIEF_ENDS = ((0.66, 0.075, 245.0), (0.97, 0.035, 95.0))


@lru_cache
def colour_table(name: str) -> FloatArray:
    """(256, 3) sRGB in 0..1 of "relief" or of a named matplotlib colour map."""
    if name == "relief":
        ends = np.array(
            [[lightness, c * math.cos(math.radians(h)), c * math.sin(math.radians(h))] for lightness, c, h in RELIEF_ENDS]
        )
        return srgb_from_oklab(*(ends[0] + np.linspace(0, 1, 256)[:, None] * (ends[1] - ends[0])).T)
    from matplotlib import colormaps

    try:
        return np.asarray(colormaps[name](np.arange(256)))[:, :3]
    except KeyError:
        raise ArrayError(f"colour map {name!r} is not known; viridis, cividis, magma and RdBu_r are", name="colours") from None


def colours_of(values: FloatArray, low: float, high: float, colours: str = "viridis") -> Picture:
    """(..., 3) uint8 sRGB colours of `values` from `low` to `high`, clipped; NaN gets the colour of nothing."""
    span = (high - low) or 1.0
    with np.errstate(invalid="ignore"):
        place = np.clip((values - low) / span, 0.0, 1.0) * 255
    table = colour_table(colours)
    index = np.nan_to_num(place)
    below = np.minimum(index.astype(int), 254)
    mixed = table[below] + (index - below)[..., None] * (table[below + 1] - table[below])
    picture = np.rint(255 * mixed).astype(np.uint8)
    picture[~np.isfinite(values)] = NOTHING
    return picture


def category_colours(count: int) -> Picture:
    """(count, 3) uint8 colours that tell `count` categories apart, the same for every call."""
    k = np.arange(count)
    # a cycle of 4: hues recur most nearly after 8, 13 and 21 steps
    lightness = np.array([0.72, 0.55, 0.84, 0.63])[k % 4]
    hue = np.radians(250 + 137.50776405 * k)
    return np.rint(255 * srgb_from_oklab(lightness, 0.115 * np.cos(hue), 0.115 * np.sin(hue))).astype(np.uint8)


def srgb_from_oklab(lightness: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """(n, 3) sRGB in 0..1 of Oklab colours, clipped to the gamut."""
    to_lms = np.array([[1, 0.3963377774, 0.2158037573], [1, -0.1055613458, -0.0638541728], [1, -0.0894841775, -1.2914855480]])
    lms = (to_lms @ np.stack([lightness, a, b])) ** 3
    to_rgb = np.array(
        [
            [4.0767416621, -3.3077115913, 0.2309699292],
            [-1.2684380046, 2.6097574011, -0.3413193965],
            [-0.0041960863, -0.7034186147, 1.7076147010],
        ]
    )
    return srgb((to_rgb @ lms).T)


def nice_step(span: float, count: int = 6) -> float:
    """The step 1, 2 or 5 x 10^k that cuts `span` into about `count` pieces."""
    raw = span / max(count, 1)
    if not (math.isfinite(raw) and raw > 0):
        return 1.0
    power = 10.0 ** math.floor(math.log10(raw))
    return power * min((1, 2, 5, 10), key=lambda m: abs(math.log(m * power / raw)))


def ticks(low: float, high: float, count: int = 6) -> list[float]:
    """Round numbers between `low` and `high`."""
    step = nice_step(high - low, count)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def span_text(low: float, high: float) -> str:
    """Both ends with as many digits as tell a thousandth of their span."""
    span = abs(high - low) or abs(high) or 1.0
    digits = min(9, max(0, 2 - math.floor(math.log10(span))))
    return f"{low:.{digits}f} to {high:.{digits}f}"


def tick_labels(values: Sequence[float]) -> list[str]:
    """The numbers with just the digits that tell them apart."""
    steps = [abs(b - a) for a, b in pairwise(values)]
    step = min(steps) if steps else (abs(values[0]) if values else 1.0) or 1.0
    largest = max((abs(v) for v in values), default=0.0)
    if largest >= 1e6 or (largest and step < 1e-5):
        return [f"{v:.3g}" for v in values]
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    return [f"{v + 0.0:.{digits}f}" for v in values]


@dataclass(frozen=True)
class ColourScale:
    """A bar with ticks, `high` on top; `high` below `low` turns it round. `marks` are drawn as lines across it (iso-lines)."""

    low: float
    high: float
    unit: str
    colours: str = "viridis"
    marks: tuple[float, ...] = ()


@dataclass(frozen=True)
class Swatches:
    """A list of colours (k, 3) with names."""

    colours: npt.NDArray[np.uint8]
    names: tuple[str, ...]


def letter_px(height: int) -> int:
    """Size of lettering for a picture of `height` pixels."""
    return int(min(40, max(SMALLEST_LETTER_PX, round(height / 34))))


def framed(picture: Picture, title: str, subtitle: str = "", scale: ColourScale | Swatches | None = None) -> Picture:
    """(H, W, 3) the picture with title, subtitle, and scale, on white paper."""
    from PIL import Image, ImageDraw

    h, w = picture.shape[:2]
    rgb = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
    size = letter_px(h)
    title_font, small = font(round(1.35 * size)), font(size)
    pad = round(1.2 * size)
    head = pad + round(1.35 * size * 1.3) + (round(1.5 * size) if subtitle else 0) + round(0.6 * size)
    right = _scale_width(scale, size, h) if scale is not None else 0
    width = max(
        pad + w + right + pad,
        2 * pad + round(max(title_font.getlength(title), small.getlength(subtitle))),
    )
    image = Image.new("RGB", (width, head + h + pad), PAPER)
    draw = ImageDraw.Draw(image)
    draw.text((pad, pad), title, font=title_font, fill=INK)
    if subtitle:
        draw.text((pad, pad + round(1.35 * size * 1.3)), subtitle, font=small, fill=FAINT)
    image.paste(Image.fromarray(rgb), (pad, head))
    if isinstance(scale, ColourScale):
        _draw_bar(image, draw, scale, pad + w + round(1.1 * size), head, h, size)
    elif isinstance(scale, Swatches):
        _draw_swatches(draw, scale, pad + w + round(1.1 * size), head, h, size)
    return np.asarray(image)


def _bar_ticks(scale: ColourScale, height: int, size: int) -> tuple[list[float], list[str]]:
    values = ticks(min(scale.low, scale.high), max(scale.low, scale.high), max(2, min(8, height // (3 * size))))
    return values, tick_labels(values)


def _scale_width(scale: ColourScale | Swatches, size: int, height: int) -> int:
    if isinstance(scale, ColourScale):
        labels = [*_bar_ticks(scale, height, size)[1], scale.unit]
        return round(1.1 * size + 1.4 * size + 0.9 * size + max(font(size).getlength(label) for label in labels))
    longest = max((font(size).getlength(name) for name in scale.names), default=0)
    return round(1.1 * size + 1.7 * size + longest)


def _draw_bar(image: Image.Image, draw: ImageDraw.ImageDraw, scale: ColourScale, x: int, y: int, height: int, size: int) -> None:
    from PIL import Image

    top = y + round(1.6 * size)
    tall, wide = height - round(1.6 * size), round(1.3 * size)
    span = (scale.high - scale.low) or 1.0
    values = scale.high - span * (np.arange(tall) + 0.5) / tall
    bar = np.repeat(colours_of(values, scale.low, scale.high, scale.colours)[:, None], wide, axis=1)
    image.paste(Image.fromarray(bar), (x, top))

    def row(value: float) -> int:
        return top + min(tall - 1, max(0, round((scale.high - value) / span * tall - 0.5)))

    for mark in scale.marks:
        draw.line([(x, row(mark)), (x + wide - 1, row(mark))], fill=INK, width=1)
    draw.text((x, y), scale.unit, font=font(size), fill=FAINT)
    for value, label in zip(*_bar_ticks(scale, height, size)):
        r = row(value)
        draw.line([(x + wide, r), (x + wide + round(0.35 * size), r)], fill=FAINT, width=max(1, size // 12))
        draw.text((x + wide + round(0.65 * size), r), label, font=font(size), fill=INK, anchor="lm")


def _draw_swatches(draw: ImageDraw.ImageDraw, scale: Swatches, x: int, y: int, height: int, size: int) -> None:
    line = round(1.55 * size)
    room = max(1, height // line)
    shown = len(scale.names) if len(scale.names) <= room else room - 1
    for k in range(shown):
        top = y + k * line
        draw.rectangle([x, top, x + size, top + size], fill=tuple(int(c) for c in scale.colours[k]))
        draw.text((x + round(1.6 * size), top + size / 2), scale.names[k], font=font(size), fill=INK, anchor="lm")
    if shown < len(scale.names):
        draw.text(
            (x, y + shown * line + size / 2), f"and {len(scale.names) - shown} more", font=font(size), fill=FAINT, anchor="lm"
        )
