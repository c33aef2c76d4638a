"""Depth pictures: what is written comes back within half a step, and a bad file is refused in one line that says why."""

import json
import struct
import zlib

import numpy as np
import pytest

from rangecheck.errors import ArrayError, InputError, OutputError, UnitMissing
from rangecheck.optics import CylindricalCamera, OrthographicCamera, PinholeCamera, RayGrid
from rangecheck.rigid import about_axis
from rangecheck.scan import RangeScan
from rangecheck.scan.readers import read_scans, write_scans

PINHOLE = PinholeCamera(40, 30, 50.0, 52.0, 19.0, 14.5, (0.1, -0.05, 1e-3, 2e-3, 0.01))
CAMERAS = [
    PinholeCamera(40, 30, 50.0, 52.0, 19.0, 14.5),
    PINHOLE,
    OrthographicCamera(40, 30, 0.5, 19.0, 14.5),
    CylindricalCamera(40, 30, 900.0, 0.1, 2.0, 14.5),
]


def some_scan(camera=PINHOLE, name="view 0", seed=0):
    random = np.random.default_rng(seed)
    ranges = random.uniform(400, 600, (camera.height, camera.width))
    ranges[random.random(ranges.shape) < 0.3] = np.nan
    pose = about_axis((0, 1, 0), 0.3)
    pose[:3, 3] = 1, 2, 3
    bright = (random.integers(0, 256, ranges.shape) / 255).astype(np.float32)
    return RangeScan(ranges, camera, pose, bright, name, noise_mm=0.2)


def lone(tmp_path, picture=None, **changes):
    """x.png with x.json beside it; returns the PNG's path."""
    write_scans(tmp_path, [some_scan(name="x")], step_mm=0.02, manifest="all.json")
    entry = json.loads((tmp_path / "all.json").read_text())["scans"][0] | {"unit": "mm"} | changes
    (tmp_path / "all.json").unlink()
    (tmp_path / "x.json").write_text(json.dumps({k: v for k, v in entry.items() if v is not None}))
    if picture is not None:
        (tmp_path / "x.png").write_bytes(picture)
    return tmp_path / "x.png"


@pytest.mark.parametrize(
    "camera, measures",
    [(c, m) for c in CAMERAS for m in ("depth", "range") if (c.model, m) != ("cylindrical", "depth")],
    ids=lambda value: value if isinstance(value, str) else f"{value.model} {len(getattr(value, 'distortion', ()))}",
)
def test_distances_come_back_within_half_a_step_and_are_then_written_with_the_same_bytes(tmp_path, camera, measures):
    scan, step = some_scan(camera), 0.02
    path = write_scans(tmp_path / "a", [scan, scan], step_mm=step, measures=measures)
    first, second = read_scans(path)
    assert (first.valid == scan.valid).all()
    distance = (lambda s: s.grid_points_mm[..., 2]) if measures == "depth" else (lambda s: s.range_mm.astype(float))
    assert np.nanmax(np.abs(distance(first) - distance(scan))) <= step / 2 + 2 * np.spacing(np.float32(600))
    assert first.camera == camera and first.name == "view 0" and first.noise_mm == 0.2 and first.unit == "mm"
    assert np.allclose(first.world_from_scan, scan.world_from_scan, rtol=0, atol=1e-12)
    assert (first.brightness == scan.brightness).all()
    write_scans(tmp_path / "b", [first, second], step_mm=step, measures=measures)
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == sorted(p.name for p in (tmp_path / "b").iterdir())
    for p in (tmp_path / "a").glob("*.png"):
        assert p.read_bytes() == (tmp_path / "b" / p.name).read_bytes()


def test_a_scanner_that_turns_has_no_depth_axis(tmp_path):
    with pytest.raises(InputError, match="measure range"):
        write_scans(tmp_path, [some_scan(CAMERAS[-1])], step_mm=0.02, measures="depth")


def test_a_step_in_inches_is_25_4_times_one_in_millimetres(tmp_path):
    mm = read_scans(lone(tmp_path, unit="mm", measures="range"))[0]
    inches = read_scans(lone(tmp_path, unit="in", measures="range"))[0]
    assert inches.unit == "in"
    assert np.allclose(inches.range_mm[mm.valid], 25.4 * mm.range_mm[mm.valid], rtol=1e-6)


def test_a_folder_is_read_through_its_manifest_and_a_lone_picture_through_the_json_beside_it(tmp_path):
    write_scans(tmp_path / "many", [some_scan(name="a"), some_scan(name="b", seed=1)], step_mm=0.02)
    assert [s.name for s in read_scans(tmp_path / "many")] == ["a", "b"]
    (tmp_path / "one").mkdir()
    picture = lone(tmp_path / "one")
    assert (read_scans(picture)[0].valid == read_scans(tmp_path / "one")[0].valid).all()
    assert (read_scans(picture)[0].valid == read_scans(picture.with_suffix(".json"))[0].valid).all()


