"""A picture of distances as an array, whatever file holds it: chosen by its first bytes, which must agree with its name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy.typing as npt

from rangecheck.errors import InputError
from rangecheck.files import read_bytes
from rangecheck.scan.readers import depth_exr, depth_pfm, depth_png, depth_tiff

Decoder = Callable[[Path], npt.NDArray[Any]]
#: first bytes, decoder, endings
_DECODERS: tuple[tuple[tuple[bytes, ...], Decoder, tuple[str, ...]], ...] = (
    ((depth_png.SIGNATURE,), depth_png.read_png, (".png",)),
    (depth_tiff.MAGIC, depth_tiff.read_tiff, (".tif", ".tiff")),
    ((depth_exr.MAGIC,), depth_exr.read_exr, (".exr",)),
    (depth_pfm.MAGIC, depth_pfm.read_pfm, (".pfm",)),
)
ENDINGS = tuple(ending for _, _, endings in _DECODERS for ending in endings)
MAGIC = {ending: magic for magic, _, endings in _DECODERS for ending in endings}


def read_picture(path: Path, expect: tuple[int, int]) -> npt.NDArray[Any]:
    """(h, w) counts (unsigned integers) or values (floats) of the picture, which must have the shape `expect`.

    Raises InputError when the file is missing, is not what its ending says, is damaged, or has another size."""
    head = read_bytes(path, 16)
    fitting = [(decode, endings) for magic, decode, endings in _DECODERS if head.startswith(magic)]
    if not fitting:
        raise InputError(path, f"is not a picture of distances; its first bytes fit none of {', '.join(ENDINGS)}")
    decode, endings = fitting[0]
    if path.suffix.lower() not in endings:
        raise InputError(path, f"holds a {endings[0][1:].upper()} picture and ends in {path.suffix or 'nothing'}; rename it")
    picture = decode(path)
    if picture.shape != expect:
        raise InputError(
            path,
            f"has {picture.shape[1]} x {picture.shape[0]} cells and its camera {expect[1]} x {expect[0]}; correct the camera",
            shape=picture.shape,
        )
    return picture
