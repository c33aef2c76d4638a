"""Cameras written beside pictures mean the same camera to every program that reads them."""

import numpy as np
import pytest

from rangecheck import rigid
from rangecheck.errors import ArrayError, CameraError, InputError
from rangecheck.export.camera_files import read_camera_json, write_camera_json, write_colmap, write_opencv_yaml
from rangecheck.export.exr import map_channels, radiance_channels, read_exr, write_exr, write_tiff
from rangecheck.optics import CylindricalCamera, OrthographicCamera, PinholeCamera

LENS = PinholeCamera(640, 480, 800.5, 790.25, 318.7, 241.1, (-0.28, 0.11, 0.0007, -0.0011, -0.02))
PLAIN = PinholeCamera.from_field_of_view(320, 200, 40)
POSE = rigid.look_at((200.0, 90.0, -310.0), (3.0, 2.0, 1.0))
POINTS = np.random.default_rng(0).uniform(-40, 40, (50, 3))


def test_a_camera_comes_back_from_its_json_with_what_was_told_beside_it(tmp_path):
    for camera in (LENS, OrthographicCamera(64, 48, 0.7, 30.0, 20.0), CylindricalCamera(64, 48, 150.0, 0.09, 2.0, 20.0)):
        write_camera_json(tmp_path / "c.json", camera, POSE, {"exposure": 0.25})
        again, pose, more = read_camera_json(tmp_path / "c.json")
        assert again == camera and more["exposure"] == 0.25
        np.testing.assert_allclose(pose, POSE, atol=1e-12)


@pytest.mark.parametrize("content", ["[]", "{}", '{"schema": "rangecheck/camera/1", "camera": {"model": "pinhole"}}'])
def test_a_file_that_is_no_camera_is_refused(tmp_path, content):
    (tmp_path / "c.json").write_text(content)
    with pytest.raises((CameraError, InputError)):
        read_camera_json(tmp_path / "c.json")


