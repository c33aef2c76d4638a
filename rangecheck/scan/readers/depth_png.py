"""Grey PNG files of 8 or 16 bits as arrays of counts (PNG, third edition: W3C 2025); count 0 = nothing returned.

The header chunk is checked before anything is decoded. Pillow decodes; its own warnings become our errors.
"""

from __future__ import annotations

import io
import struct
import warnings
from pathlib import Path

import numpy as np

from rangecheck.arrays import IntArray
from rangecheck.errors import InputError
from rangecheck.files import read_bytes, write_bytes
from rangecheck.scan.readers.limits import DEFLATE_RATIO, check_cells, check_holds

SIGNATURE = b"\x89PNG\r\n\x1a\n"


def read_png(path: Path) -> IntArray:
    """Counts (h, w) uint8 or uint16. Raises InputError for colour, palettes, other depths and damaged files."""
    from PIL import Image, UnidentifiedImageError

    content = read_bytes(path)
    if len(content) < 33 or content[:8] != SIGNATURE or content[12:16] != b"IHDR":
        raise InputError(path, "is not a PNG file; its first bytes are not PNG's signature and header")
    width, height, bits, colour = struct.unpack(">IIBB", content[16:26])
    check_cells(path, width, height)
    if colour != 0 or bits not in (8, 16):
        kind = {0: "grey", 2: "colour", 3: "palette", 4: "grey with alpha", 6: "colour with alpha"}.get(colour, f"type {colour}")
        raise InputError(
            path,
            f"is a {kind} PNG of {bits} bits; a depth picture is grey with 16 bits (or 8); save it so",
            bits=bits,
            colour=colour,
        )
    check_holds(path, width * height * bits // 8 // DEFLATE_RATIO, len(content), f"{width} x {height} cells of {bits} bits")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            picture = Image.open(io.BytesIO(content), formats=("PNG",))
            counts = np.asarray(picture)
    except (
        OSError,
        SyntaxError,
        ValueError,
        EOFError,
        struct.error,
        UnidentifiedImageError,
        Image.DecompressionBombError,
    ) as error:
        raise InputError(path, f"is a damaged PNG file ({error}); copy or save it again") from None
    if counts.shape != (height, width) or counts.dtype not in (np.dtype(np.uint8), np.dtype(np.uint16)):
        raise InputError(path, f"decodes to {counts.shape} of {counts.dtype}, not to the {height} x {width} counts of its header")
    return counts


def write_png(path: Path, counts: IntArray) -> None:
    """Counts (h, w) uint8 or uint16 as a grey PNG; the same counts give the same bytes."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(counts)).save(stream, "PNG", compress_level=6)
    write_bytes(path, stream.getvalue())
