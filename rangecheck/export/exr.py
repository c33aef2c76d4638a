"""Float images for other programs: OpenEXR (optional package) and float TIFF. No exposure, no rounding beyond float32."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.errors import ArrayError, DependencyMissing, InputError
from rangecheck.files import read_bytes, whole_file
from rangecheck.maps import Maps


def _openexr(purpose: str) -> Any:
    try:
        import OpenEXR
    except ImportError:
        raise DependencyMissing("OpenEXR", purpose, "pip install 'rangecheck[formats]'") from None
    return OpenEXR


def write_exr(path: str | Path, channels: Mapping[str, npt.NDArray[Any]], note: str = "", *, force: bool = True) -> None:
    """Write named channels, each (h, w), as one ZIP-compressed EXR: floats as float32, integers (not negative) as uint32.

    Raises DependencyMissing, ArrayError (shapes differ, negative integers), OutputError."""
    openexr = _openexr("writing EXR images")
    pixels: dict[str, npt.NDArray[Any]] = {}
    for name, values in channels.items():
        array = np.asarray(values)
        if array.ndim != 2 or array.size == 0 or array.shape != next(iter(pixels.values()), array).shape:
            raise ArrayError(
                f"channel {name} has shape {array.shape}; all channels must be (h, w), alike and not empty", name=name
            )
        if array.dtype.kind in "iu":
            if array.min() < 0:
                raise ArrayError(f"channel {name} holds {array.min()}; an EXR's integers are not negative", name=name)
            pixels[name] = np.ascontiguousarray(array, dtype=np.uint32)
        else:
            pixels[name] = np.ascontiguousarray(array, dtype=np.float32)
    if not pixels:
        raise ArrayError("there are no channels to write", name="channels")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage, "comments": note}
    with whole_file(path, force=force) as part, openexr.File(header, pixels) as file:
        file.write(str(part))


def need_openexr() -> None:
    """Raise DependencyMissing where EXR images cannot be written."""
    _openexr("writing EXR images")


def exr_bytes(channels: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """The file that `write_exr` writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image.exr"
        write_exr(path, channels)
        return path.read_bytes()


def radiance_channels(radiance: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    """Channels of a radiance image: Y for grey (h, w), R G B for (h, w, 3)."""
    if radiance.ndim == 2:
        return {"Y": radiance}
    return {name: radiance[..., k] for k, name in enumerate("RGB")}


def map_channels(maps: Maps) -> dict[str, npt.NDArray[Any]]:
    """All maps as EXR channels; the face is stored as face + 1, so that 0 = none as in part_id."""
    return {
        "distance_mm": maps.distance_mm,
        "depth_mm": maps.depth_mm,
        "incidence_rad": maps.incidence_rad,
        "N.X": maps.normals[..., 0],
        "N.Y": maps.normals[..., 1],
        "N.Z": maps.normals[..., 2],
        "part_id": maps.part_id,
        "face_plus_1": maps.face + 1,
    }


def read_exr(path: str | Path) -> dict[str, npt.NDArray[Any]]:
    """Channels (h, w) of a scanline EXR by name. Raises InputError, DependencyMissing."""
    openexr = _openexr("reading EXR images")
    read_bytes(path, 4)
    try:
        with openexr.File(str(path), separate_channels=True) as file:
            return {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except (RuntimeError, OSError, ValueError, TypeError) as error:
        raise InputError(path, f"is not a readable EXR image ({error})") from None


def write_tiff(path: str | Path, values: npt.NDArray[Any], description: str = "", *, force: bool = True) -> None:
    """Write a float map (h, w) as deflated float32 TIFF, NaN kept, `description` in its ImageDescription."""
    from PIL import Image

    array = np.asarray(values)
    if array.ndim != 2 or array.size == 0:
        raise ArrayError(f"values has shape {array.shape}; a TIFF map is (h, w) and not empty", name="values")
    with whole_file(path, force=force) as part:
        image = Image.fromarray(np.ascontiguousarray(array, dtype=np.float32))
        image.save(part, "tiff", compression="tiff_deflate", description=description)
