"""Everything other than scans that is read from files: small good files of every kind, and what reads them."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fuzz.mutate import CAMERA, mutated
from rangecheck.animation.frames import render_frames
from rangecheck.config import load_settings
from rangecheck.dataset.index import read_index
from rangecheck.dataset.ranges import read_ranges
from rangecheck.export.camera_files import read_camera_json, write_camera_json
from rangecheck.export.exr import read_exr
from rangecheck.export.map_files import read_maps_npz
from rangecheck.export.meshes import write_mesh
from rangecheck.export.pictures import read_map_png16, read_png
from rangecheck.files import presets_folder
from rangecheck.modeler import read_model
from rangecheck.pipeline.fitting import _directions
from rangecheck.pipeline.folder import job_folder
from rangecheck.pipeline.page import _charts
from rangecheck.reflectance import load_material
from rangecheck.scan import RangeScan
from rangecheck.scan.decode.capture import read_capture
from rangecheck.scan.readers import write_scans
from rangecheck.scan.readers.manifest import read_manifest
from rangecheck.solid.printer import printer
from rangecheck.studies.scenes import ball
from rangecheck.surface.mesh_files import read_mesh


@dataclass(frozen=True)
class Entry:
    """What is read, by what, and how its text may be spoilt."""

    read: Callable[[Path], Any]
    name: str
    good: tuple[bytes, ...]
    text: bool = True


#: values of the wrong kind, in a syntax that TOML and JSON share
WRONG = [
    b'""', b'"x"', b"true", b"[]", b"[[]]", b"{}", b"-1", b"0", b"1e308", b"-1e308", b"1e-320", b"99999999999999999999", b"9" * 400, b"[1, 2]",
    b"[0, 0, 0]", b"[1e300, 1e300, 1e300]", b'["a", 1]', b'"../../x"', b'"/etc/passwd"', b"[" * 4000, b'{"a" : ' * 2000, b'"\\u0000"', b"0.1",
    b"nan", b"inf", b"null", b"1_000", b"2020-01-01", b"1e9", b"100000", b"1e-9",
]  # fmt: skip
_VALUE = re.compile(rb'("[^"\n]*"|-?\d[\d.e+-]*|\[[^\[\]\n]*\]|true|false)')


def spoilt(entry: Entry, random: np.random.Generator) -> bytes:
    """One of the entry's good files after accidents of bytes, or with values of the wrong kind."""
    content = entry.good[int(random.integers(len(entry.good)))]
    if entry.text and random.random() < 0.6:
        for _ in range(int(random.integers(1, 4))):
            values = list(_VALUE.finditer(content))
            if values:
                hit = values[int(random.integers(len(values)))]
                content = content[: hit.start()] + WRONG[int(random.integers(len(WRONG)))] + content[hit.end() :]
        return content
    return mutated(content, random, [*entry.good])


def _presets(kind: str) -> tuple[bytes, ...]:
    return tuple(path.read_bytes() for path in sorted((presets_folder() / kind).glob("*.toml")))


def meshes(folder: Path) -> list[Entry]:
    """Mesh files of every format."""
    found = []
    for kind in ("ply", "stl", "obj", "off", "glb", "3mf"):
        write_mesh(ball(1, 40.0), folder / f"good.{kind}", force_open=True)
        good = [(folder / f"good.{kind}").read_bytes()]
        if kind in ("ply", "stl"):
            import trimesh

            shape = trimesh.creation.icosahedron()
            good.append(
                _bytes(shape.export(file_type="ply", encoding="ascii") if kind == "ply" else shape.export(file_type="stl_ascii"))
            )
        found.append(Entry(lambda path: read_mesh(path, "mm"), f"mesh.{kind}", tuple(good), text=kind in ("obj", "off")))
    return found


def settings(folder: Path) -> list[Entry]:
    """TOML: settings, materials, printers, ranges of data sets."""
    full = b'seed = 3\n[meshing]\nvoxel_mm = 1.5\nmethod = "fuse"\n[solid]\ncut = [0, 1, 0, 5]\nnameplate = "A"\n[light]\nmaterials = ["steel"]\n'
    return [
        Entry(load_settings, "settings.toml", (*_presets("jobs"), full)),
        Entry(
            lambda path: load_settings(None, [path.read_bytes().decode("latin1")]),
            "set.txt",
            (b"turntable.frames=72", b"solid.cut=[0, 1, 0, 5]"),
        ),
        Entry(load_material, "material.toml", _presets("materials")),
        Entry(printer, "printer.toml", _presets("printers")),
        Entry(read_ranges, "ranges.toml", _presets("datasets")),
    ]


def scenes(folder: Path) -> list[Entry]:
    """Modelled scenes."""
    return [Entry(read_model, "scene.toml", _presets("scenes"))]


