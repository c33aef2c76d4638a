"""A turntable loses nothing when it is stopped, and gives the same bytes however it was made."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from rangecheck_cli.main import exit_status

from rangecheck.export.meshes import write_mesh
from rangecheck.modeler.primitives import sphere
from rangecheck.surface import Surface

TURN = ["--unit", "mm", "--frames", "60", "--size", "160x160", "-q"]


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> Path:
    """A ball as a mesh file in a folder whose name needs care."""
    body = sphere(40.0, 0.5)
    path = tmp_path_factory.mktemp("größe, with spaces") / "ball.ply"
    write_mesh(Surface(body.vertices, body.faces), path)
    return path


@pytest.fixture(scope="module")
def undisturbed(ball) -> bytes:
    """The film of a run that nobody stopped."""
    film = ball.with_name("undisturbed.mp4")
    assert exit_status(["turntable", str(ball), "-o", str(film), *TURN]) == 0
    return film.read_bytes()


#: a turntable that is interrupted while its twentieth frame is in the making
INTERRUPTED = """
import os, signal, time
from rangecheck_cli import main
from rangecheck.pipeline import turning_job

drawn = turning_job.picture_of
# a shell that started the tests in the background had interrupts ignored, and that is inherited
signal.signal(signal.SIGINT, signal.default_int_handler)

def interrupted(job, image, exposure, index):
    if index == 20:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1.0)
    return drawn(job, image, exposure, index)

turning_job.picture_of = interrupted
main()
"""


def test_a_stopped_turntable_exits_130_and_goes_on_to_the_same_bytes(ball, undisturbed):
    film = ball.with_name("stopped.mp4")
    frames = ball.with_name("stopped-frames")
    command = [sys.executable, "-c", INTERRUPTED, "turntable", str(ball), "-o", str(film), *TURN]
    process = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=120)
    said = process.stderr
    assert process.returncode == 130, said
    assert "interrupted" in said
    assert not film.exists()
    finished = json.loads((frames / "frames.json").read_text())["done"]
    assert 0 < len(finished) < 60
    assert exit_status(["turntable", str(ball), "-o", str(film), *TURN]) == 0
    assert film.read_bytes() == undisturbed


def test_one_thread_gives_the_bytes_of_many(ball, undisturbed):
    film = ball.with_name("one thread.mp4")
    assert exit_status(["turntable", str(ball), "-o", str(film), *TURN, "--threads", "1"]) == 0
    assert film.read_bytes() == undisturbed


def test_frames_of_other_settings_are_not_mixed_in(ball, undisturbed, capsys):
    film = ball.with_name("other.mp4")
    frames = ["--frames-dir", str(ball.with_name("undisturbed-frames"))]
    assert exit_status(["turntable", str(ball), "-o", str(film), *TURN, *frames, "--material", "steel"]) == 2
    assert "--force" in capsys.readouterr().err
