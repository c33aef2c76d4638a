"""What a command is given: scans, a mesh, or both worlds in one - always ending in a surface."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rangecheck.arrays import FloatArray
from rangecheck.config import Settings
from rangecheck.errors import InputError, ScanError
from rangecheck.files import read_bytes, sha256
from rangecheck.modeler.model import Model
from rangecheck.optics import PinholeCamera
from rangecheck.pipeline.preparing import Measured, prepared
from rangecheck.progress import Reporter
from rangecheck.scan import RangeScan
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.scan.readers.limits import plain_name
from rangecheck.surface import Surface

if TYPE_CHECKING:
    from rangecheck.scan.decode import DecodedScan

MESH_SUFFIXES = (".stl", ".obj", ".off", ".glb", ".3mf", ".ply")


@dataclass(frozen=True)
class Subject:
    """A surface, and the scans it was made of where it was. `front_deg` is the azimuth of its front, about y from +z towards +x."""

    name: str
    surface: Surface
    scans: list[RangeScan] = field(default_factory=list)
    method: str = "read"
    model: Model | None = None
    front_deg: float = 0.0


def holds_capture(path: Path) -> bool:
    """Whether `path` is a folder of structured-light pictures."""
    return path.is_dir() and ((path / "capture.json").is_file() or all((path / cam).is_dir() for cam in ("leftCam", "rightCam")))


def holds_scans(path: Path) -> bool:
    """Whether `path` is read as range scans rather than as a mesh: by its kind, for PLY by what its header announces, and OBJ where it
    has points and no face."""
    if path.is_dir() or path.suffix.lower() not in MESH_SUFFIXES:
        return True
    if path.suffix.lower() == ".obj":
        content = read_bytes(path)
        return bool(re.search(rb"^\s*v\s", content, re.MULTILINE)) and not re.search(rb"^\s*f\s", content, re.MULTILINE)
    if path.suffix.lower() != ".ply":
        return False
    from rangecheck.scan.readers.ply import announced

    elements = announced(path)
    return "range_grid" in elements or "camera" in elements or (bool(elements) and not {"face", "tristrips"} & set(elements))


def decoded(folder: str | Path, reporter: Reporter, **limits: float) -> DecodedScan:
    """The range scan of the structured-light pictures in `folder`; `limits` are those of `decode_gray_code`."""
    from rangecheck.scan.decode import decode_gray_code, read_capture

    with reporter.stage("reading pictures"):
        capture = read_capture(folder)
    with reporter.stage("decoding"):
        found = decode_gray_code(
            capture.left,
            capture.left_view,
            capture.right,
            capture.right_view,
            projector=capture.projector,
            name=Path(folder).resolve().name,
            **limits,
        )
    for what in found.lost:
        reporter.note(f"lost: {what}")
    return found


def read_all_scans(paths: Sequence[str | Path], unit: str | None, reporter: Reporter) -> list[Measured]:
    """What the scanners measured, of all paths in order, pictures decoded; each scan holds enough points to go on."""
    from rangecheck.scan.readers import read_measured

    scans: list[Measured] = []
    for path in map(Path, paths):
        if not path.exists():
            raise InputError(path, "does not exist; check the name")
        if holds_capture(path):
            scans += _enough(path, [decoded(path, reporter).scan])
            continue
        with reporter.stage("reading scans"):
            scans += _enough(path, read_measured(path, unit))
    points = sum(len(scan.points_mm) if isinstance(scan, PointCloud) else int(scan.valid.sum()) for scan in scans)
    reporter.note(f"{len(scans)} scan{'s' if len(scans) != 1 else ''}, {points:,} distances")
    # a file may call its scan anything; results are written under these names
    taken: set[str] = set()
    return [scan if name == scan.name else replace(scan, name=name) for scan in scans for name in [plain_name(scan.name, taken)]]


def _enough(path: Path, scans: Sequence[Measured]) -> Sequence[Measured]:
    """The scans of `path`, each of which holds enough points to go on. Raises InputError."""
    for scan in scans:
        if isinstance(scan, RangeScan):
            try:
                scan.need_points()
            except ScanError as error:
                raise InputError(path, str(error)) from None
    return scans


def surface_of(scans: Sequence[Measured], settings: Settings, reporter: Reporter) -> tuple[Surface, str, str]:
    """One surface of all scans, the method that made it, and why that one."""
    from rangecheck.surface.meshing import choose_method, mesh_scans

    wanted = settings.meshing
    method: str = wanted.method
    reason = "asked for"
    if method == "auto":
        method, reason = choose_method(scans)
    with reporter.stage("meshing"):
        surface = mesh_scans(
            scans,
            method,
            voxel_mm=wanted.voxel_mm,
            voxel_in_spacings=wanted.voxel_in_spacings,
            max_angle_deg=wanted.max_angle_deg,
            closing=wanted.closing,
            largest_hole_mm=wanted.largest_hole_mm,
            **({"engine": wanted.poisson_engine} if method == "poisson" else {}),
        )
    reporter.note(f"meshed by {method}: {reason}; {len(surface.faces):,} faces")
    return surface, method, reason


def read_subject(path: str | Path, settings: Settings, unit: str | None, reporter: Reporter) -> Subject:
    """The surface behind `path`: a mesh file, or scans that are meshed first."""
    from rangecheck.modeler import read_model
    from rangecheck.surface.mesh_files import read_mesh

    where = Path(path)
    if not where.exists():
        raise InputError(where, "does not exist; check the name")
    if where.suffix.lower() == ".toml":
        with reporter.stage("building the scene"):
            model = read_model(where)
        return Subject(model.name, model.surface, method="modelled", model=model)
    if holds_scans(where):
        ready = prepared(read_all_scans([where], unit, reporter), settings, reporter)
        surface, method, _ = surface_of(ready.scans, settings, reporter)
        return Subject(where.stem, surface, ready.grids, method)
    with reporter.stage("reading mesh"):
        return Subject(where.stem, read_mesh(where, unit))


def hashes(paths: Sequence[str | Path]) -> dict[str, str]:
    """sha256 by name of every input file; folders file by file."""
    found: dict[str, str] = {}
    for path in map(Path, paths):
        files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        if path.suffix in (".conf", ".json"):
            files = sorted(p for p in path.parent.iterdir() if p.is_file())
        for file in files:
            found[str(file.relative_to(path.parent)) if file != path else path.name] = sha256(file)
    return found


def eye_of(scans: Sequence[Measured]) -> FloatArray | None:
    """(3,) where a single scan was taken from, world frame; None for several scans, and where a scanner's rays are parallel."""
    if len(scans) == 1 and isinstance(scans[0], RangeScan) and isinstance(scans[0].camera, PinholeCamera):
        return scans[0].world_from_scan[:3, 3]
    return None
