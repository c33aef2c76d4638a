"""Radiance to picture files: one stated exposure, sRGB, PNG.

Radiance is linear, (h, w) grey or (h, w, 3) for red, green, blue; NaN means that nothing is seen there. Pictures are (h, w[, 3])
uint8 in sRGB (IEC 61966-2-1) or uint16 numbers. The same image gives the same bytes.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray, require
from rangecheck.errors import ArrayError, InputError
from rangecheck.files import read_bytes, write_bytes
from rangecheck.quick_look import srgb

#: share of the lit pixels that an exposure keeps below white's `WHITE_LEVEL`; the rest are highlights, which may clip
EXPOSED_SHARE = 0.98
#: linear level (1 = white) to which the radiance at EXPOSED_SHARE is brought
WHITE_LEVEL = 0.80
#: pixels dimmer than this share of the brightest are background or shadow and do not count for the exposure
LIT_SHARE = 1e-4
#: at most this many pixels of each frame are looked at, evenly spread
SAMPLED_PIXELS = 65536
PNG_LEVEL = 4
#: rows that are developed in one go: what is needed on the way is several times the picture
DEVELOPED_ROWS = 256

Picture = npt.NDArray[np.uint8]


def luminance(radiance: FloatArray) -> FloatArray:
    """(h, w) luminance of grey or linear-sRGB radiance (Rec. 709 weights)."""
    return radiance if radiance.ndim == 2 else radiance @ np.array([0.2126, 0.7152, 0.0722], dtype=radiance.dtype)


def exposure_from(sequence: Iterable[FloatArray], share: float = EXPOSED_SHARE, white_level: float = WHITE_LEVEL) -> float:
    """One exposure for all frames: radiance times it is linear picture level, 1 = white.

    All frames' lit pixels are pooled; the radiance that `share` of them do not exceed becomes `white_level`. A black sequence
    gets exposure 1. Raises ArrayError for infinite radiance or an empty sequence."""
    pooled = []
    for frame in sequence:
        level = luminance(_checked(frame)).ravel()
        level = level[:: max(1, -(-level.size // SAMPLED_PIXELS))]
        pooled.append(level[level > 0])
    if not pooled:
        raise ArrayError("there is no frame to take an exposure from", name="sequence")
    levels = np.concatenate(pooled).astype(np.float64)
    if not len(levels):
        return 1.0
    levels = levels[levels >= LIT_SHARE * levels.max()]
    return white_level / float(np.quantile(levels, share))


def develop(radiance: FloatArray, exposure: float = 1.0, background: float = 0.0) -> Picture:
    """Picture of a radiance image: times `exposure`, clipped, sRGB, rounded to 8 bits.

    `background` is the sRGB level (0..1) where the radiance is NaN. Raises ArrayError for other shapes and infinite radiance."""
    image = _checked(radiance)
    if not (np.isfinite(exposure) and exposure > 0):
        raise ArrayError(f"exposure is {exposure}; it must be a positive number", name="exposure")
    picture = np.empty(image.shape, np.uint8)
    for rows in (slice(first, first + DEVELOPED_ROWS) for first in range(0, len(image), DEVELOPED_ROWS)):
        levels = srgb(image[rows].astype(np.float32) * np.float32(exposure))
        picture[rows] = np.rint(255.0 * np.where(np.isnan(levels), background, levels))
    return picture


def _checked(radiance: FloatArray) -> FloatArray:
    image = np.asarray(radiance)
    if image.ndim == 3 and image.shape[2] == 1:
        # of one wavelength: grey
        image = np.broadcast_to(image, (*image.shape[:2], 3))
    if image.dtype.kind != "f" or image.size == 0 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise ArrayError(
            f"radiance is {image.dtype} of shape {image.shape}; it must be float (h, w), (h, w, 1) or (h, w, 3), not empty",
            name="radiance",
        )
    if np.isinf(image).any():
        raise ArrayError(f"radiance has {int(np.isinf(image).sum())} infinite values; no surface sends that", name="radiance")
    return image


def png_bytes(picture: npt.NDArray[Any], text: Mapping[str, str] | None = None) -> bytes:
    """PNG file of uint8 (h, w), (h, w, 3), (h, w, 4) or uint16 (h, w), (h, w, 3), with `text` as its metadata."""
    from PIL import Image, PngImagePlugin

    if picture.dtype not in (np.uint8, np.uint16) or picture.size == 0:
        raise ArrayError(f"picture is {picture.dtype} of shape {picture.shape}; PNG holds uint8 or uint16", name="picture")
    if not text and (picture.ndim == 2 or picture.shape[2] == 3):
        return _plain_png(picture)
    if picture.dtype == np.uint16 and picture.ndim == 3:  # which Pillow neither writes nor reads
        return _with_text(_plain_png(picture), text or {})
    info = PngImagePlugin.PngInfo()
    for key, value in (text or {}).items():
        info.add_text(key, value)
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(stream, "png", compress_level=PNG_LEVEL, pnginfo=info)
    return stream.getvalue()


def _plain_png(picture: npt.NDArray[Any]) -> bytes:
    """Without metadata; several times as fast, which counts where films are made."""
    import cv2

    channels = picture if picture.ndim == 2 else picture[..., ::-1]
    encoded = cv2.imencode(".png", np.ascontiguousarray(channels), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
    return encoded.tobytes()


def _with_text(png: bytes, text: Mapping[str, str]) -> bytes:
    """The PNG with text chunks behind its header, which is 8 bytes of magic and a chunk of 25."""
    chunks = b""
    for key, value in text.items():
        body = b"tEXt" + key.encode("latin-1") + b"\0" + value.encode("latin-1")
        chunks += struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return png[:33] + chunks + png[33:]


def write_png(path: str | Path, picture: npt.NDArray[Any], text: Mapping[str, str] | None = None, *, force: bool = True) -> None:
    """Write `picture` (see `png_bytes`) as a PNG file, whole or not at all."""
    write_bytes(path, png_bytes(picture, text), force=force)


def read_png(path: str | Path) -> npt.NDArray[Any]:
    """uint8 or uint16 pixels of a PNG file. Raises InputError."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(read_bytes(path)), formats=["PNG"]) as image:
            return np.array(image)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(path, f"is not a readable PNG picture ({error})") from None


