"""Modelled scenes in TOML.

    tolerance_mm = 0.05            # how far facets may lie from the true surface; default: a tenth of a pixel of [camera]
    [camera]                       # optional: width, height, field_of_view_deg, eye_mm, target_mm
    [[source]]                     # optional: at_mm, radius_mm, radiance
    [[body]]
    name = "block"
    shape = "box"                  # box sphere cylinder cone torus plane revolved extruded mesh union difference intersection
    size_mm = [60, 40, 30]
    at_mm = [0, 20, 0]             # where its origin goes, after
    turn_deg = [0, 30, 0]          # turning about x, then y, then z
    material = "plaster"           # or a material's file, from where the program runs or beside this one

Booleans hold their operands in `of`, a list of the same tables, and difference takes all others from the first. World frame: y up.
Frames of the shapes: `primitives`. A plane is a sheet that faces up; within a boolean it is the block of matter below it.
"""

from __future__ import annotations

import difflib
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray
from rangecheck.errors import SceneError, told_of
from rangecheck.files import beside, read_toml
from rangecheck.modeler import primitives
from rangecheck.modeler.body import Body
from rangecheck.modeler.engine import OPERATIONS, combine, common_volume_mm3
from rangecheck.modeler.model import Lamp, Model, model_of
from rangecheck.modeler.true_faces import TrueFace
from rangecheck.optics import PinholeCamera

#: keys of each shape beside name, shape, at_mm, turn_deg, material; those with a default are not required
SHAPES: dict[str, tuple[str, ...]] = {
    "box": ("size_mm",),
    "sphere": ("radius_mm",),
    "cylinder": ("radius_mm", "height_mm"),
    "cone": ("radius_mm", "height_mm"),
    "torus": ("major_mm", "minor_mm"),
    "plane": ("size_mm",),
    "revolved": ("outline_mm", "faces"),
    "extruded": ("outline_mm", "depth_mm", "faces"),
    "mesh": ("file", "unit"),
} | dict.fromkeys(OPERATIONS, ("of",))
_OPTIONAL = ("faces", "unit")
_COMMON = ("name", "shape", "at_mm", "turn_deg", "material")
_DEEPEST = 16
#: facets stay within this share of a pixel of the true surface when the file does not say
TOLERANCE_PX = 0.1
#: without a camera: this share of the scene's extent
TOLERANCE_SHARE = 1e-4
#: bodies may touch; sharing more than this share of the smaller one's volume is an overlap
TOUCHING = 1e-6


def read_model(path: str | Path) -> Model:
    """The scene in a TOML file. Raises InputError (not TOML, unreadable mesh), SceneError (names the body and the rule)."""
    path = Path(path)
    with told_of(path):
        return model_from_dict(read_toml(path), path.parent)


def model_from_dict(document: Mapping[str, Any], folder: str | Path | None = None) -> Model:
    """The scene that `document` describes; mesh files are looked for in `folder` and nowhere above it."""
    if "body" not in document and any(key.startswith("K_") for key in document):
        raise SceneError("this file holds a material, no scene; give it as --material, beside a mesh, scan or scene")
    _known("the scene", document, ("name", "tolerance_mm", "camera", "source", "body"))
    rows = document.get("body")
    if not isinstance(rows, list) or not rows:
        raise SceneError("the scene has no [[body]]; give it at least one")
    camera, pose = _camera(document["camera"]) if "camera" in document else (None, None)
    builder = _Builder(Path(folder) if folder is not None else None)
    tolerance = _tolerance(document, builder, rows, camera, pose)
    builder.error_mm = tolerance
    built = [builder.body(row, "") for row in rows]
    _unique([row["name"] for row in rows], "the scene")
    _keep_apart(built)
    return model_of(
        [body for body, _, _ in built],
        [materials for _, materials, _ in built],
        tolerance,
        str(document.get("name", "model")),
        camera=camera,
        world_from_camera=pose,
        lamps=tuple(_lamp(row, k) for k, row in enumerate(_tables(document.get("source", []), "source"))),
    )


