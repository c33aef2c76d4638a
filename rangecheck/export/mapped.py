"""Maps as pictures for people: coloured with a legend, iso-lines of depth over relief, contact sheets.

Maps are (h, w) with NaN (or ID 0) where nothing is seen. Rows run downwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import BoolArray, FloatArray, IntArray, require
from rangecheck.errors import ArrayError
from rangecheck.export import legend
from rangecheck.export.pictures import Picture

#: small maps are enlarged by whole pixels until their longer side has this many
PICTURE_PX = 640
#: light of the relief under iso-lines: from the upper left and towards the viewer
RELIEF_LIGHT = (-0.5, -0.6, 0.62)
#: a cell between four pixels whose depths differ by more than this many pixel widths is an edge of the scene, not a slope
JUMP_SLOPE = 8.0
INDEX_EVERY = 5
#: shorter pieces of iso-lines, in pixels of the map, are crumbs at ragged borders
SHORTEST_LINE_PX = 3.0


def _zoom(shape: tuple[int, ...], picture_px: int) -> int:
    return max(1, picture_px // max(shape[:2]))


def _enlarged(picture: Picture, factor: int) -> Picture:
    return np.repeat(np.repeat(picture, factor, axis=0), factor, axis=1) if factor > 1 else picture


def range_of(values: FloatArray) -> tuple[float, float]:
    """Lowest and highest finite value; (0, 1) when there is none."""
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)


def coloured_map(
    values: FloatArray,
    title: str,
    unit: str,
    *,
    subtitle: str = "",
    low: float | None = None,
    high: float | None = None,
    colours: str = "viridis",
    picture_px: int = PICTURE_PX,
) -> Picture:
    """Picture (H, W, 3) of a float map (h, w) in colours, with title, scale, ticks and unit.

    `low` and `high` fix the ends of the scale (for sequences); they default to the map's own."""
    array = require("values", values, (None, None))
    if not array.size:
        raise ArrayError("the map is empty; there is nothing to draw", name="values")
    least, most = range_of(array)
    low, high = least if low is None else low, most if high is None else high
    if not subtitle:
        subtitle = f"{legend.span_text(least, most)} {unit}" if np.isfinite(array).any() else "nothing is seen from here"
    picture = _enlarged(legend.colours_of(array, low, high, colours), _zoom(array.shape, picture_px))
    return legend.framed(picture, title, subtitle, legend.ColourScale(low, high, unit, colours))


def coloured_normals(normals: FloatArray, title: str, *, picture_px: int = PICTURE_PX) -> Picture:
    """Picture (H, W, 3) of unit normals (h, w, 3), NaN where nothing is seen: red x, green y, blue z, from -1 to 1."""
    array = require("normals", normals, (None, None, 3))
    seen = np.isfinite(array).all(axis=2)
    picture = np.full(array.shape, legend.NOTHING, np.uint8)
    picture[seen] = np.rint(127.5 * (array[seen] + 1.0))
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    swatches = legend.Swatches(np.rint(127.5 * (axes + 1.0)).astype(np.uint8), ("+x", "+y", "+z", "-x", "-y", "-z"))
    return legend.framed(
        _enlarged(picture, _zoom(seen.shape, picture_px)), title, "where each colour faces, world axes", swatches
    )


def coloured_ids(
    ids: IntArray,
    names: Sequence[str],
    title: str,
    *,
    subtitle: str = "",
    seen: BoolArray | None = None,
    picture_px: int = PICTURE_PX,
) -> Picture:
    """Picture (H, W, 3) of an ID map (h, w), 0 = none, ID k named names[k - 1]; only the IDs that occur enter the legend.

    `seen` (h, w) tells pixels that see a surface but mirror nothing from the background."""
    numbers = require("ids", ids, (None, None), np.int64)
    if numbers.size and (numbers.min() < 0 or numbers.max() > len(names)):
        raise ArrayError(f"ids run from {numbers.min()} to {numbers.max()}; there are {len(names)} names", name="ids")
    colours = np.concatenate([np.array([legend.NOTHING], np.uint8), legend.category_colours(len(names))])
    present = [int(k) for k in np.unique(numbers) if k > 0]
    picture = colours[numbers]
    swatches, words = colours[present], [f"{k}  {names[k - 1]}" for k in present]
    if seen is not None:
        bare = seen & (numbers == 0)
        picture[bare] = legend.UNMIRRORED
        swatches, words = np.concatenate([swatches, np.array([legend.UNMIRRORED], np.uint8)]), [*words, "0  nothing"]
    subtitle = subtitle or f"{len(present)} of {len(names)} surfaces seen"
    enlarged = _enlarged(picture, _zoom(numbers.shape, picture_px))
    return legend.framed(enlarged, title, subtitle, legend.Swatches(swatches, tuple(words)))


