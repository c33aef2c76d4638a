"""Rigid motions as (4, 4) float64 matrices that act on column vectors: `p_world = world_from_scan @ p_scan`.

Names say both frames, so that `world_from_a @ a_from_b` reads as `world_from_b`. Lengths in millimetres.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray, require
from rangecheck.errors import ArrayError

#: how far R^T R may be from the identity before a matrix is refused: rotations read from text files carry 6 digits
ROTATION_TOLERANCE = 1e-4


def identity() -> FloatArray:
    """The motion that moves nothing, (4, 4)."""
    return np.eye(4)


def from_rotation_translation(rotation: npt.ArrayLike, translation_mm: npt.ArrayLike) -> FloatArray:
    """(4, 4) motion p -> rotation p + translation_mm."""
    motion = np.eye(4)
    motion[:3, :3] = require("rotation", rotation, (3, 3), finite=True)
    motion[:3, 3] = require("translation_mm", translation_mm, (3,), finite=True)
    return checked(motion)


def checked(motion: npt.ArrayLike, name: str = "motion") -> FloatArray:
    """`motion` as (4, 4) float64 with its rotation made exactly orthonormal (polar decomposition).

    Raises ArrayError if it is no rigid motion within ROTATION_TOLERANCE (mirrored, scaled, sheared, NaN)."""
    matrix = require(name, motion, (4, 4), finite=True)
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # numbers that large are refused below
        departure = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
        determinant = float(np.linalg.det(rotation))
    if not departure <= ROTATION_TOLERANCE or determinant < 0 or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise ArrayError(
            f"{name} is not a rigid motion: R^T R departs from the identity by {departure:.3g} "
            f"(allowed {ROTATION_TOLERANCE:g}), determinant {determinant:.4g}",
            name=name,
            departure=departure,
        )
    result = np.eye(4)
    result[:3, :3] = rotation
    if departure > 16 * np.finfo(np.float64).eps:  # what is orthonormal to rounding keeps its bits, so that files round-trip
        u, _, vt = np.linalg.svd(rotation)
        result[:3, :3] = u @ vt
    result[:3, 3] = matrix[:3, 3]
    return result


def inverse(motion: FloatArray) -> FloatArray:
    """b_from_a for a_from_b."""
    result = np.eye(4)
    result[:3, :3] = motion[:3, :3].T
    result[:3, 3] = -motion[:3, :3].T @ motion[:3, 3]
    return result


def move_points(motion: FloatArray, points_mm: FloatArray) -> FloatArray:
    """Points (..., 3) in the frame on the motion's left."""
    return points_mm @ motion[:3, :3].T + motion[:3, 3]


def move_directions(motion: FloatArray, directions: FloatArray) -> FloatArray:
    """Directions (..., 3) rotated, not shifted."""
    return directions @ motion[:3, :3].T


def rotation_from_quaternion(quaternion_xyzw: npt.ArrayLike) -> FloatArray:
    """(3, 3) active rotation of a quaternion (x, y, z, w), normalised first."""
    q = require("quaternion_xyzw", quaternion_xyzw, (4,), finite=True)
    norm = float(np.linalg.norm(q))
    if norm < 1e-6:
        raise ArrayError(f"quaternion_xyzw has length {norm:.3g}; a rotation needs length 1", name="quaternion_xyzw")
    x, y, z, w = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: npt.ArrayLike) -> FloatArray:
    """(4,) unit quaternion (x, y, z, w), w >= 0, of a rotation (3, 3), from its largest component (Shepperd 1978)."""
    r = require("rotation", rotation, (3, 3), finite=True)
    trace = float(np.trace(r))
    squares = np.array([1 - trace + 2 * r[0, 0], 1 - trace + 2 * r[1, 1], 1 - trace + 2 * r[2, 2], 1 + trace])
    k = int(np.argmax(squares))
    # the symmetric matrix 4 q q^T, written out
    products = np.array(
        [
            [squares[0], r[0, 1] + r[1, 0], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], squares[1], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[2, 0] + r[0, 2], r[1, 2] + r[2, 1], squares[2], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], squares[3]],
        ]
    )[k]
    quaternion = products / np.linalg.norm(products)
    return -quaternion if quaternion[3] < 0 else quaternion


def about_axis(axis: npt.ArrayLike, angle_rad: float) -> FloatArray:
    """(4, 4) rotation by `angle_rad` about `axis` through the origin (Rodrigues; (41) with its axis made unit)."""
    a = require("axis", axis, (3,), finite=True)
    length = float(np.linalg.norm(a))
    if length == 0.0:
        raise ArrayError("axis has length 0; a rotation needs a direction", name="axis")
    x, y, z = a / length
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    motion = np.eye(4)
    motion[:3, :3] += math.sin(angle_rad) * k + (1 - math.cos(angle_rad)) * (k @ k)
    return motion


def across(directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors across each unit vector of `directions` (..., 3): one across the axis least along it too, and direction x one."""
    one = np.cross(directions, np.eye(3)[np.abs(directions).argmin(axis=-1)])
    one /= np.linalg.norm(one, axis=-1, keepdims=True)
    return one, np.cross(directions, one)


def look_at(eye_mm: npt.ArrayLike, target_mm: npt.ArrayLike, up: npt.ArrayLike = (0.0, 1.0, 0.0)) -> FloatArray:
    """world_from_camera of a camera at `eye_mm` that looks at `target_mm`: x right, y down, z forward (OpenCV's axes).

    Raises ArrayError when the eye is the target. When `up` is along the view, the axis least along it serves instead."""
    eye = require("eye_mm", eye_mm, (3,), finite=True)
    forward = require("target_mm", target_mm, (3,), finite=True) - eye
    distance = float(np.linalg.norm(forward))
    if distance == 0.0:
        raise ArrayError("eye_mm equals target_mm; a camera needs a direction to look in", name="eye_mm")
    forward = forward / distance
    right = np.cross(forward, require("up", up, (3,), finite=True))
    if np.linalg.norm(right) < 1e-9:
        right, _ = across(forward)
    right /= np.linalg.norm(right)
    motion = np.eye(4)
    motion[:3, 0], motion[:3, 1], motion[:3, 2], motion[:3, 3] = right, np.cross(forward, right), forward, eye
    return motion


def angle_rad(motion: FloatArray) -> float:
    """Angle of the rotation part, 0 to pi, stable near both ends."""
    r = motion[:3, :3]
    sine = 0.5 * math.hypot(r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1])
    return math.atan2(sine, 0.5 * (float(np.trace(r)) - 1.0))
