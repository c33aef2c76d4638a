"""Reading mesh files as surfaces in millimetres: STL, PLY, OBJ, OFF by own readers, GLB and 3MF through trimesh.

STL, OBJ, OFF and the PLY of others do not say their unit, so it is asked for; GLB is metres by its specification, 3MF and rangecheck's own
PLY say. Vertices that faces name are welded where their coordinates are equal bit for bit, as STL, which has no indices, would weld them;
nothing is merged by nearness, dropped or turned. The labels of rangecheck's own PLY stay with its faces.
"""

from __future__ import annotations

import importlib
import io
import re
import zipfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray, IntArray, mm_per
from rangecheck.errors import DependencyMissing, InputError, UnitMissing
from rangecheck.files import DAMAGED_ARCHIVE, read_bytes
from rangecheck.surface.ply_files import Labels, ply_mesh
from rangecheck.surface.standing import lowered_in, turned_back
from rangecheck.surface.stl_files import stl_corners
from rangecheck.surface.surface import Surface
from rangecheck.surface.weld import weld_exactly

#: how many times its size a 3MF may unpack to (meshes do to 6 to 8), and up to how many bytes that is not asked
MOST_SWELLING, SWELLS_FREELY = 60, 1 << 25
#: times that a 3MF may place its parts
MOST_PLACED = 100_000
#: of a 3MF: the member of the archive, and the object in it
_Part = tuple[str, str]
_PLACING = re.compile(rb"<(?:\w+:)?(object|component|item)\b([^>]*)>")
_ATTRIBUTE = re.compile(rb"([\w:]+)\s*=\s*([\"'])(.*?)\2")
FORMATS = ("stl", "ply", "obj", "off", "glb", "3mf")
#: float32, in which STL is written and rays are traced, holds squares of lengths up to 1.8e19 mm
LARGEST_MM = 1e18
_AT_ONCE = 1 << 20
#: 3MF's names of units
_UNITS_3MF = {"micron": "um", "millimeter": "mm", "centimeter": "cm", "meter": "m", "inch": "in"}


@dataclass(frozen=True)
class MeshFile:
    """A mesh file that was read: its surface in mm, its format and unit, what was odd about it, in sentences, and whether it is
    binary STL, whose records of float32 corners leave nothing to interpret. `file_vertices` (n, 3) are those of the surface as they stand in the
    file, in its own unit and frame."""

    surface: Surface
    format: str
    unit: str
    notes: tuple[str, ...]
    file_vertices: FloatArray
    records: bool = False


def read_mesh(path: str | Path, unit: str | None = None) -> Surface:
    """The surface in a mesh file. `unit` mm, cm, m, um, in. Raises InputError, or UnitMissing where the file does not say."""
    return open_mesh(path, unit).surface


def open_mesh(path: str | Path, unit: str | None = None) -> MeshFile:
    """As `read_mesh`, with what was found out about the file."""
    path = Path(path)
    kind = _format(path, read_bytes(path, 8))
    content = b"" if kind == "stl" else read_bytes(path)
    notes: list[str] = []
    records = False
    vertices: FloatArray
    faces: IntArray
    labels: Labels | None = None
    if kind == "stl":
        corners, notes, records = stl_corners(path)
        _finite(path, corners.reshape(-1, 3), 3)
        first, number = weld_exactly(corners.reshape(-1, 3))
        vertices, faces = corners.reshape(-1, 3)[first].astype(np.float64), number.reshape(-1, 3)
        del corners
        notes.append(f"{len(number)} corners were welded to {len(first)} vertices where their float32 coordinates are equal")
    elif kind == "ply":
        vertices, faces, notes, said, labels = ply_mesh(path, content)
        unit = unit or said
    elif kind == "obj":
        vertices, faces = _obj(path, content)
    elif kind == "off":
        vertices, faces = _off(path, content)
    else:
        vertices, faces, said = _through_trimesh(path, content, kind)
        unit = unit or said
    if len(faces) == 0:
        raise InputError(path, "holds no faces; export it again")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(
            path, f"its faces name vertices {faces.min()} to {faces.max()}, and it has {len(vertices)}; the file is damaged"
        )
    _finite(path, vertices, 1)
    if unit is None:
        raise UnitMissing(path)
    if kind != "stl":
        before = len(vertices)
        vertices, faces = _welded(vertices, faces, notes)
        if labels is not None and len(vertices) < before:
            labels = labels._replace(error_mm=None)
    farthest = float(max(vertices.max(), -vertices.min())) * mm_per(unit)
    if farthest > LARGEST_MM:
        raise InputError(
            path,
            f"has coordinates up to {farthest:.3g} mm, beyond the {LARGEST_MM:g} mm that can be reckoned with; say its unit with --unit",
        )
    own = vertices
    lowered = lowered_in(read_bytes(path, 80) if kind == "stl" else _head(content, kind))
    del content
    if lowered is not None:
        vertices = turned_back(vertices, lowered)
        notes.append("it stands with z up, as slicers take it; read in the frame of its scans, y up")
    in_mm = vertices if mm_per(unit) == 1.0 else vertices * mm_per(unit)
    if labels is None:
        surface = Surface(in_mm, faces, part_names=(path.stem,))
    else:
        error = None if labels.error_mm is None else labels.error_mm * mm_per(unit)
        surface = Surface(in_mm, faces, labels.part, labels.origin, labels.names, error, labels.refined)
    return MeshFile(surface, kind, unit, tuple(notes), own, records)


