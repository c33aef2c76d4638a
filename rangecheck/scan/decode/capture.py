"""Folders of structured-light pictures: the list of patterns, the pictures and the calibration of each camera.

Two layouts are read:
- `capture.json`: {"schema": "rangecheck/capture/1", "unit": "mm", "left": CAMERA, "right": CAMERA} or with "projector": {"camera": {..},
  "world_from_camera": [[4x4]]} in place of right, where CAMERA = {"camera": {...}, "world_from_camera": [[4x4]], "pictures":
  [{"file": "a.png", "kind": "white"}, {"kind": "black"}, {"kind": "gray", "axis": "column", "bit": 0, "inverse": false},
   {"kind": "phase", "axis": "column", "period": 16.0, "step": 0, "steps": 4}]}; bit 0 is the most significant;
- that of 3DUNDERWORLD-SLS: folders leftCam and rightCam with pictures numbered 0000 white, 0001 black, then the row bits and the column
  bits, most significant first, each followed by its inverse, and calib.xml (OpenCV: X_camera = R X_world + t, mm, and the size of
  the calibrated pictures, to which smaller ones are scaled).
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import mm_per
from rangecheck.errors import ArrayError, CameraError, InputError
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
        return _described(folder / "capture.json")
    if (folder / "leftCam").is_dir() and (folder / "rightCam").is_dir():
        left, left_view = _numbered(folder / "leftCam")
        right, right_view = _numbered(folder / "rightCam")
        return Capture(left, left_view, right, right_view, None)
    if not folder.is_dir():
        raise InputError(folder, "is not a folder of structured-light pictures")
    below = sorted(p.parent.name for p in folder.glob("*/capture.json"))
    if below:
        raise InputError(folder, f"holds {len(below)} captures in its folders; name them one by one ({', '.join(below[:4])})")
    raise InputError(folder, "holds neither capture.json nor leftCam and rightCam; describe the pictures in capture.json")


def read_grey(path: Path) -> Picture:
    """A grey picture (h, w) uint8 or uint16; colours become their luminance (ITU-R 601, as JPEG has it). Raises InputError."""
    import io

    from PIL import Image

    content = read_bytes(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            picture = Image.open(io.BytesIO(content), formats=("JPEG", "PNG", "BMP", "PPM"))
            check_cells(path, *picture.size)
            return np.asarray(picture if picture.mode in ("L", "I;16") else picture.convert("L"))
    except InputError:
        raise
    except Exception as error:  # Pillow raises whatever a damaged file leads it to
        raise InputError(path, f"is a damaged picture ({' '.join(str(error).split())[:100]}); copy it again") from None


def _read_all(paths: list[Path]) -> list[Picture]:
    return [p for some in in_chunks(lambda i, j: [read_grey(p) for p in paths[i:j]], len(paths), 1) for p in some]


def _numbered(folder: Path) -> tuple[Pictures, View]:
    by_number: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        match = re.match(r"(\d{4})(?:\D.*)?\.(jpg|jpeg|png|bmp|pgm)$", path.name, re.IGNORECASE)
        if match:
            # of several files of one number the last: decoded copies carry a suffix after the number
            by_number[int(match[1])] = path
    if not {0, 1} <= set(by_number):
        raise InputError(folder, "lacks picture 0000 (white) or 0001 (black); both are needed")
    bits = -(-(max(by_number) + 1 - 2) // 4)  # the last pictures may be missing
    if not 2 <= bits <= 16:
        raise InputError(
            folder, f"ends with picture {max(by_number):04d}; that is {bits} bits for each axis, and 2 to 16 are decoded"
        )
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
    left = _camera(path, "left", document["left"], scale)
    if "projector" in document:
        return Capture(*left, None, None, _view(path, "projector", document["projector"], scale))
    return Capture(*left, *_camera(path, "right", document["right"], scale), None)


def _view(path: Path, where: str, entry: Any, scale: float) -> View:
    try:
        pose = np.array(rigid.checked(entry.get("world_from_camera", np.eye(4)), "world_from_camera"))
        pose[:3, 3] *= scale
        return View(camera_from_dict(entry["camera"]), pose)
    except (AttributeError, KeyError, TypeError, ArrayError, CameraError) as error:
        raise InputError(path, f"{where} has no usable camera and world_from_camera ({error})") from None


def _camera(path: Path, where: str, entry: Any, scale: float) -> tuple[Pictures, View]:
    view = _view(path, where, entry, scale)
    listed = entry.get("pictures")
    if not isinstance(listed, list) or not all(isinstance(p, dict) and isinstance(p.get("file"), str) for p in listed):
        raise InputError(path, f"{where} needs a list `pictures` of objects with a file and a kind")
    pictures = _read_all([beside(path, p["file"]) for p in listed])
    plain: dict[str, Picture] = {}
    bits: dict[str, dict[int, list[Picture | None]]] = {"column": {}, "row": {}}
    phases: dict[str, dict[int, Picture]] = {"column": {}, "row": {}}
    periods: dict[str, float] = {}
    for described, picture in zip(listed, pictures):
        match described:
            case {"kind": "white" | "black" as kind}:
                plain[kind] = picture
            case {"kind": "gray", "axis": "column" | "row" as axis, "bit": int(bit)} if 0 <= bit < 16:
                bits[axis].setdefault(bit, [None, None])[bool(described.get("inverse", False))] = picture
            case {"kind": "phase", "axis": "column" | "row" as axis, "step": int(step), "period": float() | int() as period}:
                phases[axis][step] = picture
                periods[axis] = float(period)
            case _:
                raise InputError(
                    path, f"{where} lists {described!r:.100}; kinds are white, black, gray (axis, bit, inverse) and phase"
                )
    if len(plain) != 2:
        raise InputError(path, f"{where} lacks a white or a black picture; both are needed")
    pairs = {
        axis: [(found.get(k, [None, None])[0], found.get(k, [None, None])[1]) for k in range(max(found, default=-1) + 1)]
        for axis, found in bits.items()
    }
    shifted = {axis: ([found[k] for k in sorted(found)], periods[axis]) if found else None for axis, found in phases.items()}
    full = float(np.iinfo(plain["white"].dtype).max)
    return (
        Pictures(plain["white"], plain["black"], pairs["column"], pairs["row"], shifted["column"], shifted["row"], full, where),
        view,
    )
