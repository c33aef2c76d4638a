"""OpenEXR files with one channel of distances. The header is read here first, so that a lie about size ends before decoding."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.errors import DependencyMissing, InputError
from rangecheck.files import read_bytes
from rangecheck.scan.readers.limits import DEFLATE_RATIO, check_cells, check_holds

MAGIC = b"v/1\x01"
#: the wavelet and deflate codes of EXR, one after the other
_RATIO = 4 * DEFLATE_RATIO


def read_exr(path: Path) -> npt.NDArray[Any]:
    """Values (h, w) float32 of an OpenEXR file: its channel Z, else Y, else the only one. Raises DependencyMissing without OpenEXR."""
    content = read_bytes(path)
    width, height = _exr_window(path, content)
    check_cells(path, width, height)
    check_holds(path, width * height // _RATIO, len(content), f"{width} x {height} cells")
    try:
        import OpenEXR
    except ImportError:
        raise DependencyMissing("OpenEXR", "reading depth pictures in EXR", "pip install 'rangecheck[formats]'") from None
    try:
        channels = OpenEXR.File(str(path), separate_channels=True, num_threads=0).channels()
    except Exception as error:  # the binding raises plain RuntimeError and others
        raise InputError(
            path, f"is a damaged EXR file ({str(error).splitlines()[0][:120] if str(error) else 'no reason given'})"
        ) from None
    name = next((n for n in ("Z", "Y") if n in channels), next(iter(channels)) if len(channels) == 1 else None)
    if name is None:
        raise InputError(path, f"has channels {', '.join(sorted(channels))[:80]}; distances are in Z, in Y, or in the only one")
    values = np.asarray(channels[name].pixels)
    if values.shape != (height, width) or values.dtype.kind != "f":
        raise InputError(
            path, f"its channel {name} is {values.dtype} of shape {values.shape}; distances are floats, {height} x {width}"
        )
    return values.astype(np.float32)


def _exr_window(path: Path, content: bytes) -> tuple[int, int]:
    """Width and height of the data window, read from the attributes of the first header."""
    position = 8
    while position < min(len(content), 1 << 20):
        name_end = content.find(b"\0", position, position + 256)
        kind_end = content.find(b"\0", name_end + 1, name_end + 257)
        if name_end <= position or kind_end < 0 or kind_end + 5 > len(content):
            break
        (size,) = struct.unpack_from("<i", content, kind_end + 1)
        if content[position:name_end] == b"dataWindow" and size == 16 and kind_end + 21 <= len(content):
            x0, y0, x1, y1 = struct.unpack_from("<4i", content, kind_end + 5)
            return x1 - x0 + 1, y1 - y0 + 1
        if size < 0:
            break
        position = kind_end + 5 + size
    raise InputError(path, "is a damaged EXR file: its header has no data window; save it again")