def _head(content: bytes, kind: str) -> bytes:
    """Where a file for slicers says how it stands."""
    if kind != "3mf":
        return b""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        names = [name for name in archive.namelist() if name.lower().endswith(".model")]
        return archive.open(names[0]).read(2000) if names else b""


def _format(path: Path, content: bytes) -> str:
    """By magic bytes where a format has them, else by the file's ending."""
    if not content:
        raise InputError(path, "is empty; export it again")
    if content[:4] == b"glTF":
        return "glb"
    if content[:4] == b"ply\n" or content[:4] == b"ply\r":
        return "ply"
    ending = path.suffix.lower().lstrip(".")
    if ending not in FORMATS:
        raise InputError(path, f"has the ending {path.suffix!r}; mesh files end in {', '.join(FORMATS)}")
    return ending


def _finite(path: Path, vertices: FloatArray, per_face: int) -> None:
    # piece by piece: what is said of each of a large file is much
    if not all(np.isfinite(vertices[first : first + _AT_ONCE]).all() for first in range(0, len(vertices), _AT_ONCE)):
        bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
        where = f"{len(np.unique(bad // 3))} faces have corners" if per_face == 3 else f"{len(bad)} vertices have coordinates"
        name = "face" if per_face == 3 else "vertex"
        raise InputError(
            path,
            f"{where} that are not finite numbers, the first in {name} {bad[0] // per_face}; export it again",
            count=len(bad),
        )


def _welded(vertices: FloatArray, faces: IntArray, notes: list[str]) -> tuple[FloatArray, IntArray]:
    """Vertices that faces name become one where their coordinates are equal; vertices that no face names stay."""
    used = np.zeros(len(vertices), bool)
    used[faces.ravel()] = True
    first, number = weld_exactly(vertices if used.all() else vertices[used])
    if len(first) == len(number):
        return vertices, faces
    notes.append(f"{len(number)} vertices were welded to {len(first)} where their coordinates are equal")
    place = np.zeros(len(vertices), np.int64)
    place[used] = number
    return np.concatenate([vertices[used][first], vertices[~used]]), place[faces]


def _obj(path: Path, content: bytes) -> tuple[FloatArray, IntArray]:
    vertices: list[tuple[float, float, float]] = []
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines(), 1):
        words = line.split()
        if not words or words[0] not in (b"v", b"f"):
            continue
        try:
            if words[0] == b"v":
                vertices.append((float(words[1]), float(words[2]), float(words[3])))
            else:
                ring = [int(word.split(b"/", 1)[0]) for word in words[1:]]
                ring = [i - 1 if i > 0 else len(vertices) + i for i in ring]
                faces.extend((ring[0], ring[k], ring[k + 1]) for k in range(1, len(ring) - 1))
        except (ValueError, IndexError):
            raise InputError(path, f"line {number} is not OBJ: {line[:60]!r}; export it again") from None
    return np.array(vertices, np.float64).reshape(-1, 3), _numbered(path, faces)


def _numbered(path: Path, faces: list[tuple[int, int, int]]) -> IntArray:
    try:
        return np.array(faces, np.int64).reshape(-1, 3)
    except OverflowError:
        raise InputError(path, "its faces name vertices by numbers beyond 64 bits; export it again") from None


def _off(path: Path, content: bytes) -> tuple[FloatArray, IntArray]:
    lines = [line for raw in content.splitlines() if (line := raw.split(b"#", 1)[0].split())]
    head = lines[0][0].upper() if lines else b""
    if head not in (b"OFF", b"COFF", b"NOFF", b"CNOFF"):
        raise InputError(path, "does not begin with OFF; it is no OFF file")
    try:
        lines[0] = lines[0][1:]
        at = 0 if lines[0] else 1
        n, m = int(lines[at][0]), int(lines[at][1])
        rows, rings = lines[at + 1 : at + 1 + n], lines[at + 1 + n : at + 1 + n + m]
        if n < 0 or m < 0 or len(rows) < n or len(rings) < m:
            raise InputError(
                path, f"counts {n} vertices and {m} faces and has {len(lines) - at - 1} lines for them; the file is cut off"
            )
        vertices = np.array([[float(x) for x in row[:3]] for row in rows], np.float64).reshape(-1, 3)
        faces: list[tuple[int, int, int]] = []
        for row in rings:
            ring = [int(x) for x in row[1 : 1 + int(row[0])]]
            if len(ring) != int(row[0]):
                raise ValueError
            faces.extend((ring[0], ring[k], ring[k + 1]) for k in range(1, len(ring) - 1))
    except (ValueError, IndexError):
        raise InputError(path, "holds lines that are not OFF; export it again") from None
    return vertices, _numbered(path, faces)


