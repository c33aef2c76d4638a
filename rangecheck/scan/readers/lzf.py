"""LZF packing as binary_compressed PCD uses it (Marc Lehmann, liblzf): runs of up to 32 bytes, copies of up to 264 from 8 KB back."""

from __future__ import annotations

import numpy as np

from rangecheck.kernels import kernel

#: 264 bytes come from at least 3
RATIO = 88


@kernel
def unpack(packed, out):
    """LZF: bytes written, -1 where a copy or a run leaves its bounds."""
    i, o = 0, 0
    while i < packed.size:
        control = int(packed[i])
        i += 1
        if control < 32:
            run = control + 1
            if i + run > packed.size or o + run > out.size:
                return -1
            out[o : o + run] = packed[i : i + run]
            i += run
            o += run
            continue
        length = control >> 5
        if length == 7:
            if i >= packed.size:
                return -1
            length += int(packed[i])
            i += 1
        if i >= packed.size:
            return -1
        source = o - ((control & 31) << 8) - int(packed[i]) - 1
        i += 1
        length += 2
        if source < 0 or o + length > out.size:
            return -1
        for k in range(length):  # byte by byte: source and target may overlap
            out[o + k] = out[source + k]
        o += length
    return o


@kernel
def pack(data):
    """LZF with a table of the last place of each three bytes."""
    out = np.empty(data.size + data.size // 32 + 16, np.uint8)
    table = np.full(65536, -1, np.int64)
    i, o, literals, n = 0, 0, 0, data.size
    while i < n:
        length, back = 0, 0
        if i + 2 < n:
            key = ((int(data[i]) << 16) | (int(data[i + 1]) << 8) | int(data[i + 2])) * 2654435761 >> 8 & 0xFFFF
            place = table[key]
            table[key] = i
            back = i - place - 1
            if place >= 0 and back < 8192:
                while length < 264 and i + length < n and data[place + length] == data[i + length]:
                    length += 1
        if length >= 3:
            if literals > 0:
                out[o - literals - 1] = literals - 1
                literals = 0
            extra = length - 2
            if extra < 7:
                out[o] = (extra << 5) | (back >> 8)
                o += 1
            else:
                out[o] = (7 << 5) | (back >> 8)
                out[o + 1] = extra - 7
                o += 2
            out[o] = back & 255
            o += 1
            i += length
            continue
        if literals == 0:
            o += 1
        out[o] = data[i]
        o += 1
        i += 1
        literals += 1
        if literals == 32:
            out[o - literals - 1] = 31
            literals = 0
    if literals > 0:
        out[o - literals - 1] = literals - 1
    return out[:o]