def write_map_png16(
    path: str | Path, values: FloatArray, quantity: str, unit: str, *, force: bool = True, **more: Any
) -> tuple[float, float]:
    """A float map (h, w) as 16-bit PNG: value = offset + step * number, number 0 = none (NaN).

    The scale, quantity and unit stand as JSON in the file's text entry "rangecheck"; `more` is added to it. Returns
    (offset, step). The rounding error is at most step / 2."""
    array = require("values", values, (None, None))
    known = np.isfinite(array)
    low, high = (float(array[known].min()), float(array[known].max())) if known.any() else (0.0, 0.0)
    step = (high - low) / 65534 or 1.0
    offset = low - step
    numbers = np.zeros(array.shape, np.uint16)
    numbers[known] = np.rint((array[known] - offset) / step).astype(np.uint16)
    scale = {"quantity": quantity, "unit": unit, "offset": offset, "step": step, "none": 0} | more
    write_png(path, numbers, {"rangecheck": json.dumps(scale, sort_keys=True)}, force=force)
    return offset, step


def write_normals_png16(path: str | Path, normals: FloatArray, *, force: bool = True) -> None:
    """Unit normals (h, w, 3) as 16-bit colours, red x, green y, blue z: value = offset + step * number, number 0 = none (NaN). The scale
    stands in the file as that of `write_map_png16`."""
    array = require("normals", normals, (None, None, 3))
    known = np.isfinite(array).all(axis=2)
    step = 2.0 / 65534
    numbers = np.zeros(array.shape, np.uint16)
    numbers[known] = np.rint((array[known].astype(np.float64) + 1.0) / step + 1.0)
    scale = {"quantity": "normal", "unit": "1", "offset": -1.0 - step, "step": step, "none": 0, "channels": ["x", "y", "z"]}
    write_png(path, numbers, {"rangecheck": json.dumps(scale, sort_keys=True)}, force=force)


def write_id_png16(path: str | Path, ids: npt.NDArray[Any], names: Iterable[str], *, force: bool = True, **more: Any) -> None:
    """An ID map (h, w) of integers 0..65535 as 16-bit PNG, exact; 0 = none, ID k is the k-th of `names`."""
    numbers = require("ids", ids, (None, None), np.int64)
    if numbers.size and (numbers.min() < 0 or numbers.max() > 65535):
        raise ArrayError(f"ids run from {numbers.min()} to {numbers.max()}; a 16-bit PNG holds 0 to 65535", name="ids")
    table = {"quantity": "surface ID", "names": list(names), "none": 0} | more
    write_png(path, numbers.astype(np.uint16), {"rangecheck": json.dumps(table, sort_keys=True)}, force=force)


def read_map_png16(path: str | Path) -> tuple[FloatArray, dict[str, Any]]:
    """(h, w) float64 values of a map PNG, (h, w, 3) of normals (NaN = none), and its scale. Raises InputError when the file states no
    scale."""
    from PIL import Image

    numbers = read_png(path)
    with Image.open(io.BytesIO(read_bytes(path)), formats=["PNG"]) as image:
        text = getattr(image, "text", {}).get("rangecheck")
    try:
        scale = json.loads(text or "")
        if scale.get("channels"):
            numbers = _colours_16(path)
        values = scale["offset"] + scale["step"] * numbers.astype(np.float64)
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(path, "states no scale (text entry 'rangecheck' with offset and step); it is not a map") from None
    return np.where(numbers == 0, np.nan, values), scale


def _colours_16(path: str | Path) -> npt.NDArray[np.uint16]:
    import cv2

    read = cv2.imdecode(np.frombuffer(read_bytes(path), np.uint8), cv2.IMREAD_UNCHANGED)
    if read is None or read.dtype != np.uint16 or read.ndim != 3 or read.shape[2] != 3:
        raise InputError(path, "is said to hold normals, and is no picture of three colours of 16 bits")
    return read[..., ::-1]
