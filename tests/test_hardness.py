"""What damaged files and killed jobs are answered with; each of these inputs once brought about something else than one clear line."""

import json
import math
import os
import signal
import struct
import subprocess
import warnings

import numpy as np
import pytest

from rangecheck.config import load_settings
from rangecheck.dataset.index import read_index
from rangecheck.dataset.ranges import read_ranges
from rangecheck.errors import InputError, OutputError, RangecheckError
from rangecheck.export.camera_files import read_camera_json
from rangecheck.export.map_files import read_maps_npz
from rangecheck.files import presets_folder, write_json
from rangecheck.modeler import read_model
from rangecheck.optics import PinholeCamera
from rangecheck.pipeline import materials, report
from rangecheck.pipeline.folder import check_free, job_folder
from rangecheck.pipeline.subject import read_all_scans
from rangecheck.progress import Reporter
from rangecheck.reflectance import load_material
from rangecheck.scan import RangeScan
from rangecheck.scan.readers import write_npz
from rangecheck.solid.check_file import check_mesh_file
from rangecheck.solid.printer import printer
from rangecheck.studies.forked_command import Moment, forked_command
from rangecheck.studies.hardness_jobs import SMALL, faults, left_over, small_scans, whole_files
from rangecheck.studies.hardness_machines import differences
from rangecheck.studies.scenes import ball
from rangecheck.studies.whole_commands import command_line
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
        (read_model, "fine.toml", preset("scenes", "ring_on_sheet.toml", 'name = "ring on sheet"', 'name = "ring"\ntolerance_mm = 1e-320')),
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


def test_a_job_killed_between_its_last_file_and_its_end_goes_on(tmp_path):
    """What it was is known, and it is only not yet said to be finished."""
    with pytest.raises(KeyboardInterrupt), job_folder(tmp_path, "key", "run.json", force=False):
        (tmp_path / "run.json").touch()
        raise KeyboardInterrupt
    with job_folder(tmp_path, "key", "run.json", force=False):
        assert not (tmp_path / "run.json").exists()
        (tmp_path / "run.json").touch()
    with pytest.raises(OutputError, match="finished results"):
        check_free(tmp_path, "run.json", force=False)


def test_two_jobs_do_not_write_in_one_folder(tmp_path):
    with job_folder(tmp_path, "key", "run.json", force=False):
        for force in (False, True):
            with (
                pytest.raises(OutputError, match="another job is writing here"),
                job_folder(tmp_path, "key", "run.json", force=force),
            ):
                pass
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def small_job(tmp_path_factory):
    """The smallest whole job, where it ended, and processes that do it again."""
    folder = tmp_path_factory.mktemp("small job")
    scans = small_scans(folder)
    with forked_command(["run", str(scans), "--out", str(folder / "undisturbed"), *SMALL]) as command:
        yield folder, scans, whole_files(folder / "undisturbed"), command


def test_a_killed_job_leaves_whole_files_and_ends_with_the_same_bytes(small_job, tmp_path):
    """Many more kills: `rangecheck study hardness --part kills-1`."""
    _, scans, undisturbed, command = small_job
    line = ["run", str(scans), "--out", str(tmp_path / "out"), *SMALL]
    # how many threads and how much memory it takes do not make it another job
    for operation, means in ((150, ()), (300, ("--set", "threads=1", "--set", "memory_mb=8000"))):
        assert command.run([*line, *means], Moment(operation=operation)).status == -signal.SIGKILL
        # which settings.json then tells
        assert faults(tmp_path / "out", undisturbed) == (["settings.json"] if means else [])
    command.run(line)
    assert whole_files(tmp_path / "out") == undisturbed and left_over(tmp_path / "out") == []


