"""Pose and intrinsics beside a picture: rangecheck's JSON, OpenCV's YAML, COLMAP's text.

All three mean the same camera: x right, y down, z forward. OpenCV counts pixels as we do (integers at centres); COLMAP puts the
upper left corner of the upper left pixel at (0, 0), so its principal point is half a pixel further. COLMAP and OpenCV state
camera_from_world: X_cam = R X_world + t, t in millimetres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rangecheck.arrays import FloatArray
from rangecheck.errors import ArrayError, CameraError, told_of
from rangecheck.files import read_json, write_bytes, write_json
from rangecheck.optics import Camera, PinholeCamera, camera_from_dict
from rangecheck.rigid import checked, inverse, quaternion_from_rotation

SCHEMA = "rangecheck/camera/1"
LIST_SCHEMA = "rangecheck/cameras/1"


def write_camera_json(
    path: str | Path, camera: Camera, world_from_camera: FloatArray, more: Mapping[str, Any] | None = None, *, force: bool = True
) -> None:
    """Camera and pose as JSON; `more` (exposure, lens, material, seed...) is kept under its own names."""
    pose = checked(world_from_camera, "world_from_camera")
    document = dict(more or {}) | {
        "schema": SCHEMA,
        "length_unit": "mm",
        "camera": camera.to_dict(),
        "world_from_camera": pose.tolist(),
    }
    write_json(path, document, force=force)


def write_camera_list(
    path: str | Path,
    camera: Camera,
    poses: Sequence[FloatArray],
    names: Sequence[str],
    more: Mapping[str, Any] | None = None,
    *,
    force: bool = True,
) -> None:
    """One camera and its pose in each picture of a sequence, as JSON."""
    rows = [
        {"picture": name, "world_from_camera": checked(pose, "world_from_camera").tolist()}
        for name, pose in zip(names, poses, strict=True)
    ]
    document = dict(more or {}) | {"schema": LIST_SCHEMA, "length_unit": "mm", "camera": camera.to_dict(), "pictures": rows}
    write_json(path, document, force=force)


def read_camera_json(path: str | Path) -> tuple[Camera, FloatArray, dict[str, Any]]:
    """Camera, world_from_camera and everything else of a file that `write_camera_json` wrote. Raises InputError, CameraError."""
    document = read_json(path)
    if not isinstance(document, dict) or document.get("schema") != SCHEMA or "camera" not in document:
        raise CameraError(f"{path} is no camera file: it must say schema {SCHEMA} and hold a camera")
    with told_of(path):
        camera = camera_from_dict(document.pop("camera"))
    try:
        pose = checked(document.pop("world_from_camera", None), "world_from_camera")
    except ArrayError as error:
        raise CameraError(f"{path}: {error}") from None
    return camera, pose, document


def write_opencv_yaml(path: str | Path, camera: Camera, world_from_camera: FloatArray, *, force: bool = True) -> None:
    """image_width, image_height, camera_matrix, distortion_coefficients, rvec-free R and t, as cv2.FileStorage reads them."""
    lens = _pinhole(camera, "OpenCV's YAML")
    pose = inverse(checked(world_from_camera, "world_from_camera"))
    distortion = [*lens.distortion, *([0.0] * (max(5, 8 * (len(lens.distortion) > 5)) - len(lens.distortion)))]
    lines = ["%YAML:1.0", "---", f"image_width: {lens.width}", f"image_height: {lens.height}"]
    lines += _matrix("camera_matrix", lens.matrix.tolist())
    lines += _matrix("distortion_coefficients", [distortion])
    lines += _matrix("R", pose[:3, :3].tolist())
    lines += _matrix("t", [[float(x)] for x in pose[:3, 3]])
    write_bytes(path, ("\n".join(lines) + "\n").encode(), force=force)


def _matrix(name: str, rows: Sequence[Sequence[float]]) -> list[str]:
    data = ", ".join(repr(float(x)) for row in rows for x in row)
    return [f"{name}: !!opencv-matrix", f"   rows: {len(rows)}", f"   cols: {len(rows[0])}", "   dt: d", f"   data: [ {data} ]"]


def write_colmap(
    folder: str | Path, cameras: Sequence[Camera], poses: Sequence[FloatArray], names: Sequence[str], *, force: bool = True
) -> None:
    """cameras.txt, images.txt and an empty points3D.txt of a COLMAP text model: picture k is names[k], taken by cameras[k] at
    world_from_camera poses[k]. Equal cameras share one entry. Raises CameraError for cameras that COLMAP does not know."""
    if not len(cameras) == len(poses) == len(names):
        raise ArrayError(f"there are {len(cameras)} cameras, {len(poses)} poses and {len(names)} names; one each is needed")
    if any(any(c.isspace() for c in name) for name in names):
        raise ArrayError("COLMAP separates by spaces; picture names may not hold any", name="names")
    known: list[PinholeCamera] = []
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D[]"]
    for k, (camera, world_from_camera, name) in enumerate(zip(cameras, poses, names)):
        lens = _pinhole(camera, "COLMAP")
        if lens not in known:
            known.append(lens)
        pose = inverse(checked(world_from_camera, "world_from_camera"))
        x, y, z, w = quaternion_from_rotation(pose[:3, :3])
        numbers = " ".join(repr(float(n)) for n in (w, x, y, z, *pose[:3, 3]))
        images += [f"{k + 1} {numbers} {known.index(lens) + 1} {name}", ""]
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    lines += [f"{k + 1} {_colmap_camera(camera)}" for k, camera in enumerate(known)]
    where = Path(folder)
    for name, content in (("cameras.txt", lines), ("images.txt", images), ("points3D.txt", ["# none"])):
        write_bytes(where / name, ("\n".join(content) + "\n").encode(), force=force)


def _colmap_camera(camera: PinholeCamera) -> str:
    numbers = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    model = "PINHOLE"
    if any(camera.distortion):
        k = [*camera.distortion, *([0.0] * (8 - len(camera.distortion)))]
        model, k = ("OPENCV", k[:4]) if not any(k[4:]) else ("FULL_OPENCV", k)
        numbers += k
    return f"{model} {camera.width} {camera.height} " + " ".join(repr(float(n)) for n in numbers)


def _pinhole(camera: Camera, form: str) -> PinholeCamera:
    if not isinstance(camera, PinholeCamera):
        raise CameraError(f"{form} knows pinhole cameras only, not a {camera.model} one; the JSON form holds every camera")
    return camera
