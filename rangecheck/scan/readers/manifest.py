"""Depth pictures and the JSON that says what their counts mean: one manifest for many scans, or `x.json` beside `x.png`.

    {"schema": "rangecheck/scans/1", "unit": "mm", "scans": [
      {"name": "view 0", "image": "view_0.png", "measures": "depth", "step": 0.02, "camera": {...},
       "world_from_scan": [[4x4]], "brightness": "view_0_brightness.png", "noise_mm": 0.2}]}

`step` is in `unit` per count, count 0 = nothing returned; `measures` is "depth" (z component) or "range" (length along the ray);
the translation of `world_from_scan` is in mm, as are the lengths of the camera. A lone `x.json` holds the entries of one scan and
the unit. Optional: name, image (lone JSON only), world_from_scan, brightness, noise_mm.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import MM_PER_UNIT, FloatArray, mm_per
from rangecheck.errors import ArrayError, CameraError, InputError, OutputError, UnitMissing
from rangecheck.files import read_json, write_json
from rangecheck.optics import Camera, CylindricalCamera, PinholeCamera, camera_from_dict
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.readers.depth_picture import read_picture
from rangecheck.scan.readers.depth_png import write_png
from rangecheck.scan.readers.limits import beside, plain_name

SCHEMA = "rangecheck/scans/1"
_SCAN_KEYS = ("name", "image", "measures", "step", "camera", "world_from_scan", "brightness", "noise_mm")
_KINDS = ("depth", "range")


def read_manifest(path: Path, unit: str | None = None) -> list[RangeScan]:
    """All scans of a manifest or of a lone `x.json`. Raises InputError that names the scan and the entry."""
    document = _document(path)
    if "scans" not in document:
        return [_lone(path, document, path.with_suffix(".png").name, unit)]
    _only(path, "", document, ("schema", "unit", "scans"))
    scans = document["scans"]
    if not isinstance(scans, list) or not scans:
        raise InputError(path, "has no scans; its list `scans` needs at least one entry")
    said = _unit(path, document, unit)
    return [_scan(path, f"scans[{index}]", entry, said) for index, entry in enumerate(scans)]


def read_lone_picture(path: Path, unit: str | None = None) -> list[RangeScan]:
    """The scan in the depth picture `path`, whose camera is in the JSON file of the same name beside it."""
    companion = path.with_suffix(".json")
    if not companion.is_file():
        raise InputError(
            path, f"has no camera; put {companion.name} beside it with unit, measures, step and camera, or name it in a manifest"
        )
    document = _document(companion)
    if "scans" in document:
        raise InputError(companion, f"lists many scans; {path.name} needs the measures, step and camera of one")
    return [_lone(companion, document | {"image": path.name}, path.name, unit)]


def pictures_of(path: Path) -> set[str] | None:
    """Names of the pictures that a lone `x.json` describes; None when it is a manifest, an empty set for any other JSON."""
    document = read_json(path)
    if not isinstance(document, dict):
        return set()
    if "scans" in document:
        return None
    if "camera" not in document:
        return set()
    return {str(document.get("image", path.with_suffix(".png").name)), str(document.get("brightness"))}


def write_scans(
    folder: str | Path, scans: Iterable[RangeScan], *, step_mm: float, measures: str = "depth", manifest: str = "scans.json"
) -> Path:
    """Write `scans` as 16-bit depth PNGs of `step_mm` per count, with brightness beside, and the manifest, whose path it returns.

    Lossless up to the step: distances come back within step_mm / 2, and what was read is written again with the same bytes.
    Brightness takes 8 bits where that loses nothing, else 16. Raises OutputError when a distance does not fit 65535 steps or
    the camera has no JSON form (a measured grid of rays: write NPZ)."""
    folder = Path(folder)
    if measures not in _KINDS:
        raise ArrayError(f"measures is {measures!r}; it must be depth or range", name="measures")
    if not (np.isfinite(step_mm) and step_mm > 0):
        raise ArrayError(f"step_mm is {step_mm}; it must be a positive length", name="step_mm")
    taken: set[str] = set()
    entries = []
    for scan in scans:
        stem = plain_name(scan.name, taken)
        image = folder / f"{stem}.png"
        if not isinstance(scan.camera, PinholeCamera | CylindricalCamera) and scan.camera.model == "raygrid":
            raise OutputError(image, "a measured grid of rays does not fit a manifest's camera; write NPZ instead")
        distance = scan.range_mm.astype(np.float64)
        if measures == "depth":
            scale, offset = _range_per_depth(image, scan.camera)
            distance = distance / scale + offset
        counts = np.rint(distance / step_mm)
        most, least = float(np.nanmax(counts, initial=0)), float(np.nanmin(counts, initial=1))
        if most > 65535 or least < 1:
            raise OutputError(
                image,
                f"{measures}s from {least * step_mm:g} to {most * step_mm:g} mm do not fit counts 1 to 65535 of {step_mm:g} mm; "
                f"choose a step of at least {most * step_mm / 65535:.3g} mm and below every {measures}",
            )
        write_png(image, np.where(scan.valid, counts, 0).astype(np.uint16))
        entry: dict[str, Any] = {"name": scan.name, "image": image.name, "measures": measures, "step": float(step_mm)}
        entry["camera"] = scan.camera.to_dict()
        entry["world_from_scan"] = scan.world_from_scan.tolist()
        if scan.brightness is not None:
            entry["brightness"] = plain_name(f"{stem}_brightness", taken) + ".png"
            write_png(folder / entry["brightness"], _brightness_counts(image, scan.brightness))
        if scan.noise_mm is not None:
            entry["noise_mm"] = float(scan.noise_mm)
        entries.append(entry)
    path = folder / manifest
    write_json(path, {"schema": SCHEMA, "unit": "mm", "scans": entries})
    return path


def _document(path: Path) -> dict[str, Any]:
    document = read_json(path)
    if not isinstance(document, dict):
        raise InputError(path, f"holds {type(document).__name__}; a manifest is an object with schema, unit and scans")
    schema = document.get("schema", SCHEMA)
    if schema != SCHEMA:
        raise InputError(path, f"has schema {schema!r}; scans are read from {SCHEMA!r}", schema=schema)
    return document


def _lone(path: Path, document: dict[str, Any], image: str, unit: str | None) -> RangeScan:
    entry = {"name": path.stem, "image": image} | {k: v for k, v in document.items() if k not in ("schema", "unit")}
    return _scan(path, "", entry, _unit(path, document, unit))


def _unit(path: Path, document: Mapping[str, Any], unit: str | None) -> str:
    said = document.get("unit")
    if said is None:
        if unit is None:
            raise UnitMissing(path)
        return unit
    if not isinstance(said, str) or said not in MM_PER_UNIT:
        raise InputError(path, f"says its unit is {said!r}; it must be one of {', '.join(MM_PER_UNIT)}")
    if unit is not None and unit != said:
        raise InputError(path, f"says its unit is {said}, and {unit} was asked for; leave out the unit, or correct the file")
    return said


def _only(path: Path, where: str, entries: Mapping[str, Any], known: tuple[str, ...]) -> None:
    unknown = [key for key in entries if key not in known]
    if unknown:
        raise InputError(path, f"{where or 'the document'} has an unknown entry {unknown[0]!r}; known are {', '.join(known)}")


def _scan(path: Path, where: str, entry: Any, unit: str) -> RangeScan:
    label = f"{where} " if where else ""
    if not isinstance(entry, dict):
        raise InputError(path, f"{where} is {entry!r:.40}; a scan is an object")
    _only(path, where, entry, _SCAN_KEYS)
    for key in ("image", "measures", "camera"):
        if key not in entry:
            raise InputError(path, f"{label}lacks {key!r}; a scan has {', '.join(_SCAN_KEYS[:5])}", key=key)
    if entry["measures"] not in _KINDS:
        raise InputError(path, f"{label}measures {entry['measures']!r}; it must be depth (z component) or range (along the ray)")
    image = beside(path, entry["image"])
    name = entry.get("name", image.stem)
    if not isinstance(name, str):
        raise InputError(path, f"{label}has the name {name!r}; a name is a string")
    noise = None if entry.get("noise_mm") is None else _number(path, label, "noise_mm", entry["noise_mm"])
    try:
        camera = camera_from_dict(entry["camera"])
        pose = rigid.checked(entry.get("world_from_scan", rigid.identity()), "world_from_scan")
    except (CameraError, ArrayError) as error:
        raise InputError(path, f"{label}{error}") from None
    picture = read_picture(image, expect=(camera.height, camera.width))
    if picture.dtype.kind == "f":
        step = _number(path, label, "step", entry.get("step", 1.0))
    elif "step" in entry:
        step = _number(path, label, "step", entry["step"])
    else:
        raise InputError(path, f"{label}lacks 'step', the {unit} per count of {image.name}")
    with np.errstate(invalid="ignore", over="ignore"):
        distance = picture.astype(np.float64) * (step * mm_per(unit))
        distance[~(np.isfinite(distance) & (distance > 0))] = np.nan
        if entry["measures"] == "depth":
            scale, offset = _range_per_depth(path, camera)
            distance = (distance - offset) * scale
        range_mm = distance.astype(np.float32)
    scan = RangeScan(range_mm, camera, pose, _brightness(path, entry, camera), name, unit, noise)
    if not scan.valid.any():
        raise InputError(image, "holds no distance: every cell says that nothing returned; check the file and its step")
    return scan


def _number(path: Path, label: str, key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e30:
        raise InputError(path, f"{label}has {key} {value!r}; it must be a positive number", key=key)
    return float(value)


def _brightness(path: Path, entry: Mapping[str, Any], camera: Camera) -> FloatArray | None:
    if entry.get("brightness") is None:
        return None
    picture = read_picture(beside(path, entry["brightness"]), expect=(camera.height, camera.width))
    full = 1.0 if picture.dtype.kind == "f" else float(np.iinfo(picture.dtype).max)
    return (picture / full).astype(np.float32)


def _brightness_counts(path: Path, brightness: FloatArray) -> np.ndarray:
    if not (np.isfinite(brightness).all() and brightness.min() >= 0 and brightness.max() <= 1):
        raise OutputError(path, "brightness lies outside 0..1; scale it first")
    coarse = np.rint(brightness * np.float64(255))
    if ((coarse / 255).astype(np.float32) == brightness).all():
        return coarse.astype(np.uint8)
    return np.rint(brightness * np.float64(65535)).astype(np.uint16)


def _range_per_depth(path: Path, camera: Camera) -> tuple[FloatArray, FloatArray | float]:
    """Per pixel: range = (depth - offset) scale, from the ray's z component and the z of its origin."""
    if isinstance(camera, CylindricalCamera):
        raise InputError(path, "a cylindrical camera has no depth axis; its pictures measure range")
    if isinstance(camera, PinholeCamera) and not any(camera.distortion):
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = (np.arange(camera.height) - camera.cy) / camera.fy
        return np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2), 0.0
    origins, directions = camera.pixel_rays()
    return 1 / directions[..., 2], origins[..., 2]