def relief_shading(depth: FloatArray, pixel: float) -> FloatArray:
    """(h, w) in 0..1: the depth map lit as matt relief; `pixel` is a pixel's width in the unit of depth. NaN stays NaN."""
    slope_v, slope_u = (_slope(depth, axis) / pixel for axis in (0, 1))
    length = np.sqrt(1 + slope_u**2 + slope_v**2)
    light = np.array(RELIEF_LIGHT) / math.sqrt(sum(c * c for c in RELIEF_LIGHT))
    # the normal towards the viewer of z = depth(u, v), with z away from the viewer
    return np.clip((slope_u * light[0] + slope_v * light[1] + light[2]) / length, 0, 1)


def _slope(depth: FloatArray, axis: int) -> FloatArray:
    """Central differences, one-sided at the edge of what is known, 0 for lone pixels; NaN where depth is."""
    ahead = np.full_like(depth, np.nan)
    behind = np.full_like(depth, np.nan)
    step = np.diff(depth, axis=axis)
    if axis == 0:
        ahead[:-1], behind[1:] = step, step
    else:
        ahead[:, :-1], behind[:, 1:] = step, step
    both = np.where(np.isnan(ahead), behind, np.where(np.isnan(behind), ahead, 0.5 * (ahead + behind)))
    return np.where(np.isnan(depth), np.nan, np.nan_to_num(both))


def iso_lines(depth: FloatArray, step: float, jump: float = math.inf) -> dict[float, list[FloatArray]]:
    """Iso-lines of a map (h, w) at whole multiples of `step`: level -> polylines (n, 2) in pixel coordinates (u, v).

    Lines end at NaN, and wherever the four pixels around them differ by more than `jump`: there the scene has an edge."""
    import contourpy

    array = require("depth", depth, (None, None))
    if min(array.shape) < 2 or not np.isfinite(array).any():
        return {}
    low, high = range_of(array)
    if (high - low) / step > 10_000:
        raise ArrayError(f"a step of {step:g} cuts {high - low:g} into more than 10000 lines; take a larger step", name="step")
    cells = np.stack([array[:-1, :-1], array[:-1, 1:], array[1:, :-1], array[1:, 1:]])
    edge = ~(np.where(np.isnan(cells), -np.inf, cells).max(0) - np.where(np.isnan(cells), np.inf, cells).min(0) <= jump)
    generator: Any = contourpy.contour_generator(z=np.ma.masked_invalid(array), name="serial", corner_mask=True)
    found: dict[float, list[FloatArray]] = {}
    for k in range(math.floor(low / step) + 1, math.ceil(high / step)):
        pieces: list[FloatArray] = []
        for line in generator.lines(k * step):
            middle = 0.5 * (line[1:] + line[:-1])
            column = np.clip(middle[:, 0].astype(int), 0, edge.shape[1] - 1)
            row = np.clip(middle[:, 1].astype(int), 0, edge.shape[0] - 1)
            cuts = np.flatnonzero(edge[row, column]) + 1
            pieces.extend(piece for piece in np.split(line, cuts) if len(piece) > 1)
        if pieces:
            found[k * step] = pieces
    return found


