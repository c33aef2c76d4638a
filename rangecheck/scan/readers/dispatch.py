"""`read_scans`: which reader a path belongs to, by its ending and its first bytes, which must agree; nothing is tried out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rangecheck.arrays import mm_per
from rangecheck.errors import InputError
from rangecheck.files import read_bytes
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.readers import conf, depth_png, manifest, npz, ply, range_grid_ply


@dataclass(frozen=True)
class Format:
    """One format: the endings of its files, how they may begin (empty: any text), its reader."""

    name: str
    endings: tuple[str, ...]
    magic: tuple[bytes, ...]
    read: Callable[[Path, str | None], list[RangeScan]]


FORMATS = (
    Format("depth PNG", (".png",), (depth_png.SIGNATURE,), manifest.read_lone_picture),
    Format("manifest", (".json",), (), manifest.read_manifest),
    Format("NumPy archive", (".npz",), (npz.MAGIC,), npz.read_npz),
    Format("PLY", (".ply",), (ply.MAGIC,), range_grid_ply.read_range_grid),
    Format("placement list", (".conf",), (), conf.read_conf),
)


def read_scans(path: str | Path, unit: str | None = None) -> list[RangeScan]:
    """The range scans in `path`: a file, a manifest, a `.conf`, or a folder of them. At least one, in the file's order.

    unit  mm, cm, m, um or in; needed where the file does not say its unit (UnitMissing), refused where it says another

    A folder is read through its manifest (the one JSON file that lists scans) or its one `.conf`; else file by file in the order
    of their names, a depth picture through the JSON file beside it. Raises InputError in one line when something is missing, damaged or not what it says; the first problem ends
    the reading, so nothing is left out silently."""
    path = Path(path)
    if unit is not None:
        mm_per(unit)
    if path.is_dir():
        return _read_folder(path, unit)
    return _format_of(path).read(path, unit)


def _format_of(path: Path) -> Format:
    head = read_bytes(path, 64)
    ending = path.suffix.lower()
    fitting = [f for f in FORMATS if ending in f.endings]
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


def _read_folder(folder: Path, unit: str | None) -> list[RangeScan]:
    files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    described = {p: manifest.pictures_of(p) for p in files if p.suffix.lower() == ".json"}
    leading = [p for p, pictures in described.items() if pictures is None] or [p for p in files if p.suffix.lower() == ".conf"]
    if len(leading) > 1:
        names = ", ".join(p.name for p in leading[:4])
        raise InputError(folder, f"holds {len(leading)} lists of scans ({names}); name the one to read", count=len(leading))
    if leading:
        return read_scans(leading[0], unit)
    covered = {name for pictures in described.values() for name in pictures or ()}
    endings = {ending for f in FORMATS for ending in f.endings}
    wanted = [
        p for p in files if p.suffix.lower() in endings and p.name not in covered and (p not in described or bool(described[p]))
    ]
    if not wanted:
        raise InputError(folder, f"holds no scans among its {len(files)} files; scans end in {', '.join(sorted(endings))}")
    return [scan for p in wanted for scan in read_scans(p, unit)]
