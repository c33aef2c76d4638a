"""TIFF, EXR, PFM, PCD, PTX, E57, range maps, Cyberware echo and plain lists: what each file says is what the scan holds."""

import struct

import numpy as np
import pytest

from rangecheck.errors import InputError, OutputError, UnitMissing
from rangecheck.optics import CylindricalCamera, OrthographicCamera, PinholeCamera, RayGrid
from rangecheck.rigid import about_axis, move_points
from rangecheck.scan import RangeScan
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.scan.readers import read_measured, read_scans, write_pcd, write_ptx
from rangecheck.scan.readers.depth_exr import read_exr
from rangecheck.scan.readers.depth_tiff import read_tiff
from rangecheck.scan.readers.e57 import _table, first_wrong_page, unpack_bits
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


# --- E57


def crc_pages(logical, page=1024):
    """`logical` in pages with CRC-32C, computed bit by bit."""
    out = b""
    for start in range(0, len(logical), page - 4):
        part = logical[start : start + page - 4].ljust(page - 4, b"\0")
        crc = 0xFFFFFFFF
        for byte in part:
            crc ^= byte
            for _ in range(8):
                crc = (crc >> 1) ^ (0x82F63B78 if crc & 1 else 0)
        out += part + struct.pack(">I", crc ^ 0xFFFFFFFF)
    return out