def contour_picture(
    depth_mm: FloatArray,
    step_mm: float | None = None,
    *,
    pixel_mm: float | None = None,
    title: str = "Depth contours",
    subtitle: str = "",
    relief: bool = True,
    crop: bool = True,
    picture_px: int = 900,
) -> Picture:
    """Iso-lines of depth (isoplot) at every `step_mm` over tinted relief, every fifth heavier, with legend: (H, W, 3).

    `step_mm` defaults to a round number that gives about 25 lines; `pixel_mm` is the width of a pixel on the object, by which
    relief and edges are judged (default: such that the median slope is 1). With `crop` only what is seen is shown."""
    import cv2

    depth = require("depth_mm", depth_mm, (None, None))
    if not depth.size:
        raise ArrayError("the depth map is empty; there is nothing to draw", name="depth_mm")
    depth = _cropped(depth) if crop else depth
    low, high = range_of(depth)
    step = step_mm if step_mm is not None else legend.nice_step(high - low, 25)
    if not (math.isfinite(step) and step > 0):
        raise ArrayError(f"step_mm is {step}; it must be a positive length", name="step_mm")
    pixel = pixel_mm or _typical_pixel(depth)
    factor = max(1.0, picture_px / max(depth.shape))
    size = (round(depth.shape[1] * factor), round(depth.shape[0] * factor))
    # near is light and far is dark in the tint, the way a relief map is coloured
    tint = legend.colours_of(depth, high, low, "relief").astype(float)
    if relief:
        shade = np.nan_to_num(relief_shading(depth, pixel), nan=1.0)
        tint *= (0.45 + 0.6 * shade)[..., None]
        tint[~np.isfinite(depth)] = legend.NOTHING
    picture = cv2.resize(np.clip(tint, 0, 255, out=tint).astype(np.uint8), size, interpolation=cv2.INTER_CUBIC)
    thin = max(1, round(max(size) / 900))
    for level, lines in iso_lines(depth, step, JUMP_SLOPE * pixel).items():
        heavy = round(level / step) % INDEX_EVERY == 0
        # 4 binary digits of sub-pixel position
        long_enough = [line for line in lines if np.hypot(*np.diff(line, axis=0).T).sum() >= SHORTEST_LINE_PX]
        drawn = [np.rint(((line + 0.5) * factor - 0.5) * 16).astype(np.int32) for line in long_enough]
        cv2.polylines(picture, drawn, False, (16, 18, 22), thin + 1 if heavy else thin, cv2.LINE_AA, 4)
    subtitle = subtitle or f"a line every {step:g} mm, every {INDEX_EVERY * step:g} mm heavier"
    heavy_step = INDEX_EVERY * step
    marks = tuple(k * heavy_step for k in range(math.ceil(low / heavy_step), math.floor(high / heavy_step) + 1))
    return legend.framed(picture, title, subtitle, legend.ColourScale(high, low, "mm", "relief", marks))


def _cropped(depth: FloatArray) -> FloatArray:
    """The part of the map around what is seen, with a border of a twentieth."""
    rows, columns = (np.flatnonzero(np.isfinite(depth).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return depth
    border = max(2, round(0.05 * max(np.ptp(rows), np.ptp(columns))))
    top, left = max(0, rows[0] - border), max(0, columns[0] - border)
    return depth[top : rows[-1] + border + 1, left : columns[-1] + border + 1]


def _typical_pixel(depth: FloatArray) -> float:
    steps = np.hypot(*(_slope(depth, axis) for axis in (0, 1)))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return float(np.median(steps)) if len(steps) else 1.0


def contact_sheet(
    pictures: Sequence[npt.NDArray[np.uint8]],
    captions: Sequence[str] | None = None,
    *,
    columns: int | None = None,
    cell_px: int = 240,
) -> Picture:
    """All pictures on one sheet, row by row, each scaled to fit `cell_px`, with its caption below: (H, W, 3)."""
    from PIL import Image, ImageDraw

    if not len(pictures):
        raise ArrayError("there are no pictures for the sheet", name="pictures")
    across = columns or min(len(pictures), max(1, math.ceil(math.sqrt(1.5 * len(pictures)))))
    size = max(legend.SMALLEST_LETTER_PX, cell_px // 18)
    gap, below = max(4, cell_px // 30), round(1.6 * size) if captions is not None else 0
    scaled = []
    for picture in pictures:
        image = Image.fromarray(picture).convert("RGB")
        ratio = cell_px / max(image.size)
        scaled.append(
            image.resize((max(1, round(image.width * ratio)), max(1, round(image.height * ratio))), Image.Resampling.LANCZOS)
        )
    wide, tall = max(i.width for i in scaled), max(i.height for i in scaled) + below
    rows = math.ceil(len(scaled) / across)
    sheet = Image.new("RGB", (gap + across * (wide + gap), gap + rows * (tall + gap)), legend.PAPER)
    draw = ImageDraw.Draw(sheet)
    for k, image in enumerate(scaled):
        x, y = gap + (k % across) * (wide + gap), gap + (k // across) * (tall + gap)
        sheet.paste(image, (x + (wide - image.width) // 2, y))
        if captions is not None:
            draw.text((x + wide / 2, y + tall - below / 2), captions[k], font=legend.font(size), fill=legend.FAINT, anchor="mm")
    return np.asarray(sheet)
