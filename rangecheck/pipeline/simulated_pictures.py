"""The pictures that one or two cameras take of a subject under Gray code, written as captures that `decode` reads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import ScanError
from rangecheck.files import whole_file, write_json
from rangecheck.optics import PinholeCamera
from rangecheck.progress import Reporter
from rangecheck.rigid import look_at
from rangecheck.scan.decode.capture import SCHEMA
from rangecheck.scan.readers.depth_png import write_png
from rangecheck.scan.simulate import RangeFinder
from rangecheck.scan.simulate_gray_code import Capture, GrayCodePictures, simulate_gray_code

#: most columns of the projector, and camera pixels that its columns are at least wide on average: narrower stripes are not resolved
COLUMNS, PIXELS = 1024, 2.0


def projector_for(camera: PinholeCamera) -> PinholeCamera:
    """A projector of 4 to 3, of as many columns as a power of two lets the camera resolve, whose light covers what the camera's smaller
    field of view covers."""
    width = min(COLUMNS, max(16, 1 << int(math.log2(min(camera.width, 4 * camera.height / 3) / PIXELS))))
    height = 3 * width // 4
    focal = camera.fx * height / min(camera.width, camera.height)
    return PinholeCamera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))


def write_captures(
    folder: Path,
    subject: Any,
    camera: PinholeCamera,
    poses: Sequence[FloatArray],
    middle_mm: FloatArray,
    finder: RangeFinder,
    cameras: int,
    seed: int,
    reporter: Reporter,
) -> list[Path]:
    """A folder for each pose, with the pictures of each camera, capture.json, and the truth on the left camera's grid; the list of the
    capture.json. The projector stands to the right by the finder's baseline; of two cameras it stands in the middle."""
    projector = projector_for(camera)
    taking = Capture(
        working_distance_mm=finder.working_distance_mm, ambient=0.03 + finder.ambient, full_scale=1.3 + finder.ambient
    )
    baseline = np.asarray(finder.source_mm)
    written = []
    with reporter.stage("taking pictures", len(poses) * cameras):
        for index, pose in enumerate(poses):
            where = folder / f"view_{index:02d}"
            right = look_at(pose[:3, 3] + pose[:3, :3] @ baseline, middle_mm)
            lamp = look_at(pose[:3, 3] + pose[:3, :3] @ (baseline / cameras), middle_mm)
            document: dict[str, Any] = {"schema": SCHEMA, "unit": "mm"}
            for k, (side, stand) in enumerate((("left", pose), ("right", right))[:cameras]):
                made = simulate_gray_code(
                    subject.caster, camera, stand, projector, lamp, taking, seed, camera_index=cameras * index + k,
                    finish=subject.finish, motion=subject.motion,
                )  # fmt: skip
                if not np.isfinite(made.true_column).any():
                    raise ScanError(f"view_{index:02d}: the projector lights nothing that the {side} camera sees")
                document[side] = _placed(camera, stand) | {"pictures": _written(where, side, made)}
                if k == 0:
                    _truth(where / "truth.npz", made)
                reporter.advance(cameras * index + k + 1)
            if cameras == 1:
                document["projector"] = _placed(projector, lamp)
            # last: with it the capture is whole
            write_json(where / "capture.json", document)
            written.append(where / "capture.json")
    return written


def _placed(camera: PinholeCamera, pose: FloatArray) -> dict[str, Any]:
    return {"camera": camera.to_dict(), "world_from_camera": pose.tolist()}


def _written(where: Path, side: str, made: GrayCodePictures) -> list[dict[str, Any]]:
    """Write the pictures, and the entries that say what each shows; a capture's bit 0 is the most significant."""
    entries = []
    for name, picture in zip(made.names, made.pictures):
        file = f"{side}/{name}.png"
        write_png(where / file, picture)
        entry: dict[str, Any] = {"file": file}
        if name in ("white", "black"):
            entry["kind"] = name
        else:
            axis, number, *inverse = name.split("_")
            most = max(int(other.split("_")[1]) for other in made.names if other.startswith(axis))
            entry |= {"kind": "gray", "axis": axis, "bit": most - int(number), "inverse": bool(inverse)}
        entries.append(entry)
    return entries


def _truth(path: Path, made: GrayCodePictures) -> None:
    with whole_file(path) as part, part.open("wb") as stream:
        np.savez_compressed(stream, true_range_mm=made.true_range_mm, true_column=made.true_column, true_row=made.true_row)
