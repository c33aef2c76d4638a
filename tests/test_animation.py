"""Orbits that frame exactly, and frames that can be stopped anywhere."""

import json
import math

import numpy as np
import pytest

from rangecheck import rigid
from rangecheck.animation import Orbit, framing_error_px, orbit_around, pilot_indices, render_frames
from rangecheck.animation.frames import key_of
from rangecheck.errors import CameraError, OutputError, SceneError
from rangecheck.optics import CylindricalCamera, OrthographicCamera, PinholeCamera
from rangecheck.surface import Surface


def cloud(seed=0, offset=(0.0, 0.0, 0.0)):
    """A surface of scattered triangles, longer than wide, off the axis."""
    vertices = np.random.default_rng(seed).normal(size=(60, 3)) * [30, 80, 20] + [15, 40, -10] + np.asarray(offset)
    return Surface(vertices, np.arange(60).reshape(-1, 3))


CAMERAS = [
    PinholeCamera.from_field_of_view(320, 240, 30),
    PinholeCamera.from_field_of_view(200, 300, 80),
    PinholeCamera(320, 240, 400, 390, 150, 130, (-0.1, 0.02, 0.001, -0.001)),
]


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("swing_deg", [0.0, 20.0])
def test_every_vertex_is_inside_every_frame_and_no_closer_orbit_would_do(camera, swing_deg):
    surface = cloud()
    orbit = orbit_around(surface, camera, frames=24, elevation_deg=15, margin=0.04, swing_deg=swing_deg)

    def worst(distance_mm, centre=orbit.centre_mm):
        closer = Orbit(centre, distance_mm, 15, 24, swing_deg=swing_deg)
        return max(framing_error_px(surface.vertices, camera, closer.world_from_camera(i), 0.04) for i in range(24))

    assert worst(orbit.distance_mm) <= 1e-5
    if not camera.distortion:
        # no centre nearby lets the camera come a thousandth closer
        for step in [(0, 0, 0), *(tuple(s * e) for e in 2.0 * np.eye(3) for s in (-1, 1))]:
            assert worst(orbit.distance_mm * 0.999, tuple(np.add(orbit.centre_mm, step))) > 0


def test_framing_does_not_depend_on_where_the_surface_is():
    near, far = (orbit_around(cloud(offset=o), CAMERAS[0], frames=12) for o in ((0, 0, 0), (1e6, -2e6, 5e5)))
    assert far.distance_mm == pytest.approx(near.distance_mm, rel=1e-6)
    np.testing.assert_allclose(np.subtract(far.centre_mm, (1e6, -2e6, 5e5)), near.centre_mm, atol=1e-3)


def test_a_single_point_and_a_single_frame_can_be_framed():
    point = Surface(np.full((3, 3), 7.0), np.array([[0, 1, 2]]))
    orbit = orbit_around(point, CAMERAS[0], frames=1)
    assert framing_error_px(point.vertices, CAMERAS[0], orbit.world_from_camera(0)) < 0


def test_what_cannot_be_framed_is_said():
    with pytest.raises(SceneError, match="no faces"):
        orbit_around(Surface(np.zeros((3, 3)), np.empty((0, 3), int)), CAMERAS[0], frames=4)
    with pytest.raises(CameraError, match="margin"):
        orbit_around(cloud(), CAMERAS[0], frames=4, margin=0.5)
    with pytest.raises(CameraError, match="pinhole or orthographic"):
        orbit_around(cloud(), CylindricalCamera(90, 50, 180.0, 0.05, 2.0, 24.5), frames=4)
    with pytest.raises(CameraError, match="optical axis leaves"):
        orbit_around(cloud(), PinholeCamera(100, 100, 100, 100, -20, 50), frames=4)
    small = OrthographicCamera(100, 100, 1.0, 49.5, 49.5)
    with pytest.raises(CameraError, match="take pixels of") as told:
        orbit_around(cloud(), small, frames=4)
    wide = OrthographicCamera(100, 100, told.value.measured["pixel_mm"] * 1.0001, 49.5, 49.5)
    assert orbit_around(cloud(), wide, frames=4).frames == 4


@pytest.mark.parametrize(
    "wrong", [{"distance_mm": 0.0}, {"frames": 0}, {"elevation_deg": 90.0}, {"axis": (0.0, 0.0, 0.0)}, {"start_deg": math.nan}]
)
def test_an_impossible_orbit_is_refused(wrong):
    with pytest.raises(CameraError, match=next(iter(wrong)).replace("elevation_deg", "rises").replace("_", "_")):
        Orbit(**{"centre_mm": (0, 0, 0), "distance_mm": 10.0, "elevation_deg": 0.0, "frames": 4} | wrong)


