"""Folders of structured-light pictures: the list of patterns, the pictures and the calibration of each camera.

Two layouts are read:
- `capture.json`: {"schema": "rangecheck/capture/1", "unit": "mm", "left": CAMERA, "right": CAMERA} or with "projector": {"camera": {..},
  "world_from_camera": [[4x4]]} in place of right, where CAMERA = {"camera": {...}, "world_from_camera": [[4x4]], "pictures":
  [{"file": "a.png", "kind": "white"}, {"kind": "black"}, {"kind": "gray", "axis": "column", "bit": 0, "inverse": false},
   {"kind": "phase", "axis": "column", "period": 16.0, "step": 0, "steps": 4}]}; bit 0 is the most significant. A picture that is listed and
  not there, or not listed, is missing; how many bits there are is what the projector's size needs (or "cells": [columns, rows], where two
  cameras stand alone), or else the last that either camera lists;
- that of 3DUNDERWORLD-SLS: folders leftCam and rightCam with pictures numbered 0000 white, 0001 black, then the row bits and the column
  bits, most significant first, each followed by its inverse, and calib.xml (OpenCV: X_camera = R X_world + t, mm, and the size of
  the calibrated pictures, to which smaller ones are scaled).
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import mm_per
from rangecheck.errors import ArrayError, CameraError, InputError, told_of
from rangecheck.files import read_bytes, read_json
from rangecheck.kernels import in_chunks
from rangecheck.optics import PinholeCamera, camera_from_dict
from rangecheck.scan.decode.pictures import Picture, Pictures
from rangecheck.scan.decode.structured_light import View
from rangecheck.scan.readers.limits import beside, check_cells

SCHEMA = "rangecheck/capture/1"


class Capture(NamedTuple):
    """What `decode_gray_code` takes: left, left_view, right, right_view, and the projector where there is no right camera."""

    left: Pictures
    left_view: View
    right: Pictures | None
    right_view: View | None
    projector: View | None


def read_capture(folder: str | Path) -> Capture:
    """Pictures and calibration in `folder`. Missing pictures of a numbered sequence stay missing; white and black must be there.

    Raises InputError that names what is missing or does not fit."""
    folder = Path(folder)
    if (folder / "capture.json").is_file():
        with told_of(folder / "capture.json"):
            return _described(folder / "capture.json")
    if (folder / "leftCam").is_dir() and (folder / "rightCam").is_dir():
        named = [_by_number(folder / name) for name in ("leftCam", "rightCam")]
        # the last pictures of one camera, or of both, may be missing
        bits = max(-(-(max(found) - 1) // 4) for found in named)
        if not 2 <= bits <= 16:
            raise InputError(
                folder,
                f"ends with picture {max(map(max, named)):04d}; that is {bits} bits for each axis, and 2 to 16 are decoded",
            )
        left, right = (_numbered(folder / name, found, bits) for name, found in zip(("leftCam", "rightCam"), named))
        return Capture(*left, *right, None)
    if not folder.is_dir():
        said = (
            "is a file; give the folder of the structured-light pictures" if folder.exists() else "does not exist; check the name"
        )
        raise InputError(folder, said)
    below = sorted(p.parent.name for p in folder.glob("*/capture.json"))
    if below:
        raise InputError(folder, f"holds {len(below)} captures in its folders; name them one by one ({', '.join(below[:4])})")
    raise InputError(folder, "holds neither capture.json nor leftCam and rightCam; describe the pictures in capture.json")


def read_grey(path: Path, *, green: bool = False) -> Picture:
    """A grey picture (h, w) uint8 or uint16; colours become their luminance (ITU-R 601, as JPEG has it), or their green alone, which is
    of one wavelength's light whatever the numbers' response. Raises InputError."""
    import io

    from PIL import Image, UnidentifiedImageError

    content = read_bytes(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            picture = Image.open(io.BytesIO(content), formats=("JPEG", "PNG", "BMP", "PPM"))
            check_cells(path, *picture.size)
            if green and picture.mode not in ("L", "I;16", "I"):
                return np.asarray(picture.convert("RGB").getchannel("G"))
            if picture.mode == "I":
                # what PGM of more than 8 bits becomes: 0 to 65535 in 32 bits, which a conversion to grey would cut off at 255
                return np.asarray(picture).astype(np.uint16)
            return np.asarray(picture if picture.mode in ("L", "I;16") else picture.convert("L"))
    except InputError:
        raise
    except UnidentifiedImageError:
        raise InputError(path, "is no picture that can be read; JPEG, PNG, BMP and PPM can") from None
    except Exception as error:  # Pillow raises whatever a damaged file leads it to
        raise InputError(path, f"is a damaged picture ({' '.join(str(error).split())[:100]}); copy it again") from None


def _read_all(paths: list[Path]) -> list[Picture]:
    return [p for some in in_chunks(lambda i, j: [read_grey(p) for p in paths[i:j]], len(paths), 1) for p in some]


def _by_number(folder: Path) -> dict[int, Path]:
    """Pictures by their numbers; of several files of one number the last, for decoded copies carry a suffix after the number."""
    by_number: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        match = re.match(r"(\d{4})(?:\D.*)?\.(jpg|jpeg|png|bmp|pgm)$", path.name, re.IGNORECASE)
        if match:
            by_number[int(match[1])] = path
    if not {0, 1} <= set(by_number):
        raise InputError(folder, "lacks picture 0000 (white) or 0001 (black); both are needed")
    return by_number


def _numbered(folder: Path, by_number: dict[int, Path], bits: int) -> tuple[Pictures, View]:
    numbers = sorted(by_number)
    pictures = dict(zip(numbers, _read_all([by_number[n] for n in numbers])))

    def pairs(start: int) -> list[tuple[Picture | None, Picture | None]]:
        return [(pictures.get(start + 2 * k), pictures.get(start + 2 * k + 1)) for k in range(bits)]

    height, width = pictures[0].shape
    wrong = [n for n in numbers if pictures[n].shape != (height, width)]
    if wrong:
        raise InputError(
            by_number[wrong[0]], f"is {pictures[wrong[0]].shape[::-1]} pixels and picture 0000 {(width, height)}; use one size"
        )
    view = _opencv_view(folder / "calib.xml", width, height)
    full = float(np.iinfo(pictures[0].dtype).max)
    return Pictures(pictures[0], pictures[1], pairs(2 + 2 * bits), pairs(2), full_scale=full, name=folder.name), view


def _opencv_view(path: Path, width: int, height: int) -> View:
    """The view in an OpenCV storage file, scaled from its Width and Height to pictures of `width` x `height`."""
    content = read_bytes(path, 1 << 22)
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise InputError(path, "declares entities, which OpenCV's files do not; the file is refused")
    try:
        camera = ElementTree.fromstring(content).find("Camera")
        if camera is None:
            raise ValueError("it has no Camera")
        matrix, lens, shift, turn = (
            np.array((camera.findtext(f"{key}/data") or "").split(), dtype=float)
            for key in ("Matrix", "Distortion", "Translation", "Rotation")
        )
        full = int(camera.findtext("Width") or 0), int(camera.findtext("Height") or 0)
        k = matrix.reshape(3, 3)
        world_from_camera = rigid.inverse(rigid.from_rotation_translation(turn.reshape(3, 3), shift))
        scale = full[0] / width
        if full[0] < 1 or abs(full[1] / height - scale) > 0.01 * scale:
            raise ValueError(f"it was calibrated on {full[0]} x {full[1]} pixels, and the pictures have {width} x {height}")
        pinhole = PinholeCamera(
            width,
            height,
            k[0, 0] / scale,
            k[1, 1] / scale,
            (k[0, 2] + 0.5) / scale - 0.5,  # pixels count from their middle
            (k[1, 2] + 0.5) / scale - 0.5,
            tuple(lens.tolist()),
        )
    except (ElementTree.ParseError, ValueError, LookupError, ArrayError, CameraError) as error:
        raise InputError(path, f"is no calibration that can be used: {error}") from None
    return View(pinhole, world_from_camera)


def _described(path: Path) -> Capture:
    document = read_json(path)
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise InputError(path, f"is not a capture; its schema must be {SCHEMA!r}")
    if "left" not in document or ("right" in document) == ("projector" in document):
        raise InputError(path, "needs left, and either right or projector")
    scale = mm_per(document.get("unit", "")) if document.get("unit") in ("mm", "cm", "m", "um", "in") else 0.0
    if scale == 0.0:
        raise InputError(path, f"says its unit is {document.get('unit')!r}; it must be mm, cm, m, um or in")
    cells = _cells(path, document)
    left = _camera(path, "left", document["left"], scale)
    if "projector" in document:
        projector = _view(path, "projector", document["projector"], scale)
        return Capture(
            left.pictures(left.bits(cells or (projector.camera.width, projector.camera.height))), left.view, None, None, projector
        )
    right = _camera(path, "right", document["right"], scale)
    least = left.bits(cells), right.bits(cells)
    bits = {axis: max(n[axis] for n in least) for axis in ("column", "row")}
    return Capture(left.pictures(bits), left.view, right.pictures(bits), right.view, None)


def _cells(path: Path, document: dict[str, Any]) -> tuple[int, int] | None:
    match document.get("cells"):
        case None:
            return None
        case [int(columns), int(rows)] if 2 <= columns <= 65536 and 2 <= rows <= 65536:
            return columns, rows
    raise InputError(path, f"has cells {document['cells']!r:.60}; they are the projector's [columns, rows], 2 to 65536 each")


def _view(path: Path, where: str, entry: Any, scale: float) -> View:
    try:
        pose = np.array(rigid.checked(entry.get("world_from_camera", np.eye(4)), "world_from_camera"))
        pose[:3, 3] *= scale
        return View(camera_from_dict(entry["camera"]), pose)
    except (AttributeError, KeyError, TypeError, ArrayError, CameraError) as error:
        raise InputError(path, f"{where} has no usable camera and world_from_camera ({error})") from None


@dataclass(frozen=True)
class _Taken:
    """What one camera took, as far as it is there: white and black, (pattern, inverse) by bit, and phase pictures by step, with steps and
    period, by axis."""

    view: View
    name: str
    plain: dict[str, Picture]
    found: dict[str, dict[int, list[Picture | None]]]
    phases: dict[str, dict[int, Picture | None]]
    steps: dict[str, tuple[int, float]]

    def bits(self, cells: tuple[int, int] | None) -> dict[str, int]:
        """How many bits each axis has: as many as this camera lists, and as many as `cells` need of an axis that is listed at all."""
        counts = {}
        for k, axis in enumerate(("column", "row")):
            listed = max(self.found[axis], default=-1) + 1
            counts[axis] = max(listed, (cells[k] - 1).bit_length()) if cells and listed else listed
        return counts

    def pictures(self, bits: dict[str, int]) -> Pictures:
        """All of them, those that are missing as None."""
        none: list[Picture | None] = [None, None]
        pairs = {
            axis: [(found.get(k, none)[0], found.get(k, none)[1]) for k in range(bits[axis])]
            for axis, found in self.found.items()
        }
        shifted = {
            axis: ([self.phases[axis].get(k) for k in range(count)], period) for axis, (count, period) in self.steps.items()
        }
        full = float(np.iinfo(self.plain["white"].dtype).max)
        return Pictures(
            self.plain["white"], self.plain["black"], pairs["column"], pairs["row"], shifted.get("column"), shifted.get("row"), full,
            self.name,
        )  # fmt: skip


def _camera(path: Path, where: str, entry: Any, scale: float) -> _Taken:
    view = _view(path, where, entry, scale)
    listed = entry.get("pictures")
    if not isinstance(listed, list) or not all(isinstance(p, dict) and isinstance(p.get("file"), str) for p in listed):
        raise InputError(path, f"{where} needs a list `pictures` of objects with a file and a kind")
    files = [beside(path, p["file"]) for p in listed]
    there = [file for file in files if file.exists()]
    read = dict(zip(there, _read_all(there)))
    taken = _Taken(view, where, {}, {"column": {}, "row": {}}, {"column": {}, "row": {}}, {})
    for described, file in zip(listed, files):
        picture = read.get(file)
        match described:
            case {"kind": "white" | "black" as kind}:
                if picture is None:
                    raise InputError(file, f"does not exist; {where} cannot be decoded without its {kind} picture")
                taken.plain[kind] = picture
            case {"kind": "gray", "axis": "column" | "row" as axis, "bit": int(bit)} if 0 <= bit < 16:
                taken.found[axis].setdefault(bit, [None, None])[bool(described.get("inverse", False))] = picture
            case {"kind": "phase", "axis": "column" | "row" as axis, "step": int(step), "period": float() | int() as period} if (
                0 <= step < 64 and isinstance(count := described.get("steps"), int) and step < count <= 64
            ):
                taken.phases[axis][step] = picture
                taken.steps[axis] = max(count, taken.steps.get(axis, (0, 0.0))[0]), float(period)
            case _:
                raise InputError(
                    path,
                    f"{where} lists {described!r:.100}; kinds are white, black, gray (axis, bit, inverse) and phase (axis, step, steps, period)",
                )
    if len(taken.plain) != 2:
        raise InputError(path, f"{where} lacks a white or a black picture; both are needed")
    return taken
