"""Errors keep what they measured; arrays are refused by name; rigid motions undo themselves; files are whole or absent."""

import fcntl
import json
import math
import os
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rangecheck import arrays, equations, errors, files, kernels, progress, rigid
from rangecheck.basis import frame_around
from rangecheck.config import load_settings

ROOT = Path(__file__).resolve().parent.parent


def test_an_error_keeps_what_it_measured():
    error = errors.SurfaceError("surface is open: 3 boundary edges", edges=3)
    assert error.edges == 3
    assert error.measured == {"edges": 3}


def test_an_error_is_one_line_whatever_a_file_calls_its_parts():
    told = str(errors.SettingError("camera.a\nb\x1b[31m\u2028\udcff is unknown; müssen"))
    assert told == r"camera.a\nb\x1b[31m\u2028\udcff is unknown; müssen"


def test_a_wrong_array_is_refused_by_its_name():
    with pytest.raises(errors.ArrayError, match=r"points_mm has shape \(2, 2\); it must be \(n, 3\)"):
        arrays.require("points_mm", [[1, 2], [3, 4]], (None, 3))
    with pytest.raises(errors.ArrayError, match=r"1 values that are not finite, the first at index \(1, 0\)"):
        arrays.require("points_mm", [[1, 2, 3], [math.nan, 0, 0]], (None, 3), finite=True)
    with pytest.raises(errors.ArrayError, match="unit is 'furlong'"):
        arrays.mm_per("furlong")


unit_interval = st.floats(-1, 1)


@given(st.tuples(*[unit_interval] * 4).filter(lambda q: sum(x * x for x in q) > 0.01), st.tuples(*[unit_interval] * 3))
def test_a_rigid_motion_forth_and_back_is_the_identity(quaternion, translation):
    motion = rigid.from_rotation_translation(rigid.rotation_from_quaternion(quaternion), np.array(translation) * 1000)
    points = np.random.default_rng(1).normal(size=(5, 3)) * 100
    back = rigid.move_points(rigid.inverse(motion), rigid.move_points(motion, points))
    assert np.abs(back - points).max() < 64 * np.spacing(1000.0)


def test_a_camera_that_looks_at_a_point_has_it_ahead_and_stands_upright():
    world_from_camera = rigid.look_at([0, 0, 500], [0, 100, 0])
    ahead = rigid.move_points(rigid.inverse(world_from_camera), np.array([[0.0, 100, 0]]))[0]
    assert np.allclose(ahead, [0, 0, math.hypot(500, 100)])
    assert rigid.move_directions(world_from_camera, np.array([0.0, 1, 0]))[1] < 0  # the picture's down is the world's down
    assert np.linalg.det(rigid.look_at([0, 9, 0], [0, 0, 0])[:3, :3]) == pytest.approx(1)  # up along the view


def test_the_angle_of_a_rotation_is_stable_near_zero_and_pi():
    for angle in (0.0, 1e-9, 1.0, math.pi - 1e-9, math.pi):
        assert rigid.angle_rad(rigid.about_axis([1, 2, 3], angle)) == pytest.approx(angle, abs=1e-12)


@pytest.mark.parametrize("matrix", [np.diag([1, 1, -1, 1.0]), np.diag([2, 2, 2, 1.0]), np.full((4, 4), math.nan)])
def test_a_mirror_a_scale_and_nan_are_no_rigid_motions(matrix):
    with pytest.raises(errors.ArrayError):
        rigid.checked(matrix)


def test_chunks_come_back_in_order_on_any_number_of_threads():
    for count in (1, 2, 5):
        with kernels.threads(count):
            chunks = kernels.in_chunks(lambda a, b: list(range(a, b)), 1003, 100)
            assert [i for chunk in chunks for i in chunk] == list(range(1003))