@pytest.mark.parametrize("camera", [LENS, PLAIN, PinholeCamera(64, 48, 50, 50, 30, 20, (0.1, 0, 0, 0, 0, 0.05))])
def test_opencv_reads_the_yaml_and_projects_as_we_do(tmp_path, camera):
    import cv2

    write_opencv_yaml(tmp_path / "c.yml", camera, POSE)
    file = cv2.FileStorage(str(tmp_path / "c.yml"), cv2.FILE_STORAGE_READ)
    k, d, r, t = (file.getNode(n).mat() for n in ("camera_matrix", "distortion_coefficients", "R", "t"))
    assert int(file.getNode("image_width").real()) == camera.width
    file.release()
    expected = cv2.projectPoints(POINTS, cv2.Rodrigues(r)[0], t, k, d)[0][:, 0]
    found, _ = camera.project(rigid.move_points(rigid.inverse(POSE), POINTS))
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_colmap_text_describes_the_same_projection_half_a_pixel_on(tmp_path):
    full = PinholeCamera(64, 48, 50, 50, 30, 20, (0.1, 0, 0, 0, 0.02))
    barrel = PinholeCamera(64, 48, 50, 50, 30, 20, (0.1, 0.01, 0.002, 0.003))
    cameras, names = [PLAIN, LENS, PLAIN, full, barrel], [f"{k}.png" for k in range(5)]
    poses = [POSE, rigid.about_axis((1, 2, 3), 3.1), rigid.about_axis((0, 1, 0), np.pi), np.eye(4), POSE]
    write_colmap(tmp_path, cameras, poses, names)
    rows = [line.split() for line in (tmp_path / "cameras.txt").read_text().splitlines() if not line.startswith("#")]
    assert [row[1] for row in rows] == ["PINHOLE", "FULL_OPENCV", "FULL_OPENCV", "OPENCV"]
    images = (tmp_path / "images.txt").read_text().split("\n")[1:]
    for k in range(5):
        assert images[2 * k + 1] == ""
        row = images[2 * k].split()
        assert int(row[0]) == k + 1 and row[9] == names[k]
        w, x, y, z, *t = (float(n) for n in row[1:8])
        np.testing.assert_allclose(rigid.rotation_from_quaternion((x, y, z, w)), poses[k][:3, :3].T, atol=1e-12)
        np.testing.assert_allclose(t, rigid.inverse(poses[k])[:3, 3], atol=1e-9)
        numbers = [float(n) for n in rows[int(row[8]) - 1][2:]]
        camera = cameras[k]
        assert numbers[:6] == [camera.width, camera.height, camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
        assert tuple(numbers[6 : 6 + len(camera.distortion)]) == camera.distortion
    with pytest.raises(CameraError, match="pinhole cameras only"):
        write_colmap(tmp_path, [OrthographicCamera(6, 4, 1.0, 3, 2)], [POSE], ["a.png"])
    with pytest.raises(ArrayError, match="one each"):
        write_colmap(tmp_path, [PLAIN], [], ["a.png"])
    with pytest.raises(ArrayError, match="spaces"):
        write_colmap(tmp_path, [PLAIN], [POSE], ["a b.png"])


def test_quaternions_and_rotations_are_each_others_inverse():
    rng = np.random.default_rng(4)
    for angle in (0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi):
        for axis in (*np.eye(3), *rng.normal(size=(20, 3))):
            rotation = rigid.about_axis(axis, angle)[:3, :3]
            quaternion = rigid.quaternion_from_rotation(rotation)
            assert quaternion[3] >= 0
            np.testing.assert_allclose(rigid.rotation_from_quaternion(quaternion), rotation, atol=1e-14)


def test_exr_and_tiff_keep_floats_integers_and_nan(tmp_path):
    pytest.importorskip("OpenEXR", reason="the optional package OpenEXR is not installed")
    from PIL import Image
    from test_maps import CAMERA, ball

    from rangecheck.maps import trace_maps

    maps = trace_maps(ball(subdivisions=2), CAMERA, rigid.look_at((0, 0, 200), (0, 0, 0)))
    write_exr(tmp_path / "m.exr", map_channels(maps), "made by a test")
    again = read_exr(tmp_path / "m.exr")
    np.testing.assert_array_equal(again["distance_mm"], maps.distance_mm.astype(np.float32))
    assert (again["part_id"] == maps.part_id).all() and (again["face_plus_1"] == maps.face + 1).all()
    first = (tmp_path / "m.exr").read_bytes()
    write_exr(tmp_path / "m.exr", map_channels(maps), "made by a test")
    assert (tmp_path / "m.exr").read_bytes() == first
    assert set(radiance_channels(np.zeros((2, 2, 3)))) == {"R", "G", "B"}
    write_tiff(tmp_path / "d.tiff", maps.depth_mm, "depth, mm")
    with Image.open(tmp_path / "d.tiff") as image:
        np.testing.assert_array_equal(np.asarray(image), maps.depth_mm.astype(np.float32))
        assert image.tag_v2[270] == "depth, mm"
    with pytest.raises(ArrayError, match="not negative"):
        write_exr(tmp_path / "x.exr", {"a": np.array([[-1]])})
    with pytest.raises(ArrayError, match="alike"):
        write_exr(tmp_path / "x.exr", {"a": np.zeros((2, 2)), "b": np.zeros((3, 2))})
    (tmp_path / "x.exr").write_bytes(b"no picture")
    with pytest.raises(InputError, match="not a readable EXR"):
        read_exr(tmp_path / "x.exr")


@pytest.mark.parametrize("kind", ["orthographic", "cylindrical"])
def test_maps_are_taken_by_a_camera_without_a_lens_where_the_settings_say_so(kind, tmp_path, capsys):
    import trimesh
    from rangecheck_cli.main import exit_status

    from rangecheck.export.map_files import read_maps_npz

    trimesh.creation.icosphere(subdivisions=4, radius=40.0).export(tmp_path / "ball.stl")
    asked = [
        "maps",
        str(tmp_path / "ball.stl"),
        "--unit",
        "mm",
        "--size",
        "60x48",
        "--camera",
        "0,0,200",
        "--set",
        f"picture.camera={kind}",
    ]
    assert exit_status([*asked, "-o", str(tmp_path / "maps")]) == 0
    assert f"camera: {kind}" in capsys.readouterr().out
    maps = read_maps_npz(tmp_path / "maps" / "maps.npz")
    camera, pose, _ = read_camera_json(tmp_path / "maps" / "camera.json")
    assert camera == maps.camera and camera.model == kind
    np.testing.assert_allclose(pose, maps.world_from_camera)
    # parallel to the axis of view, or square to the upright axis: both have a closed form on the sphere
    x, y, _ = np.moveaxis(maps.points_mm(), -1, 0)
    off = np.hypot(x, y) if kind == "orthographic" else np.abs(y)
    well = off < 30
    assert well.sum() > 500 and np.isfinite(maps.distance_mm[well]).all()
    sag = 40 * (1 - np.cos(np.arcsin(1 / 16))) / np.cos(np.arcsin(30 / 40))
    expected = 200 - np.sqrt(1600 - off[well] ** 2)
    assert (maps.distance_mm[well] > expected - 1e-4).all() and (maps.distance_mm[well] < expected + 1.5 * sag).all()
    # right in the picture is right for who stands there, and up is up
    columns, rows = np.arange(60) - 29.5, np.arange(48) - 23.5
    front = np.abs(columns) < 10
    assert (np.sign(x[24, front]) == np.sign(columns[front])).all() and (np.sign(y[8:40, 30]) == -np.sign(rows[8:40])).all()
    for more, said in (("picture.vignetting=true", "belongs to a lens"), ("picture.pixel_mm=-1", "greater than 0")):
        assert exit_status([*asked, "--set", more, "-o", str(tmp_path / "other")]) == 2
        assert said in capsys.readouterr().err
    assert exit_status(["turntable", *asked[1:4], "--set", f"picture.camera={kind}", "-o", str(tmp_path / "t.mp4")]) == 2
    assert "needs pinhole" in capsys.readouterr().err
