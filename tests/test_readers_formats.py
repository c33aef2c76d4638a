"""TIFF, EXR, PFM, PCD and PTX: what each file says is what the scan holds."""

import numpy as np
import pytest

from rangecheck.errors import InputError, OutputError, UnitMissing
from rangecheck.optics import OrthographicCamera, PinholeCamera, RayGrid
from rangecheck.rigid import about_axis, move_points
from rangecheck.scan import RangeScan
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.scan.readers import read_measured, read_scans, write_pcd, write_ptx
from rangecheck.scan.readers.depth_exr import read_exr
from rangecheck.scan.readers.depth_tiff import read_tiff
from rangecheck.scan.readers.lzf import pack, unpack

CAMERA = PinholeCamera(24, 18, 30.0, 31.0, 11.0, 9.5)


def some_scan(camera=CAMERA, seed=0):
    random = np.random.default_rng(seed)
    ranges = random.uniform(400, 600, (camera.height, camera.width)).astype(np.float32)
    ranges[random.random(ranges.shape) < 0.3] = np.nan
    pose = about_axis((1, 2, 3), 0.7)
    pose[:3, 3] = 10, -20, 30
    return RangeScan(ranges, camera, pose, random.random(ranges.shape), "x")


def turning_scan():
    """A scanner that turns all around, with jittered angles."""
    random = np.random.default_rng(4)
    azimuth = np.linspace(-np.pi, np.pi, 40, endpoint=False)[None, :] + random.normal(0, 1e-3, (16, 40))
    down = np.linspace(-0.9, 0.6, 16)[:, None] + random.normal(0, 1e-3, (16, 40))
    directions = np.stack([np.cos(down) * np.sin(azimuth), np.sin(down), np.cos(down) * np.cos(azimuth)], axis=-1)
    return some_scan(RayGrid(40, 16, np.zeros((16, 40, 3)), directions))


# --- pictures of floats


def picture(tmp_path, values, ending):
    """A float picture with its camera beside it."""
    import json

    path = tmp_path / f"x{ending}"
    if ending == ".pfm":
        height, width = values.shape
        path.write_bytes(f"Pf\n{width} {height}\n-1.0\n".encode() + values[::-1].astype("<f4").tobytes())
    elif ending == ".exr":
        OpenEXR = pytest.importorskip("OpenEXR")
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Z": np.ascontiguousarray(values, np.float32)}).write(str(path))
    else:
        from PIL import Image

        Image.fromarray(values).save(path, compression="tiff_deflate")
    entry = {"unit": "m", "measures": "depth", "camera": CAMERA.to_dict()} | ({"step": 0.001} if values.dtype.kind == "u" else {})
    (tmp_path / "x.json").write_text(json.dumps(entry))
    return path


@pytest.mark.parametrize("ending", [".pfm", ".exr", ".tif", ".tiff"])
def test_float_pictures_hold_depths_in_their_unit(tmp_path, ending):
    depth = np.random.default_rng(0).uniform(0.4, 0.6, (18, 24)).astype(np.float32)
    depth[2, 3], depth[4, 5], depth[6, 7], depth[8, 9] = np.nan, 0, -1, np.inf
    (scan,) = read_scans(picture(tmp_path, depth, ending))
    good = np.isfinite(depth) & (depth > 0)
    assert (scan.valid == good).all()
    assert np.allclose(scan.depth_mm[good], 1000 * depth[good], rtol=3e-7)


