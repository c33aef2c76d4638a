"""`read_scans`: which reader a path belongs to, by its ending and its first bytes, which must agree; nothing is tried out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rangecheck.arrays import mm_per
from rangecheck.errors import InputError, UnitMissing, told_of
from rangecheck.files import read_bytes
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.readers import (
    camera_ply,
    conf,
    cyberware,
    depth_picture,
    e57,
    manifest,
    npz,
    pcd,
    ply,
    ptx,
    range_grid_ply,
    xyz,
)

Measured = RangeScan | PointCloud
#: endings of files that hold others, packed
_PACKED = (".gz", ".bz2", ".xz", ".zst", ".z", ".zip", ".7z", ".tar", ".tgz", ".rar")


@dataclass(frozen=True)
class Format:
    """One format: the endings of its files, how they may begin (empty: any text), its reader."""

    name: str
    endings: tuple[str, ...]
    magic: tuple[bytes, ...]
    read: Callable[[Path, str | None], Sequence[Measured]]
    #: whether files of this kind in a folder are scans; notes and tables end like lists of points
    in_folders: bool = True


def _read_ply(path: Path, unit: str | None) -> Sequence[Measured]:
    """A range grid, a triangulated range map with its camera, or a cloud; a mesh is refused."""
    content = ply.read_ply(path)
    if unit is None:
        raise UnitMissing(path)
    if "range_grid" in content.elements:
        return [range_grid_ply.scan_of_grid(content, unit)]
    if "camera" in content.elements:
        return camera_ply.scan_of_range_map(content, unit)
    if content.elements.get("face", content.elements.get("tristrips")) is not None:
        raise InputError(
            path, "is a mesh without a camera, not a range scan; check it as a mesh, or export the scanner's own files"
        )
    return xyz.read_ply_cloud(content, unit)


FORMATS = (
    *(Format("depth picture", (e,), m, manifest.read_lone_picture) for e, m in depth_picture.MAGIC.items()),
    Format("manifest", (".json",), (), manifest.read_manifest),
    Format("NumPy archive", (".npz",), (npz.MAGIC,), npz.read_npz),
    Format("PLY", (".ply",), (ply.MAGIC,), _read_ply),
    Format("placement list", (".conf",), (), conf.read_conf),
    Format("PCD", (".pcd",), (), pcd.read_pcd),
    Format("PTX", (".ptx",), (), ptx.read_ptx),
    Format("E57", (".e57",), (e57.MAGIC,), e57.read_e57),
    Format("Cyberware echo", (".cyb", ".cy", ".echo"), (cyberware.MAGIC,), cyberware.read_cyberware),
    Format("list of points", (".xyz",), (), xyz.read_xyz),
    Format("OBJ", (".obj",), (), xyz.read_obj, in_folders=False),
    Format("list of points", (".txt", ".asc", ".csv"), (), xyz.read_xyz, in_folders=False),
)


def read_scans(path: str | Path, unit: str | None = None) -> list[RangeScan]:
    """The range scans in `path`: a file, a manifest, a `.conf`, or a folder of them. At least one, in the file's order.

    unit  mm, cm, m, um or in; needed where the file does not say its unit (UnitMissing), refused where it says another

    A folder is read through its manifest (the one JSON file that lists scans) or its one `.conf`; else file by file in the order
    of their names, a depth picture through the JSON file beside it. Raises InputError in one line when something is missing,
    damaged or not what it says, or is a cloud without a grid (`read_measured` takes those); the first problem ends the reading, so
    nothing is left out silently."""
    scans = []
    for item in read_measured(path, unit):
        if not isinstance(item, RangeScan):
            raise InputError(
                path,
                f"{item.name} is {len(item.points_mm)} points without a grid or a place they were seen from, so neighbours, free space "
                "and viewing angles are unknown; only methods that take clouds can use it (poisson)",
                points=len(item.points_mm),
            )
        scans.append(item)
    return scans


def read_measured(path: str | Path, unit: str | None = None) -> list[Measured]:
    """As `read_scans`, with point clouds among the results where a file holds no grid."""
    path = Path(path)
    if unit is not None:
        mm_per(unit)
    if path.is_dir():
        return _read_folder(path, unit)
    # files hold any bits: NaN that signal, numbers past float32; what is not finite counts as not measured
    with told_of(path), np.errstate(all="ignore"):
        return list(_format_of(path).read(path, unit))


def _format_of(path: Path) -> Format:
    ending = path.suffix.lower()
    fitting = [f for f in FORMATS if ending in f.endings]
    if fitting and (path.is_fifo() or path.is_socket()):
        raise InputError(path, "is a pipe, not a file; write what comes through it to a file")
    head = read_bytes(path, 64) if fitting or path.is_file() or not path.exists() else b""
    if ending in _PACKED:
        raise InputError(path, f"is packed ({ending}); unpack it and name what was in it")
    if not fitting:
        known = ", ".join(sorted({e for f in FORMATS for e in f.endings}))
        raise InputError(path, f"ends in {ending or 'nothing'}; scans are read from {known}")
    if not head:
        raise InputError(path, "is empty; copy it again")
    for candidate in fitting:
        if not candidate.magic or head.startswith(candidate.magic):
            return candidate
    actual = next((f.name for f in FORMATS if f.magic and head.startswith(f.magic)), None)
    told = f"it begins like {actual}" if actual else f"it begins with {head[:8]!r}"
    raise InputError(path, f"is named like {fitting[0].name}, but {told}; correct its name or its content")


def _read_folder(folder: Path, unit: str | None) -> list[Measured]:
    try:
        found = sorted(p for p in folder.iterdir() if not p.name.startswith("."))
    except OSError as error:
        raise InputError(folder, f"cannot be read ({error.strerror}); ask for the right to, or copy it") from None
    files = [p for p in found if p.is_file()]
    described = {p: manifest.pictures_of(p) for p in files if p.suffix.lower() == ".json"}
    leading = [p for p, pictures in described.items() if pictures is None] or [p for p in files if p.suffix.lower() == ".conf"]
    if len(leading) > 1:
        names = ", ".join(p.name for p in leading[:4])
        raise InputError(folder, f"holds {len(leading)} lists of scans ({names}); name the one to read", count=len(leading))
    if leading:
        return read_measured(leading[0], unit)
    covered = {name for pictures in described.values() for name in pictures or ()}
    endings = {ending for f in FORMATS if f.in_folders for ending in f.endings}
    # what cannot be read is not passed over: the other scans would then be taken for all
    for p in found:
        if p.suffix.lower() in _PACKED and Path(p.stem).suffix.lower() in endings:
            raise InputError(p, f"is packed ({p.suffix}); unpack it, or move it out of the folder")
        if p.suffix.lower() in endings and p.is_symlink() and not p.exists():
            raise InputError(p, "is a link to nothing; mend it, or move it out of the folder")
    wanted = [
        p for p in files if p.suffix.lower() in endings and p.name not in covered and (p not in described or bool(described[p]))
    ]
    if not wanted:
        below = [p.name for p in found if p.is_dir()]
        hint = f"; name the folders in it one by one ({', '.join(below[:4])})" if below else ""
        raise InputError(folder, f"holds no scans among its {len(files)} files; scans end in {', '.join(sorted(endings))}{hint}")
    return [scan for p in wanted for scan in read_measured(p, unit)]
