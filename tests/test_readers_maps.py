"""Range maps with their camera, Cyberware echo files and plain lists of points."""

import struct

import numpy as np
import pytest
from test_readers_formats import CAMERA, some_scan

from rangecheck.errors import InputError
from rangecheck.optics import CylindricalCamera
from rangecheck.scan.readers import read_measured, read_scans


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


@pytest.mark.parametrize("count", ["124³", "9" * 5000, "-3", "0x10", "1_0"])
def test_a_count_that_is_no_whole_number_is_refused(tmp_path, count):
    (tmp_path / "a.cyb").write_bytes(cyberware(np.full((4, 512), 10000)).replace(b"NLT=4", f"NLT=--{count}".encode("latin-1")))
    with pytest.raises(InputError, match="a whole number is needed"):
        read_scans(tmp_path / "a.cyb")
    head = f"ply\nformat ascii 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n"
    (tmp_path / "a.ply").write_bytes(head.encode("latin-1"))
    with pytest.raises(InputError, match="line 3 of its header"):
        read_measured(tmp_path / "a.ply", "mm")


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