def e57(fields, records, pose="", limits=""):
    """A file of one scan; fields: (xml attributes, stream bytes) by name."""
    streams = [stream for _, stream in fields.values()]
    packet_size = -(-(6 + 2 * len(streams) + sum(map(len, streams))) // 4) * 4
    packet = struct.pack("<BBHH", 1, 0, packet_size - 1, len(streams)) + struct.pack(f"<{len(streams)}H", *map(len, streams))
    packet = (packet + b"".join(streams)).ljust(packet_size, b"\0")
    section = struct.pack("<B7xQQQ", 1, 32 + len(packet), 48 + 32, 0) + packet
    assert 48 + len(section) <= 1020, "offsets below stay within the first page"
    prototype = "".join(f"<{name} {attributes}/>" for name, (attributes, _) in fields.items())
    xml = (
        '<?xml version="1.0"?><e57Root xmlns="http://www.astm.org/COMMIT/E57/2010-e57-v1.0"><data3D><vectorChild type="Structure">'
        f'<name>s</name>{pose}{limits}<points type="CompressedVector" fileOffset="48" recordCount="{records}">'
        f"<prototype>{prototype}</prototype></points></vectorChild></data3D></e57Root>"
    ).encode()
    place = 48 + len(section)
    total = -(-(place + len(xml)) // 1020) * 1024
    header = struct.pack("<8sIIQQQQ", b"ASTM-E57", 1, 0, total, place, len(xml), 1024)
    return crc_pages(header + section + xml)


def bits(values, width):
    number = sum(int(v) << (width * k) for k, v in enumerate(values))
    return number.to_bytes(-(-width * len(values) // 8), "little")


def grid_e57(**changes):
    x, y, z = np.array([[2.0, 2, 2, 2, 2], [0.1, 0, 0.1, 0, 0.05], [0.1, 0.1, 0, 0, 0]])
    fields = {
        "cartesianX": ('type="Float" precision="single"', x.astype("<f4").tobytes()),
        "cartesianY": ('type="Float"', y.astype("<f8").tobytes()),
        "cartesianZ": ('type="ScaledInteger" minimum="-500" maximum="523" scale="0.001"', bits(np.rint(z * 1000) + 500, 10)),
        "rowIndex": ('type="Integer" minimum="0" maximum="1"', bits([0, 0, 1, 1, 1], 1)),
        "columnIndex": ('type="Integer" minimum="0" maximum="1"', bits([0, 1, 0, 1, 1], 1)),
        "cartesianInvalidState": ('type="Integer" minimum="0" maximum="2"', bits([0, 0, 0, 0, 2], 2)),
        "intensity": ('type="Integer" minimum="7" maximum="7"', b""),
    } | changes
    pose = "<pose><rotation><w>0</w><x>0</x><y>0</y><z>1</z></rotation><translation><x>1</x></translation></pose>"
    return e57(fields, 5, pose)


def test_an_e57_with_indices_is_a_grid_in_metres_at_its_pose(tmp_path):
    (tmp_path / "a.e57").write_bytes(grid_e57())
    (scan,) = read_scans(tmp_path / "a.e57")
    assert scan.range_mm.shape == (2, 2) and scan.valid.all() and scan.unit == "m" and scan.name == "s"
    # half a turn about z, then one metre along x
    told = [[-1000, -100, 100], [-1000, 0, 100], [-1000, -100, 0], [-1000, 0, 0]]
    assert np.allclose(sorted(scan.points_mm().round(3).tolist()), sorted(told), atol=1e-3)


def test_an_e57_without_indices_is_a_cloud(tmp_path):
    (tmp_path / "a.e57").write_bytes(grid_e57(rowIndex=('type="String"', b""), columnIndex=('type="String"', b"")))
    (cloud,) = read_measured(tmp_path / "a.e57")
    assert isinstance(cloud, PointCloud) and len(cloud.points_mm) == 4


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda b: b[:-1024], "copy it again"),
        (lambda b: b[:100] + bytes([b[100] ^ 1]) + b[101:], "page 0 of . has a wrong checksum"),
        (lambda b: b[:20], "cut short"),
        (lambda b: repage(b, b'recordCount="5"', b'recordCount="9"'), "cut short"),
        (lambda b: repage(b, b'fileOffset="48"', b'fileOffset="99"'), "section of kind"),
        (lambda b: repage(b, b'fileOffset="48"', b'fileOffset="-9"'), "section|cut short|cannot"),
        (lambda b: repage(b, b'minimum="-500"', b'minimum="9999"'), "cartesianZ runs from"),
        (lambda b: repage(b, b"cartesianX", b"cartesianU"), "neither Cartesian nor spherical"),
        (lambda b: repage(b, b"<prototype>", b"<prototypo>"), "XML is damaged"),
        (lambda b: repage(b, b'<?xml version="1.0"?>', b"<!DOCTYPE e57Root   >"), "declares entities"),
        (lambda b: repage(b, b"<w>0</w><x>0</x><y>0</y><z>1</z>", b"<w>0</w><x>0</x><y>0</y><z>0</z>"), "no rigid motion"),
    ],
)
def test_a_damaged_e57_is_refused(tmp_path, change, message):
    (tmp_path / "a.e57").write_bytes(change(grid_e57()))
    with pytest.raises(InputError, match=message):
        read_scans(tmp_path / "a.e57")


def repage(content, old, new):
    """Change the content and put the checksums right again."""
    logical = b"".join(content[k : k + 1020] for k in range(0, len(content), 1024))
    assert old in logical and len(old) == len(new)
    return crc_pages(logical.replace(old, new))


def test_bits_of_every_width_are_unpacked():
    random = np.random.default_rng(0)
    for width in (1, 3, 7, 8, 13, 31, 32, 47, 63, 64):
        values = (
            random.integers(0, 2**width, 17, dtype=np.uint64, endpoint=False)
            if width < 64
            else random.integers(0, 2**63, 17, np.uint64)
        )
        found = unpack_bits(np.frombuffer(bits(values, width), np.uint8), width, 17)
        assert (found == values).all()


def test_the_checksum_of_a_known_page_is_known():
    # CRC-32C of "123456789" is E3069283 (RFC 3720, Castagnoli)
    page = np.frombuffer(b"123456789" + bytes.fromhex("E3069283"), np.uint8)
    assert first_wrong_page(page, 13, _table()) == -1


# --- range maps, Cyberware, plain lists


def range_map(scan, **changes):
    """PLY with the scan's points, a camera element and triangles."""
    world, camera, pose = scan.points_mm(), scan.camera, scan.world_from_scan
    axes = (pose[:3, :3] * [1, -1, -1]).T
    values = dict(zip(("view_px", "view_py", "view_pz"), pose[:3, 3]))
    values |= {f"{a}_axis{b}": axes["xyz".index(a), "xyz".index(b)] for a in "xyz" for b in "xyz"}
    values |= {"focal": 1.0, "scalex": 1 / camera.fx, "scaley": 1 / camera.fy, "centerx": camera.cx}
    values |= {"centery": camera.height - 1 - camera.cy, "viewportx": camera.width, "viewporty": camera.height} | changes
    header = ["ply", "format binary_little_endian 1.0", "element camera 1", *(f"property double {n}" for n in values)]
    header += [f"element vertex {len(world)}", *(f"property double {a}" for a in "xyz")]
    header += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    body = struct.pack(f"<{len(values)}d", *values.values()) + world.astype("<f8").tobytes() + struct.pack("<Biii", 3, 0, 1, 2)
    return "\n".join(header).encode() + body


@pytest.mark.parametrize("shift", [0.0, 0.5], ids=["centres", "corners"])
def test_a_triangulated_range_map_is_seen_by_its_camera_again(tmp_path, shift):
    scan = some_scan()
    content = range_map(scan, centerx=CAMERA.cx + shift, centery=CAMERA.height - 1 - CAMERA.cy + shift)
    (tmp_path / "a.ply").write_bytes(content)
    (back,) = read_scans(tmp_path / "a.ply", "mm")
    assert (back.valid == scan.valid).all()
    assert np.abs(back.points_mm() - scan.points_mm()).max() < 1e-4


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"viewportx": 0}, "at least one"),
        ({"viewportx": 1e9}, "at least one|at most"),
        ({"focal": 0}, "focal length or a scale of 0"),
        ({"x_axisx": 3.0}, "no pose"),
        ({"view_px": np.nan}, "no pose"),
        ({"focal": 0.1}, "share a cell"),
        ({"centerx": 1e6}, "sees none"),
        ({"k1": 0.1}, "lens distortion"),
    ],
)
def test_a_range_map_that_its_camera_did_not_see_is_refused(tmp_path, changes, message):
    (tmp_path / "a.ply").write_bytes(range_map(some_scan(), **changes))
    with pytest.raises(InputError, match=message):
        read_scans(tmp_path / "a.ply", "mm")


