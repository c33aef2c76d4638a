"""Files as people hand them over: written on other systems, packed, linked to nothing, without the grid that a method needs."""

import gzip
import os

import numpy as np
import pytest
from rangecheck_cli.main import exit_status

from rangecheck.errors import InputError, ScanError
from rangecheck.optics import PinholeCamera
from rangecheck.scan import RangeScan
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.scan.readers import read_measured, read_scans, write_npz, write_pcd, write_ptx
from rangecheck.surface.meshing import mesh_scans

CAMERA = PinholeCamera(8, 6, 10.0, 10.0, 3.5, 2.5)
PLY_HEAD = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


def scan(name="a"):
    ranges = np.linspace(400, 500, 48, dtype=np.float32).reshape(6, 8)
    ranges[0, 0] = np.nan
    return RangeScan(ranges, CAMERA, name=name)


@pytest.mark.parametrize("text", ["1 2 3\n4 5 6\n7 8 9\n", "x y z\n1 2 3\n4 5 6\n7 8 9\n"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_every_point_of_a_list_counts_whatever_system_wrote_it(tmp_path, text, end, mark):
    (tmp_path / "a.xyz").write_bytes((mark + text.replace("\n", end)).encode())
    (cloud,) = read_measured(tmp_path / "a.xyz", "mm")
    assert np.array_equal(cloud.points_mm, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_a_ptx_is_the_same_scan_whatever_system_wrote_it(tmp_path, end, mark):
    write_ptx(tmp_path / "a.ptx", scan())
    text = (tmp_path / "a.ptx").read_text()
    (tmp_path / "b.ptx").write_bytes((mark + text.replace("\n", end)).encode())
    (a,), (b,) = read_scans(tmp_path / "a.ptx"), read_scans(tmp_path / "b.ptx")
    assert np.array_equal(a.points_mm(), b.points_mm()) and a.valid.sum() == 47


def test_a_placement_list_may_begin_with_a_byte_order_mark(tmp_path, sample_data):
    vertices = "0 0 0\n1 0 0\n"
    grid = PLY_HEAD.format(2).replace("end_header\n", "element range_grid 2\nproperty list uchar int v\nend_header\n")
    grid = grid.replace("format ascii 1.0\n", "format ascii 1.0\nobj_info num_cols 2\nobj_info num_rows 1\n")
    (tmp_path / "a.ply").write_text(grid + vertices + "1 0\n1 1\n")
    (tmp_path / "a.conf").write_bytes("\ufeffbmesh a.ply 0 0 0 0 0 0 1\r\n".encode())
    assert len(read_scans(tmp_path, "mm")) == 1


def test_a_folder_with_a_packed_scan_is_not_read_without_it(tmp_path):
    write_npz(tmp_path / "a.npz", scan())
    (tmp_path / "b.npz.gz").write_bytes(gzip.compress((tmp_path / "a.npz").read_bytes()))
    with pytest.raises(InputError, match=r"b\.npz\.gz: is packed \(\.gz\); unpack it"):
        read_scans(tmp_path)
    with pytest.raises(InputError, match=r"is packed \(\.gz\); unpack it and name"):
        read_scans(tmp_path / "b.npz.gz")


def test_a_folder_with_a_link_to_nothing_is_not_read_without_it(tmp_path):
    write_npz(tmp_path / "a.npz", scan())
    (tmp_path / "good.npz").symlink_to(tmp_path / "a.npz")
    assert len(read_scans(tmp_path)) == 2
    (tmp_path / "b.npz").symlink_to(tmp_path / "gone.npz")
    with pytest.raises(InputError, match=r"b\.npz: is a link to nothing"):
        read_scans(tmp_path)


def test_a_pipe_is_refused_instead_of_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.npz")
    with pytest.raises(InputError, match="is a pipe"):
        read_scans(tmp_path / "a.npz")


def test_a_folder_of_folders_names_them(tmp_path):
    (tmp_path / "left ear").mkdir()
    write_npz(tmp_path / "left ear" / "a.npz", scan())
    with pytest.raises(InputError, match=r"one by one \(left ear\)"):
        read_scans(tmp_path)


@pytest.mark.parametrize("method", ["grid", "fuse"])
def test_a_cloud_is_refused_by_methods_that_need_a_grid_with_the_reason(method):
    cloud = PointCloud(np.random.default_rng(1).random((50, 3)), name="attic")
    with pytest.raises(ScanError, match=f"attic is 50 points without a grid.*{method} needs both; use poisson or pivot"):
        mesh_scans([cloud], method)
    with pytest.raises(ScanError, match="attic is 50 points"):
        mesh_scans([scan(), cloud], method)


def test_check_takes_a_ply_for_what_its_header_announces(tmp_path, capsys):
    points = np.random.default_rng(2).normal(size=(40, 3))
    rows = "".join("{:.4f} {:.4f} {:.4f}\n".format(*p) for p in points)
    (tmp_path / "cloud.ply").write_text(PLY_HEAD.format(40) + rows)
    assert exit_status(["check", str(tmp_path / "cloud.ply"), "--unit", "mm", "-q"]) == 0
    assert "1 readable point cloud\n" in capsys.readouterr().out


def test_too_few_distances_are_told_with_the_name_of_the_file(tmp_path, capsys):
    ranges = np.full((6, 8), np.nan, np.float32)
    ranges[2, 3] = 500
    (tmp_path / "köpfe 1").mkdir()
    write_npz(tmp_path / "köpfe 1" / "b.npz", RangeScan(ranges, CAMERA, name="lonely"))
    write_pcd(tmp_path / "b.pcd", RangeScan(ranges, CAMERA))
    for path in (tmp_path / "köpfe 1" / "b.npz", tmp_path / "b.pcd"):
        assert exit_status(["mesh", str(path), "-o", str(tmp_path / "out.ply"), "-q"]) == 2
        said = capsys.readouterr().err.strip()
        assert str(path) in said and "1 of 48 cells hold a distance" in said and "\n" not in said
    assert not (tmp_path / "out.ply").exists()


def test_a_cloud_in_obj_is_checked_as_a_cloud_and_a_mesh_in_obj_as_a_mesh(tmp_path, capsys):
    points = "".join(f"v {x} {y} {x * y / 9}\n" for x in range(6) for y in range(6))
    (tmp_path / "cloud.obj").write_text(points)
    assert exit_status(["check", str(tmp_path / "cloud.obj"), "--unit", "mm", "-q"]) in (0, 1)
    assert "1 readable point cloud" in capsys.readouterr().out
    (tmp_path / "mesh.obj").write_text(points + "f 1 2 7\n")
    assert exit_status(["check", str(tmp_path / "mesh.obj"), "--unit", "mm", "-q"]) == 1
    assert "open-edges" in capsys.readouterr().out


@pytest.mark.engines
def test_too_few_points_are_refused_under_the_name_of_what_holds_them(tmp_path, capsys):
    (tmp_path / "mostly-nan.obj").write_text("v 1 2 3\nv 2 3 4\n" + 300 * "v nan nan nan\n")
    line = ["mesh", str(tmp_path / "mostly-nan.obj"), "--unit", "mm", "-o", str(tmp_path / "a.ply"), "-q"]
    assert exit_status(line) == 2
    assert "mostly-nan: 2 samples; at least 16 are needed: scan it again" in capsys.readouterr().err
    (tmp_path / "all-nan.obj").write_text(300 * "v nan nan nan\n")
    with pytest.raises(InputError, match=r"all-nan\.obj: holds no point: none is finite; check how it was exported"):
        read_measured(tmp_path / "all-nan.obj", "mm")
