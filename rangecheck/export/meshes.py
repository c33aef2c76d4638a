"""Meshes of surfaces and solids: PLY keeps everything, OBJ and OFF vertices and faces, GLB and STL what viewers and slicers read.

PLY: binary, float64 positions, part and origin of each face (`origin`: 0 measured, 1 interpolated, 2 invented), expected error of each
vertex where known. GLB: metres, as its specification has it, coloured by origin. 3MF (core specification 1.3): millimetres, with metadata,
as slicers take it. STL of anything but a `Solid` is refused; whatever is written of a `Solid` is read back and judged again (see stl.py).
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.errors import OutputError
from rangecheck.export.stl import Exported, as_float32, proved_file, write_stl
from rangecheck.files import whole_file
from rangecheck.solid.rounding import collapse_flat_faces
from rangecheck.solid.solid import Solid
from rangecheck.surface.standing import file_from_scans, words
from rangecheck.surface.surface import ORIGIN_NAMES, Surface

SUFFIXES = (".ply", ".obj", ".off", ".glb", ".3mf", ".stl")
#: colours of measured, interpolated, invented faces in GLB, linear RGB
ORIGIN_COLOURS = ((0.75, 0.75, 0.75), (0.35, 0.55, 0.85), (0.85, 0.4, 0.25))


def write_mesh(
    surface: Surface | Solid,
    path: str | Path,
    *,
    force: bool = True,
    force_open: bool = False,
    ascii: bool = False,
    stand: bool = False,
    severities: Mapping[str, str] | None = None,
) -> Exported | None:
    """Write a surface in mm to `path`, in the format of its ending, whole or not at all; same surface, same bytes. What was read back of an
    STL or of a Solid is returned. `ascii` and `force_open` concern STL (see `write_stl`); `stand` STL and 3MF, which slicers open with z up.

    Raises OutputError for an unknown ending, NotSolid for an STL of what is not a Solid and for a Solid that its file no longer says."""
    suffix = Path(path).suffix.lower()
    if suffix == ".stl":
        return write_stl(surface, path, force=force, force_open=force_open, ascii=ascii, stand=stand, severities=severities)
    proved = isinstance(surface, Solid)
    shape = surface.surface if isinstance(surface, Solid) else surface
    moved = 0.0
    lowered = float(shape.bounds_mm[0, 1]) if stand and suffix == ".3mf" else None
    if proved and suffix == ".glb":
        # GLB holds float32 like STL
        shape, moved = as_float32(shape)
        shape = collapse_flat_faces(shape)
    try:
        content = _WRITERS[suffix](shape) if lowered is None else _3mf(shape, lowered)
    except KeyError:
        raise OutputError(path, f"ends in {suffix or 'nothing'}; a mesh ends in {', '.join(SUFFIXES)}") from None
    if not proved:
        with whole_file(path, force=force) as part:
            part.write_bytes(content)
        return None
    with proved_file(path, force=force, must_be_solid=True, severities=severities) as (part, judged):
        part.write_bytes(content)
    return Exported(Path(path), len(shape.faces), judged.verdict, moved, judged.surface, lowered)


def _ply(surface: Surface) -> bytes:
    columns: list[Any] = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
    if surface.vertex_error_mm is not None:
        columns.append(("error_mm", "<f4"))
    vertices = np.empty(len(surface.vertices), columns)
    for axis, name in enumerate("xyz"):
        vertices[name] = surface.vertices[:, axis]
    if surface.vertex_error_mm is not None:
        vertices["error_mm"] = surface.vertex_error_mm
    kinds: list[Any] = [("count", "u1"), ("corners", "<i4", 3), ("part", "<i4"), ("origin", "u1")]
    if surface.refined_of_face is not None:
        kinds.append(("refined", "u1"))
    faces = np.empty(len(surface.faces), kinds)
    faces["count"], faces["corners"] = 3, surface.faces
    faces["part"], faces["origin"] = surface.part_of_face, surface.origin_of_face
    if surface.refined_of_face is not None:
        faces["refined"] = surface.refined_of_face
    names = [f"comment part {i} {json.dumps(name)}" for i, name in enumerate(surface.part_names)]
    head = [
        "ply",
        "format binary_little_endian 1.0",
        "comment unit mm",
        "comment origin " + " ".join(f"{i} {name}" for i, name in enumerate(ORIGIN_NAMES)),
        *names,
        f"element vertex {len(vertices)}",
        *(f"property {'double' if kind == '<f8' else 'float'} {name}" for name, kind in columns),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "property int part",
        "property uchar origin",
        *(["property uchar refined"] if surface.refined_of_face is not None else []),
        "end_header\n",
    ]
    return "\n".join(head).encode() + vertices.tobytes() + faces.tobytes()


def _obj(surface: Surface) -> bytes:
    rows = ["# millimetres"]
    rows += [f"v {x!r} {y!r} {z!r}" for x, y, z in surface.vertices.tolist()]
    faces = (surface.faces + 1).tolist()
    part = surface.part_of_face
    for number, name in enumerate(surface.part_names):
        mine = np.flatnonzero(part == number)
        if len(mine):
            rows.append(f"g {''.join(c if c.isalnum() or c in '-_.' else '_' for c in name)}")
            rows += ["f %d %d %d" % tuple(faces[f]) for f in mine.tolist()]  # noqa: UP031 (twice as fast)
    return ("\n".join(rows) + "\n").encode()


def _off(surface: Surface) -> bytes:
    rows = ["OFF", "# millimetres", f"{len(surface.vertices)} {len(surface.faces)} 0"]
    rows += [f"{x!r} {y!r} {z!r}" for x, y, z in surface.vertices.tolist()]
    rows += [f"3 {a} {b} {c}" for a, b, c in surface.faces.tolist()]
    return ("\n".join(rows) + "\n").encode()


def _glb(surface: Surface) -> bytes:
    """glTF 2.0, binary container: one mesh with one primitive per origin present, positions in metres about the origin, float32."""
    positions = (surface.vertices / 1000.0).astype("<f4")
    chunks, views, accessors, primitives, materials = [positions.tobytes()], [], [], [], []
    views.append({"buffer": 0, "byteOffset": 0, "byteLength": positions.nbytes, "target": 34962})
    low, high = (positions.min(axis=0), positions.max(axis=0)) if len(positions) else (np.zeros(3), np.zeros(3))
    accessors.append(
        {
            "bufferView": 0,
            "componentType": 5126,
            "count": len(positions),
            "type": "VEC3",
            "min": low.tolist(),
            "max": high.tolist(),
        }
    )
    offset = positions.nbytes
    for origin, name in enumerate(ORIGIN_NAMES):
        corners = surface.faces[surface.origin_of_face == origin].astype("<u4")
        if not len(corners):
            continue
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": corners.nbytes, "target": 34963})
        accessors.append({"bufferView": len(views) - 1, "componentType": 5125, "count": corners.size, "type": "SCALAR"})
        colour = [*ORIGIN_COLOURS[origin], 1.0]
        surface_look = {"baseColorFactor": colour, "metallicFactor": 0.0, "roughnessFactor": 1.0}
        materials.append({"name": name, "doubleSided": True, "pbrMetallicRoughness": surface_look})
        primitives.append({"attributes": {"POSITION": 0}, "indices": len(accessors) - 1, "material": len(materials) - 1})
        chunks.append(corners.tobytes())
        offset += corners.nbytes
    document = {
        "asset": {"version": "2.0", "generator": "rangecheck"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "materials": materials,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(chunks)
    body += b"\0" * (-len(body) % 4)
    head = struct.pack("<III", 0x46546C67, 2, 12 + 8 + len(text) + 8 + len(body))
    return head + struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body


_3MF_TYPES = """<?xml version="1.0" encoding="UTF-8"?>
<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">
<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>
<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>
</Types>
"""
_3MF_LINKS = """<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">
<Relationship Target="/3D/3dmodel.model" Id="model" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>
</Relationships>
"""


def _3mf(surface: Surface, lowered_mm: float | None = None) -> bytes:
    """A zip archive with one object; vertices keep the digits that tell their float64 values, and the item's transform makes it stand."""
    motion = np.eye(4) if lowered_mm is None else file_from_scans(lowered_mm)
    placed = "" if lowered_mm is None else f' transform="{" ".join(f"{x!r}" for x in motion[:3].T.ravel().tolist())}"'
    shares = ", ".join(f"{name} {100 * surface.share_of_area(k):.2f} %" for k, name in enumerate(ORIGIN_NAMES))
    rows = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<model unit="millimeter" xml:lang="en-US" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">',
        f'<metadata name="Application">rangecheck{"" if lowered_mm is None else words(lowered_mm)}</metadata>',
        f'<metadata name="Description">share of area: {shares}</metadata>',
        '<resources><object id="1" type="model"><mesh><vertices>',
        *(f'<vertex x="{x!r}" y="{y!r}" z="{z!r}"/>' for x, y, z in surface.vertices.tolist()),
        "</vertices><triangles>",
        *(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in surface.faces.tolist()),
        f'</triangles></mesh></object></resources><build><item objectid="1"{placed}/></build></model>',
    ]
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in (
            ("[Content_Types].xml", _3MF_TYPES),
            ("_rels/.rels", _3MF_LINKS),
            ("3D/3dmodel.model", "\n".join(rows)),
        ):
            # a fixed date: the same solid gives the same bytes
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), text, zipfile.ZIP_DEFLATED)
    return stream.getvalue()


_WRITERS: dict[str, Callable[[Surface], bytes]] = {".ply": _ply, ".obj": _obj, ".off": _off, ".glb": _glb, ".3mf": _3mf}
