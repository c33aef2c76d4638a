"""Surfaces as mesh files for other programs: PLY with everything we know of each face, OBJ and GLB with the geometry.

Millimetres, except GLB, whose unit is the metre by definition. STL is written by `export.stl`, of solids only.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from rangecheck.errors import OutputError
from rangecheck.files import write_bytes
from rangecheck.surface import ORIGIN_NAMES, Surface


def ply_bytes(surface: Surface) -> bytes:
    """Binary PLY: vertices as float64, with error_mm where known; faces with `origin` (0 measured, 1 interpolated, 2 invented)
    and `part`."""
    vertex_fields = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
    if surface.vertex_error_mm is not None:
        vertex_fields.append(("error_mm", "<f4"))
    vertices = np.empty(len(surface.vertices), np.dtype(vertex_fields))
    for axis, name in enumerate("xyz"):
        vertices[name] = surface.vertices[:, axis]
    if surface.vertex_error_mm is not None:
        vertices["error_mm"] = surface.vertex_error_mm
    faces = np.empty(len(surface.faces), np.dtype([("count", "u1"), ("corners", "<i4", 3), ("origin", "u1"), ("part", "<i4")]))
    faces["count"], faces["corners"] = 3, surface.faces
    faces["origin"], faces["part"] = surface.origin_of_face, surface.part_of_face
    kinds = {"<f8": "double", "<f4": "float"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment written by rangecheck, unit mm",
        *(f"comment origin {number} {name}" for number, name in enumerate(ORIGIN_NAMES)),
        *(f"comment part {number} {name.encode('ascii', 'replace').decode()}" for number, name in enumerate(surface.part_names)),
        f"element vertex {len(vertices)}",
        *(f"property {kinds[kind]} {name}" for name, kind in vertex_fields),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "property uchar origin",
        "property int part",
        "end_header",
    ]
    return "\n".join(header).encode() + b"\n" + vertices.tobytes() + faces.tobytes()


def _obj_bytes(surface: Surface) -> bytes:
    vertices = "\n".join(f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in surface.vertices.tolist())
    faces = "\n".join(f"f {a} {b} {c}" for a, b, c in (surface.faces + 1).tolist())
    return f"# unit mm\n{vertices}\n{faces}\n".encode()


def _glb_bytes(surface: Surface) -> bytes:
    import trimesh

    mesh = trimesh.Trimesh(surface.vertices / 1000.0, surface.faces, process=False)
    content = trimesh.Scene({"surface": mesh}).export(file_type="glb")
    assert isinstance(content, bytes)
    return content


_WRITERS: dict[str, Callable[[Surface], bytes]] = {".ply": ply_bytes, ".obj": _obj_bytes, ".glb": _glb_bytes}
SUFFIXES = tuple(_WRITERS)


def write_mesh(surface: Surface, path: str | Path, *, force: bool = True) -> None:
    """Write `surface`, open or closed, as the format that `path`'s ending names (one of SUFFIXES), whole or not at all."""
    writer = _WRITERS.get(Path(path).suffix.lower())
    if writer is None:
        raise OutputError(path, f"ends in {Path(path).suffix or 'nothing'}; a mesh ends in {', '.join(SUFFIXES)}")
    write_bytes(path, writer(surface), force=force)
