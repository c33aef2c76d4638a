"""Speckle and jumping highlights, measured in the pictures of a turntable.

A smooth mirror shows few, large highlights that slide from frame to frame; a noisy one breaks them into grains that flash up and go. Pictures
are sRGB of 8 bits on an even backdrop.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray

#: linear level from which a pixel is highlight
BRIGHT = 0.6
#: a highlight of one frame is found again in the next when it lies within this share of the picture's width
REACH = 0.01


@dataclass(frozen=True)
class Speckle:
    """contrast: RMS of what a 5 x 5 median does not explain, over the mean level of the object. pieces: connected highlights a frame.
    jumps: share of them that have no highlight near their place in the next frame. frames: how many were looked at."""

    contrast: float
    pieces: float
    jumps: float
    frames: int


def speckle_of(frames: Iterable[npt.NDArray[np.uint8]]) -> Speckle | None:
    """Over pictures (h, w) or (h, w, 3) in their order; None where there are none."""
    import cv2

    squared, level, count, pieces, alone, looked = 0.0, 0.0, 0, 0, 0, 0
    before: npt.NDArray[np.int32] | None = None
    total_before = 0
    for picture in frames:
        grey = picture if picture.ndim == 2 else np.ascontiguousarray(picture.mean(axis=2).astype(np.uint8))
        backdrop = np.median(np.r_[grey[0], grey[-1], grey[:, 0], grey[:, -1]])
        object_ = cv2.erode((grey != backdrop).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
        smooth = cv2.medianBlur(grey, 5)
        here, around = _linear(grey), _linear(smooth)
        squared += float(((here - around)[object_] ** 2).sum())
        level += float(here[object_].sum())
        count += int(object_.sum())
        bright = ((here >= BRIGHT) & object_).astype(np.uint8)
        total, label = cv2.connectedComponents(bright, connectivity=8)
        if before is not None and total_before > 1:
            reach = max(1, round(REACH * grey.shape[1]))
            wide = cv2.dilate(bright, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
            found = np.unique(before[wide])
            alone += total_before - 1 - int((found > 0).sum())
        pieces += total - 1
        before, total_before = label, total
        looked += 1
    if not looked:
        return None
    mean = level / max(count, 1)
    last = 0 if before is None else total_before - 1
    return Speckle(
        contrast=float(np.sqrt(squared / max(count, 1)) / mean) if mean > 0 else 0.0,
        pieces=pieces / looked,
        jumps=alone / max(pieces - last, 1),
        frames=looked,
    )


def _linear(picture: npt.NDArray[np.uint8]) -> FloatArray:
    y = picture / 255.0
    return np.where(y <= 0.04045, y / 12.92, ((y + 0.055) / 1.055) ** 2.4)
