"""PTX, the text format of terrestrial scanners (Leica): one or many grids of points with the pose of each.

Per scan: columns, rows, position (3), axes (3 x 3), then 4 x 4 for row vectors (p_world = p_file M, so M is the transpose of
world_from_file), then columns x rows lines `x y z intensity [r g b]`, column by column; `0 0 0` where nothing returned. File frame: of
the scanner, z up. Metres by the format's definition; another unit may be asked for. Scan frame: x right, y down, z forward, turned
about the vertical so that forward is the middle of what was seen.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, mm_per
from rangecheck.errors import ArrayError, InputError, OutputError
from rangecheck.files import read_bytes, write_bytes
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.readers.limits import check_cells, check_holds
from rangecheck.scan.readers.organised import FILE_FROM_LEVEL, level_frame, scan_from_points
from rangecheck.scan.readers.text_numbers import parse_numbers, plain_text

_HEADER_NUMBERS = 2 + 3 + 9 + 16


def read_ptx(path: Path, unit: str | None = None) -> list[RangeScan]:
    """All scans of the file that hold a point. Raises InputError when a grid is cut short or a pose is no rigid motion."""
    content = plain_text(read_bytes(path))
    unit = unit or "m"
    scans, position, number = [], 0, 0
    while content[position:].strip() or number == 0:
        number += 1
        head, position = parse_numbers(path, content, position, _HEADER_NUMBERS, what=f"numbers of the header of scan {number}")
        width, height = (int(v) if 0 < v < 1e9 and v == int(v) else 0 for v in head[:2])
        check_cells(path, width, height)
        columns = _columns(path, content, position)
        cells = width * height
        check_holds(
            path, 2 * cells * columns - 1, len(content) - position, f"{width} columns x {height} rows of {columns} numbers"
        )
        body, position = parse_numbers(path, content, position, cells * columns, columns=columns, what="numbers")
        scan = _scan(path, head, body.reshape(width, height, columns).transpose(1, 0, 2), unit, number)
        if scan is not None:
            scans.append(scan)
    if not scans:
        raise InputError(path, "holds no distance: every cell is `0 0 0`; check how it was exported")
    if len(scans) == 1:
        return [RangeScan(s.range_mm, s.camera, s.world_from_scan, s.brightness, path.stem, unit) for s in scans]
    return scans


def write_ptx(path: str | Path, scans: RangeScan | list[RangeScan], *, force: bool = True) -> None:
    """Write scans as PTX in metres, every number with the digits that give it back. Raises OutputError for cameras whose rays do not
    start in one point, and for cells without a return whose ray PTX could not keep (they come back as law and neighbours say)."""
    blocks = []
    for scan in [scans] if isinstance(scans, RangeScan) else scans:
        origins, _ = scan.camera.pixel_rays()
        if np.abs(origins[scan.valid]).max(initial=0.0) > 0:
            raise OutputError(path, "PTX cannot say where rays start that have no common origin; write NPZ")
        level = np.eye(4)
        level[:3, :3] = FILE_FROM_LEVEL
        world_from_file = scan.world_from_scan @ rigid.inverse(level)
        world_from_file[:3, 3] /= 1000.0
        points = np.where(scan.valid[..., None], scan.grid_points_mm @ FILE_FROM_LEVEL.T / 1000.0, 0.0)
        bright = np.full(scan.range_mm.shape, 0.5) if scan.brightness is None else scan.brightness.astype(np.float64)
        height, width = scan.range_mm.shape
        rows = [world_from_file[:3, 3], *world_from_file[:3, :3].T, *world_from_file.T]
        lines = [str(width), str(height)] + [" ".join(repr(float(v)) for v in row) for row in rows]
        # bottom row first within each column, as scanners turn their mirrors upwards
        table = np.concatenate([points, bright[..., None]], axis=2)[::-1].transpose(1, 0, 2).reshape(-1, 4)
        lines += [" ".join(map(repr, row)) for row in table.tolist()]
        blocks.append("\n".join(lines) + "\n")
    write_bytes(path, "".join(blocks).encode(), force=force)


def _columns(path: Path, content: bytes, position: int) -> int:
    """Numbers on the first line of points: 4 or 7 (3 and 6 where the intensity is left out)."""
    for line in content[position : position + 4096].split(b"\n"):
        if line.strip():
            count = len(line.split())
            if count not in (3, 4, 6, 7):
                raise InputError(path, f"its first point has {count} numbers; PTX has x y z, intensity and red green blue")
            return count
    raise InputError(path, "is cut short: it ends after its header; copy or export it again")


def _scan(path: Path, head: FloatArray, body: FloatArray, unit: str, number: int) -> RangeScan | None:
    matrix = head[14:30].reshape(4, 4).T.copy()
    matrix[:3, 3] *= mm_per(unit)
    try:
        world_from_file = rigid.checked(matrix, f"the 4 x 4 of scan {number}")
    except ArrayError as error:
        raise InputError(path, f"{error}; export it again") from None
    points = body[..., :3] * mm_per(unit)
    empty = ~np.isfinite(points).all(axis=2) | (points == 0).all(axis=2)
    points = np.where(empty[..., None], np.nan, points)
    if empty.all():
        return None
    file_from_scan = level_frame(points[~empty])
    columns = body.shape[2]
    bright = None
    if columns in (4, 7):
        told = body[..., 3]
        bright = told.astype(np.float32) if np.isfinite(told).all() and told.min() >= 0 and told.max() <= 1 else None
    return scan_from_points(
        points @ file_from_scan[:3, :3],
        world_from_scan=world_from_file @ file_from_scan,
        brightness=bright,
        name=f"{path.stem}_{number}",
        unit=unit,
    )