class _Builder:
    """Bodies from tables, at one tessellation error."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self.error_mm = math.inf

    def body(self, row: Any, above: str, depth: int = 0) -> tuple[Body, tuple[str, ...], bool]:
        """The body of a table in the frame above it, the material of each face, and whether it is closed."""
        if not isinstance(row, Mapping):
            raise SceneError(f"{above or 'the scene'}: a body is a table with name and shape, not {row!r}")
        name = row.get("name")
        if not isinstance(name, str) or not name or "/" in name or len(name) > 100:
            raise SceneError(f"{above or 'the scene'}: a body needs a name (text without '/'); it has {name!r}")
        path = f"{above}{name}"
        shape = row.get("shape")
        if not isinstance(shape, str) or shape not in SHAPES:
            near = difflib.get_close_matches(str(shape), SHAPES, n=1)
            raise SceneError(
                f"{path}: shape is {shape!r}; known are {', '.join(SHAPES)}" + (f"; did you mean {near[0]}?" if near else "")
            )
        _known(path, row, (*_COMMON, *SHAPES[shape]))
        missing = [key for key in SHAPES[shape] if key not in row and key not in _OPTIONAL]
        if missing:
            raise SceneError(f"{path}: a {shape} needs {', '.join(missing)}")
        if depth > _DEEPEST:
            raise SceneError(f"{path}: bodies are nested more than {_DEEPEST} deep")
        materials: tuple[str, ...]
        if shape in OPERATIONS:
            made, materials = self._combined(row, path, shape, depth)
            closed = True
        else:
            made, closed = self._primitive(row, path, shape, solid_plane=depth > 0)
            made = Body(made.vertices, made.faces, made.label, tuple(f"{path}/{n}" for n in made.names), made.true_faces)
            materials = ("",) * len(made.names)
        material = row.get("material", "")
        if not isinstance(material, str):
            raise SceneError(f"{path}: material is {material!r}; it must be a name")
        if material.endswith(".toml") and self.folder is not None:
            material = beside(material, self.folder)
        # the innermost word counts: an operand may be of another material than the whole
        return made.moved(_placement(row, path)), tuple(m or material for m in materials), closed

    def _combined(self, row: Mapping[str, Any], path: str, shape: str, depth: int) -> tuple[Body, tuple[str, ...]]:
        operands = _tables(row["of"], f"{path}: of")
        if len(operands) < 2:
            raise SceneError(f"{path}: a {shape} needs at least two bodies in `of`; it has {len(operands)}")
        built = [self.body(operand, f"{path}/", depth + 1) for operand in operands]
        names = [str(operand["name"]) for operand in operands]
        _unique(names, path)
        body = combine(shape, [b for b, _, _ in built], names, path)
        return body, tuple(m for _, materials, _ in built for m in materials)

    def _primitive(self, row: Mapping[str, Any], path: str, shape: str, solid_plane: bool) -> tuple[Body, bool]:
        def length(key: str) -> float:
            return _positive(row[key], f"{path}: {key}")

        def lengths(key: str, count: int) -> list[float]:
            values = row[key]
            if not isinstance(values, list) or len(values) != count:
                raise SceneError(f"{path}: {key} is {values!r}; it must be {count} lengths")
            return [_positive(v, f"{path}: {key}") for v in values]

        error = self.error_mm
        if shape == "box":
            return primitives.box(lengths("size_mm", 3)), True
        if shape == "plane":
            x, z = lengths("size_mm", 2)
            if not solid_plane:
                return primitives.sheet((x, z)), False
            deep = max(x, z)
            below = rigid.identity()
            below[1, 3] = -deep / 2
            return primitives.box((x, deep, z)).moved(below), True
        if shape == "sphere":
            return primitives.sphere(length("radius_mm"), error, path), True
        if shape == "mesh":
            return self._mesh(row, path), True
        if shape == "extruded":
            points, names = _outline(row, path)
            return primitives.extruded(points, names, length("depth_mm"), error, path), True
        if shape == "cylinder":
            r, h = length("radius_mm"), length("height_mm") / 2
            points, names = [[0, -h], [r, -h], [r, h], [0, h]], ["bottom", "side", "top", ""]
        elif shape == "cone":
            r, h = length("radius_mm"), length("height_mm")
            points, names = [[0, -h], [r, -h], [0, 0]], ["base", "side", ""]
        elif shape == "torus":
            a, b = length("major_mm"), length("minor_mm")
            if b >= a:
                raise SceneError(f"{path}: minor_mm is {b:g}, not less than major_mm {a:g}; a ring needs a hole")
            return _one_face(primitives.revolved([[a - b, 0, 1], [a + b, 0, 1]], ["surface", "surface"], error, path)), True
        else:
            points, names = _outline(row, path)
        return primitives.revolved(points, names, error, path), True

    def _mesh(self, row: Mapping[str, Any], path: str) -> Body:
        from rangecheck.surface.mesh_files import read_mesh

        file, unit = row["file"], row.get("unit")
        inside = PurePosixPath(file) if isinstance(file, str) else None
        if inside is None or self.folder is None or inside.is_absolute() or ".." in inside.parts:
            raise SceneError(f"{path}: file is {file!r}; it must be a path inside the scene file's folder")
        target = self.folder / inside
        if not target.resolve().is_relative_to(self.folder.resolve()):
            raise SceneError(f"{path}: file {file!r} leads out of the scene file's folder")
        surface = read_mesh(target, unit)
        return Body(
            surface.vertices,
            np.asarray(surface.faces, np.int64),
            np.zeros(len(surface.faces), np.int64),
            ("surface",),
            (TrueFace("mesh"),),
        )


def _one_face(body: Body) -> Body:
    return Body(body.vertices, body.faces, np.zeros_like(body.label), ("surface",), body.true_faces[:1])


def _outline(row: Mapping[str, Any], path: str) -> tuple[list[list[float]], list[str]]:
    points = row["outline_mm"]
    if not isinstance(points, list) or not all(
        isinstance(p, list) and all(_is_number(x) and abs(x) < 1e9 for x in p) for p in points
    ):
        raise SceneError(f"{path}: outline_mm must be a list of points [x, y] or [x, y, bulge]")
    names = row.get("faces", [f"side {k + 1}" for k in range(len(points))])
    if not isinstance(names, list) or len(names) != len(points) or not all(isinstance(n, str) and "/" not in n for n in names):
        raise SceneError(f"{path}: faces must name each of the outline's {len(points)} segments")
    return points, names


def _placement(row: Mapping[str, Any], path: str) -> FloatArray:
    motion = rigid.identity()
    for axis, turn in zip(np.eye(3), _numbers(row.get("turn_deg", [0, 0, 0]), f"{path}: turn_deg")):
        motion = rigid.about_axis(axis, math.radians(turn)) @ motion
    motion[:3, 3] = _numbers(row.get("at_mm", [0, 0, 0]), f"{path}: at_mm")
    return motion


def _camera(row: Any) -> tuple[PinholeCamera, FloatArray]:
    keys = ("width", "height", "field_of_view_deg", "eye_mm", "target_mm")
    if not isinstance(row, Mapping):
        raise SceneError("camera must be one table [camera]")
    _known("camera", row, keys)
    missing = [key for key in keys if key not in row]
    if missing:
        raise SceneError(f"camera lacks {', '.join(missing)}")
    size = [row["width"], row["height"]]
    if not all(isinstance(n, int) and not isinstance(n, bool) for n in size):
        raise SceneError(f"camera's width and height are {size}; they must be whole numbers of pixels")
    camera = PinholeCamera.from_field_of_view(size[0], size[1], _positive(row["field_of_view_deg"], "camera: field_of_view_deg"))
    return camera, rigid.look_at(_numbers(row["eye_mm"], "camera: eye_mm"), _numbers(row["target_mm"], "camera: target_mm"))


def _lamp(row: Mapping[str, Any], k: int) -> Lamp:
    where = f"source {k + 1}"
    _known(where, row, ("at_mm", "radius_mm", "radiance"))
    missing = [key for key in ("at_mm", "radius_mm", "radiance") if key not in row]
    if missing:
        raise SceneError(f"{where} lacks {', '.join(missing)}")
    x, y, z = _numbers(row["at_mm"], f"{where}: at_mm")
    return Lamp((x, y, z), _positive(row["radius_mm"], f"{where}: radius_mm"), _positive(row["radiance"], f"{where}: radiance"))


def _tolerance(
    document: Mapping[str, Any], builder: _Builder, rows: list[Any], camera: PinholeCamera | None, pose: FloatArray | None
) -> float:
    if "tolerance_mm" in document:
        return _positive(document["tolerance_mm"], "tolerance_mm")
    # a coarse build tells the scene's size, and how near the camera is to it
    builder.error_mm = math.inf
    points = np.concatenate([builder.body(row, "")[0].vertices for row in rows])
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    if camera is None or pose is None:
        return TOLERANCE_SHARE * extent
    low, high = points.min(axis=0), points.max(axis=0)
    nearest = float(np.linalg.norm(np.maximum(np.maximum(low - pose[:3, 3], pose[:3, 3] - high), 0.0)))
    return TOLERANCE_PX * max(nearest, 1e-2 * extent) / camera.fx


def _keep_apart(built: Sequence[tuple[Body, tuple[str, ...], bool]]) -> None:
    solids = [body for body, _, closed in built if closed]
    boxes = [(b.vertices.min(axis=0), b.vertices.max(axis=0)) for b in solids]
    for i in range(len(solids)):
        for j in range(i):
            if (boxes[i][0] >= boxes[j][1]).any() or (boxes[j][0] >= boxes[i][1]).any():
                continue
            shared = common_volume_mm3(solids[i], solids[j])
            least = min(_volume(solids[i]), _volume(solids[j]))
            if shared > TOUCHING * least:
                a, b = (s.names[0].split("/")[0] for s in (solids[j], solids[i]))
                raise SceneError(f"{a} and {b} overlap by {shared:.4g} mm3; matter is in one place once: unite them, or move one")


def _volume(body: Body) -> float:
    corners = body.vertices[body.faces]
    return float(abs(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))) / 6


def _tables(rows: Any, where: str) -> list[Mapping[str, Any]]:
    if not isinstance(rows, list) or not all(isinstance(row, Mapping) for row in rows):
        raise SceneError(f"{where} must be a list of tables")
    return rows


def _known(where: str, row: Mapping[str, Any], keys: Sequence[str]) -> None:
    for key in row:
        if key not in keys:
            near = difflib.get_close_matches(key, keys, n=1)
            raise SceneError(
                f"{where}: {key} is not known; it takes {', '.join(keys)}" + (f"; did you mean {near[0]}?" if near else "")
            )


def _unique(names: Sequence[str], where: str) -> None:
    twice = sorted({n for n in names if list(names).count(n) > 1})
    if twice:
        raise SceneError(f"{where}: the name {twice[0]!r} is given twice; names tell bodies apart")


def _is_number(value: Any) -> bool:
    # whole numbers beyond every float are numbers to TOML, and nothing that can be drawn
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _positive(value: Any, where: str) -> float:
    if not _is_number(value) or not 0 < value < 1e9:
        raise SceneError(f"{where} is {value!r}; it must be a positive number")
    return float(value)


def _numbers(values: Any, where: str) -> list[float]:
    if not isinstance(values, list) or len(values) != 3 or not all(_is_number(v) and abs(v) < 1e9 for v in values):
        raise SceneError(f"{where} is {values!r}; it must be three numbers [x, y, z]")
    return [float(v) for v in values]
