"""OpenEXR files (openexr.com, "OpenEXR File Layout") with a channel of distances: scan lines, stored plainly or by ZIP or ZIPS.

Read here in full: the usual library writes its complaints to stderr and hands over pictures with missing lines. Tiles, parts, deep
pixels and other compressions are refused.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.errors import InputError
from rangecheck.files import read_bytes
from rangecheck.scan.readers.limits import DEFLATE_RATIO, check_cells, check_holds

MAGIC = b"v/1\x01"
_LINES = {0: 1, 2: 1, 3: 16}  # NONE, ZIPS, ZIP: lines per chunk
_COMPRESSIONS = ("NONE", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
_TYPES = ("<u4", "<f2", "<f4")


def read_exr(path: Path) -> npt.NDArray[Any]:
    """Values (h, w) float32 of channel Z, else Y, else the only one. Raises InputError for what is not read and for any damage."""
    content = read_bytes(path)
    attributes, position = _attributes(path, content)
    channels = _channels(path, attributes)
    try:
        x0, y0, x1, y1 = struct.unpack("<4i", attributes[b"dataWindow"])
        (compression,) = attributes[b"compression"]
    except (KeyError, struct.error, ValueError):
        raise InputError(path, "is a damaged EXR file: its header lacks its window or its compression; save it again") from None
    width, height = x1 - x0 + 1, y1 - y0 + 1
    check_cells(path, width, height)
    if compression not in _LINES:
        name = _COMPRESSIONS[compression] if compression < len(_COMPRESSIONS) else str(compression)
        raise InputError(path, f"is compressed by {name}; depth pictures are read plain or compressed by ZIP or ZIPS: save it so")
    wanted = next((n for n in ("Z", "Y") if n in channels), next(iter(channels)) if len(channels) == 1 else None)
    if wanted is None:
        raise InputError(path, f"has channels {', '.join(channels)[:80]}; distances are in Z, in Y, or in the only one")
    if channels[wanted] == "<u4":
        raise InputError(path, f"its channel {wanted} holds whole numbers; distances are floats: save them so")
    line_bytes = width * sum(int(code[2]) for code in channels.values())
    before = width * sum(int(code[2]) for name, code in channels.items() if name < wanted)
    lines = _LINES[compression]
    chunks = -(-height // lines)
    check_holds(path, 8 * chunks + height * line_bytes // DEFLATE_RATIO, len(content) - position, f"{width} x {height} cells")
    values = np.empty((height, width), np.float32)
    for offset in struct.unpack_from(f"<{chunks}Q", content, position):
        if offset + 8 > len(content):
            raise InputError(path, "is cut short: a chunk of lines lies behind its end; copy or save it again")
        y, size = struct.unpack_from("<ii", content, offset)
        row = y - y0
        if not (0 <= row < height and row % lines == 0 and 0 <= size <= len(content) - offset - 8):
            raise InputError(
                path, f"is a damaged EXR file: a chunk of {size} bytes says that it starts at line {y}; save it again"
            )
        count = min(lines, height - row)
        raw = _inflated(path, content[offset + 8 : offset + 8 + size], count * line_bytes, compression)
        table = np.frombuffer(raw, np.uint8).reshape(count, line_bytes)
        code = channels[wanted]
        values[row : row + count] = table[:, before : before + width * int(code[2])].copy().view(code)
    starts = {struct.unpack_from("<i", content, offset)[0] for offset in struct.unpack_from(f"<{chunks}Q", content, position)}
    if len(starts) != chunks:
        raise InputError(
            path, f"is a damaged EXR file: {chunks - len(starts)} of its {chunks} chunks of lines are missing; save it again"
        )
    return values


def _attributes(path: Path, content: bytes) -> tuple[dict[bytes, bytes], int]:
    """Values of the header's attributes by name, and where the table of chunks starts."""
    if len(content) < 16 or content[:4] != MAGIC:
        raise InputError(path, "is not an EXR file; its first bytes are not EXR's")
    (version,) = struct.unpack_from("<I", content, 4)
    if version & 0xFF != 2 or version & 0x1A00:
        raise InputError(
            path, f"is an EXR of version {version & 0xFF} with tiles, parts or deep pixels; save one picture of scan lines"
        )
    attributes: dict[bytes, bytes] = {}
    position = 8
    while content[position : position + 1] not in (b"\0", b""):
        name_end = content.find(b"\0", position, position + 256)
        kind_end = content.find(b"\0", name_end + 1, name_end + 257)
        if name_end < 0 or kind_end < 0 or kind_end + 5 > len(content):
            raise InputError(path, "is a damaged EXR file: its header has no end; save it again")
        (size,) = struct.unpack_from("<i", content, kind_end + 1)
        if not 0 <= size <= len(content) - kind_end - 5:
            raise InputError(path, f"is a damaged EXR file: an attribute takes {size} bytes; save it again")
        attributes[content[position:name_end]] = content[kind_end + 5 : kind_end + 5 + size]
        position = kind_end + 5 + size
    return attributes, position + 1


def _channels(path: Path, attributes: dict[bytes, bytes]) -> dict[str, str]:
    """Type code of each channel, by name, in the order of the file."""
    listed, channels, position = attributes.get(b"channels", b""), {}, 0
    while position < len(listed) and listed[position] != 0:
        end = listed.find(b"\0", position)
        if end < 0 or end + 17 > len(listed):
            break
        kind, _, across, down = struct.unpack_from("<iIii", listed, end + 1)
        if not 0 <= kind < 3 or (across, down) != (1, 1):
            raise InputError(path, "has channels of an unknown kind or of fewer samples than cells; save it plainly")
        channels[listed[position:end].decode("latin-1")] = _TYPES[kind]
        position = end + 17
    if not channels:
        raise InputError(path, "is a damaged EXR file: it has no channels; save it again")
    return dict(sorted(channels.items()))


def _inflated(path: Path, packed: bytes, size: int, compression: int) -> bytes:
    if compression == 0 or len(packed) == size:
        raw = packed
    else:
        try:
            raw = zlib.decompressobj().decompress(packed, size + 1)
        except zlib.error as error:
            raise InputError(path, f"is a damaged EXR file ({error}); save it again") from None
        if len(raw) == size:
            # differences from byte to byte, then the two halves interleaved
            sums = np.frombuffer(raw, np.uint8).copy()
            sums[1:] -= 128
            sums = np.cumsum(sums, dtype=np.uint8)
            plain = np.empty(size, np.uint8)
            half = (size + 1) // 2
            plain[::2], plain[1::2] = sums[:half], sums[half:]
            return plain.tobytes()
    if len(raw) != size:
        raise InputError(path, f"is a damaged EXR file: lines of {size} bytes unpack to {len(raw)}; save it again")
    return raw
