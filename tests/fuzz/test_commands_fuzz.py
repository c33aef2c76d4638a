"""Command lines that nobody would write: every command answers with a status of the contract, and complains in one line.

Some dozens run with the other tests. The full run: RANGECHECK_FUZZ=5000 pytest tests/fuzz/test_commands_fuzz.py -s; RANGECHECK_FUZZ_SEED draws others.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import click
import numpy as np

COUNT = int(os.environ.get("RANGECHECK_FUZZ", "60"))
SEED = int(os.environ.get("RANGECHECK_FUZZ_SEED", "1"))
LONGEST_S, MOST_BYTES = 5.0, 1 << 30
#: what makes scans, studies and schedulers work long, or reaches out; and options that keep a job small
LEFT_OUT = ("study", "sample")
NEVER = ("--scheduler", "--dashboard")
SMALL = {"--size": "9x8", "--frames": "1", "--count": "1", "--views": "1", "--preset": "quick", "--threads": "2"}
ODD = [
    "", " ", "-1", "0", "1", "2", "nan", "inf", "1e999", "9" * 400, "x", "é\u202e", "8x8", "0x0", "9" * 30 + "x1", "1,2,3", "1,2", "nan,0,1", "0,0,0", "../../x",
    "/dev/null", "/", ".", "~", "-", "--", "%", "5%", "mm", "steel", "plaster", "seed=1", "seed=", "=", "a.b.c=1", "turntable.frames=0", "light.materials=[]",
    "picture.width=9", "solid.cut=[0,0,0,1]", "meshing.voxel_mm=1e-300", "quick", "auto", "[" * 2000, "{", "\\", "a\nb", "1e-300", "0.5", "run",
]  # fmt: skip


def drawn(random: np.random.Generator, name: str, command: click.Command, files: list[str], out: Path) -> list[str]:
    """Arguments of one command: some of its options, with fitting and odd values; small pictures where nothing else is said."""
    line, given = [name], set()

    def value() -> str:
        pool = files if random.random() < 0.5 else ODD
        return pool[int(random.integers(len(pool)))]

    def fitting(kind: click.ParamType) -> str:
        if isinstance(kind, click.Choice):
            return str(kind.choices[int(random.integers(len(kind.choices)))])
        if isinstance(kind, click.Path):
            return files[int(random.integers(len(files)))]
        return ("1", "2", "0.5", "1,2,3", "9x8")[int(random.integers(5))]

    for param in command.params:
        if isinstance(param, click.Argument):
            count = int(random.integers(0, 3)) if param.nargs == -1 else 1
            line += [fitting(param.type) if random.random() < 0.7 else value() for _ in range(count)]
            continue
        option = param.opts[0]
        chance = 0.9 if param.required or option in SMALL else 0.12
        if option in NEVER or option == "--help" or random.random() > chance:
            continue
        given.add(option)
        line.append(option)
        if getattr(param, "is_flag", False) or getattr(param, "count", False):
            continue
        if param.name == "out" and random.random() < 0.8:
            ending = ("", ".png", ".stl", ".mp4", ".ply", ".npz", ".toml", ".svg", ".3mf", ".txt")[int(random.integers(10))]
            line.append(str(out / f"o{ending}"))
        elif option in SMALL and random.random() < 0.9:
            line.append(SMALL[option])
        else:
            line.append(fitting(param.type) if random.random() < 0.6 else value())
    return line


def harmless(line: list[str]) -> bool:
    """Whether nothing outside the test's own folder can be written, and no picture is large."""
    pairs = list(pairwise(line))
    big = any(a == "--set" and ("width" in b or "frames" in b) and "=9" not in b for a, b in pairs)
    outside = any(a in ("-o", "--out", "--output", "--log", "--frames-dir") and not b.startswith("/") for a, b in pairs)
    return not big and not outside