def test_the_camera_looks_at_the_centre_upright_from_equal_angles_and_the_loop_closes():
    orbit = Orbit((1, 2, 3), 100, 20, 8)
    eyes = []
    for i in range(8):
        pose = orbit.world_from_camera(i)
        eye = pose[:3, 3] - [1, 2, 3]
        np.testing.assert_allclose(pose[:3, 2], -eye / 100, atol=1e-12)
        assert pose[1, 0] == pytest.approx(0, abs=1e-12) and pose[1, 1] < 0
        eyes.append(eye)
        np.testing.assert_array_equal(pose, orbit.world_from_camera(i + 8))
    np.testing.assert_allclose(eyes[0], 100 * np.array([0, math.sin(math.radians(20)), math.cos(math.radians(20))]), atol=1e-12)
    assert eyes[2][0] > 90
    steps = np.linalg.norm(np.diff([*eyes, eyes[0]], axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-12)


def test_turning_the_model_and_carrying_the_camera_are_the_same_picture():
    orbit = Orbit((5, -3, 8), 90, 25, 12, axis=(0.2, 1, -0.1))
    for i in range(12):
        np.testing.assert_allclose(
            orbit.world_from_turned(i) @ orbit.world_from_camera(0), orbit.world_from_camera(i), atol=1e-12
        )
        np.testing.assert_allclose(rigid.move_points(orbit.world_from_turned(i), np.array([5.0, -3, 8])), [5, -3, 8], atol=1e-12)


def radiance(index):
    return np.random.default_rng(index).uniform(0.5, 1.0 + index, (8, 8))


def encode(image, exposure, index=0):
    return (image * exposure).tobytes()


def make(folder, **changes):
    arguments = {"frame": radiance, "frames": 9, "folder": folder, "key": "job", "encode": encode}
    arguments["exposure"] = lambda pilots: 1 / max(p.max() for p in pilots)
    return render_frames(**(arguments | changes))


def content(folder):
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


def test_all_frames_share_one_exposure_from_the_pilots(tmp_path):
    paths = make(tmp_path)
    assert pilot_indices(9) == [0, 2, 4, 6] and pilot_indices(2) == [0, 1] and pilot_indices(1) == [0]
    exposure = 1 / max(radiance(i).max() for i in (0, 2, 4, 6))
    assert [p.read_bytes() for p in paths] == [encode(radiance(i), exposure) for i in range(9)]
    assert json.loads((tmp_path / "frames.json").read_text())["exposure"] == exposure


@pytest.mark.parametrize("stop_at", [0, 3, 8])
def test_an_interrupted_job_goes_on_to_the_same_bytes(tmp_path, stop_at):
    make(tmp_path / "whole")
    asked = []

    def stopping(index):
        asked.append(index)
        # the pilots come first; then the frames in order
        if (len(asked) > 4 and index == stop_at) or (stop_at in (0,) and len(asked) > 2):
            raise KeyboardInterrupt
        return radiance(index)

    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "part", frame=stopping)
    left = content(tmp_path / "part")
    assert not any(".part" in name for name in left)
    remade = []
    make(tmp_path / "part", frame=lambda i: remade.append(i) or radiance(i))
    assert content(tmp_path / "part") == content(tmp_path / "whole")
    finished = len(left) - 1
    assert len(set(remade)) <= 9 - finished + 4


def test_a_finished_job_renders_nothing_and_a_damaged_frame_is_made_again(tmp_path):
    paths = make(tmp_path)
    before = content(tmp_path)
    make(tmp_path, frame=None)
    paths[5].write_bytes(b"half")
    paths[7].unlink()
    remade, seen = [], []
    make(tmp_path, frame=lambda i: remade.append(i) or radiance(i), progress=lambda done, n: seen.append((done, n)))
    assert remade == [5, 7] and content(tmp_path) == before
    assert seen == [(7, 9), (8, 9), (9, 9)]


def test_frames_of_another_job_are_never_mixed_in(tmp_path):
    make(tmp_path)
    before = content(tmp_path)
    for changes in ({"key": "other"}, {"frames": 10}, {"suffix": ".exr"}):
        with pytest.raises(OutputError, match=r"--force"):
            make(tmp_path, **changes)
        assert content(tmp_path) == before
    make(tmp_path, key="other", frames=3, force=True)
    assert sorted(content(tmp_path)) == ["frame_0000.png", "frame_0001.png", "frame_0002.png", "frames.json"]


def test_frames_without_a_manifest_are_not_trusted(tmp_path):
    make(tmp_path)
    (tmp_path / "frames.json").write_text("{ broken")
    with pytest.raises(OutputError, match="unknown job"):
        make(tmp_path)
    (tmp_path / ".frame_0001.abc.part.png").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("keep")
    make(tmp_path, force=True)
    assert (tmp_path / "notes.txt").exists() and not list(tmp_path.glob(".frame*"))


def test_an_unwritable_folder_is_an_output_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be used for frames"):
        make(tmp_path / "file" / "frames")


def test_keys_change_with_anything_that_determines_a_frame():
    base = {
        "vertices": np.arange(6.0).reshape(2, 3),
        "material": {"k": 0.9, "name": "plaster"},
        "frames": 3,
        "b": b"x",
        "t": (1, None),
    }
    variants = [
        base | {"vertices": np.arange(6.0).reshape(3, 2)},
        base | {"vertices": np.arange(6.0, dtype=np.float32).reshape(2, 3)},
        base | {"material": {"k": 0.9000001, "name": "plaster"}},
        base | {"frames": 3.0},
        base | {"b": b"y"},
        base | {"t": (1, 0)},
        base | {"t": [[1], None]},
    ]
    keys = [key_of(v) for v in [base, *variants]]
    assert len(set(keys)) == len(keys)
    assert key_of(dict(reversed(base.items()))) == keys[0]