def cyberware(radii, head=""):
    """radii (latitudes, longitudes) as raw 16-bit values, latitude 0 at the bottom."""
    nlt, nlg = radii.shape
    text = f"Cyberware Digitizer Data\nNAME=head\nSPACE=CYLINDRICAL\nNLG={nlg}\nLGINCR=12272\nNLT={nlt}\nLTINCR=700\nRSHIFT=3\n{head}DATA=\n"
    return text.encode() + radii.T.astype(">i2").tobytes()


def test_a_cyberware_head_stands_upright_and_turns_right_handedly(tmp_path):
    radii = np.full((4, 512), 10000)
    radii[3, 0], radii[0, 128], radii[1, 5] = 12000, 11000, -0x8000
    (tmp_path / "a.cyb").write_bytes(cyberware(radii, "THETA_RIGHTHAND=TRUE\n"))
    (scan,) = read_scans(tmp_path / "a.cyb")
    assert isinstance(scan.camera, CylindricalCamera) and scan.valid.sum() == 4 * 512 - 1 and scan.unit == "um"
    x, y, z = scan.grid_points_mm[0, 0]
    assert np.allclose([x, y, z], [0, -3 * 0.7, 96], atol=1e-3), "the top latitude, ahead"
    x, y, z = scan.grid_points_mm[3, 128]
    # a quarter turn, right-handed about up (-y): from +z towards -x here, where y points down
    assert np.allclose([x, y, z], [-88, 0, 0], atol=0.02)
    (tmp_path / "a.cyb").write_bytes(cyberware(radii))
    assert np.allclose(read_scans(tmp_path / "a.cyb")[0].grid_points_mm[3, 128], [88, 0, 0], atol=0.02)


def test_a_cyberware_stage_measures_heights(tmp_path):
    content = cyberware(np.array([[100, 200, 300], [-100, 500, 600]])).replace(b"CYLINDRICAL", b"CARTESIAN")
    (tmp_path / "a.cyb").write_bytes(content)
    (scan,) = read_scans(tmp_path / "a.cyb")
    assert np.allclose(scan.points_mm()[:, 2], -np.array([-0.8, 4, 4.8, 0.8, 1.6, 2.4]), atol=1e-5)


