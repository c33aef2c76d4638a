"""Grey TIFF files (TIFF 6.0, Adobe 1992, with its supplements) of 8 or 16 bits or of 32-bit floats as distances.

One page in strips; stored plainly, by Deflate or by LZW, with any predictor. Pillow reads the tags; strips are unpacked here, because
the usual library writes its complaints to stderr.
"""

from __future__ import annotations

import io
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.errors import InputError
from rangecheck.files import read_bytes
from rangecheck.kernels import kernel
from rangecheck.scan.readers.limits import check_cells, check_holds

MAGIC = (b"II*\0", b"MM\0*")
#: LZW's codes of 12 bits stand for at most 4096 bytes
_RATIO = 4096
_KINDS = {(1, 8): "u1", (1, 16): "u2", (3, 32): "f4"}
_PLAIN, _LZW, _DEFLATE = (1,), (5,), (8, 32946)


def read_tiff(path: Path) -> npt.NDArray[Any]:
    """Counts (h, w) uint8 or uint16, or values float32. Raises InputError for colour, other depths, many pages and damage."""
    content = read_bytes(path)
    tags = _tags(path, content)

    def one(tag: int, default: int | None = None) -> int:
        value = tags.get(tag, default)
        value = value[0] if isinstance(value, tuple) and len(value) == 1 else value
        if not isinstance(value, int):
            raise InputError(path, f"is a damaged TIFF file: its tag {tag} is {value!r:.40}; save it again")
        return value

    width, height = one(256), one(257)
    check_cells(path, width, height)
    code = _KINDS.get((one(339, 1), one(258, 1)))
    if code is None or one(277, 1) != 1 or one(262, 1) not in (0, 1):
        raise InputError(
            path, f"is a TIFF of {one(277, 1)} samples of {one(258, 1)} bits; distances are grey, 8 or 16 bits or 32-bit floats"
        )
    order = "<" if content[:2] == b"II" else ">"
    line, rows = width * int(code[1]), min(one(278, height), height)
    check_holds(path, height * line // _RATIO, len(content), f"{width} x {height} cells")
    offsets, sizes = (tuple(tags.get(tag, ())) for tag in (273, 279))
    compression, predictor = one(259, 1), one(317, 1)
    if compression not in _PLAIN + _LZW + _DEFLATE or predictor not in (1, 2, 3):
        raise InputError(
            path, f"is compressed by method {compression}; depth pictures are read plain or packed by Deflate or LZW: save it so"
        )
    if rows < 1 or len(offsets) != -(-height // rows) or len(sizes) != len(offsets) or one(266, 1) != 1:
        raise InputError(
            path, f"has {len(offsets)} strips for {height} lines, {rows} a strip; tiled files are not read: save it in strips"
        )
    values = np.empty((height, width), code)
    for k, (offset, size) in enumerate(zip(offsets, sizes)):
        count = min(rows, height - k * rows)
        if not (isinstance(offset, int) and isinstance(size, int) and offset >= 0 and 0 <= size <= len(content) - offset):
            raise InputError(path, f"is cut short: strip {k} of {size} bytes at {offset} is not all there; copy it again")
        raw = _strip(path, content[offset : offset + size], count * line, compression)
        values[k * rows : k * rows + count] = _undifferenced(raw.reshape(count, line), code, order, predictor)
    return values


def _tags(path: Path, content: bytes) -> dict[int, Any]:
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            picture: Any = Image.open(io.BytesIO(content), formats=("TIFF",))
            tags = dict(picture.tag_v2)
            pages = 1 if picture.tag_v2.next == 0 else 2
    except Exception as error:  # Pillow raises whatever a damaged tag leads it to
        raise InputError(path, f"is a damaged TIFF file ({' '.join(str(error).split())[:100] or type(error).__name__})") from None
    if pages != 1:
        raise InputError(path, "holds several pages; a depth picture is one page: save them one by one")
    return tags


def _strip(path: Path, packed: bytes, size: int, compression: int) -> npt.NDArray[np.uint8]:
    if compression in _DEFLATE:
        try:
            packed = zlib.decompressobj().decompress(packed, size)
        except zlib.error as error:
            raise InputError(path, f"is a damaged TIFF file ({error}); save it again") from None
    elif compression in _LZW:
        out = np.empty(size, np.uint8)
        packed = out[: max(unpack_lzw(np.frombuffer(packed, np.uint8), out), 0)].tobytes()
    if len(packed) < size:
        raise InputError(path, f"is cut short: a strip of {size} bytes unpacks to {len(packed)}; copy it again")
    return np.frombuffer(packed, np.uint8, size)


def _undifferenced(raw: npt.NDArray[np.uint8], code: str, order: str, predictor: int) -> npt.NDArray[Any]:
    """Lines of values from lines of bytes (TIFF 6.0 section 14; Adobe's technical note 3 for floats)."""
    if predictor == 3:
        # all most significant bytes first, then the next, each the difference from the byte before
        planes = np.cumsum(raw, axis=1, dtype=np.uint8).reshape(len(raw), int(code[1]), -1)
        return np.ascontiguousarray(planes.transpose(0, 2, 1)).view(">" + code)[..., 0]
    values = raw.view(order + code)
    if predictor == 2:
        return np.cumsum(
            values.astype("=u" + code[1]) if code[0] == "u" else values.view(order + "u4"), axis=1, dtype="u" + code[1]
        ).view("=" + code)
    return values


@kernel
def unpack_lzw(packed, out):
    """TIFF's LZW, codes most significant bit first, widened one code early: bytes written, -1 where a code is not known yet."""
    prefix, suffix, length = np.zeros(4096, np.int32), np.zeros(4096, np.uint8), np.zeros(4096, np.int32)
    for k in range(256):
        suffix[k] = k
        length[k] = 1
    known, width, before, o = 258, 9, -1, 0
    at, bits = 0, 8 * packed.size
    while at + width <= bits:
        code = 0
        for _ in range(width):
            code = (code << 1) | ((int(packed[at >> 3]) >> (7 - (at & 7))) & 1)
            at += 1
        if code == 257:
            break
        if code == 256:
            known, width, before = 258, 9, -1
            continue
        if before < 0:
            if code > 255:
                return -1
        elif known < 4096:
            source = code if code < known else before
            if code > known:
                return -1
            while length[source] > 1:
                source = prefix[source]
            prefix[known], suffix[known], length[known] = before, suffix[source], length[before] + 1
            known += 1
        if code >= known:
            return -1
        end, entry = o + length[code], code
        for k in range(end - 1, o - 1, -1):
            if k < out.size:
                out[k] = suffix[entry]
            entry = prefix[entry]
        o = end
        if o >= out.size:
            return out.size
        before = code
        if known >= (1 << width) - 1 and width < 12:
            width += 1
    return o
