"""Structured light: pictures of coded patterns to a range scan on the first camera's grid.

Posdamer & Altschuler, "Surface measurement by space-encoded projected beam systems", 1982; Gray codes after Inokuchi et al., 1984.
With two calibrated cameras the projector needs no calibration: it only names the places that both cameras see. With one, the
projector is the second eye, and its calibration is needed.

A point lies on the ray of its pixel in the first camera, at the distance where it comes nearest, in the second picture, to the place
that shows the same projector coordinates. What is left there is the epipolar residual, kept per pixel. Its scatter from pixel to
pixel is also what the scan states as its noise: coordinates are smoothed over windows of two cells, so neighbouring ranges alone
(`scan.noise`) would say too little.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.errors import ScanError
from rangecheck.optics import Camera
from rangecheck.scan.decode.match import partners, smoothed
from rangecheck.scan.decode.pictures import Pictures, Seen, see_all
from rangecheck.scan.range_scan import RangeScan

MIN_CONTRAST = 0.03
MAX_RESIDUAL_PX = 3.0
_STEPS = 4
#: pixels over which the residual of a wrong calibration stays the same
_CALIBRATION_PX = 12.0


class Reason(IntEnum):
    """Why a pixel holds no distance."""

    MEASURED = 0
    SHADOW = 1  # hardly brighter in white than in black
    FAINT = 2  # lit, but the finest stripes cannot be told apart
    AMBIGUOUS = 3  # codes of neighbours contradict each other: an edge, a highlight, a stray reflection
    MISSING = 4  # not readable, and pictures of this camera are missing
    UNSEEN = 5  # the other camera does not see this place
    CONTRADICTED = 6  # the other camera sees it in two places
    EPIPOLAR = 7  # the two rays pass each other too far apart, or meet behind a camera


class View(NamedTuple):
    """A calibrated camera (or projector, whose pixels are its cells) whose grid is that of its pictures, and where it stands."""

    camera: Camera
    world_from_camera: FloatArray


@dataclass(frozen=True, eq=False)
class DecodedScan:
    """A scan and what is known about every pixel of it.

    reason        (h, w) uint8, a `Reason`
    interpolated  (h, w) True where the pixel's own code could not be read and its neighbours' planes gave it
    residual_px   (h, w) float32 epipolar residual: distance, in the second picture, between the point and its partner
    both_px       (h, w) float32 root mean square over the two pictures of the reprojection error at the best point (Sampson 1982,
                  first order), for comparison with other programs, which move both
    lost          missing pictures, in words
    cells         projector cells that gave points; pixels finer than a cell are interpolated between their crossings"""

    scan: RangeScan
    reason: IntArray = field(repr=False)
    interpolated: BoolArray = field(repr=False)
    residual_px: FloatArray = field(repr=False)
    both_px: FloatArray = field(repr=False)
    lost: tuple[str, ...]
    cells: int

    @property
    def measured(self) -> int:
        """Pixels whose own code was read."""
        return int((self.scan.valid & ~self.interpolated).sum())

    def counts(self) -> dict[str, int]:
        """Pixels per reason, by name, and `interpolated` among the measured ones."""
        told = {r.name.lower(): int((self.reason == r).sum()) for r in Reason}
        return told | {"interpolated": int((self.scan.valid & self.interpolated).sum()), "cells": self.cells}


def decode_gray_code(
    left: Pictures,
    left_view: View,
    right: Pictures | None = None,
    right_view: View | None = None,
    *,
    projector: View | None = None,
    min_contrast: float = MIN_CONTRAST,
    max_residual_px: float = MAX_RESIDUAL_PX,
    name: str = "decoded",
) -> DecodedScan:
    """Decode `left`, with `right` as second eye, or with `projector` (columns and rows are its pixels; rows may be missing).

    min_contrast     white minus black, 0..1 of full scale, below which a pixel is in shadow
    max_residual_px  epipolar residual above which a pixel is refused

    Raises ScanError when nothing can be decoded, or neither second eye is given."""
    if (right is None) != (right_view is None) or (right is None) == (projector is None):
        raise ScanError("structured light needs a second eye: pictures and view of a second camera, or the view of the projector")
    height, width = left.white.shape
    _fits(left, left_view)
    if right is not None and right_view is not None:
        _fits(right, right_view)
    seen, *others = see_all([p for p in (left, right) if p is not None], min_contrast)
    lost = left.lost()
    if seen.row is None and right is not None:
        raise ScanError(f"{left.name}: two cameras need row and column codes to know what both see; only columns are there")
    first = smoothed(seen.column, seen.row if seen.row is not None else np.where(np.isfinite(seen.column), np.float32(0), np.nan))
    reason = _why_unread(seen, bool(lost))
    known = np.isfinite(first.value[..., 0])
    reason[known] = Reason.UNSEEN
    if right is not None and right_view is not None:
        lost += right.lost()
        other = others[0]
        if other.row is None:
            raise ScanError(f"{right.name}: two cameras need row and column codes to know what both see; only columns are there")
        place, unseen = partners(first, smoothed(other.column, other.row))
        second = right_view
        reason[known & ~unseen & ~np.isfinite(place[..., 0])] = Reason.CONTRADICTED
    else:
        assert projector is not None
        second = projector
        place = first.value.astype(np.float64) - 0.5  # coordinates count from a cell's edge, pixels from its middle
    ask = np.isfinite(place[..., 0])
    rows, columns = np.nonzero(ask)
    found = _triangulated(left_view, second, np.stack([columns, rows], axis=1).astype(float), place[ask], seen.row is not None)
    good = (found.residual_px <= max_residual_px) & (found.range_mm > 0)
    reason[ask] = np.where(good, Reason.MEASURED, Reason.EPIPOLAR)
    maps = np.full((3, height, width), np.nan, np.float32)
    for target, values in zip(maps, (found.range_mm, found.residual_px, found.both_px)):
        target[ask] = np.where(good, values, np.nan)
    if not good.any():
        raise ScanError(
            f"{name}: {int(known.sum())} pixels were decoded and none could be placed; check the calibration and which eye is which"
        )
    bright = np.clip(left.white / left.full_scale, 0, 1).astype(np.float32)
    noise = _noise_mm(ask, np.where(good, found.across_px, np.nan), found.mm_per_px[good]) if seen.row is not None else None
    scan = RangeScan(maps[0], left_view.camera, left_view.world_from_camera, bright, name, noise_mm=noise)
    cell = np.floor(first.value[scan.valid]).astype(np.int64)
    cells = len(np.unique(cell[:, 0] * 65536 + cell[:, 1]))
    return DecodedScan(scan, reason, scan.valid & ~first.own, maps[1], maps[2], tuple(lost), cells)


def _fits(pictures: Pictures, view: View) -> None:
    have, want = pictures.white.shape, (view.camera.height, view.camera.width)
    if have != want:
        raise ScanError(
            f"{pictures.name}: pictures are {have[1]} x {have[0]} and the calibrated camera {want[1]} x {want[0]}; "
            "scale the calibration to the pictures"
        )


def _why_unread(seen: Seen, lost: bool) -> IntArray:
    reason = np.where(seen.lit, np.uint8(Reason.MISSING if lost else Reason.AMBIGUOUS), np.uint8(Reason.SHADOW))
    return np.where(seen.faint, np.uint8(Reason.FAINT), reason).astype(np.uint8)


class _Found(NamedTuple):
    range_mm: FloatArray
    residual_px: FloatArray
    both_px: FloatArray
    across_px: FloatArray  # the residual with its sign, across the epipolar line
    mm_per_px: FloatArray  # how far the range moves with the place along the line


def _triangulated(first: View, second: View, uv: FloatArray, place: FloatArray, two_axes: bool) -> _Found:
    """Ranges along the rays of pixels uv (n, 2) of the first view that come nearest to `place` (n, 2) in the second."""
    across = rigid.inverse(second.world_from_camera) @ first.world_from_camera
    weight = np.array([1.0, 1.0 if two_axes else 0.0])

    def solve(uv: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        origin, direction = first.camera.rays(uv[:, 0], uv[:, 1])
        origin, direction = rigid.move_points(across, origin), rigid.move_directions(across, direction)
        other_origin, other = second.camera.rays(place[:, 0], place[:, 1])
        # start where the two rays pass each other nearest; without rows the second ray is only a plane, and the first step decides
        apart, along = origin - other_origin, (direction * other).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            away = (along * (other * apart).sum(axis=1) - (direction * apart).sum(axis=1)) / (1 - along * along)

        def error(away: FloatArray) -> FloatArray:
            return (second.camera.project(origin + away[:, None] * direction)[0] - place) * weight

        with np.errstate(divide="ignore", invalid="ignore"):
            if not two_axes:
                away = _in_plane(second.camera, place, origin, direction)
            for _ in range(_STEPS):
                step = 1e-4 * np.abs(away)
                here = error(away)
                change = (error(away + step) - here) / step[:, None]
                away = away - (change * here).sum(axis=1) / (change * change).sum(axis=1)
        return away, error(away), change

    away, left_over, change = solve(uv)
    residual = np.hypot(left_over[:, 0], left_over[:, 1])
    # how far the signed residual moves per pixel of the first picture, from some hundreds of points: it hardly varies
    some = np.flatnonzero(np.isfinite(residual) & (residual > 0.05))
    some = some[:: max(1, len(some) // 500)]
    both = residual / np.sqrt(2)
    if two_axes and len(some) >= 10:
        place, kept = place[some], place
        normal = left_over[some] / residual[some, None]
        shifts = [((solve(uv[some] + shift)[1] - left_over[some]) * normal).sum(axis=1) for shift in ([1.0, 0.0], [0.0, 1.0])]
        place = kept
        per_pixel = float(np.nanmedian(np.hypot(*shifts)))
        both = residual / np.sqrt(2 * (1 + per_pixel**2))
    with np.errstate(divide="ignore", invalid="ignore"):
        px_per_mm = np.hypot(change[:, 0], change[:, 1])
        across_px = (left_over[:, 1] * change[:, 0] - left_over[:, 0] * change[:, 1]) / px_per_mm
        mm_per_px = 1 / px_per_mm
    away = np.where(np.isfinite(away), away, np.nan)
    return _Found(away, np.where(np.isfinite(residual), residual, np.inf), both, across_px, mm_per_px)


def _noise_mm(ask: BoolArray, across_px: FloatArray, mm_per_px: FloatArray) -> float | None:
    """Standard deviation of range: what the residual across the epipolar line, less its mean over some cells around (which is the
    calibration's), scatters by; places scatter along the line as much, and that is range. None with too few pixels to tell."""
    import cv2

    known = np.zeros(ask.shape, np.float32)
    signed = np.zeros(ask.shape, np.float32)
    known[ask], signed[ask] = np.isfinite(across_px), np.nan_to_num(across_px)
    weight, mean = (cv2.GaussianBlur(a, (0, 0), _CALIBRATION_PX, borderType=cv2.BORDER_REFLECT) for a in (known, signed))
    fluctuation = signed - mean / np.maximum(weight, 1e-6)
    inside = (known > 0) & (weight > 0.5)
    if inside.sum() < 1000:
        return None
    return float(np.median(np.abs(fluctuation[inside])) / 0.6745 * np.median(mm_per_px))


def _in_plane(camera: Camera, place: FloatArray, origin: FloatArray, direction: FloatArray) -> FloatArray:
    """Range at which rays meet the plane that a projector column lights: through two of the column's own rays."""
    top = camera.rays(place[:, 0], np.full(len(place), 0.25 * camera.height))
    low = camera.rays(place[:, 0], np.full(len(place), 0.75 * camera.height))
    normal = np.cross(top[1], low[1])
    return ((top[0] - origin) * normal).sum(axis=1) / (direction * normal).sum(axis=1)