def test_the_unit_is_asked_for_when_missing_and_a_contradiction_is_refused(tmp_path):
    picture = lone(tmp_path, unit=None)
    with pytest.raises(UnitMissing, match="--unit"):
        read_scans(picture)
    assert read_scans(picture, "cm")[0].unit == "cm"
    with pytest.raises(InputError, match="its unit is mm, and m was asked for"):
        read_scans(lone(tmp_path, unit="mm"), "m")
    with pytest.raises(ArrayError, match="furlong"):
        read_scans(picture, "furlong")


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"camera": None}, "lacks 'camera'"),
        ({"camera": 3}, "camera is int"),
        ({"camera": {"model": "fisheye"}}, "model is 'fisheye'"),
        ({"camera": {"model": "orthographic", "width": 41, "height": 30, "pixel_mm": 1, "cx": 0, "cy": 0}}, "its camera 41 x 30"),
        ({"measures": "disparity"}, "depth .* or range"),
        ({"step": -1}, "step -1; it must be a positive number"),
        ({"step": True}, "positive number"),
        ({"step": None}, "lacks 'step'"),
        ({"noise_mm": "much"}, "noise_mm 'much'"),
        ({"name": 5}, "a name is a string"),
        ({"unit": "furlong"}, "must be one of mm"),
        ({"brigthness": "x.png"}, "unknown entry 'brigthness'"),
        ({"brightness": "../x.png"}, "outside its own folder"),
        ({"brightness": "none.png"}, "does not exist"),
        ({"world_from_scan": [[1, 0], [0, 1]]}, r"shape \(2, 2\)"),
        ({"world_from_scan": np.diag([2.0, 1, 1, 1]).tolist()}, "not a rigid motion"),
        ({"schema": "rangecheck/scans/9"}, "scans are read from"),
        ({"scans": []}, "lists many scans"),
    ],
    ids=str,
)
def test_a_wrong_entry_is_named(tmp_path, changes, message):
    with pytest.raises(InputError, match=message) as caught:
        read_scans(lone(tmp_path, **changes))
    assert "\n" not in str(caught.value)


def test_nan_in_the_camera_is_refused(tmp_path):
    picture = lone(tmp_path)
    text = picture.with_suffix(".json").read_text().replace("50.0", "NaN")
    picture.with_suffix(".json").write_text(text)
    with pytest.raises(InputError, match="NaN is not a JSON number"):
        read_scans(picture)


def header_of(width, height, bits=16, colour=0, data=b""):
    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    "picture, message",
    [
        (b"", "is empty"),
        (b"GIF89a" + bytes(64), "it begins with b'GIF89a"),
        (header_of(60000, 60000), "at most"),
        (header_of(5000, 5000), "is cut short"),
        (header_of(0, 30), "at least one"),
        (header_of(40, 30, colour=2), "is a colour PNG"),
        (header_of(40, 30, data=bytes(100)), "damaged"),
        (header_of(40, 30, data=bytes(30 * 81)), "holds no distance"),
        (header_of(40, 29, data=bytes(29 * 81)), "40 x 29 cells and its camera 40 x 30"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_picture_that_lies_or_is_cut_short_is_refused(tmp_path, picture, message):
    with pytest.raises(InputError, match=message):
        read_scans(lone(tmp_path, picture))


@pytest.mark.parametrize(
    "name", ["/etc/passwd", "../x.png", "a/../../x.png", "C:\\x.png", "..\\x.png", "link/x.png", 7, "", "a\nb"]
)
def test_a_manifest_cannot_name_files_outside_its_folder(tmp_path, name):
    folder = tmp_path / "scans"
    write_scans(folder, [some_scan()], step_mm=0.02)
    write_scans(tmp_path, [some_scan(name="x")], step_mm=0.02)
    (folder / "link").symlink_to(tmp_path)
    document = json.loads((folder / "scans.json").read_text())
    document["scans"][0]["image"] = name
    (folder / "scans.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"outside its own folder|leads out of|a file name is"):
        read_scans(folder)


def test_distances_that_do_not_fit_the_counts_are_not_written(tmp_path):
    with pytest.raises(OutputError, match="choose a step of at least"):
        write_scans(tmp_path, [some_scan()], step_mm=0.001)
    with pytest.raises(OutputError, match="below every depth"):
        write_scans(tmp_path, [some_scan()], step_mm=5000.0)
    grid = np.zeros((2, 2, 3))
    with pytest.raises(OutputError, match="write NPZ"):
        write_scans(tmp_path, [RangeScan(np.ones((2, 2)), RayGrid(2, 2, grid, grid))], step_mm=0.01)
    assert not list(tmp_path.iterdir())


def test_missing_files_and_folders_without_scans_are_named(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_scans(tmp_path / "no.png")
    with pytest.raises(InputError, match="holds no scans"):
        read_scans(tmp_path)
    (tmp_path / "notes.md").write_text("hello")
    with pytest.raises(InputError, match="scans are read from"):
        read_scans(tmp_path / "notes.md")
    write_scans(tmp_path, [some_scan()], step_mm=0.02, manifest="one.json")
    (tmp_path / "two.json").write_text((tmp_path / "one.json").read_text())
    with pytest.raises(InputError, match="2 lists of scans"):
        read_scans(tmp_path)
    (tmp_path / "two.json").unlink()
    (tmp_path / "view_0.json").unlink(missing_ok=True)
    (tmp_path / "one.json").unlink()
    with pytest.raises(InputError, match="has no camera"):
        read_scans(tmp_path / "view_0.png")