def _refuse_to_swell(path: Path, content: bytes) -> None:
    """Refuse an archive that unpacks to many times what lists of numbers pack to, before it is unpacked: its reader holds it whole."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            unpacked = sum(member.file_size for member in archive.infolist())
    except DAMAGED_ARCHIVE as error:
        raise InputError(path, f"cannot be read as 3MF ({error}); export it again") from None
    if unpacked > max(SWELLS_FREELY, MOST_SWELLING * len(content)):
        raise InputError(
            path,
            f"unpacks from {len(content)} to {unpacked} bytes, more than {MOST_SWELLING} times, which no mesh does; export it again",
            unpacked=unpacked,
        )


def _refuse_to_multiply(path: Path, content: bytes) -> None:
    """Refuse a 3MF whose components of components place its parts more often than its reader follows; it would leave the rest out."""
    try:
        placed, inside = _parts_of(content)
    except DAMAGED_ARCHIVE as error:
        raise InputError(path, f"cannot be read as 3MF ({error}); export it again") from None
    times = 0
    for _ in range(len(inside) + 1):  # one level of components after another; a circle of them has no last
        times += placed.total()
        below: Counter[_Part] = Counter()
        for part, count in placed.items():
            for component in inside.get(part, ()):
                below[component] += count
        placed = below
        if not placed or times > MOST_PLACED:
            break
    if placed or times > MOST_PLACED:
        raise InputError(path, f"places its parts more than {MOST_PLACED} times, in each other; export it again as one mesh")


def _parts_of(content: bytes) -> tuple[Counter[_Part], dict[_Part, list[_Part]]]:
    """What the build of a 3MF places, how often each, and the components of each object."""
    inside: dict[_Part, list[_Part]] = {}
    placed: Counter[_Part] = Counter()
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for member in archive.namelist():
            within: _Part | None = None
            for tag, attributes in _PLACING.findall(archive.read(member) if member.endswith(".model") else b""):
                named = {key.rpartition(b":")[2]: value.decode("latin1") for key, _, value in _ATTRIBUTE.findall(attributes)}
                if tag == b"object":
                    within = member, named.get(b"id", "")
                    continue
                part = named.get(b"path", member).strip("/"), named.get(b"objectid", "")
                if tag == b"item":
                    placed[part] += 1
                elif within is not None:
                    inside.setdefault(within, []).append(part)
    return placed, inside


def _through_trimesh(path: Path, content: bytes, kind: str) -> tuple[FloatArray, IntArray, str]:
    """Vertices, faces and unit of GLB or 3MF, all instances placed by their transforms."""
    try:
        import trimesh

        for package in ("networkx", "lxml") if kind == "3mf" else ():  # trimesh says without their names that it lacks them
            importlib.import_module(package)
    except ImportError as error:
        lacking = error.name or "trimesh"
        remedy = "pip install trimesh" if lacking == "trimesh" else "pip install 'rangecheck[formats]'"
        raise DependencyMissing(lacking, f"reading {kind.upper()}", remedy) from None
    if kind == "3mf":
        _refuse_to_swell(path, content)
        _refuse_to_multiply(path, content)
    try:
        scene = trimesh.load_scene(io.BytesIO(content), file_type=kind)
        vertices, faces = _placed(scene, trimesh.Trimesh)
    except ImportError as error:
        raise DependencyMissing(
            error.name or "a package", f"reading {kind.upper()}", "pip install 'rangecheck[formats]'"
        ) from None
    except Exception as error:  # a foreign reader may raise anything on a damaged file
        raise InputError(path, f"cannot be read as {kind.upper()} ({type(error).__name__}: {error}); export it again") from None
    if len(faces) == 0:
        raise InputError(path, "holds no faces; export it again")
    said = "m" if kind == "glb" else _UNITS_3MF.get(str(scene.units or "millimeter").rstrip("s"), "mm")
    if not 0 <= np.min(faces) <= np.max(faces) < len(vertices):
        raise InputError(path, f"its faces name vertices outside the {len(vertices)} that it has; export it again")
    # each primitive of GLB brings all vertices of its buffer: keep those that it uses
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3), said


def _placed(scene: Any, kind: Any) -> tuple[FloatArray, IntArray]:
    """All instances of the scene's meshes where its transforms place them; mirrored ones turned inside out, as they look."""
    meshes = {
        name: (np.asarray(part.vertices, np.float64), np.asarray(part.faces, np.int64))
        for name, part in scene.geometry.items()
        if isinstance(part, kind)
    }
    vertices, faces, start = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        if name not in meshes:
            continue  # lines and points
        own, rings = meshes[name]
        vertices.append(own @ matrix[:3, :3].T + matrix[:3, 3])
        faces.append((rings[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else rings) + start)
        start += len(own)
    return np.concatenate(vertices), np.concatenate(faces)
