"""PCD, the Point Cloud Library's format, version .7 (and .6, .5): ascii, binary and binary_compressed, organised or not.

Frame: of the sensor, x right, y down, z forward; `VIEWPOINT` (translation, then quaternion w x y z) is world_from_scan. HEIGHT above
1 means an organised grid, rows from the top, NaN where nothing returned. The format has no unit, except in files written here, where
a comment line says it. binary_compressed holds all x, then all y, ..., packed by LZF.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import MM_PER_UNIT, FloatArray, mm_per
from rangecheck.errors import ArrayError, InputError, OutputError, UnitMissing
from rangecheck.files import read_bytes, write_bytes
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.readers.limits import MAX_CELLS, check_cells, check_holds
from rangecheck.scan.readers.lzf import RATIO, pack, unpack
from rangecheck.scan.readers.organised import scan_from_points
from rangecheck.scan.readers.text_numbers import parse_numbers

MAGIC = (b"# .PCD", b"#.PCD", b"VERSION", b"# ", b"FIELDS")
_UNIT_COMMENT = "# unit "


def read_pcd(path: Path, unit: str | None = None) -> list[RangeScan | PointCloud]:
    """The scan of an organised file, the cloud of any other. Raises InputError, and UnitMissing where no comment says the unit."""
    content = read_bytes(path)
    header, start, said = _header(path, content)
    unit = _agreed(path, said, unit)
    fields, rows = _layout(path, header), _count(path, header, "POINTS")
    width, height = _count(path, header, "WIDTH"), _count(path, header, "HEIGHT")
    check_cells(path, rows if height == 1 and rows <= 65536 else width, height) if height > 1 else None
    if width * height != rows or rows > MAX_CELLS or rows < 1:
        raise InputError(path, f"its header says {width} x {height} cells and {rows} points; export it again", points=rows)
    values = _body(path, content, start, header["DATA"][0], fields, rows)
    points = np.stack([values[axis] for axis in "xyz"], axis=-1).astype(np.float64) * mm_per(unit)
    pose = _viewpoint(path, header, mm_per(unit))
    if height == 1:
        good = np.isfinite(points).all(axis=1)
        if not good.any():
            raise InputError(path, "holds no point: all are NaN; check how it was exported")
        return [PointCloud(rigid.move_points(pose, points[good]), None, path.stem, unit)]
    bright = _brightness(values)
    scan = scan_from_points(
        points.reshape(height, width, 3),
        world_from_scan=pose,
        brightness=None if bright is None else bright.reshape(height, width),
        name=path.stem,
        unit=unit,
    )
    if scan is None:
        raise InputError(path, "holds no distance: every point is NaN or zero; check how it was exported")
    return [scan]


def write_pcd(path: str | Path, scan: RangeScan, *, kind: str = "binary_compressed", force: bool = True) -> None:
    """Write `scan` as an organised PCD of float64 points in mm, lossless in its points, brightness and pose.

    kind  ascii, binary or binary_compressed

    Raises OutputError for cameras whose rays do not start in one point: PCD cannot say where they start."""
    origins, _ = scan.camera.pixel_rays()
    if np.abs(origins[scan.valid]).max(initial=0.0) > 0:
        raise OutputError(path, "PCD cannot say where rays start that have no common origin; write NPZ")
    points = scan.grid_points_mm.reshape(-1, 3)
    columns = {axis: points[:, k].astype("<f8") for k, axis in enumerate("xyz")}
    if scan.brightness is not None:
        columns["intensity"] = scan.brightness.ravel().astype("<f4")
    height, width = scan.range_mm.shape
    quaternion = _quaternion_wxyz(scan.world_from_scan[:3, :3])
    view = " ".join(repr(float(v)) for v in (*scan.world_from_scan[:3, 3], *quaternion))
    lines = ["# .PCD v0.7 - Point Cloud Data file format", f"{_UNIT_COMMENT}mm", "VERSION 0.7", "FIELDS " + " ".join(columns)]
    lines += ["SIZE " + " ".join(str(c.itemsize) for c in columns.values()), "TYPE" + " F" * len(columns)]
    lines += ["COUNT" + " 1" * len(columns), f"WIDTH {width}", f"HEIGHT {height}", f"VIEWPOINT {view}"]
    lines += [f"POINTS {width * height}", f"DATA {kind}", ""]
    if kind == "ascii":
        table = zip(*(c.tolist() for c in columns.values()))
        body = "".join(" ".join(map(repr, row)) + "\n" for row in table).encode()
    elif kind == "binary":
        rows = np.empty(width * height, [(name, c.dtype) for name, c in columns.items()])
        for name, column in columns.items():
            rows[name] = column
        body = rows.tobytes()
    elif kind == "binary_compressed":
        flat = b"".join(c.tobytes() for c in columns.values())
        packed = pack(np.frombuffer(flat, np.uint8)).tobytes()
        body = struct.pack("<II", len(packed), len(flat)) + packed
    else:
        raise ArrayError(f"kind is {kind!r}; it must be ascii, binary or binary_compressed", name="kind")
    write_bytes(path, "\n".join(lines).encode() + body, force=force)


def _header(path: Path, content: bytes) -> tuple[dict[str, list[str]], int, str | None]:
    header: dict[str, list[str]] = {}
    said, position = None, 0
    while "DATA" not in header:
        end = content.find(b"\n", position, position + 65536)
        if end < 0 or position > 1 << 20:
            raise InputError(path, "is not a PCD file: its header has no line DATA; export it again")
        line = content[position:end].decode("latin-1").strip()
        position = end + 1
        if line.startswith(_UNIT_COMMENT):
            said = line.removeprefix(_UNIT_COMMENT).strip()
        if line and not line.startswith("#"):
            key, *words = line.split()
            header[{"COLUMNS": "FIELDS"}.get(key, key)] = words
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT") if not header.get(key)]
    if missing or header["DATA"] not in (["ascii"], ["binary"], ["binary_compressed"]):
        raise InputError(path, f"its header lacks {', '.join(missing) or 'a known kind of DATA'}; export it again")
    return header, position, said if said in MM_PER_UNIT else None


def _agreed(path: Path, said: str | None, asked: str | None) -> str:
    if said is None and asked is None:
        raise UnitMissing(path)
    if said is not None and asked is not None and said != asked:
        raise InputError(path, f"says its unit is {said}, and {asked} was asked for; leave out the unit")
    return said or asked or "mm"


def _count(path: Path, header: dict[str, list[str]], key: str) -> int:
    words = header.get(key) or [str(_count(path, header, "WIDTH") * _count(path, header, "HEIGHT"))]
    if len(words) != 1 or not words[0].isdecimal() or len(words[0]) > 12:
        raise InputError(path, f"its {key} is {' '.join(words)[:40]!r}; it must be a whole number")
    return int(words[0])


def _layout(path: Path, header: dict[str, list[str]]) -> list[tuple[str, np.dtype, int]]:
    """Name, type and count of each field."""
    names = header["FIELDS"]
    counts = header.get("COUNT") or ["1"] * len(names)
    if not len(names) == len(header["SIZE"]) == len(header["TYPE"]) == len(counts):
        raise InputError(path, "its FIELDS, SIZE, TYPE and COUNT differ in length; export it again")
    fields = []
    for name, size, kind, count in zip(names, header["SIZE"], header["TYPE"], counts):
        code = {"F": "f", "I": "i", "U": "u"}.get(kind, "") + size
        if (
            code not in ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")
            or not count.isdecimal()
            or not 0 < int(count[:6]) < 4096
        ):
            raise InputError(path, f"its field {name[:40]!r} is {kind} of {size} bytes, {count[:10]} times; PCD has no such type")
        fields.append((name, np.dtype("<" + code), int(count)))
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise InputError(path, f"has no field {missing[0]}; it has {', '.join(names)[:80]}")
    return fields


def _body(
    path: Path, content: bytes, start: int, kind: str, fields: list[tuple[str, np.dtype, int]], rows: int
) -> dict[str, FloatArray]:
    """First item of each field (rows,); a later field of the same name is passed over."""
    columns: dict[str, FloatArray] = {}
    row_bytes = sum(t.itemsize * n for _, t, n in fields)
    present = len(content) - start
    if kind == "ascii":
        width = sum(n for _, _, n in fields)
        check_holds(path, 2 * rows * width - 1, present, f"{rows} points of {width} numbers")
        numbers, end = parse_numbers(path, content, start, rows * width, columns=width, what="numbers")
        if content[end:].strip():
            raise InputError(path, f"holds more than the {rows} points its header announces; export it again")
        table, first = numbers.reshape(rows, width), 0
        for name, kind_of, n in fields:
            values = table[:, first]
            # a packed colour is written as the number its bits make
            columns.setdefault(name, values.astype(kind_of) if name in ("rgb", "rgba") and kind_of.kind == "f" else values)
            first += n
        return columns
    if kind == "binary":
        check_holds(path, rows * row_bytes, present, f"{rows} points of {row_bytes} bytes")
        table_type = np.dtype({"names": [str(k) for k in range(len(fields))], "formats": [(t, (n,)) for _, t, n in fields]})
        records: Any = np.frombuffer(content, table_type, rows, start)
        return {name: records[str(k)][:, 0] for k, (name, _, _) in reversed(list(enumerate(fields)))}
    check_holds(path, 8, present, "the sizes of its compressed points")
    packed, unpacked = struct.unpack_from("<II", content, start)
    if unpacked != rows * row_bytes:
        raise InputError(path, f"its points unpack to {unpacked} bytes and {rows * row_bytes} are needed; export it again")
    check_holds(path, packed, present - 8, f"{packed} compressed bytes")
    check_holds(path, unpacked // RATIO, packed, f"{unpacked} bytes of points")
    flat = np.empty(unpacked, np.uint8)
    if unpack(np.frombuffer(content, np.uint8, packed, start + 8), flat) != unpacked:
        raise InputError(path, "its compressed points are damaged; copy or export it again")
    first = 0
    for name, kind_of, n in fields:
        items = np.frombuffer(flat, kind_of, rows * n, first).reshape(rows, n)
        columns.setdefault(name, items[:, 0])
        first += rows * n * kind_of.itemsize
    return columns


def _viewpoint(path: Path, header: dict[str, list[str]], scale: float) -> FloatArray:
    words = header.get("VIEWPOINT") or ["0", "0", "0", "1", "0", "0", "0"]
    try:
        tx, ty, tz, qw, qx, qy, qz = (float(w) for w in words)
        return rigid.from_rotation_translation(
            rigid.rotation_from_quaternion([qx, qy, qz, qw]), [scale * tx, scale * ty, scale * tz]
        )
    except (ValueError, ArrayError) as error:
        raise InputError(path, f"its VIEWPOINT is no pose ({error}); correct that line") from None


def _brightness(values: dict[str, FloatArray]) -> FloatArray | None:
    """Brightness from packed colours (Rec. 709 weights), or from an intensity within 0..1; else None."""
    for name in ("rgb", "rgba"):
        if name in values and values[name].dtype.itemsize == 4:
            bits = np.ascontiguousarray(values[name]).view("<u4")
            red, green, blue = ((bits >> shift) & 255 for shift in (16, 8, 0))
            return ((0.2126 * red + 0.7152 * green + 0.0722 * blue) / 255.0).astype(np.float32)
    if "intensity" in values:
        bright = values["intensity"].astype(np.float64)
        if np.isfinite(bright).all() and bright.min() >= 0 and bright.max() <= 1:
            return bright.astype(np.float32)
    return None


def _quaternion_wxyz(rotation: FloatArray) -> FloatArray:
    """Unit quaternion of a rotation: the eigenvector of the largest eigenvalue (Bar-Itzhack 2000), stable everywhere."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2], r[0, 2] - r[2, 0]],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return np.array([w, x, y, z]) * (1.0 if w >= 0 else -1.0)
