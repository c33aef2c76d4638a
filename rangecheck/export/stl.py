"""STL of solids, and the proof that what was written is still solid.

STL holds float32 corners without indices. At 300 mm float32 steps by 3e-5 mm, so faces can lose their area and sheets can touch once
rounded. Therefore the check is part of the export: the coordinates are rounded first, faces that lose their area are collapsed, the
bytes are read back as a slicer would, welded where equal, and judged again. Only a `Solid` is exported.

Binary: 80 bytes of header, a little-endian count, then per face normal, three corners, two bytes. ASCII: nine digits, which say every
float32 exactly. Same solid, same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray
from rangecheck.errors import NotSolid
from rangecheck.files import whole_file
from rangecheck.solid.findings import Verdict
from rangecheck.solid.rounding import collapse_flat_faces
from rangecheck.solid.solid import Solid, check_solid
from rangecheck.surface.mesh_files import open_mesh
from rangecheck.surface.standing import standing, words
from rangecheck.surface.surface import Surface

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = b"binary STL, millimetres, written by rangecheck"
_STANDING_HEADER = b"binary STL, mm, written by rangecheck"


@dataclass(frozen=True)
class Exported:
    """What was written: the file, its faces, the check of its own bytes, the farthest that rounding moved a vertex, what was read back, and by how
    much it was lowered where it stands as slicers take it (see surface/standing.py)."""

    path: Path
    faces: int
    verdict: Verdict
    moved_mm: float
    read_back: Surface = field(repr=False)
    lowered_mm: float | None = None


def write_stl(
    solid: Solid | Surface,
    path: str | Path,
    *,
    force: bool = True,
    force_open: bool = False,
    ascii: bool = False,
    stand: bool = False,
    severities: Mapping[str, str] | None = None,
) -> Exported:
    """Write STL in mm, binary unless `ascii`, whole or not at all, and check what the file says. With `stand`, turned so that y becomes z,
    upwards, and lowered onto z = 0, as slicers take it; the file says so, and is read here in the frame it came from.

    A Surface that is no Solid is refused with NotSolid unless `force_open`; then the verdict on its bytes is returned, not raised.
    `severities` overrides those of findings by code. Raises OutputError when the file cannot be written or exists and `force` is False."""
    surface = solid.surface if isinstance(solid, Solid) else solid
    if not isinstance(solid, Solid) and not force_open:
        raise NotSolid("only a Solid is exported as STL; make one with Solid.from_surface(), or force an open file", findings=())
    lowered: float | None = None
    if stand:
        surface, lowered = standing(surface)
    rounded, moved = as_float32(surface)
    if isinstance(solid, Solid):
        rounded = collapse_flat_faces(rounded)
    count = len(rounded.faces)
    with proved_file(path, force=force, must_be_solid=not force_open, severities=severities) as (part, judged):
        with part.open("wb") as stream:
            for piece in _pieces(rounded, ascii, lowered):
                stream.write(piece)
        # what is read back takes their place
        del rounded, surface
    return Exported(Path(path), count, judged.verdict, moved, judged.surface, lowered)


def stl_bytes(surface: Surface, *, ascii: bool = False) -> bytes:
    """A surface as the bytes of an STL file, neither checked nor mended: for tests and measurements. `write_stl` is for parts."""
    return b"".join(_pieces(surface, ascii))


def _pieces(surface: Surface, ascii: bool, lowered_mm: float | None = None) -> Iterator[bytes]:
    how = b"" if lowered_mm is None else words(lowered_mm).encode()
    if ascii:
        yield b"solid rangecheck mm" + how + b"\n" if how else b"solid rangecheck millimetres\n"
    else:
        # filled up with zeros, because admesh prints on from a head without one into whatever lies behind it
        head = (_STANDING_HEADER + how if how else _HEADER).ljust(80, b"\0")
        yield head + np.uint32(len(surface.faces)).astype("<u4").tobytes()
    for start in range(0, len(surface.faces), 1 << 18):
        records = _records(surface, slice(start, start + (1 << 18)))
        yield _facets(records) if ascii else records.tobytes()
    if ascii:
        yield b"endsolid rangecheck\n"


@dataclass
class ReadBack:
    """What a written file says, filled in once it was read."""

    verdict: Verdict = field(init=False)
    surface: Surface = field(init=False)


@contextmanager
def proved_file(
    path: str | Path, *, force: bool, must_be_solid: bool, severities: Mapping[str, str] | None = None
) -> Iterator[tuple[Path, ReadBack]]:
    """A file to be written in the block; it gets its name only after its bytes were read back and judged, which fills in the ReadBack.
    Raises NotSolid when they are not solid although `must_be_solid`."""
    judged = ReadBack()
    with whole_file(path, force=force) as part:
        yield part, judged
        # GLB and 3MF say their unit themselves
        judged.surface = open_mesh(part, None if part.suffix.lower() in (".glb", ".3mf") else "mm").surface
        verdict = judged.verdict = check_solid(judged.surface, severities=severities)
        if must_be_solid and not verdict.fit:
            raise NotSolid(f"{path}: read back as float32 it is {verdict.sentence()}", findings=verdict.findings, verdict=verdict)


def as_float32(surface: Surface) -> tuple[Surface, float]:
    """`surface` with its coordinates rounded to float32, and the farthest that moved a vertex."""
    rounded = surface.vertices.astype(np.float32).astype(np.float64)
    moved = max((float(np.abs(new - old).max()) for new, old in _in_rows(rounded, surface.vertices)), default=0.0)
    return (
        Surface(
            rounded, surface.faces, surface.part_of_face, surface.origin_of_face, surface.part_names, surface.vertex_error_mm
        ),
        moved,
    )


def _in_rows(*arrays: FloatArray) -> Iterator[tuple[FloatArray, ...]]:
    return (tuple(a[first : first + (1 << 20)] for a in arrays) for first in range(0, len(arrays[0]), 1 << 20))


def _records(surface: Surface, faces: slice) -> npt.NDArray[np.void]:
    corners = surface.vertices[surface.faces[faces]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    records = np.zeros(len(corners), _RECORD)
    records["corners"] = corners
    records["normal"] = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return records


def _facets(records: npt.NDArray[np.void]) -> bytes:
    numbers = np.concatenate([records["normal"], records["corners"].reshape(-1, 9)], axis=1).tolist()
    shape = (
        "facet normal {:.9g} {:.9g} {:.9g}\n outer loop\n  vertex {:.9g} {:.9g} {:.9g}\n  vertex {:.9g} {:.9g} {:.9g}\n"
        "  vertex {:.9g} {:.9g} {:.9g}\n endloop\nendfacet\n"
    )
    return "".join(shape.format(*row) for row in numbers).encode()
