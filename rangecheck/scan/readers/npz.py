"""One range scan as a NumPy archive (.npz), every number as it is in memory: the lossless form, and the only one for measured grids
of rays.

Members: schema, range_mm, world_from_scan, description (JSON: name, unit, noise_mm, camera) and, if there are any, brightness,
origins_mm and directions. Names and headers are checked before anything is unpacked; nothing is unpickled.
"""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck import rigid
from rangecheck.arrays import MM_PER_UNIT
from rangecheck.errors import ArrayError, CameraError, InputError
from rangecheck.files import DAMAGED_ARCHIVE, read_bytes, write_bytes
from rangecheck.optics import RayGrid, camera_from_dict
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.readers.limits import DEFLATE_RATIO, MAX_CELLS, check_cells, check_holds

SCHEMA = "rangecheck/scan/1"
MAGIC = b"PK\x03\x04"
_MEMBERS = {
    "schema": "U",
    "description": "U",
    "range_mm": "f4",
    "world_from_scan": "f8",
    "brightness": "f4",
    "origins_mm": "f8",
    "directions": "f8",
}


def write_npz(path: str | Path, scan: RangeScan, *, force: bool = True) -> None:
    """Write `scan` so that `read_npz` gives back the same numbers; the same scan gives the same bytes. Raises OutputError."""
    description: dict[str, Any] = {"name": scan.name, "unit": scan.unit, "noise_mm": scan.noise_mm}
    description["camera"] = scan.camera.to_dict()
    members: dict[str, npt.NDArray[Any]] = {
        "schema": np.array(SCHEMA),
        "description": np.array(json.dumps(description)),
        "range_mm": scan.range_mm,
        "world_from_scan": scan.world_from_scan,
    }
    if scan.brightness is not None:
        members["brightness"] = scan.brightness
    if isinstance(scan.camera, RayGrid):
        members |= {"origins_mm": scan.camera.origins_mm, "directions": scan.camera.directions}
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=4) as archive:
        for name, values in members.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asanyarray(values), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getbuffer(), zipfile.ZIP_DEFLATED)
    write_bytes(path, stream.getvalue(), force=force)


def read_npz(path: Path, unit: str | None = None) -> list[RangeScan]:
    """The one scan of the archive. Raises InputError for foreign, damaged and oversized members."""
    content = read_bytes(path)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {
                info.filename.removesuffix(".npy"): _member(path, archive, info, len(content)) for info in archive.infolist()
            }
    except DAMAGED_ARCHIVE as error:
        raise InputError(path, f"is a damaged NumPy archive ({error}); copy or write it again") from None
    missing = [name for name in ("schema", "description", "range_mm", "world_from_scan") if name not in members]
    if missing:
        raise InputError(path, f"lacks {', '.join(missing)}; scans are read from archives that `write_npz` or `decode` wrote")
    if str(members["schema"]) != SCHEMA:
        raise InputError(path, f"has schema {str(members['schema'])[:60]!r}; scans are read from {SCHEMA!r}")
    try:
        description = json.loads(str(members["description"]))
        name, said, noise = (description[key] for key in ("name", "unit", "noise_mm"))
        numbers = dict(description["camera"])
        if numbers.get("model") == "raygrid":
            camera: Any = RayGrid(int(numbers["width"]), int(numbers["height"]), members["origins_mm"], members["directions"])
        else:
            camera = camera_from_dict(numbers)
        if not isinstance(name, str) or said not in MM_PER_UNIT:
            raise ValueError(f"name {name!r} and unit {said!r} are not a name and a unit")
        if noise is not None and not (isinstance(noise, int | float) and 0 < noise < 1e6):
            raise ValueError(f"noise_mm is {noise!r}; it must be positive")
        pose = rigid.checked(members["world_from_scan"], "world_from_scan")
        scan = RangeScan(members["range_mm"], camera, pose, members.get("brightness"), name, said, noise)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError, CameraError, ArrayError) as error:
        raise InputError(path, f"its description does not fit its arrays ({error!s:.200}); write it again") from None
    if unit is not None and unit != said:
        raise InputError(path, f"says its unit was {said}, and {unit} was asked for; leave out the unit")
    if not scan.valid.any():
        raise InputError(path, "holds no distance: every cell says that nothing returned; check how it was made")
    return [scan]


def _member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, present: int) -> npt.NDArray[Any]:
    name = info.filename.removesuffix(".npy")
    if name not in _MEMBERS:
        raise InputError(path, f"holds {info.filename[:60]!r}, which a scan has not; known are {', '.join(_MEMBERS)}")
    if info.file_size > 24 * MAX_CELLS + 4096:
        raise InputError(path, f"its {name} announces {info.file_size} bytes, more than {MAX_CELLS} cells take")
    check_holds(path, info.file_size // DEFLATE_RATIO, present, f"{info.file_size} bytes of {name}")
    content = io.BytesIO(archive.read(info))
    try:
        version = np.lib.format.read_magic(content)
        header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
        shape, _, dtype = header(content)
        wanted = _MEMBERS[name]
        if (dtype.kind != "U" if wanted == "U" else dtype != np.dtype(wanted)) or len(shape) > 3:
            raise ValueError(f"{name} is {dtype} of shape {shape}")
        if name == "range_mm":
            check_cells(path, *(shape[::-1] if len(shape) == 2 else (0, 0)))
        if int(np.prod(shape, dtype=object)) * dtype.itemsize != info.file_size - content.tell():
            raise ValueError(f"{name} of shape {shape} does not fill its {info.file_size} bytes")
        content.seek(0)
        return np.lib.format.read_array(content, allow_pickle=False)
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, SyntaxError, OverflowError, MemoryError, RecursionError) as error:
        raise InputError(path, f"is a damaged NumPy archive ({error!s:.200}); write it again") from None
