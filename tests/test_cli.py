"""The command line keeps its contract: exit statuses, one clear line on stderr, results on stdout, quick help."""

import importlib
import json
import re
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import click
import numpy as np
import pytest
from rangecheck_cli.main import COMMANDS, cli, exit_status

from rangecheck.config import load_settings


def complaint(capsys, *arguments) -> str:
    """The one line that a failing command leaves, after checking that its status is 2 and its stdout empty."""
    assert exit_status([str(a) for a in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = [line for line in captured.err.splitlines() if line.startswith("rangecheck: ")]
    assert len(lines) in (1, 2)  # wrong usage adds where to look
    return lines[0]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_says_in_help_what_the_overview_says(name, capsys):
    command = importlib.import_module(f"rangecheck_cli.{name}_command").command
    assert isinstance(command, click.Command)
    assert command.short_help == COMMANDS[name]
    assert exit_status([name, "--help"]) == 0
    assert COMMANDS[name].rstrip(".") in " ".join(capsys.readouterr().out.split())


def test_help_imports_no_heavy_package():
    script = (
        "import sys; from rangecheck_cli.main import exit_status; exit_status(['--help']); "
        "print([n for n in ('numpy', 'numba', 'scipy', 'cv2', 'open3d', 'pydantic', 'rich') if n in sys.modules])"
    )
    shown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert shown.splitlines()[-1] == "[]"


def test_an_unknown_command_or_option_names_the_nearest(capsys):
    assert "did you mean render?" in complaint(capsys, "rendr")
    assert "--frmes" in complaint(capsys, "turntable", "x.ply", "-o", "y.mp4", "--frmes", "3")


@pytest.mark.parametrize(
    "command", [["check"], ["mesh", "-o", "out.ply"], ["solid", "-o", "out.stl"], ["render", "-o", "out.png"]]
)
def test_a_missing_file_is_one_line_and_status_2(command, capsys, tmp_path):
    assert "does not exist" in complaint(capsys, *command, tmp_path / "no such file.ply", "--unit", "mm")
    assert list(tmp_path.iterdir()) == []


def test_a_truncated_ply_is_refused(capsys, tmp_path, sample_data):
    broken = tmp_path / "half a mesh.ply"
    broken.write_bytes(
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n1 0"
    )
    assert broken.name in complaint(capsys, "check", broken, "--unit", "mm")


def test_a_png_that_is_no_png_is_refused(capsys, tmp_path):
    fake = tmp_path / "depth.png"
    fake.write_bytes(b"GIF89a, or so")
    assert "depth.png" in complaint(capsys, "check", fake, "--unit", "mm")


def test_a_camera_with_nan_is_refused(capsys, tmp_path, sample_data):
    manifest = (sample_data / "frontal" / "scans.json").read_text().replace('"fx": ', '"fx": NaN, "was": ')
    (tmp_path / "scans.json").write_text(manifest)
    assert "NaN" in complaint(capsys, "run", tmp_path / "scans.json", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_scan_in_which_nothing_returned_is_refused(capsys, tmp_path):
    from rangecheck.optics import PinholeCamera
    from rangecheck.scan import RangeScan
    from rangecheck.scan.readers.npz import write_npz

    camera = PinholeCamera.from_field_of_view(32, 24, 40)
    write_npz(tmp_path / "nothing.npz", RangeScan(np.full((24, 32), np.nan), camera))
    assert "every cell says that nothing returned" in complaint(
        capsys, "run", tmp_path / "nothing.npz", "--out", tmp_path / "out"
    )
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_refused_before_any_work(capsys, tmp_path, sample_data):
    (tmp_path / "file").write_text("in the way")
    message = complaint(capsys, "run", sample_data, "--out", tmp_path / "file" / "out")
    assert "file" in message


def test_a_file_without_unit_asks_for_it(capsys, tmp_path):
    mesh = tmp_path / "cube.stl"
    mesh.write_bytes(b"\0" * 80 + np.uint32(1).tobytes() + np.zeros(12, "<f4").tobytes() + b"\0\0")
    assert "--unit" in complaint(capsys, "check", mesh)


def test_json_is_one_document_and_nothing_else(capsys):
    exit_status(["doctor", "--json", "-q"])
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "rangecheck/doctor/1"
    assert {row["name"] for row in document["checks"]} >= {"numpy", "embreex", "encoder"}


def test_a_rehearsal_says_what_a_job_would_need_and_leaves_nothing(capsys, tmp_path, sample_data):
    assert exit_status(["run", str(sample_data / "frontal"), "--out", str(tmp_path / "out"), "--dry-run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["scans"] == 1 and told["distances"] > 10_000 and 0 < told["bytes_needed"] < told["bytes_free"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["turntable", "dataset", "run --each"])
def test_every_long_job_can_be_rehearsed(command, capsys, tmp_path, sample_data):
    out = tmp_path / ("film.mp4" if command == "turntable" else "out")
    where = "--out" if command.startswith("run") else "-o"
    assert exit_status([*command.split(), str(sample_data / "frontal"), where, str(out), "--dry-run", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["command"] == command.split()[0] and 0 < told["bytes_needed"] < told["bytes_free"]
    assert list(tmp_path.iterdir()) == []


def test_a_rehearsal_asks_the_scheduler_whether_it_is_there(capsys, tmp_path, sample_data):
    asked = ["run", sample_data / "frontal", "--out", tmp_path / "out", "--dry-run", "--scheduler"]
    assert "'nonsense' is no address of a dask scheduler" in complaint(capsys, *asked, "nonsense")


def test_findings_are_explained_where_they_are_told(capsys, tmp_path):
    mesh = tmp_path / "face.stl"
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
    mesh.write_bytes(b"\0" * 80 + np.uint32(1).tobytes() + np.zeros(3, "<f4").tobytes() + corners.tobytes() + b"\0\0")
    assert exit_status(["check", str(mesh), "--unit", "mm", "-q"]) == 1
    before = capsys.readouterr().out
    assert exit_status(["check", str(mesh), "--unit", "mm", "-q", "--explain"]) == 1
    after = capsys.readouterr().out
    assert after.startswith(before) and after[len(before) :].startswith("open-edges: open edges\n  why:  ")


def test_a_rehearsal_refuses_a_disk_that_is_too_small(capsys, tmp_path, sample_data, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=1_000_000))
    said = complaint(capsys, "run", sample_data / "frontal", "--out", tmp_path / "out", "--dry-run")
    assert "1 MB free" in said


def test_a_new_settings_file_changes_nothing_until_a_line_is_uncommented(capsys, tmp_path):
    file = tmp_path / "settings.toml"
    assert exit_status(["init", "-o", str(file)]) == 0
    assert load_settings(file) == load_settings()
    text = file.read_text()
    uncommented = re.sub(r"^# (\w+ = )", r"\1", text, flags=re.MULTILINE)
    file.write_text(uncommented)
    assert load_settings(file) == load_settings()  # every default is written as TOML
    file.write_text(text.replace("# frames = 36", "frames = 7"))
    assert load_settings(file).turntable.frames == 7
    capsys.readouterr()
    assert "exists already" in complaint(capsys, "init", "-o", file)


def test_shells_are_told_how_to_complete(capsys):
    for shell in ("bash", "zsh", "fish"):
        assert exit_status(["completion", shell]) == 0
        assert "_RANGECHECK_COMPLETE" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "completed"),
    [
        ("run --pres", "--preset"),
        ("explain open", "open-edges"),
        ("render x.ply --material st", "steel"),
        ("study hard", "hardness"),
    ],
)
def test_shells_complete_options_and_the_names_of_what_there_is(words, completed, capsys, monkeypatch):
    monkeypatch.setenv("COMP_WORDS", f"rangecheck {words}")
    monkeypatch.setenv("COMP_CWORD", str(len(words.split())))
    monkeypatch.setenv("_RANGECHECK_COMPLETE", "bash_complete")
    with pytest.raises(SystemExit):
        importlib.import_module("rangecheck_cli.main").cli.main(prog_name="rangecheck")
    assert f"plain,{completed}" in capsys.readouterr().out.splitlines()


@pytest.mark.parametrize(
    ("words", "begun", "completed"),
    [
        ("check x.stl --printer", "prusa", {"prusa-sl1", "prusa-sl1s"}),
        ("solid x.stl --printer", "l", {"large-sla"}),
        ("check x.ply --profile", "", {"bust-75", "bust-150", "bust-300"}),
        ("run x --set", "turntable.fr", {"turntable.frames=", "turntable.frame_format="}),
        ("run x --set", "se", {"seed=", "sensor."}),
        ("render x.ply --config", "", {"quick", "normal", "fine"}),
        ("schema", "cam", {"camera", "cameras"}),
        ("materials", "steel_", {"steel_ground", "steel_satin"}),
        ("dataset x.toml --ranges", "d", {"default"}),
        ("study rays --part", "", {"engines", "chunks"}),
        ("study job --part", "n", {"normal"}),
        ("study nothing --part", "", set()),
        ("study --part", "", set()),
    ],
)
def test_what_can_be_named_is_completed(words, begun, completed):
    from click.shell_completion import ShellComplete

    items = ShellComplete(cli, {}, "rangecheck", "_RANGECHECK_COMPLETE").get_completions(words.split(), begun)
    plain = [item.value for item in items if item.type == "plain"]
    for name in completed:
        assert any(value.startswith(name) for value in plain), plain
    assert all(any(value.startswith(name) for name in completed) for value in plain), plain
    # a file may stand where a shipped one is named; a shell looks for those itself, and is told so first
    files = [place for place, item in enumerate(items) if item.type == "file"]
    assert files == ([0] if words.split()[-1] in ("--printer", "--config", "--ranges", "materials") else [])


def test_wrong_usage_names_the_help_of_its_own_command(capsys):
    assert exit_status(["turntable", "x.ply", "-o", "y.mp4", "--size", "3"]) == 2
    assert "see rangecheck turntable --help" in capsys.readouterr().err


def test_a_command_that_passes_its_memory_ends_and_says_so(tmp_path):
    """In a process of its own, which holds nothing before; four times the bound, so that a loaded machine looks in time."""
    from rangecheck.export.meshes import write_mesh
    from rangecheck.studies.scenes import ball

    write_mesh(ball(8, 40.0), tmp_path / "ball.ply")
    line = ["render", str(tmp_path / "ball.ply"), "--unit", "mm", "--size", "64x64", "-o", str(tmp_path / "ball.png")]
    line += ["--set", "memory_mb=256", "-q"]
    done = subprocess.run([sys.executable, "-m", "rangecheck_cli", *line], capture_output=True, text=True)
    assert done.returncode == 2 and "out of memory" in done.stderr and len(done.stderr.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["ball.ply"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the memory of processes is read from /proc")
def test_what_a_command_started_counts_and_ends_with_it(tmp_path):
    child = f"import os, time; open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); held = bytearray(300_000_000); time.sleep(60)"
    parent = "import subprocess, sys; from rangecheck_cli.memory import bound_memory; bound_memory(200); "
    parent += f"subprocess.run([sys.executable, '-c', {child!r}])"
    done = subprocess.run([sys.executable, "-c", parent], capture_output=True, text=True)
    assert done.returncode == 2 and "out of memory" in done.stderr and len(done.stderr.splitlines()) == 1
    gone = Path("/proc") / (tmp_path / "pid").read_text() / "stat"
    until = time.monotonic() + 20
    while gone.exists() and gone.read_text().split()[2] != "Z":  # what was killed gives its memory back first
        assert time.monotonic() < until
        time.sleep(0.01)


@pytest.mark.parametrize("command", [["solid"], ["mesh"], ["run"], ["maps"], ["dataset", "--count", "1"]])
def test_no_command_writes_over_what_it_reads(command, capsys, tmp_path, sample_data):
    (tmp_path / "here").write_bytes(b"precious")
    (tmp_path / "link").symlink_to(tmp_path / "here")
    option = "--out" if command[0] in ("run", "maps", "dataset") else "-o"
    assert "choose another place" in complaint(capsys, *command, tmp_path / "here", option, tmp_path / "link", "--force")
    assert (tmp_path / "here").read_bytes() == b"precious"


def test_a_log_holds_what_was_done_and_how_it_ended(capsys, tmp_path):
    log = tmp_path / "logs" / "a b.log"
    assert exit_status(["explain", "open-edges", "--log", str(log)]) == 0
    capsys.readouterr()
    complaint(capsys, "check", tmp_path / "none.ply", "--unit", "mm", "--log", log)
    lines = log.read_text().splitlines()
    assert any("open-edges" in line for line in lines) and "does not exist" in lines[-1]
    assert all(re.match(r"\d{4}-\d\d-\d\dT[\d:.]+Z ", line) for line in lines)
    letter = tmp_path / "letter.txt"
    letter.write_text("Dear Ann,\n")
    assert "is no log" in complaint(capsys, "explain", "open-edges", "--log", letter)
    assert letter.read_text() == "Dear Ann,\n"


def test_doctor_keeps_what_packages_print_off_its_document_and_names_the_libraries_they_lack(capfd, monkeypatch, tmp_path):
    noisy = tmp_path / "pymeshlab.py"
    noisy.write_text(
        "import os\nprint('Unable to load the following plugins:')\n"
        "os.write(1, b'libio_base.so: (libOpenGL.so.0: cannot open shared object file: No such file or directory)')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pymeshlab", raising=False)
    exit_status(["doctor", "--json", "-q"])
    sys.modules.pop("pymeshlab")
    checks = {row["name"]: row for row in json.loads(capfd.readouterr().out)["checks"]}
    assert checks["pymeshlab"]["state"] == "broken" and "libOpenGL.so.0" in checks["pymeshlab"]["detail"]
    assert "libopengl0" in checks["pymeshlab"]["mend"]


@pytest.mark.parametrize(("command", "kept"), [("fit", False), ("check", False), ("run", True), ("turntable", True)])
def test_what_a_stopped_command_keeps_is_said_of_those_that_go_on_from_there(monkeypatch, capsys, command, kept):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "main", stopped)
    assert exit_status([command, "x"]) == 130
    said = capsys.readouterr().err
    assert "interrupted" in said and ("what was finished is kept" in said) == kept
