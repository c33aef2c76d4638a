"""Small pictures of things for notebooks: no light is followed, nothing is measured.

Unit normals are in a camera's frame: x right, y down, z forward, so that what faces the viewer has negative z.
"""

from __future__ import annotations

import numpy as np

from rangecheck.arrays import FloatArray

#: towards the light, over the viewer's left shoulder
LIGHT = np.array([-0.45, -0.6, -0.66])
#: longer side of a quick look, pixels
LONGEST = 384


def srgb(linear: FloatArray) -> FloatArray:
    """sRGB-encoded values 0..1 (IEC 61966-2-1) of linear levels, clipped to 0..1 first."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def shaded_png(normals: FloatArray) -> bytes:
    """PNG of (h, w, 3) unit normals as a matt object under one light; white where they are NaN."""
    cosine = np.clip(normals @ (LIGHT / np.linalg.norm(LIGHT)), 0.0, None)
    levels = srgb(0.08 + 0.8 * cosine)
    return png(np.rint(255 * np.where(np.isnan(levels), 1.0, levels)))


def radiance_png(radiance: FloatArray) -> bytes:
    """PNG of (h, w, c) linear radiance, exposed so that 2 % of its lit pixels clip; for figures with a stated exposure use
    `rangecheck.export.pictures`."""
    lit = radiance[radiance > 0]
    white = float(np.quantile(lit, 0.98)) if lit.size else 1.0
    levels = srgb(0.8 * np.nan_to_num(radiance) / white)
    return png(np.rint(255 * (levels[..., 0] if levels.shape[-1] == 1 else levels[..., :3])))


def png(levels: FloatArray) -> bytes:
    """PNG of (h, w) grey or (h, w, 3) red, green, blue levels 0..255."""
    import cv2

    picture = levels.astype(np.uint8)
    return bytes(cv2.imencode(".png", picture if picture.ndim == 2 else np.ascontiguousarray(picture[..., ::-1]))[1])


def grid_normals(points_mm: FloatArray) -> FloatArray:
    """(h, w, 3) unit normals towards the viewer of a grid of points in its frame; NaN beside cells without a point."""
    if min(points_mm.shape[:2]) < 2:
        return np.full_like(points_mm, np.nan)
    across, along = np.gradient(points_mm, axis=1), np.gradient(points_mm, axis=0)
    normals = np.cross(along, across)
    lengths = np.linalg.norm(normals, axis=2, keepdims=True)
    return normals / np.where(lengths > 0, lengths, np.nan)
