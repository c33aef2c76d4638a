"""Cyberware echo files: cylindrical (or linear) range images of a scanner that turned around a head.

A text header from `Cyberware Digitizer Data` to `DATA=`, then NLG x NLT big-endian 16-bit radii, longitude by longitude, each
`value << RSHIFT` micrometres; 0x8000 is a void, and so is a radius of zero or less. LTINCR is the step along the vertical axis
in micrometres, LGINCR the step in longitude in microradians (SPACE=CYLINDRICAL) or micrometres (SPACE=CARTESIAN, where the value is
the height z above the stage). Latitudes run upwards; longitudes turn right-handedly about up with THETA_RIGHTHAND=TRUE, else
left-handedly. The unit is in the format. Refused: SPACE=BILATERAL, INSIDE_OUT, RPROP other than 100. Passed over: names, dates,
windows, SCALE and shifts, which only turn or crop the picture.

World frame = scan frame, y down: y is minus the height above the first latitude.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from rangecheck.errors import CameraError, InputError
from rangecheck.files import read_bytes
from rangecheck.optics import Camera, CylindricalCamera, RayGrid
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.readers.limits import check_cells, check_holds

MAGIC = b"Cyberware Digitizer Data"
STAND_OFF_MM = 100.0
_VOID = -0x8000


def read_cyberware(path: Path, unit: str | None = None) -> list[RangeScan]:
    """The one scan of the file. Raises InputError that names the entry that is missing or unknown."""
    content = read_bytes(path)
    if unit not in (None, "um"):
        raise InputError(path, f"is in micrometres by its format, and {unit} was asked for; leave out the unit")
    end = content.find(b"\nDATA=", 0, 1 << 16)
    start = content.find(b"\n", end + 1) + 1
    if end < 0 or start == 0:
        raise InputError(path, "its header does not end with `DATA=`; copy it again")
    head = dict(line.strip().split("=", 1) for line in content[:end].decode("latin-1").splitlines() if "=" in line)
    columns, rows = _whole(path, head, "NLG"), _whole(path, head, "NLT")
    across, along, shift = _whole(path, head, "LGINCR"), _whole(path, head, "LTINCR"), _whole(path, head, "RSHIFT")
    check_cells(path, columns, rows)
    check_holds(path, 2 * columns * rows, len(content) - start, f"{columns} longitudes x {rows} latitudes")
    if not (across > 0 and along > 0 and 0 <= shift <= 16):
        raise InputError(
            path, f"has LGINCR {across}, LTINCR {along} and RSHIFT {shift}; steps are positive and the shift 0 to 16"
        )
    if head.get("INSIDE_OUT", "FALSE") != "FALSE" or head.get("RPROP", "100").split(".")[0] != "100":
        raise InputError(path, "is inside out or has RPROP other than 100, which is not read; export it plainly")
    values = np.frombuffer(content, ">i2", columns * rows, start).reshape(columns, rows).T[::-1].astype(np.float64)
    values = np.where(values == _VOID, np.nan, values * 2.0**shift / 1000.0)
    space = head.get("SPACE", "CYLINDRICAL")
    if not (np.nan_to_num(values) > 0).any():
        raise InputError(path, "holds no distance: every radius is void; check how it was made")
    most = float(np.nanmax(values)) + STAND_OFF_MM
    top = -(rows - 1) * along / 1000.0
    camera: Camera
    try:
        if space == "CYLINDRICAL":
            values = np.where(values > 0, values, np.nan)
            step = across * 1e-6 * (-1 if head.get("THETA_RIGHTHAND", "FALSE") != "FALSE" else 1)
            # LGINCR is rounded to a microradian: NLG of them may pass one turn by less than one of them
            step = math.copysign(
                min(abs(step), 2 * math.pi / columns) if abs(step) * columns < 2 * math.pi + 1e-3 else abs(step), step
            )
            camera = CylindricalCamera(columns, rows, most, step, along / 1000.0, rows - 1.0)
        elif space == "CARTESIAN":
            x, y = np.meshgrid(np.arange(columns) * across / 1000.0, top + np.arange(rows) * along / 1000.0)
            origins = np.stack([x, y, np.full(x.shape, -most)], axis=-1)
            camera = RayGrid(columns, rows, origins, np.broadcast_to([0.0, 0.0, 1.0], origins.shape).copy())
        else:
            raise InputError(path, f"has SPACE={space[:20]}; CYLINDRICAL and CARTESIAN are read")
    except CameraError as error:
        raise InputError(path, f"its header describes no scanner: {error}") from None
    return [RangeScan(most - values, camera, name=path.stem, unit="um")]


def _whole(path: Path, head: dict[str, str], key: str) -> int:
    text = head.get(key, "")
    if not text.removeprefix("-").isdecimal() or len(text) > 9:
        raise InputError(path, f"its header has {key}={text[:20]!r}; a whole number is needed", key=key)
    return int(text)
