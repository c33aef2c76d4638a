"""E57 (ASTM E2807): scans in metres, as grids where row and column indices are given, else as clouds.

Read here in full, without a library: pages with CRC-32C checksums, of which every one is verified before a byte is believed; an XML
section; and per scan a compressed vector of packets whose byte streams are bit-packed integers or floats. Frames as in PTX: z up,
`pose` is world_from_file (quaternion w x y z). Points marked invalid are left out.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray, mm_per
from rangecheck.errors import ArrayError, InputError
from rangecheck.files import read_bytes
from rangecheck.kernels import kernel
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.readers.limits import MAX_CELLS, check_cells, check_holds
from rangecheck.scan.readers.organised import level_frame, scan_from_points

MAGIC = b"ASTM-E57"
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_CASTAGNOLI = 0x82F63B78


def read_e57(path: Path, unit: str | None = None) -> list[RangeScan | PointCloud]:
    """All scans of the file, in its order. Raises InputError for a wrong checksum, with the page, and for anything that contradicts
    the standard."""
    content = read_bytes(path)
    logical, page = _pages(path, content)
    scans: list[RangeScan | PointCloud] = []
    for number, node in enumerate(_data3d(path, content, logical, page), 1):
        read = _scan(path, node, logical, page, unit or "m", number)
        if read is not None:
            scans.append(read)
    if not scans:
        raise InputError(path, "holds no scan with a valid point; check how it was exported")
    return scans


def _table() -> IntArray:
    values = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        values = np.where(values & 1, (values >> 1) ^ np.uint32(_CASTAGNOLI), values >> 1)
    return values


@kernel
def first_wrong_page(data, page, table):
    """Number of the first page whose last four bytes are not the CRC-32C of the others (most significant byte first), or -1."""
    for p in range(data.size // page):
        crc = np.uint32(0xFFFFFFFF)
        for i in range(p * page, (p + 1) * page - 4):
            crc = np.uint32(crc >> np.uint32(8)) ^ table[(crc ^ np.uint32(data[i])) & np.uint32(255)]
        crc ^= np.uint32(0xFFFFFFFF)
        end = (p + 1) * page
        for k in range(4):
            if np.uint32(data[end - 4 + k]) != (crc >> np.uint32(24 - 8 * k)) & np.uint32(255):
                return p
    return -1


def _pages(path: Path, content: bytes) -> tuple[bytes, int]:
    """The content without checksums, and the page size."""
    check_holds(path, 48, len(content), "an E57 header")
    _, major, _, length, _, _, page = struct.unpack_from("<8sIIQQQQ", content)
    if major != 1 or page < 1024 or page > 1 << 20 or page & (page - 1) or length != len(content) or length % page:
        raise InputError(
            path,
            f"its header says version {major}, {length} bytes in pages of {page}, and {len(content)} bytes are there; copy it again",
        )
    wrong = int(first_wrong_page(np.frombuffer(content, np.uint8), page, _table()))
    if wrong >= 0:
        raise InputError(
            path, f"page {wrong} of {len(content) // page} has a wrong checksum; the file is damaged: copy it again", page=wrong
        )
    return np.frombuffer(content, np.uint8).reshape(-1, page)[:, :-4].tobytes(), page


def _place(physical: int, page: int) -> int:
    return physical // page * (page - 4) + physical % page


def _data3d(path: Path, content: bytes, logical: bytes, page: int) -> list[ElementTree.Element]:
    offset, size = struct.unpack_from("<QQ", content, 24)
    start = _place(offset, page)
    check_holds(path, start + size, len(logical), f"{size} bytes of XML at {offset}")
    text = logical[start : start + size].rstrip(b"\0")
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise InputError(path, "its XML declares entities, which E57 does not; the file is refused")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(path, f"its XML is damaged ({error}); export it again") from None
    for node in root.iter():
        node.tag = node.tag.rsplit("}", 1)[-1]
    return root.findall("data3D/vectorChild")


class _Stream:
    """One field of the prototype: how its bytes become numbers."""

    def __init__(self, node: ElementTree.Element) -> None:
        kind = node.get("type")
        self.name, self.scale, self.offset, self.bits, self.low = node.tag, 1.0, 0.0, 0, 0
        self.code = ""
        if kind == "Float":
            self.code = "<f4" if node.get("precision") == "single" else "<f8"
            self.bits = 8 * int(self.code[2])
        elif kind in ("Integer", "ScaledInteger"):
            self.low = int(node.get("minimum", -(2**63)))
            high = int(node.get("maximum", 2**63 - 1))
            if not -(2**63) <= self.low <= high < 2**63:
                raise ValueError(f"{node.tag} runs from {self.low} to {high}")
            self.bits = (high - self.low).bit_length()
            if kind == "ScaledInteger":
                self.scale, self.offset = float(node.get("scale", 1.0)), float(node.get("offset", 0.0))
        elif kind != "String":
            raise ValueError(f"{node.tag} is of type {kind}")
        self.text = kind == "String"

    def numbers(self, stream: bytes, count: int) -> FloatArray:
        if self.code:
            return np.frombuffer(stream, self.code, count).astype(np.float64)
        if self.bits == 0:
            return np.full(count, self.low * self.scale + self.offset)
        raw = unpack_bits(np.frombuffer(stream, np.uint8), self.bits, count)
        return (raw.astype(np.float64) + float(self.low)) * self.scale + self.offset


@kernel
def unpack_bits(data, bits, count):
    """`count` unsigned integers of `bits` bits each, least significant bit first."""
    out = np.empty(count, np.uint64)
    at = 0
    for i in range(count):
        value, have = np.uint64(0), 0
        while have < bits:
            byte, skip = at >> 3, at & 7
            take = min(8 - skip, bits - have)
            part = (np.uint64(data[byte]) >> np.uint64(skip)) & ((np.uint64(1) << np.uint64(take)) - np.uint64(1))
            value |= part << np.uint64(have)
            have += take
            at += take
        out[i] = value
    return out


def _columns(path: Path, points: ElementTree.Element, logical: bytes, page: int) -> dict[str, FloatArray]:
    """Numbers of every field, by name, each (records,)."""
    try:
        count, offset = int(points.get("recordCount", "")), int(points.get("fileOffset", ""))
        prototype = points.find("prototype")
        streams = [_Stream(node) for node in (prototype if prototype is not None else ())]
    except (ValueError, OverflowError) as error:
        raise InputError(path, f"its XML describes no points ({error}); export it again") from None
    names = [s.name for s in streams]
    if (
        not 0 <= count <= MAX_CELLS
        or len(set(names)) < len(names)
        or offset < 48
        or not all(np.isfinite([s.scale, s.offset]).all() for s in streams)
    ):
        raise InputError(path, f"its XML announces {count} points of {', '.join(names)[:80]}, which cannot be read")
    start = _place(offset, page)
    check_holds(path, start + 32, len(logical), "a compressed vector")
    kind, length, first, _ = struct.unpack_from("<B7xQQQ", logical, start)
    position, end = _place(first, page), min(start + length, len(logical))
    if kind != 1 or position < 48:
        raise InputError(path, f"has a section of kind {kind} where points are announced; export it again")
    for s in streams:
        check_holds(path, 0 if s.text else (s.bits * count + 7) // 8, max(end - start, 0), f"{count} values of {s.name}")
    parts: list[list[bytes]] = [[] for _ in streams]
    while position + 6 <= end:
        packet, _, less, n = struct.unpack_from("<BBHH", logical, position)
        if packet == 1:
            if n != len(streams) or position + less + 1 > end or 6 + 2 * n > less + 1:
                raise InputError(
                    path, f"a packet of points holds {n} streams in {less + 1} bytes and {len(streams)} are announced"
                )
            sizes = struct.unpack_from(f"<{n}H", logical, position + 6)
            at = position + 6 + 2 * n
            if at + sum(sizes) > position + less + 1:
                raise InputError(path, "a packet of points is shorter than its streams; export it again")
            for part, size in zip(parts, sizes):
                part.append(logical[at : at + size])
                at += size
        elif packet not in (0, 2):
            raise InputError(path, f"has a packet of kind {packet}, which E57 does not; export it again")
        position += less + 1
    columns = {}
    for s, part in zip(streams, parts):
        if not s.text:
            stream = b"".join(part)
            check_holds(path, (s.bits * count + 7) // 8, len(stream), f"{count} values of {s.name}")
            columns[s.name] = s.numbers(stream, count)
    return columns


def _scan(
    path: Path, node: ElementTree.Element, logical: bytes, page: int, unit: str, number: int
) -> RangeScan | PointCloud | None:
    points = node.find("points")
    if points is None:
        return None
    columns = _columns(path, points, logical, page)
    with np.errstate(over="ignore", invalid="ignore"):
        if all(n in columns for n in _CARTESIAN):
            xyz = np.stack([columns[n] for n in _CARTESIAN], axis=1)
            state = columns.get("cartesianInvalidState")
        elif all(n in columns for n in _SPHERICAL):
            r, azimuth, elevation = (columns[n] for n in _SPHERICAL)
            xyz = r[:, None] * np.stack(
                [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
            )
            state = columns.get("sphericalInvalidState")
        else:
            raise InputError(path, f"scan {number} has neither Cartesian nor spherical points; it has {', '.join(columns)[:80]}")
        xyz = xyz * mm_per(unit)
        good: BoolArray = np.asarray(np.isfinite(xyz).all(axis=1) & (np.abs(xyz) < 1e30).all(axis=1))
    if state is not None:
        good = good & (state == 0)
    if not good.any():
        return None
    world_from_file = _pose(path, node, mm_per(unit), number)
    name = (node.findtext("name") or "").strip() or f"{path.stem}_{number}"
    if "rowIndex" in columns and "columnIndex" in columns:
        return _gridded(path, columns, xyz, good, node, world_from_file, name, unit)
    return PointCloud(rigid.move_points(world_from_file, xyz[good]), None, name, unit)


def _gridded(
    path: Path,
    columns: dict[str, FloatArray],
    xyz: FloatArray,
    good: BoolArray,
    node: ElementTree.Element,
    world_from_file: FloatArray,
    name: str,
    unit: str,
) -> RangeScan | PointCloud | None:
    row, column = (columns[n][good].astype(np.int64) for n in ("rowIndex", "columnIndex"))
    row, column = row - row.min(), column - column.min()
    height, width = int(row.max()) + 1, int(column.max()) + 1
    if height == 1 or width == 1 or height * width > 64 * len(row) + 65536:
        # one line, or hardly a cell in a hundred: indices without a grid behind them
        return PointCloud(rigid.move_points(world_from_file, xyz[good]), None, name, unit)
    check_cells(path, width, height)
    file_from_scan = level_frame(xyz[good])
    grid = np.full((height, width, 3), np.nan)
    # of several returns in one cell the nearest stays: what lies behind it was seen past an edge
    away = (xyz[good] ** 2).sum(axis=1)
    order = np.argsort(-away, kind="stable")
    grid[row[order], column[order]] = (xyz[good] @ file_from_scan[:3, :3])[order]
    bright = None
    if "intensity" in columns:
        told, limits = columns["intensity"], node.find("intensityLimits")
        low, high = (_number(limits, f"intensity{k}", d) for k, d in (("Minimum", 0.0), ("Maximum", 1.0)))
        scaled = (told[good] - low) / (high - low) if high > low else told[good] * np.nan
        if np.isfinite(scaled).all():
            bright = np.zeros((height, width), np.float32)
            bright[row[order], column[order]] = np.clip(scaled, 0, 1)[order]
    return scan_from_points(grid, world_from_scan=world_from_file @ file_from_scan, brightness=bright, name=name, unit=unit)


def _number(node: ElementTree.Element | None, key: str, default: float) -> float:
    text = (node.findtext(key) or "0").strip() if node is not None and node.find(key) is not None else None
    try:
        value = default if text is None else float(text)
    except ValueError:
        return default
    return value if np.isfinite(value) else default


def _pose(path: Path, node: ElementTree.Element, scale: float, number: int) -> FloatArray:
    pose: Any = node.find("pose")
    if pose is None:
        return rigid.identity()
    turn, shift = pose.find("rotation"), pose.find("translation")
    quaternion = [_number(turn, key, 1.0 if key == "w" else 0.0) for key in "xyzw"]
    try:
        rotation = rigid.rotation_from_quaternion(quaternion)
        return rigid.from_rotation_translation(rotation, [scale * _number(shift, key, 0.0) for key in "xyz"])
    except ArrayError as error:
        raise InputError(path, f"the pose of scan {number} is no rigid motion ({error}); export it again") from None