def test_a_file_is_whole_or_absent(tmp_path):
    target = tmp_path / "sub folder" / "ü.bin"
    with pytest.raises(RuntimeError), files.whole_file(target) as part:
        part.write_bytes(b"half")
        raise RuntimeError
    assert list(target.parent.iterdir()) == []
    files.write_bytes(target, b"whole")
    assert target.read_bytes() == b"whole"
    with pytest.raises(errors.OutputError, match="pass --force"):
        files.write_bytes(target, b"other", force=False)


def test_json_refuses_what_json_does_not_have(tmp_path):
    (tmp_path / "a.json").write_text('{"x": NaN}')
    with pytest.raises(errors.InputError, match="not valid JSON"):
        files.read_json(tmp_path / "a.json")
    with pytest.raises(ValueError, match="Out of range"):
        files.write_json(tmp_path / "b.json", {"x": math.nan})
    assert not (tmp_path / "b.json").exists()


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("turntable.frmes=3", "did you mean turntable.frames?"),
        ("turntable.frames=0", "greater than or equal to 1"),
        ("nothing=1", "unknown; known here: seed"),
        ("turntable=3", "valid dictionary"),
        ("turntable.frames", "takes key=value"),
    ],
)
def test_a_wrong_setting_is_refused_with_its_path(assignment, message):
    with pytest.raises(errors.SettingError, match=message.replace("?", r"\?")):
        load_settings(None, [assignment])


def test_presets_load_and_single_options_win():
    settings = load_settings("quick", ["turntable.frames=5"], {"turntable.frames": 7, "seed": None})
    assert (settings.turntable.frames, settings.picture.width, settings.seed) == (7, 256, 0)
    for preset in (files.presets_folder() / "jobs").glob("*.toml"):
        load_settings(preset)
    json.dumps(load_settings("fine").model_dump(mode="json"), allow_nan=False)


def test_every_package_folder_is_listed_for_the_wheel():
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {".".join(p.parent.relative_to(ROOT).parts) for p in (ROOT / "rangecheck").rglob("__init__.py")}
    assert listed == found | {"rangecheck.presets", "rangecheck_cli"}


def test_a_compiled_kernel_is_keyed_by_the_sources_of_what_it_imports():
    package = Path(kernels.__file__).parent
    names = {str(Path(path).relative_to(package)) for path in kernels.sources_of(package / "transport" / "scatter.py")}
    assert {"transport/scatter.py", "basis.py", "reflectance/fast.py", "reflectance/octaves.py"} <= names
    assert not names & {"pipeline/job.py", "surface/surface.py"}


def test_a_changed_source_changes_the_key_of_kernels_that_import_it(tmp_path, monkeypatch):
    monkeypatch.setattr(kernels, "_PACKAGE", tmp_path / "rangecheck")
    folder = tmp_path / "rangecheck"
    folder.mkdir()
    (folder / "constants.py").write_text("SIZE = 3\n")
    (folder / "inner.py").write_text("from rangecheck.kernels import kernel\nfrom rangecheck.constants import SIZE\n")
    (folder / "outer.py").write_text("from rangecheck.kernels import kernel\nfrom .inner import (\n    f,\n)\n")

    def key():
        kernels.sources_of.cache_clear()
        return kernels.GivenFolder.get_source_stamp(SimpleNamespace(_py_file=str(folder / "outer.py")))

    before = key()
    assert key() == before
    (folder / "constants.py").write_text("SIZE = 4\n")
    assert key() != before
    kernels.sources_of.cache_clear()


