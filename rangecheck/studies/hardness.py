"""What the job survives: SIGKILL at random moments, a full disk at every stage, fifty subjects in one process, an older processor.

A killed job stays in its folder, and the next kill strikes the job that takes it up again. After one to four kills in a row it is left to
finish, and its bytes are compared with the undisturbed job's. The parts kills-1 ... kills-5 together are 200 kills.
"""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.errors import RangecheckError
from rangecheck.studies.forked_command import Forked, Moment, forked_command
from rangecheck.studies.hardness_disk import DISK_PARTS
from rangecheck.studies.hardness_jobs import FINISHED, LOCK, SMALL, UNFINISHED, faults, left_over, small_scans, whole_files
from rangecheck.studies.hardness_machines import machines_part
from rangecheck.studies.whole_commands import command_line
from rangecheck.study import Part, study_of_parts
from rangecheck.study.memory import held_mb

#: kills of one part, and parts: each has a seed of its own
KILLS, PIECES = 40, 5
#: kills that one job must bear before it is left to finish: one to so many
MOST_IN_A_ROW = 4
SUBJECTS, SETTLED, ALLOWED_GROWTH = 50, 3, 0.05


def _kills_part(quick: bool, seed: int) -> Part:
    """Every other kill comes at a moment drawn evenly from the job's time, the rest at or a moment after one of its operations on files."""
    kills = 6 if quick else KILLS
    random = np.random.default_rng(seed)
    rows: list[dict[str, Any]] = []
    came_late = completed = same = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scans, out = small_scans(folder), folder / "killed"

        def job(to: Path) -> list[str]:
            return ["run", str(scans), "--out", str(to), *SMALL]

        with forked_command(job(folder / "warm")) as command:
            whole = command.run(job(folder / "undisturbed"))
            undisturbed = whole_files(folder / "undisturbed")
            left = int(random.integers(1, MOST_IN_A_ROW + 1))
            while len(rows) < kills:
                before = len(whole_files(out))
                killed = command.run(job(out), _moment(random, whole, by_time=len(rows) % 2 == 0))
                if killed.status == -signal.SIGKILL:
                    left -= 1
                    row = {"seconds": killed.seconds, "operations": killed.operations, "files_before": before}
                    rows.append(row | {"files": len(whole_files(out)), "half": faults(out, undisturbed), "same": None})
                else:
                    came_late += 1  # what is taken up again has less to do than the undisturbed job
                finished = (out / FINISHED).exists() and not (out / UNFINISHED).exists()
                if not finished and left > 0 and len(rows) < kills:
                    continue
                if not finished:
                    command.run(job(out))
                completed += 1
                ended_well = whole_files(out) == undisturbed and set(left_over(out)) <= ({LOCK} if finished else set())
                same += ended_well
                if rows:
                    rows[-1]["same"] = ended_well
                shutil.rmtree(out)
                left = int(random.integers(1, MOST_IN_A_ROW + 1))
    half = [f"kill {k + 1}: {', '.join(row['half'])}" for k, row in enumerate(rows) if row["half"]]
    finding = (
        f"{kills} SIGKILLs struck a job of {whole.seconds:.1f} s and {whole.operations} operations on files ({came_late} more came after its "
        f"end): {len(half)} times a half file under a final name; {same} of {completed} jobs taken up again, or struck after their last file, "
        f"ended with the bytes of all {len(undisturbed)} files"
    )
    return Part(findings=[finding, *half], tables={f"kills_{seed}": rows})


def _moment(random: np.random.Generator, whole: Forked, *, by_time: bool) -> Moment:
    if by_time:
        return Moment(seconds=float(random.uniform(0.0, whole.seconds)))
    after = float(random.exponential(whole.seconds / whole.operations)) * float(random.integers(2))
    return Moment(operation=int(random.integers(1, whole.operations + 1)), then_s=after)


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
        f"{subjects} subjects in one process: {settled:.0f} MB after subject {SETTLED}, {last:.0f} MB after the last, {100 * growth:+.1f} % "
        f"(at most {100 * ALLOWED_GROWTH:.0f} %: {'kept' if growth <= ALLOWED_GROWTH else 'missed'}); the most after any {max(held):.0f} MB"
    )
    return Part(findings=[finding], tables={"memory": [{"subject": k + 1, "held_mb": mb} for k, mb in enumerate(held)]})


_PARTS: dict[str, Callable[[bool], Part]] = {f"kills-{k + 1}": partial(_kills_part, seed=k + 1) for k in range(PIECES)}
_PARTS |= DISK_PARTS | {"memory": _memory_part, "machines": machines_part}
PARTS = tuple(_PARTS)
study = study_of_parts("hardness", "Hardness: kills, full disks and long runs", _PARTS)
