"""Cutting a solid by a plane, and choosing where a bust is cut flat to stand.

The plane's cap is of part "base" and invented; all other faces keep part and origin, and where the plane does not pass, their vertices.
Large surfaces are cut face by face (plane_cut.py), all others by manifold3d, which takes 480 bytes a face.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray, require
from rangecheck.errors import SurfaceError
from rangecheck.solid.engine import from_engine, to_engine
from rangecheck.solid.plane_cut import cut_by_plane
from rangecheck.solid.solid import Solid
from rangecheck.surface.surface import INVENTED, Surface

UP = (0.0, 1.0, 0.0)
#: more faces than this are cut without manifold3d, however much memory there is
FACES_OF_ENGINE = 1 << 22


@dataclass(frozen=True)
class BaseHeight:
    """Where to cut: `height_mm` along `up`, and why there in one sentence."""

    height_mm: float
    reason: str


def cut_flat(solid: Solid | Surface, *, height_mm: float, up: npt.ArrayLike = UP) -> Solid:
    """What of `solid` lies above the plane up . x = height_mm, capped there. A closed Surface will do: what is left of it is proved.

    Raises SurfaceError when nothing or all would remain, NotSolid when what remains is no solid."""
    whole, notes = (solid.surface, solid.notes) if isinstance(solid, Solid) else (solid, ())
    surface = trimmed(whole, height_mm=height_mm, up=up)
    removed = 1 - surface.volume_mm3 / whole.volume_mm3
    note = f"cut flat at {height_mm:.3f} mm: {100 * removed:.2f} % of the volume went"
    return Solid.from_surface(surface, notes=(*notes, note))


def trimmed(whole: Surface, *, height_mm: float, up: npt.ArrayLike = UP, cap: str = "base") -> Surface:
    """What of a closed surface lies above the plane up . x = height_mm, with a cap of part `cap`; closed and manifold, its solidity not
    proved again. `up` points to what is kept, and need not be vertical.

    Raises SurfaceError when nothing or all would remain, NotSolid when `whole` is not closed."""
    normal = _unit(up)
    heights = whole.vertices @ normal
    low, high = float(heights.min()), float(heights.max())
    if not low < height_mm < high:
        raise SurfaceError(
            f"the plane at {height_mm:.3f} mm misses the solid, which reaches from {low:.3f} to {high:.3f} mm; choose a height between",
            height_mm=height_mm,
            low_mm=low,
            high_mm=high,
        )
    if len(whole.faces) > FACES_OF_ENGINE:
        return cut_by_plane(whole, normal, height_mm, cap)
    engine, number = to_engine(whole)
    return from_engine(engine.trim_by_plane(tuple(normal), float(height_mm)), [(number, whole)], cap)


def choose_base_height(solid: Solid | Surface, *, up: npt.ArrayLike = UP, most_removed: float = 0.35) -> BaseHeight:
    """The lowest plane above which the surface is measured: below it lies what was invented to close the bottom.

    Walking upwards in 200 levels, the cut is where the invented share of the area, over the next 2 % of the height, first falls
    below 5 %, or if it never does, below half; at most `most_removed` of the height is given up. A solid without invented faces near its bottom is cut 1 % above it,
    which only makes it stand flat."""
    normal = _unit(up)
    surface = solid.surface if isinstance(solid, Solid) else solid
    heights = surface.vertices @ normal
    low, high = float(heights.min()), float(heights.max())
    tall = high - low
    middle = heights[surface.faces].mean(axis=1)
    level = np.minimum(((middle - low) / tall * 200).astype(int), 199)
    areas = surface.face_areas
    invented: FloatArray = np.bincount(level, areas * (surface.origin_of_face == INVENTED), minlength=200).astype(np.float64)
    total: FloatArray = np.bincount(level, areas, minlength=200).astype(np.float64)
    share = _moving_sum(invented, 4) / np.maximum(_moving_sum(total, 4), 1e-300)
    limit = int(most_removed * 200)
    clean, mostly = np.flatnonzero(share[: limit + 1] < 0.05), np.flatnonzero(share[: limit + 1] < 0.5)
    if share[0] < 0.05:
        step, reason = 2, "the bottom is measured; the cut only makes it flat"
    elif len(clean):
        step = int(clean[0])
        reason = f"above {low + step / 200 * tall:.1f} mm less than 5 % of the surface is invented"
    elif len(mostly):
        step = int(mostly[0])
        reason = f"above {low + step / 200 * tall:.1f} mm less than half of the surface is invented"
    else:
        step = limit
        reason = f"invented surface reaches above {100 * most_removed:.0f} % of the height; no more is given up"
    height = low + max(step, 1) / 200 * tall
    return BaseHeight(float(height), reason)


def _moving_sum(values: FloatArray, width: int) -> FloatArray:
    """Sum of each value and the next width - 1."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    last = np.minimum(np.arange(len(values)) + width, len(values))
    return total[last] - total[: len(values)]


def _unit(up: npt.ArrayLike) -> FloatArray:
    direction = require("up", up, (3,), finite=True)
    length = float(np.linalg.norm(direction))
    if length == 0:
        raise SurfaceError("up has length 0; a plane needs a direction")
    return direction / length