def test_a_job_has_the_same_bytes_in_every_place_and_on_any_number_of_threads(small_job, tmp_path):
    """Time zone, language, names of places and the order of sets must not be seen in what a job writes."""
    folder, scans, undisturbed, _ = small_job
    (tmp_path / "Ñandú büste").symlink_to(folder)
    elsewhere = {"TZ": "Asia/Kathmandu", "LC_ALL": "tr_TR.UTF-8", "LANG": "de_DE", "PYTHONHASHSEED": "7", "PYTHONUTF8": "0"}
    line = ["run", str(tmp_path / "Ñandú büste" / scans.name), "--out", str(tmp_path / "out"), *SMALL, "--threads", "3"]
    subprocess.run(command_line(line), env=os.environ | elsewhere, check=True, stdout=subprocess.DEVNULL)
    found = whole_files(tmp_path / "out")
    # these name the inputs, and the number of threads that was asked for
    told = {"settings.json", "run.json"}
    assert {name: said for name, said in found.items() if name not in told} == {
        name: said for name, said in undisturbed.items() if name not in told
    }


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda v: np.where(np.arange(len(v))[:, None] == 3, np.nan, v), "not finite"),
        (lambda v: np.where(np.arange(len(v))[:, None] == 3, np.inf, v), "not finite"),
        (lambda v: v * 1e-310, "degenerate-faces"),
        (lambda v: v + 1e9, "short-edges"),
        (lambda v: np.where(np.arange(len(v))[:, None] < 20, v[0], v), "non-manifold-edges"),
    ],
    ids=["nan", "infinite", "denormal", "far away", "duplicate"],
)
def test_strange_coordinates_are_refused_or_named(spoil, said, tmp_path):
    surface = ball(2, 40.0)
    vertices = np.asarray(spoil(surface.vertices), np.float64)
    rows = [f"{x!r} {y!r} {z!r}\n" for x, y, z in vertices.tolist()] + [f"3 {a} {b} {c}\n" for a, b, c in surface.faces.tolist()]
    head = PLY.format(z="z", list=CORNERS.replace("float", "int")).replace("float", "double")
    head = head.replace("vertex 3", f"vertex {len(vertices)}").replace("face 1", f"face {len(surface.faces)}")
    (tmp_path / "odd.ply").write_text(head + "".join(rows))
    if said == "not finite":
        with pytest.raises(InputError, match=said):
            check_mesh_file(tmp_path / "odd.ply", "mm")
        return
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = check_mesh_file(tmp_path / "odd.ply", "mm").verdict
    assert said in [finding.code for finding in found.findings]
    # far away, float64 still holds the ball; float32, and so STL, would not
    assert found.fit == (said == "short-edges")


def test_what_a_file_calls_its_scan_leads_no_result_out_of_its_folder(tmp_path):
    ranges = np.full((11, 14), 400.0)
    camera = PinholeCamera(14, 11, 20.0, 21.0, 6.5, 5.5)
    for k, name in enumerate(("../../above", "/etc/above", "../../above")):
        write_npz(tmp_path / f"{k}.npz", RangeScan(ranges, camera, name=name))
    scans = read_all_scans(sorted(tmp_path.glob("*.npz")), None, Reporter())
    assert [scan.name for scan in scans] == ["above", "etc_above", "above_2"]


def test_a_material_file_from_elsewhere_leads_no_result_out_of_its_folder(tmp_path):
    (tmp_path / "mine.toml").write_text((presets_folder() / "materials" / "plaster.toml").read_text())
    made = materials([str(tmp_path / "mine.toml"), "plaster"], str(tmp_path / "out"), force=False, reporter=Reporter())
    assert made.fit and len(list((tmp_path / "out").iterdir())) == 2


@pytest.mark.parametrize(
    "spoil",
    [{"scans": None}, {"scans": [{"name": "../../x", "camera": {}}]}, {"turntables": [{"material": "../.."}]}, {"verdict": 3}],
)
def test_a_report_is_made_of_a_whole_job_only_and_of_its_own_folder(spoil, tmp_path):
    facts = {
        "name": "a",
        "camera": {},
        "valid": 1,
        "valid_share": 1.0,
        "width": 1,
        "height": 1,
        "nearest_mm": 1.0,
        "farthest_mm": 1.0,
    }
    content = {
        "stl": None, "scans": [facts | {"spacing_mm": 1.0, "noise_mm": 1.0}], "fit": True, "verdict": {"findings": [], "sentence": "x"}, "area_shares": {},
        "method": "fuse", "reason": "x", "turntables": [], "settings": {"turntable": {}, "solid": {}}, "decisions": [], "versions": {}, "seconds": {}, "inputs": {},
    }  # fmt: skip
    (tmp_path / "run.json").write_text(json.dumps(content))
    report(str(tmp_path), reporter=Reporter())
    (tmp_path / "report.html").unlink()
    (tmp_path / "run.json").write_text(json.dumps(content | spoil))
    with pytest.raises(InputError) as refused:
        report(str(tmp_path), reporter=Reporter())
    assert "\n" not in str(refused.value) and not (tmp_path / "report.html").exists()


def test_no_report_is_made_where_no_job_was_finished(tmp_path):
    with pytest.raises(InputError, match="no finished job"):
        report(str(tmp_path), reporter=Reporter())


def test_jobs_of_two_machines_are_compared_by_the_numbers_in_their_files(tmp_path):
    for name, length, word in (("one", 2.0, "fit"), ("other", 2.0 + 4e-12, "unfit")):
        write_json(tmp_path / name / "a.json", {"lengths_mm": [[8.0, length]], "seconds": length})
        write_json(tmp_path / name / "b.json", {"verdict": word, "key": word})
        (tmp_path / name / "same.txt").write_text("as ever")
        np.savez(
            tmp_path / name / "c.npz", distance=np.array([length, np.nan, 4.0]), text=np.array(json.dumps({"seconds": length}))
        )
    (tmp_path / "one" / "lost.txt").write_text("there")
    found = {one.file: one.relative for one in differences(tmp_path / "one", tmp_path / "other")}
    assert found.pop("a.json") == pytest.approx(4e-12 / 8, rel=1e-3)
    assert found.pop("c.npz") == pytest.approx(1e-12, rel=1e-3)
    assert found == {"b.json": math.inf, "lost.txt": math.inf}
