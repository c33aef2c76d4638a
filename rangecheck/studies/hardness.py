"""What the job survives: SIGKILL at random moments, a full disk at every stage, fifty subjects in one process.

Moments of kills are drawn evenly from the time that the undisturbed job takes, each part with a seed of its own, so that the parts
kills-1 ... kills-20 together are 200 kills. A killed job stays in its folder and the next kill strikes the job that takes it up again; every
fifth is left to finish, and its bytes are compared.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.errors import RangecheckError
from rangecheck.studies.hardness_disk import DISK_PARTS
from rangecheck.studies.hardness_jobs import SMALL, faults, left_over, small_scans, whole_files
from rangecheck.studies.whole_commands import command, command_line, killed_after
from rangecheck.study import Part, study_of_parts
from rangecheck.study.memory import held_mb

KILLS, PIECES = 10, 20
#: a job is left to finish after so many kills
FINISH_AFTER = 5
SUBJECTS, SETTLED, ALLOWED_GROWTH = 50, 3, 0.05


def _kills_part(quick: bool, seed: int) -> Part:
    kills, finish_after = (2, 2) if quick else (KILLS, FINISH_AFTER)
    random = np.random.default_rng(seed)
    rows: list[dict[str, Any]] = []
    completed = same = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scans = small_scans(folder)

        def job(out: Path) -> list[str]:
            return ["run", str(scans), "--out", str(out), *SMALL]

        command(*job(folder / "warm"))  # compiles, where nothing was kept
        took = command(*job(folder / "undisturbed")).seconds
        undisturbed = whole_files(folder / "undisturbed")
        out = folder / "killed"
        struck = 0
        while struck < kills:
            moment = float(random.uniform(0.0, took))
            ended = killed_after(job(out), moment)
            struck += not ended
            wrong = faults(out, undisturbed)
            finished = (out / "run.json").exists()  # killed after its last file, or not at all
            row = {
                "kill": struck,
                "seconds": moment,
                "ended_before": ended,
                "files": len(whole_files(out)),
                "half": wrong,
                "same": None,
            }
            rows.append(row)
            if not finished and struck % finish_after and struck < kills:
                continue
            if not finished:
                command(*job(out))
            completed += 1
            row["same"] = whole_files(out) == undisturbed and (finished or not left_over(out))
            same += bool(row["same"])
            shutil.rmtree(out)
        files = len(undisturbed)
    half = [f"kill {row['kill']}: {', '.join(row['half'])}" for row in rows if row["half"]]
    finding = (
        f"{kills} SIGKILLs struck a job of {took:.1f} s, at moments drawn from seed {seed} ({len(rows) - kills} more came after its end): "
        f"{len(half)} times a half file under a final name; {same} of {completed} jobs taken up again ended with the bytes of all {files} files"
    )
    return Part(findings=[finding, *half], tables={f"kills_{seed}": rows})


def _memory_part(quick: bool) -> Part:
    """`run --each` in one process; what it holds is read as each subject ends."""
    subjects = 4 if quick else SUBJECTS
    held: list[float] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # as many different subjects as settle it; the rest are the same scans under other names
        made = [small_scans(folder, seed) for seed in range(SETTLED)]
        names = [folder / "subjects" / f"subject_{k:02d}" for k in range(subjects)]
        for k, path in enumerate(names):
            shutil.copytree(made[k % SETTLED], path)
        line = command_line(["run", *map(str, names), "--each", "--out", str(folder / "out"), *SMALL], quiet=False)
        with subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
            assert process.stderr is not None
            for said in process.stderr:
                if re.match(r"subject_\d+: ", said):
                    held.append(held_mb(process.pid))
        if process.returncode not in (0, 1) or len(held) != subjects:
            raise RangecheckError(f"the subjects' process ended with {process.returncode} after {len(held)} of {subjects}")
    settled, last = held[SETTLED - 1], held[-1]
    growth = last / settled - 1
    finding = (
        f"{subjects} subjects in one process: {settled:.0f} MB after subject {SETTLED}, {last:.0f} MB after the last, {growth:+.1%} "
        f"(at most {ALLOWED_GROWTH:.0%}: {'kept' if growth <= ALLOWED_GROWTH else 'missed'}); the most after any {max(held):.0f} MB"
    )
    return Part(findings=[finding], tables={"memory": [{"subject": k + 1, "held_mb": mb} for k, mb in enumerate(held)]})


_PARTS: dict[str, Callable[[bool], Part]] = {f"kills-{k + 1}": partial(_kills_part, seed=k + 1) for k in range(PIECES)}
_PARTS |= DISK_PARTS | {"memory": _memory_part}
PARTS = tuple(_PARTS)
study = study_of_parts("hardness", "Hardness: kills, full disks and long runs", _PARTS)