def test_a_16_bit_tiff_holds_counts(tmp_path):
    counts = np.random.default_rng(0).integers(0, 2**16, (18, 24)).astype(np.uint16)
    (scan,) = read_scans(picture(tmp_path, counts, ".tif"))
    assert np.allclose(scan.depth_mm[counts > 0], counts[counts > 0], rtol=3e-7) and not scan.valid[counts == 0].any()


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw", "tiff_deflate"])
@pytest.mark.parametrize("predictor", [1, 2, 3])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_tiff_strips_are_unpacked_as_they_were_packed(tmp_path, compression, predictor, kind):
    if (compression == "raw" and predictor > 1) or (predictor == 3 and kind is not np.float32):
        return  # TIFF has no such file
    from PIL import Image

    values = (np.add.outer(np.arange(70) * 3, np.arange(90) // 2) + np.random.default_rng(0).integers(0, 3, (70, 90))).astype(
        kind
    )
    Image.fromarray(values).save(tmp_path / "a.tif", compression=compression, tiffinfo={317: predictor})
    assert (read_tiff(tmp_path / "a.tif") == values).all()


@pytest.mark.parametrize("how", ["NO", "ZIPS", "ZIP"])
@pytest.mark.parametrize("size", [(1, 1), (33, 7), (16, 20)])
def test_exr_lines_are_unpacked_as_they_were_packed(tmp_path, how, size):
    OpenEXR = pytest.importorskip("OpenEXR")
    random = np.random.default_rng(0)
    channels = {"A": random.random(size).astype(np.float16), "Z": random.random(size).astype(np.float32)}
    channels["b"] = np.arange(size[0] * size[1], dtype=np.uint32).reshape(size)
    header = {"compression": getattr(OpenEXR, f"{how}_COMPRESSION"), "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, dict(channels)).write(str(tmp_path / "a.exr"))
    assert (read_exr(tmp_path / "a.exr") == channels["Z"]).all()


def test_an_exr_compressed_otherwise_says_how_to_save_it(tmp_path):
    OpenEXR = pytest.importorskip("OpenEXR")
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Z": np.ones((4, 5), np.float32)}).write(str(tmp_path / "a.exr"))
    with pytest.raises(InputError, match="compressed by PIZ"):
        read_exr(tmp_path / "a.exr")


@pytest.mark.parametrize("ending", [".pfm", ".exr", ".tif"])
def test_float_pictures_that_are_cut_short_or_lie_are_refused(tmp_path, ending):
    path = picture(tmp_path, np.full((18, 24), 0.5, np.float32), ending)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 2 // 3])
    with pytest.raises(InputError):
        read_scans(path)
    path.write_bytes(content[:6] + b"junk" * 20)
    with pytest.raises(InputError):
        read_scans(path)
    if ending == ".pfm":
        path.write_bytes(content.replace(b"24 18", b"60000 60000"))
        with pytest.raises(InputError, match="at most"):
            read_scans(path)


# --- PCD


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("make", [some_scan, turning_scan], ids=["pinhole", "own rays"])
def test_pcd_gives_back_points_brightness_and_pose(tmp_path, kind, make):
    scan = make()
    write_pcd(tmp_path / "a.pcd", scan, kind=kind)
    (back,) = read_scans(tmp_path / "a.pcd")
    assert (back.valid == scan.valid).all() and (back.brightness == scan.brightness).all() and back.unit == "mm"
    assert np.abs(back.points_mm() - scan.points_mm()).max() < 1e-9
    assert isinstance(back.camera, type(scan.camera))
    assert (back.range_mm[back.valid] == scan.range_mm[scan.valid]).all()


def test_projecting_into_rays_all_around_finds_the_cells(tmp_path):
    write_pcd(tmp_path / "a.pcd", turning_scan())
    (scan,) = read_scans(tmp_path / "a.pcd")
    uv, _ = scan.camera.project(scan.grid_points_mm[scan.valid])
    rows, columns = np.nonzero(scan.valid)
    assert np.abs(uv - np.stack([columns, rows], axis=1)).max() < 1e-3


PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA ascii\n"


def test_pcd_with_crlf_and_decimal_commas_is_read_and_asks_for_its_unit(tmp_path):
    body = "0,1 0,2 1,5\nnan nan nan\n0,1 0,3 1,5\n0,2 0,3 1,5\n"
    (tmp_path / "a.pcd").write_bytes((PCD + body).replace("\n", "\r\n").encode())
    with pytest.raises(UnitMissing):
        read_scans(tmp_path / "a.pcd")
    (scan,) = read_scans(tmp_path / "a.pcd", "m")
    assert np.allclose(scan.points_mm(), [[100, 200, 1500], [100, 300, 1500], [200, 300, 1500]])


def test_an_unorganised_pcd_is_a_cloud_and_no_scan(tmp_path):
    text = PCD.replace("WIDTH 2", "WIDTH 4").replace("HEIGHT 2", "HEIGHT 1").replace("0 0 0 1 0 0 0", "1 0 0 1 0 0 0")
    (tmp_path / "a.pcd").write_text(text + "1 2 3\n4 5 6\nnan nan nan\n7 8 9\n")
    (cloud,) = read_measured(tmp_path / "a.pcd", "cm")
    assert isinstance(cloud, PointCloud) and np.allclose(cloud.points_mm, [[20, 20, 30], [50, 50, 60], [80, 80, 90]])
    with pytest.raises(InputError, match=r"3 points without a grid .* \(poisson\)"):
        read_scans(tmp_path / "a.pcd", "cm")


@pytest.mark.parametrize(
    "change, message",
    [
        (("POINTS 4", "POINTS 5"), "2 x 2 cells and 5 points"),
        (("WIDTH 2", "WIDTH 999999999"), "at most"),
        (("WIDTH 2", "WIDTH two"), "must be a whole number"),
        (("TYPE F F F", "TYPE F F"), "differ in length"),
        (("SIZE 4 4 4", "SIZE 4 4 3"), "no such type"),
        (("FIELDS x y z", "FIELDS x y w"), "no field z"),
        (("DATA ascii", "DATA morse"), "a known kind of DATA"),
        (("DATA ascii", ""), "no line DATA"),
        (("1 0 0 0\n", "0 0 0 0\n"), "VIEWPOINT is no pose"),
        (("1 2 3\n", "1.0 2\n"), "line 11 holds 2 numbers"),
        (("9 9 9\n", ""), "cut short"),
        (("9 9 9\n", "9 9 9\n1 1 1\n"), "more than the 4 points"),
        (("9 9 9\n", "9 9 nine\n"), "line 14 holds b'nine'"),
    ],
)
def test_a_damaged_pcd_is_refused(tmp_path, change, message):
    text = (PCD + "1 2 3\n4 5 6\n7 8 9\n9 9 9\n").replace(*change)
    (tmp_path / "a.pcd").write_text(text)
    with pytest.raises(InputError, match=message):
        read_scans(tmp_path / "a.pcd", "m")


def test_packing_is_inverted_and_damage_is_seen():
    random = np.random.default_rng(0)
    for data in (
        b"",
        b"a",
        b"abcabcabcabcabcabc" * 40,
        bytes(5000),
        random.bytes(3000),
        np.repeat(random.bytes(50), 20).tobytes(),
    ):
        flat = np.frombuffer(data, np.uint8)
        packed = pack(flat)
        out = np.empty(len(flat), np.uint8)
        assert unpack(packed, out) == len(flat) and out.tobytes() == data
        for _ in range(20):
            broken = np.frombuffer(random.bytes(40), np.uint8)
            assert unpack(broken, out) <= len(out)
    assert len(pack(np.zeros(5000, np.uint8))) < 100


# --- PTX


@pytest.mark.parametrize("make", [some_scan, turning_scan], ids=["pinhole", "own rays"])
def test_ptx_gives_back_points_ranges_and_pose(tmp_path, make):
    scan = make()
    write_ptx(tmp_path / "a.ptx", [scan, scan])
    first, second = read_scans(tmp_path / "a.ptx")
    assert (first.name, second.name, first.unit) == ("a_1", "a_2", "m")
    assert (first.valid == scan.valid).all() and (first.brightness == scan.brightness).all()
    assert np.abs(first.points_mm() - scan.points_mm()).max() < 1e-9
    assert np.abs(first.range_mm[scan.valid] - scan.range_mm[scan.valid]).max() <= np.spacing(np.float32(600))
    assert np.abs(second.points_mm() - scan.points_mm()).max() < 1e-9


def ptx(matrix=None, points="1 0 0 0.5\n0 0 0 0.5\n1 0.1 0.1 0.5\n1 0 0.1 0.5\n", size="2\n2"):
    matrix = np.eye(4) if matrix is None else matrix
    rows = "\n".join(" ".join(map(str, row)) for row in np.asarray(matrix).T)
    return f"{size}\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n{rows}\n{points}"


def test_a_ptx_matrix_acts_on_row_vectors(tmp_path):
    pose = about_axis((0, 0, 1), 0.5)
    pose[:3, 3] = 7, 8, 9
    (tmp_path / "a.ptx").write_bytes(ptx(pose).replace("\n", "\r\n").encode())
    (scan,) = read_scans(tmp_path / "a.ptx")
    told = 1000 * move_points(pose, np.array([[1, 0, 0], [1, 0.1, 0.1], [1, 0, 0.1]]))
    found = scan.points_mm()
    assert all(np.abs(found - point).max(axis=1).min() < 1e-3 for point in told) and len(found) == 3


@pytest.mark.parametrize(
    "text, message",
    [
        (ptx(np.diag([2.0, 1, 1, 1])), "no rigid motion|not a rigid motion"),
        (ptx(size="2\n20000"), "cut short"),
        (ptx(size="99999\n99999"), "at most"),
        (ptx(size="0\n2"), "at least one"),
        (ptx(size="2.5\n2"), "at least one"),
        (ptx(points="1 2\n"), "its first point has 2 numbers"),
        (ptx(points="1 0 0 0.5\n1 0 0\n1 0.1 0.1 0.5\n1 0 0.1 0.5\n"), "holds 3 numbers"),
        (ptx(points="0 0 0 0\n" * 4), "every cell is `0 0 0`"),
        (ptx(points=""), "ends after its header"),
        ("2\n2\n0 0", "cut short"),
        (ptx() + "7\n", "header of scan 2"),
        ("\0\1\2", "a number is needed"),
    ],
)
def test_a_damaged_ptx_is_refused(tmp_path, text, message):
    (tmp_path / "a.ptx").write_text(text)
    with pytest.raises(InputError, match=message):
        read_scans(tmp_path / "a.ptx")


@pytest.mark.parametrize("write", [write_pcd, write_ptx])
def test_rays_without_a_common_origin_are_not_written_as_if_they_had_one(tmp_path, write):
    with pytest.raises(OutputError, match="write NPZ"):
        write(tmp_path / "a.x", some_scan(OrthographicCamera(24, 18, 0.5, 12, 9)))


@pytest.mark.real_data
def test_the_kinect_and_stereo_clouds_have_their_cameras(real_data):
    folder = real_data / "organised_pcd"
    with pytest.raises(UnitMissing):
        read_scans(folder)
    kinect, stereo = read_scans(folder, "m")
    assert kinect.range_mm.shape == stereo.range_mm.shape == (480, 640)
    assert np.allclose(
        [kinect.camera.fx, kinect.camera.fy, kinect.camera.cx, kinect.camera.cy], [525, 525, 319.5, 239.5], atol=1e-3
    )
    law = stereo.camera.law
    assert np.allclose([1 / law.s[0, 1], 1 / law.s[1, 2]], 964.36, atol=0.05)
    assert np.allclose([-law.s[0, 0] / law.s[0, 1], -law.s[1, 0] / law.s[1, 2]], [319.81, 223.36], atol=0.05)
    assert 0.5 < kinect.valid.mean() < 1 and stereo.brightness is not None