@pytest.mark.parametrize(
    "change, message",
    [
        ((b"NLT=4", b"NLT=5"), "cut short"),
        ((b"NLT=4", b"NLT=x"), "a whole number is needed"),
        ((b"NLG=512", b"NLG=99999999"), "at most"),
        ((b"LTINCR=700", b"LTINCR=0"), "steps are positive"),
        ((b"LGINCR=12272", b"LGINCR=912272"), "describes no scanner"),
        ((b"DATA=", b"DATE="), "does not end with"),
        ((b"CYLINDRICAL", b"BILATERAL"), "CYLINDRICAL and CARTESIAN"),
        ((b"RSHIFT=3", b"RSHIFT=3\nINSIDE_OUT=TRUE"), "inside out"),
    ],
)
def test_a_damaged_cyberware_file_is_refused(tmp_path, change, message):
    (tmp_path / "a.cyb").write_bytes(cyberware(np.full((4, 512), 10000)).replace(*change))
    with pytest.raises(InputError, match=message):
        read_scans(tmp_path / "a.cyb")


@pytest.mark.parametrize(
    "text",
    [
        "1.5 2 3\n4 5 6.25\n",
        "x y z\r\n1.5 2 3\r\n4 5 6.25\r\n",
        "1,5;2;3\n4;5;6,25\n",
        "1,5\t2\t3\n4\t5\t6,25",
        "# by us\n1.5, 2, 3\n4, 5, 6.25\n",
        "1.5,2,3\n\n4,5,6.25\n",
    ],
)
def test_lists_of_points_are_read_in_every_locale(tmp_path, text):
    (tmp_path / "a.xyz").write_text(text, newline="")
    (cloud,) = read_measured(tmp_path / "a.xyz", "cm")
    assert np.allclose(cloud.points_mm, [[15, 20, 30], [40, 50, 62.5]])


def test_unit_vectors_after_the_points_are_normals(tmp_path):
    (tmp_path / "a.csv").write_text("1 2 3 0 0 1\n4 5 6 0.6 0.8 0\n")
    (cloud,) = read_measured(tmp_path / "a.csv", "mm")
    assert np.allclose(cloud.normals, [[0, 0, 1], [0.6, 0.8, 0]])
    (tmp_path / "a.csv").write_text("1 2 3 255 0 1\n4 5 6 0 8 0\n")
    assert read_measured(tmp_path / "a.csv", "mm")[0].normals is None


@pytest.mark.parametrize(
    "text, message",
    [
        ("1 2\n3 4\n", "a point needs x y z"),
        ("1 2 3\n4 5\n", "line 2 holds 2 numbers"),
        ("1 2 3\n4 5 six\n", "line 2 holds b'six'"),
        ("1.234,5 2.345,6 3.456,7\n", "mixes commas"),
        ("nan nan nan\n", "none is finite"),
        ("hello\nworld\n", "no line of numbers"),
        ("1 2 3\0\n", "is not a text file"),
    ],
)
def test_a_damaged_list_of_points_is_refused(tmp_path, text, message):
    (tmp_path / "a.xyz").write_text(text)
    with pytest.raises(InputError, match=message):
        read_measured(tmp_path / "a.xyz", "mm")


def test_a_mesh_is_no_measurement_and_bare_vertices_are_a_cloud(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    body = "0 0 0\n1 0 0\n0 1 0\n"
    (tmp_path / "a.ply").write_text(head + "end_header\n" + body)
    assert len(read_measured(tmp_path / "a.ply", "mm")[0].points_mm) == 3
    (tmp_path / "a.ply").write_text(head + "element face 1\nproperty list uchar int v\nend_header\n" + body + "3 0 1 2\n")
    with pytest.raises(InputError, match="is a mesh"):
        read_measured(tmp_path / "a.ply", "mm")


# --- scans that nobody here made


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


@pytest.mark.real_data
def test_the_good_e57_is_read_as_another_library_reads_it_and_the_bad_one_refused(real_data):
    path = real_data / "e57" / "reference_bunnyInt32.e57"
    (cloud,) = read_measured(path)
    assert cloud.points_mm.shape == (30571, 3)
    pye57 = pytest.importorskip("pye57")
    other = pye57.E57(str(path)).read_scan_raw(0)
    assert (cloud.points_mm == 1000 * np.stack([other[f"cartesian{axis}"] for axis in "XYZ"], axis=1)).all()
    with pytest.raises(InputError, match="page 0 of 1 has a wrong checksum"):
        read_measured(real_data / "e57" / "self_bad-crc.e57")