def test_a_kernel_that_another_process_compiles_is_waited_for_and_loaded(tmp_path):
    (tmp_path / "alike.py").write_text("from rangecheck.kernels import kernel\n\n\n@kernel\ndef twice(x):\n    return 2 * x\n")
    ask = "import alike; print('ready', flush=True); print(alike.twice(21)); print(sum(alike.twice.stats.cache_misses.values()))"
    told = {"cwd": tmp_path, "env": os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": str(tmp_path)}}
    assert subprocess.run([sys.executable, "-c", ask], **told, capture_output=True, text=True).stdout.split() == [
        "ready",
        "42",
        "1",
    ]
    saved = {path: path.read_bytes() for path in (tmp_path / "kept").rglob("*.nb?")}
    assert len(saved) == 2 and not list((tmp_path / "kept").rglob("*.lock"))
    for path in saved:
        path.unlink()
    # this process stands for one that is compiling
    index = next(path for path in saved if path.suffix == ".nbi")
    lock = index.with_suffix(".lock")
    with lock.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with subprocess.Popen([sys.executable, "-c", ask], **told, stdout=subprocess.PIPE, text=True) as waiting:
            assert waiting.stdout.readline() == "ready\n"
            time.sleep(1.0)
            assert waiting.poll() is None
            for path, content in saved.items():
                path.write_bytes(content)
            fcntl.flock(held, fcntl.LOCK_UN)
            assert waiting.communicate(timeout=60)[0].split() == ["42", "0"]


def test_a_kernel_that_cannot_be_compiled_keeps_nobody_waiting():
    made = kernels.kernel(lambda x: x.nothing)
    with pytest.raises(numba.TypingError):
        made(3)
    assert made._cache._lock is None and not made._cache._lock_path.exists()


def test_where_no_cache_can_be_written_kernels_compile_all_the_same(monkeypatch):
    for locator in (kernels.GivenFolder, kernels.BesideSource, kernels.UserCache):
        monkeypatch.setattr(locator, "from_function", classmethod(lambda cls, function, file: None))
    told = []
    monkeypatch.setattr(progress, "on_first_compile", lambda: told.append("compiling"))
    twice = kernels.kernel(lambda x: 2 * x)
    assert twice(21) == 42 and twice(2) == 4
    assert told == ["compiling"]


def test_parts_that_a_killed_process_left_are_swept_up_and_nothing_else(tmp_path):
    below = tmp_path / "frames"
    below.mkdir()
    kept = [tmp_path / "a.part.png", tmp_path / ".hidden.partial", below / "b.png", below / ".lock"]
    for path in kept:
        path.write_text("kept")
    with files.whole_file(below / "c.png") as part:
        survivor = part.with_name(".d.abcdefgh.part.png")
        survivor.write_text("half")
        part.write_text("whole")
    files.sweep_parts(tmp_path)
    assert not survivor.exists()
    assert all(path.exists() for path in [*kept, below / "c.png"])


@pytest.mark.parametrize(
    "frames", [rigid.across, lambda z: np.array([frame_around(*n) for n in z]).reshape(-1, 2, 3).swapaxes(0, 1)]
)
def test_two_directions_across_a_third_make_a_right_handed_frame_with_it(frames):
    rng = np.random.default_rng(3)
    z = np.concatenate([np.eye(3), -np.eye(3), arrays.unit_vectors(rng.normal(size=(200, 3)))])
    u, v = frames(z)
    some_roundings = 16 * np.finfo(float).eps
    assert np.abs(np.linalg.det(np.stack([u, v, z], axis=1)) - 1.0).max() < some_roundings
    assert (
        np.abs(np.einsum("kni,lni->kln", np.stack([u, v, z]), np.stack([u, v, z])) - np.eye(3)[..., None]).max() < some_roundings
    )


def test_a_factored_system_gives_back_its_solution_and_a_singular_one_is_told():
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(9, 6))
    system, answer = rows.T @ rows, rng.normal(size=6)
    factor, found = np.tril(system), system @ answer
    assert equations.cholesky(factor, 6, 1e-4, 0.0)
    equations.substituted(factor, 6, found, found)
    assert np.abs(found - answer).max() < 16 * np.linalg.cond(system) * np.finfo(float).eps
    rows[:, 5] = rows[:, 4]
    assert not equations.cholesky(rows.T @ rows, 6, 1e-4, 0.0)
    # of the first five, which are sound, the factor is numpy's
    sound = rows.T @ rows
    assert equations.cholesky(sound, 5, 1e-4, 0.0)
    np.testing.assert_allclose(np.tril(sound[:5, :5]), np.linalg.cholesky((rows.T @ rows)[:5, :5]), rtol=1e-12)