def documents(folder: Path) -> list[Entry]:
    """JSON and lists: cameras, captures, lamps, indices of data sets, charts of studies."""
    write_camera_json(folder / "good.camera.json", CAMERA, np.eye(4), {"exposure": 1.0})
    camera = (folder / "good.camera.json").read_bytes()
    view = {"camera": CAMERA.to_dict(), "world_from_camera": np.eye(4).tolist()}
    shots = [{"file": "p.png", "kind": "white"}, {"file": "p.png", "kind": "black"}]
    shots += [
        {"file": "p.png", "kind": "gray", "axis": "column", "bit": k, "inverse": bool(i)} for k in range(4) for i in range(2)
    ]
    (folder / "fuzzed").mkdir(exist_ok=True)
    (folder / "fuzzed" / "p.png").write_bytes(_png(np.zeros((11, 14), np.uint8)))
    capture = {"schema": "rangecheck/capture/1", "unit": "mm", "left": view | {"pictures": shots}, "projector": view}
    row = {"index": 0, "picture": "pictures/0.png", "truth": "truth/0.npz", "camera": CAMERA.to_dict()}
    chart = {"slug": "a", "title": "A"}
    study = {"schema": "rangecheck/study/1", "name": "x", "title": "X", "charts": [chart]}
    (folder / "fuzzed" / "study-a.svg").write_bytes(b"<svg/>")
    _frames(folder / "good_frames")
    frames = (folder / "good_frames" / "frames.json").read_bytes()
    write_scans(folder / "good_scans", [RangeScan(np.full((11, 14), 400.0), CAMERA, name="p")], step_mm=0.02)
    scans = json.loads((folder / "good_scans" / "scans.json").read_bytes())
    (folder / "fuzzed" / "depth.png").write_bytes(_png(np.full((11, 14), 20_000, np.uint16)))
    scans["scans"][0] |= {"image": "depth.png", "brightness": None}
    return [
        Entry(read_camera_json, "a.camera.json", (camera,)),
        Entry(lambda path: read_capture(path.parent), "capture.json", (json.dumps(capture).encode(),)),
        Entry(lambda path: _directions(path, 3), "lights.txt", (b"0 0 1\n1 0 2\n0 -1 1.5\n",)),
        Entry(read_index, "index.jsonl", (json.dumps(row).encode() + b"\n" + json.dumps(row | {"index": 1}).encode() + b"\n",)),
        Entry(lambda path: _charts(path.parent), "study.json", (json.dumps(study).encode(),)),
        Entry(lambda path: _frames(path.parent), "frames.json", (frames,)),
        Entry(_go_on, "unfinished.json", (b'{"schema": "rangecheck/unfinished/1", "key": "a"}\n',)),
        Entry(read_manifest, "scans.json", (json.dumps(scans).encode(),)),
    ]


def _frames(folder: Path) -> None:
    """Two pictures of one pixel, made or taken up in the folder."""
    try:
        render_frames(
            lambda index: np.full((1, 1), float(index)), 2, folder, "key", encode=lambda radiance, *_: radiance.tobytes()
        )
    finally:
        for path in folder.glob("frame_*"):
            path.unlink()


def _go_on(path: Path) -> None:
    """The job that is stopped in the file's folder, taken up."""
    others = [one for one in path.parent.iterdir() if one.name != path.name]
    with job_folder(path.parent, "a", "run.json", force=False):
        assert all(one.exists() for one in others)


def pictures(folder: Path) -> list[Entry]:
    """Pictures and maps as they are read back."""
    from rangecheck.export.exr import write_exr
    from rangecheck.export.map_files import write_maps
    from rangecheck.maps import trace_maps
    from rangecheck.rigid import look_at

    maps = trace_maps(ball(1, 40.0), CAMERA, look_at((0.0, 0.0, 200.0), (0.0, 0.0, 0.0)))
    written = write_maps(folder / "maps", maps)
    by_16 = [path.read_bytes() for path in written if path.suffix == ".png" and _reads(read_map_png16, path)]
    found = [
        Entry(read_png, "picture.png", (_png(np.arange(462, dtype=np.uint8).reshape(11, 14, 3)),), text=False),
        Entry(read_maps_npz, "maps.npz", ((folder / "maps" / "maps.npz").read_bytes(),), text=False),
        Entry(read_map_png16, "map16.png", tuple(by_16), text=False),
    ]
    try:
        write_exr(folder / "a.exr", {"Z": np.ones((11, 14), np.float32)})
    except Exception:
        return found
    return [*found, Entry(read_exr, "a.exr", ((folder / "a.exr").read_bytes(),), text=False)]


def _reads(read: Callable[[Path], Any], path: Path) -> bool:
    from rangecheck.errors import RangecheckError

    try:
        read(path)
    except RangecheckError:
        return False
    return True


def _png(pixels: np.ndarray) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


def _bytes(content: str | bytes) -> bytes:
    return content.encode() if isinstance(content, str) else content


GROUPS = {"meshes": meshes, "settings": settings, "scenes": scenes, "documents": documents, "pictures": pictures}
