"""Every command that writes, on a disk that fills up while it writes.

The disk is a tmpfs of its own in a namespace of its own, which Linux gives to anybody where user namespaces are allowed: first wide, to see
how much the command writes, then with room for a share of that. What stands there when the command has ended is copied out and compared.
Then the disk is made wide again and the same command must bring about what it would have.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rangecheck.errors import DependencyMissing, RangecheckError
from rangecheck.files import presets_folder
from rangecheck.studies.hardness_jobs import (
    SMALL,
    faults,
    left_over,
    small_capture,
    small_mesh,
    small_photograph,
    small_scans,
    whole_files,
)
from rangecheck.studies.whole_commands import command, command_line
from rangecheck.study import Part

#: room for these shares of what a command writes
SHARES = (0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9)
_FEW = (0.0, 0.5, 0.9)
_SCRIPT = """
set -e
disk=$1; before=$2; room_kib=$3; copies=$4; shift 4
used() { df -k --output=used "$disk" | tail -1; }
mount -t tmpfs -o size=512m none "$disk"
if [ -n "$before" ]; then cp -a "$before" "$disk/out"; fi
head -c 4096 /dev/zero >"$disk/filler"  # a size of 0 would be no limit
start=$(used)
if [ "$room_kib" -ge 0 ]; then mount -o remount,size=$((start + room_kib))k "$disk"; fi
status=0; "$@" >"$copies/said" 2>"$copies/complaint" </dev/null || status=$?
end=$(used)
rm "$disk/filler"
mkdir "$copies/left"; cp -a "$disk/." "$copies/left"
again=-
if [ "$room_kib" -ge 0 ]; then
    mount -o remount,size=512m "$disk"
    again=0; "$@" $FORCE >/dev/null 2>"$copies/complaint again" </dev/null || again=$?
    mkdir "$copies/again"; cp -a "$disk/." "$copies/again"
fi
echo $status $again $((end - start))
"""


@dataclass(frozen=True)
class Writer:
    """A command; '{out}' in its arguments is the disk's folder. `before` is what stands there already."""

    arguments: tuple[str, ...]
    shares: tuple[float, ...] = _FEW
    before: Path | None = None
    #: finished files stand in the way of the next try, and --force says that they may be replaced
    force: bool = False
    #: whether it writes the same bytes each time; a study tells of times
    repeats: bool = True


@dataclass(frozen=True)
class Ended:
    """How a command on a disk ended: its status, that of the same command once there was room, what it wrote, what it said, what was left."""

    status: int
    again: int | None
    wrote_kib: int
    complaint: str
    complaint_again: str
    left: Path
    left_again: Path


def on_disk(writer: Writer, room_kib: int | None, folder: Path) -> Ended:
    """The command on a disk with so much room beside what stands there (None: enough). Copies of the disk stay in `folder`.

    Raises DependencyMissing where the system gives no disk of one's own."""
    disk = folder.parent / "disk"  # the same name always: results may bear it
    disk.mkdir(exist_ok=True)
    folder.mkdir()
    line = command_line([part.replace("{out}", str(disk / "out")) for part in writer.arguments], quiet=False)
    script = [
        "sh",
        "-c",
        _SCRIPT,
        "sh",
        str(disk),
        str(writer.before or ""),
        str(-1 if room_kib is None else room_kib),
        str(folder),
    ]
    environment = os.environ | {"FORCE": "--force" if writer.force else ""}
    done = subprocess.run(
        ["unshare", "--user", "--map-root-user", "--mount", *script, *line], capture_output=True, text=True, env=environment
    )
    if done.returncode != 0:
        raise DependencyMissing(
            "unshare", f"a disk of its own ({done.stderr.strip()[-120:]})", "sysctl kernel.unprivileged_userns_clone=1"
        )
    status, again, wrote = done.stdout.split()[-3:]
    said = [folder / "complaint", folder / "complaint again"]
    words = [path.read_text(errors="replace") if path.exists() else "" for path in said]
    return Ended(
        int(status), None if again == "-" else int(again), int(wrote), words[0], words[1], folder / "left", folder / "again"
    )


def judged(ended: Ended, undisturbed: dict[str, str], repeats: bool = True) -> list[str]:
    """What is wrong with how a full disk was answered; empty when all is well. Without `repeats` files must be there and whole, no more."""
    wrong = []
    complaints = [line for line in ended.complaint.splitlines() if line.startswith("rangecheck: ")]
    if ended.status != 2:
        wrong.append(f"exit status {ended.status}")
    if len(complaints) != 1 or "Traceback" in ended.complaint:
        wrong.append(f"says {ended.complaint[-300:].strip()!r}")
    half = (
        faults(ended.left, undisturbed)
        if repeats
        else [n for n, said in whole_files(ended.left).items() if said.startswith("not")]
    )
    wrong += [f"{name} is not whole" for name in half]
    wrong += [f"{name} is left over" for name in left_over(ended.left)]
    if ended.again not in (0, 1):
        wrong.append(f"does not go on once there is room: {ended.complaint_again[-200:].strip()!r}")
    elif repeats and whole_files(ended.left_again) != undisturbed:
        wrong.append("ends with other bytes once there is room")
    elif whole_files(ended.left_again).keys() != undisturbed.keys():
        wrong.append("ends with other files once there is room")
    return wrong


