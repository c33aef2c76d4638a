"""Meshes of surfaces and solids: PLY keeps everything, OBJ and OFF vertices and faces, GLB and STL what viewers and slicers read.

PLY: binary, float64 positions, part and origin of each face (`origin`: 0 measured, 1 interpolated, 2 invented), expected error of each
vertex where known. GLB: metres, as its specification has it, coloured by origin. STL of anything but a `Solid` is refused (see stl.py).
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.errors import OutputError
from rangecheck.export.stl import write_stl
from rangecheck.files import whole_file
from rangecheck.solid.solid import Solid
from rangecheck.surface.surface import ORIGIN_NAMES, Surface

SUFFIXES = (".ply", ".obj", ".off", ".glb", ".stl")
#: colours of measured, interpolated, invented faces in GLB, linear RGB
ORIGIN_COLOURS = ((0.75, 0.75, 0.75), (0.35, 0.55, 0.85), (0.85, 0.4, 0.25))


def write_mesh(surface: Surface | Solid, path: str | Path, *, force: bool = True) -> None:
    """Write a surface in mm to `path`, in the format of its ending, whole or not at all; same surface, same bytes.

    Raises OutputError for an unknown ending, NotSolid for an STL of what is not a Solid."""
    suffix = Path(path).suffix.lower()
    if suffix == ".stl":
        write_stl(surface, path, force=force)
        return
    shape = surface.surface if isinstance(surface, Solid) else surface
    try:
        content = {".ply": _ply, ".obj": _obj, ".off": _off, ".glb": _glb}[suffix](shape)
    except KeyError:
        raise OutputError(path, f"ends in {suffix or 'nothing'}; a mesh ends in {', '.join(SUFFIXES)}") from None
    with whole_file(path, force=force) as part:
        part.write_bytes(content)


def _ply(surface: Surface) -> bytes:
    columns: list[Any] = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
    if surface.vertex_error_mm is not None:
        columns.append(("error_mm", "<f4"))
    vertices = np.empty(len(surface.vertices), columns)
    for axis, name in enumerate("xyz"):
        vertices[name] = surface.vertices[:, axis]
    if surface.vertex_error_mm is not None:
        vertices["error_mm"] = surface.vertex_error_mm
    faces = np.empty(len(surface.faces), [("count", "u1"), ("corners", "<i4", 3), ("part", "<i4"), ("origin", "u1")])
    faces["count"], faces["corners"] = 3, surface.faces
    faces["part"], faces["origin"] = surface.part_of_face, surface.origin_of_face
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