def inputs(folder: Path) -> list[str]:
    """Good and spoilt files of every kind that commands take."""
    from fuzz.mutate import CAMERA
    from rangecheck.export.meshes import write_mesh
    from rangecheck.files import presets_folder
    from rangecheck.scan import RangeScan
    from rangecheck.scan.readers import write_npz, write_scans
    from rangecheck.studies.scenes import ball

    ranges = np.full((11, 14), 400.0)
    ranges[:, :2] = np.nan
    write_npz(folder / "a.npz", RangeScan(ranges, CAMERA))
    write_scans(folder / "scans", [RangeScan(ranges, CAMERA, name="a")], step_mm=0.02)
    for kind in ("ply", "stl", "obj"):
        write_mesh(ball(1, 40.0), folder / f"ball.{kind}", force_open=True)
    (folder / "half.ply").write_bytes((folder / "ball.ply").read_bytes()[:300])
    (folder / "empty.stl").touch()
    (folder / "settings.toml").write_text("seed = 3\n")
    (folder / "broken.toml").write_text("seed = [")
    (folder / "empty").mkdir()
    (folder / "a.json").write_text(json.dumps({"schema": "rangecheck/scans/1"}))
    shutil.copy(presets_folder() / "scenes" / "bored_block.toml", folder)
    return [*map(str, folder.iterdir()), str(folder / "missing.ply")]


def feed(folder: Path, count: int, seed: int) -> None:
    """Give `count` command lines to the program; exits with those answered wrongly."""
    from rangecheck_cli.main import COMMANDS, exit_status

    random = np.random.default_rng(seed)
    files, out = inputs(folder), folder / "out"
    os.chdir(folder)
    commands: dict[str, Any] = {
        name: importlib.import_module(f"rangecheck_cli.{name}_command").command for name in COMMANDS if name not in LEFT_OUT
    }
    names, told, wrong = list(commands), {}, []
    said, complaints = folder / "said", folder / "complaints"
    keep = (os.dup(1), os.dup(2))
    fed = 0
    while fed < count:
        name = names[fed % len(names)]
        line = drawn(random, name, commands[name], files, out)
        if not harmless(line):
            continue
        fed += 1
        for number, path in ((1, said), (2, complaints)):
            with path.open("w") as stream:
                os.dup2(stream.fileno(), number)
        start, fault = time.process_time(), ""
        try:
            status: Any = exit_status(line)
        except BaseException as error:
            status, fault = type(error).__name__, f"{type(error).__name__}: {error}"
        spent = time.process_time() - start
        sys.stdout.flush()
        for number, kept in zip((1, 2), keep):
            os.dup2(kept, number)
        lines = [one for one in complaints.read_text(errors="replace").splitlines() if one.startswith("rangecheck: ")]
        if not fault and status not in (0, 1, 2, 130):
            fault = f"status {status}"
        if not fault and status == 2 and len(lines) not in (1, 2) and name != "check":
            fault = f"{len(lines)} lines of complaint: {complaints.read_text(errors='replace')[-300:]}"
        if not fault and spent > LONGEST_S and fed > 5 * len(names):  # before that, kernels are compiled
            fault = f"{spent:.1f} s"
        told[f"{name} {status}"] = told.get(f"{name} {status}", 0) + 1
        if fault:
            wrong.append(f"{fault[:400]}\n    {line}")
    held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(f"{count} command lines of seed {seed}, {held / 1e6:.0f} MB at most: {dict(sorted(told.items()))}")
    if wrong:
        sys.exit("\n".join(wrong))


def test_every_command_line_is_answered_as_the_contract_says(tmp_path):
    code = f"from pathlib import Path; from fuzz.test_commands_fuzz import feed; feed(Path({str(tmp_path)!r}), {COUNT}, {SEED})"
    root = Path(__file__).resolve().parents[1]
    environment = os.environ | {"PYTHONPATH": str(root)}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, timeout=120 + COUNT, env=environment
    )
    print(done.stdout)
    assert done.returncode == 0, (done.stderr or done.stdout)[-3000:]