def _job(folder: Path) -> dict[str, Writer]:
    return {"run": Writer(("run", str(small_scans(folder)), "--out", "{out}", *SMALL), SHARES)}


def _shapes(folder: Path) -> dict[str, Writer]:
    scans, mesh = str(small_scans(folder)), str(small_mesh(folder))
    command("run", scans, "--out", str(folder / "finished"), *SMALL)
    simulate = ("simulate", mesh, "--unit", "mm", "--views", "3", "--size", "40x40", "-o", "{out}")
    return {
        "mesh": Writer(("mesh", scans, "-o", "{out}/mesh.ply")),
        "solid": Writer(("solid", mesh, "--unit", "mm", "--base", "none", "-o", "{out}/ball.stl")),
        "simulate": Writer(simulate),
        "report": Writer(("report", "{out}"), (0.0, 0.5), folder / "finished"),
    }


def _pictures(folder: Path) -> dict[str, Writer]:
    mesh = str(small_mesh(folder))
    size = ("--unit", "mm", "--size", "40x40")
    return {
        "turntable": Writer(("turntable", mesh, *size, "--frames", "4", "-o", "{out}/turn.mp4"), (0.0, 0.3, 0.6, 0.9)),
        "maps": Writer(("maps", mesh, *size, "-o", "{out}"), (0.0, 0.3, 0.6, 0.9), force=True),
        "dataset": Writer(("dataset", mesh, *size, "--count", "4", "-o", "{out}"), (0.0, 0.3, 0.6, 0.9)),
        "render": Writer(("render", mesh, *size, "-o", "{out}/ball.png"), force=True),
    }


def _others(folder: Path) -> dict[str, Writer]:
    capture, photograph, scene = small_capture(folder), small_photograph(folder), presets_folder() / "scenes" / "bored_block.toml"
    sphere = ("--sphere", "48,48,40")
    return {
        "decode": Writer(("decode", str(capture), "--pictures", "-o", "{out}/scan.npz"), force=True),
        "draw": Writer(("draw", str(scene), "--size", "160x120", "-o", "{out}/block.svg")),
        "materials": Writer(("materials", "plaster", "steel", "-o", "{out}"), force=True),
        "fit": Writer(("fit", str(photograph), *sphere, "-o", "{out}/sphere.toml")),
        "calibrate": Writer(("fit", str(photograph), *sphere, "--calibrate", "matt", "-o", "{out}/lights.txt")),
        "init": Writer(("init", "-o", "{out}/settings.toml")),
        "study": Writer(("study", "reflectance", "--part", "grazing", "--quick", "-o", "{out}"), force=True, repeats=False),
    }


def _sample(folder: Path) -> dict[str, Writer]:
    return {"sample": Writer(("sample", "-o", "{out}"), (0.5,))}


def full_disk_part(quick: bool, which: str) -> Part:
    """The commands of one kind, each on disks of several sizes."""
    findings, rows = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for name, writer in KINDS[which](folder).items():
            enough = on_disk(writer, None, folder / name)
            undisturbed = whole_files(enough.left)
            if enough.status not in (0, 1):
                raise RangecheckError(f"rangecheck {name} ended with {enough.status} on an empty disk: {enough.complaint[-300:]}")
            shares = writer.shares[1:2] if quick else writer.shares
            bad = []
            for share in shares:
                place = folder / f"{name} {share:g}"
                ended = on_disk(writer, int(share * enough.wrote_kib) // 4 * 4, place)  # in whole pages
                wrong = judged(ended, undisturbed, writer.repeats)
                rows.append(
                    {"command": name, "share": share, "status": ended.status, "said": ended.complaint[-300:], "wrong": wrong}
                )
                bad += [f"{name} with room for {100 * share:.0f} % of {enough.wrote_kib} KiB: {one}" for one in wrong]
                shutil.rmtree(place)
            findings.append(
                f"{name}: {len(shares)} full disks, {'each answered in one line, nothing half-written' if not bad else 'NOT answered well:'}"
            )
            findings += bad
    return Part(findings=findings, tables={f"full_disk_{which}": rows})


KINDS = {"run": _job, "shapes": _shapes, "pictures": _pictures, "others": _others, "sample": _sample}
DISK_PARTS = {f"full-disk-{which}": partial(full_disk_part, which=which) for which in KINDS}
