"""The small job that the studies of hardness disturb, and what its folder may hold at any moment.

Of three views of a ball, so that every stage of the job is passed within seconds. A file under its final name must be the undisturbed
job's, byte for byte. Two quote how long things took: of run.json that is left out, and report.html must end as a page does. What is under
way stands in hidden files, and in manifests of what is finished so far, which must be valid JSON.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.export.meshes import write_mesh
from rangecheck.export.pictures import png_bytes
from rangecheck.files import write_bytes, write_json
from rangecheck.optics import PinholeCamera
from rangecheck.raycast import EmbreeCaster
from rangecheck.rigid import look_at
from rangecheck.scan.simulate_gray_code import Capture as Lighting
from rangecheck.scan.simulate_gray_code import simulate_gray_code
from rangecheck.studies.scenes import ball
from rangecheck.studies.whole_commands import command

#: manifests of what is finished so far: they grow, and may be there or not
UNFINISHED = "unfinished.json"
UNDER_WAY = (UNFINISHED, "frames.json", "underway.jsonl")
#: what the job writes last, and what keeps others away while it runs
FINISHED, LOCK = "run.json", ".lock"
#: pictures as small as they may be; without what computes long and writes nothing
SMALL = ("--frames", "2", "--size", "24x24", "--set", "light.model=direct", "--set", "scan.quality=false")
_TIMES = ("seconds", "peak_memory_mb")


def small_mesh(folder: Path) -> Path:
    """A ball of 1280 faces as a file."""
    write_mesh(ball(3, 40.0), folder / "ball.ply")
    return folder / "ball.ply"


def small_scans(folder: Path, seed: int = 0) -> Path:
    """The folder of its scans."""
    scans = folder / f"scans_{seed}"
    mesh = small_mesh(folder)
    views = ("--views", "3", "--size", "40x40", "--noise-mm", "0.05", "--seed", str(seed))
    command("simulate", str(mesh), "--unit", "mm", *views, "-o", str(scans))
    return scans


def small_capture(folder: Path) -> Path:
    """The folder of a ball's pictures under Gray codes of 32 x 32 cells."""
    capture = folder / "capture"
    surface = ball(4, 40.0)
    camera = PinholeCamera.from_field_of_view(80, 60, 12.0)
    projector = PinholeCamera.from_field_of_view(32, 32, 12.0)
    views = [look_at(eye, (0.0, 0.0, 0.0)) for eye in ((-60.0, 0.0, 500.0), (60.0, 0.0, 500.0))]
    caster = EmbreeCaster(surface.vertices, surface.faces)
    taken = simulate_gray_code(caster, camera, views[0], projector, views[1], Lighting(), seed=0)
    entries: list[dict[str, Any]] = []
    for name, picture in zip(taken.names, taken.pictures):
        write_bytes(capture / f"{name}.png", png_bytes(picture))
        axis, *rest = name.split("_")
        what = {"kind": "gray", "axis": axis, "bit": 4 - int(rest[0]), "inverse": len(rest) > 1} if rest else {"kind": name}
        entries.append({"file": f"{name}.png"} | what)
    left, right = ({"camera": c.to_dict(), "world_from_camera": v.tolist()} for c, v in zip((camera, projector), views))
    document = {"schema": "rangecheck/capture/1", "unit": "mm", "left": left | {"pictures": entries}, "projector": right}
    write_json(capture / "capture.json", document)
    return capture


def small_photograph(folder: Path) -> Path:
    """A matt sphere of radius 40 pixels around (48, 48), lit from beside the camera."""
    x, y = (np.mgrid[0:96, 0:96][::-1] - 48.0) / 40.0
    z = np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
    lit = np.where(z > 0, 0.6 * np.maximum(0.42 * x - 0.32 * y + 0.85 * z, 0.0), 0.0)
    write_bytes(folder / "sphere.png", png_bytes(np.rint(lit * 65535).astype(np.uint16)))
    return folder / "sphere.png"


def whole_files(folder: Path) -> dict[str, str]:
    """What every file under a final name says, by name: a digest, or 'not whole: ...'. Hidden files and what is under way are left out."""
    found: dict[str, str] = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if not path.is_file() or path.name.startswith("."):
            continue
        if path.name in UNDER_WAY:
            wrong = _not_json(path)
            if wrong:
                found[name] = wrong
        else:
            found[name] = _content(path)
    return found


def faults(folder: Path, undisturbed: dict[str, str]) -> list[str]:
    """Names of files in the folder that are there and are not the undisturbed job's."""
    return [name for name, content in whole_files(folder).items() if undisturbed.get(name) != content]


def left_over(folder: Path) -> list[str]:
    """Hidden files that something killed, or refused, left behind."""
    return [str(path.relative_to(folder)) for path in sorted(folder.rglob(".*")) if path.is_file()]


def _content(path: Path) -> str:
    content = path.read_bytes()
    if path.name == "report.html":
        return "a page" if content.rstrip().endswith(b"</html>") else f"not whole: {len(content)} bytes"
    if path.suffix == ".json":
        wrong = _not_json(path)
        if wrong:
            return wrong
        document = json.loads(content)
        if isinstance(document, dict) and any(key in document for key in _TIMES):
            kept = {key: value for key, value in document.items() if key not in _TIMES}
            content = json.dumps(kept, sort_keys=True).encode()
    return hashlib.sha256(content).hexdigest()


def _not_json(path: Path) -> str:
    try:
        # the last line of a list may have been cut off; those who read it know
        for part in path.read_text().split("\n")[:-1] if path.suffix == ".jsonl" else [path.read_text()]:
            json.loads(part)
    except (ValueError, OSError) as error:
        return f"not whole: {error}"
    return ""
