"""What damaged files and killed jobs are answered with; each of these inputs once brought about something else than one clear line."""

import json
import struct
import warnings

import numpy as np
import pytest

from rangecheck.config import load_settings
from rangecheck.dataset.index import read_index
from rangecheck.dataset.ranges import read_ranges
from rangecheck.errors import InputError, OutputError, RangecheckError
from rangecheck.export.camera_files import read_camera_json
from rangecheck.export.map_files import read_maps_npz
from rangecheck.files import presets_folder
from rangecheck.modeler import read_model
from rangecheck.optics import PinholeCamera
from rangecheck.pipeline import report
from rangecheck.pipeline.folder import check_free, job_folder
from rangecheck.progress import Reporter
from rangecheck.reflectance import load_material
from rangecheck.solid.printer import printer
from rangecheck.surface.mesh_files import read_mesh

HUGE, DEEP = "9" * 400, "[" * 4000
CAMERA = {"schema": "rangecheck/camera/1", "camera": PinholeCamera(4, 3, 5.0, 5.0, 1.5, 1.0).to_dict()}
PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float {z}\nelement face 1\n{list}\nend_header\n"
POINTS = "0 0 0\n1 0 0\n0 1 0\n"
CORNERS = "property list uchar float vertex_indices"


def glb_with_index(index):
    """A triangle whose third corner is vertex `index`."""
    body = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes() + struct.pack("<3I", 0, 1, index)
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 12}]
    kinds = [{"componentType": 5126, "type": "VEC3"}, {"componentType": 5125, "type": "SCALAR"}]
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}], "buffers": [{"byteLength": 48}], "bufferViews": views,
        "accessors": [{"bufferView": k, "count": 3} | kind for k, kind in enumerate(kinds)],
    }  # fmt: skip
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def spoilt_maps():
    """An archive whose first member is not what its compression says."""
    import io

    stream = io.BytesIO()
    np.savez_compressed(stream, description=np.array("x" * 500))
    content = bytearray(stream.getvalue())
    content[60:120] = b"\xff" * 60
    return bytes(content)


def preset(kind, name, old, new):
    text = (presets_folder() / kind / name).read_text()
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("read", "name", "content"),
    [
        (load_settings, "deep.toml", f"seed = {DEEP}"),
        (load_material, "deep.toml", f"source = {DEEP}"),
        (load_material, "number.toml", "K_lm = 1\nsource = 3"),
        (load_material, "index.toml", "K_lm = 1\nindex = 3"),
        (printer, "deep.toml", f"name = {DEEP}"),
        (printer, "huge.toml", preset("printers", "prusa-sl1.toml", "build_mm = [", f"build_mm = [{HUGE}, ")),
        (read_ranges, "huge.toml", f"[camera]\naside = [0, {HUGE}]"),
        (read_model, "huge.toml", preset("scenes", "bored_block.toml", "radius_mm = 14", f"radius_mm = {HUGE}")),
        (read_model, "wide.toml", preset("scenes", "bored_block.toml", "width = 480", f"width = {HUGE}")),
        (read_camera_json, "model.json", json.dumps(CAMERA | {"camera": {"model": []}})),
        (read_camera_json, "far.json", json.dumps(CAMERA | {"world_from_camera": (np.eye(4) * 1e200).tolist()})),
        (read_index, "deep.jsonl", f"{DEEP}\n" + '{"index": 0, "picture": "a", "truth": "b"}\n'),
        (read_maps_npz, "maps.npz", spoilt_maps()),
        (read_mesh, "huge.obj", f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 {HUGE}"),
        (read_mesh, "huge.off", f"OFF\n3 1 0\n{POINTS}3 0 1 {HUGE}"),
        (read_mesh, "outside.glb", glb_with_index(256)),
        (read_mesh, "nan.ply", PLY.format(z="z", list=CORNERS) + POINTS + "3 0 1 nan\n"),
        (read_mesh, "count.ply", PLY.format(z="z", list=CORNERS) + POINTS + "1e30 0 1 2 0 0 0 0 0 0 0 0\n"),
        (read_mesh, "twice.ply", PLY.format(z="y", list=CORNERS) + POINTS + "3 0 1 2\n"),
        (read_mesh, "empty.ply", PLY.format(z="z", list="element nothing 1000000000000\n" + CORNERS) + POINTS + "3 0 1 2\n"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused_in_one_line(read, name, content, tmp_path):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(RangecheckError) as refused:
            read(path)
    assert "\n" not in str(refused.value)


def test_a_setting_given_on_the_command_line_is_refused_in_one_line():
    for assignment in ("a\nb=3", f"seed={DEEP}"):
        with pytest.raises(RangecheckError) as refused:
            load_settings(None, [assignment])
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "spoil", [{"charts": None}, {"charts": [3]}, {"charts": [{"slug": "../../x", "title": "x"}]}, {"charts": [{"slug": "x" * 400, "title": ""}]}]
)  # fmt: skip
def test_charts_are_taken_of_whole_studies_only_and_from_their_own_folder(spoil, tmp_path):
    from rangecheck.pipeline.page import _charts

    (tmp_path / "study.json").write_text(json.dumps({"schema": "rangecheck/study/1", "title": "x"} | spoil))
    with pytest.raises(InputError):
        _charts(tmp_path)


def test_a_job_killed_before_it_could_say_which_it_is_does_not_stand_in_the_way(tmp_path):
    (tmp_path / ".lock").touch()
    (tmp_path / ".unfinished.abcd1234.part.json").touch()
    with job_folder(tmp_path, "key", "run.json", force=False):
        assert [path.name for path in tmp_path.glob("*.part*")] == []
    (tmp_path / "letter.txt").touch()
    with pytest.raises(OutputError, match="holds no job of this kind"):
        check_free(tmp_path, "run.json", force=False)


def test_no_report_is_made_where_no_job_was_finished(tmp_path):
    with pytest.raises(InputError, match="no finished job"):
        report(str(tmp_path), reporter=Reporter())
