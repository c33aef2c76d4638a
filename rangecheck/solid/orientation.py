"""Which way up to print: what each orientation costs in islands, overhangs, peel force, height and resin that stays.

One grid of cells per orientation answers most of it. Islands are pieces of a layer with nothing below them, not even a cell to the side
(45 degrees): each needs a support or it stays on the vat's floor. The force that peels a layer off grows with its area, so the largest
layer counts. No single number is best: what another orientation beats in everything is left out, the rest is ordered by its ranks.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.solid.drainage import retained
from rangecheck.solid.printer import Printer
from rangecheck.solid.printing import UP, smallest_footprint
from rangecheck.solid.slices import cells_of, frame_of
from rangecheck.surface.surface import Surface

#: cells along the longest side
CELLS_ACROSS = 96
TILTS_DEG, TURNS = (15.0, 30.0, 45.0), 6


@dataclass(frozen=True)
class Orientation:
    """One way up. `up` in the part's frame; areas in mm2, volumes in mm3, as cells of `step_mm` see them.

    islands, island_mm2  pieces that begin in mid-air, and their area in the layer where they begin
    overhang_mm2         faces nearer to the horizontal than the printer's limit, seen from below
    peak_mm2             the largest layer
    held_mm3             resin that stays in hollows
    fits                 whether the printer's build space holds it
    """

    up: tuple[float, float, float]
    tilt_deg: float
    height_mm: float
    islands: int
    island_mm2: float
    overhang_mm2: float
    peak_mm2: float
    held_mm3: float
    fits: bool
    step_mm: float

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return asdict(self) | {"up": list(self.up)}


def advise(surface: Surface, printer: Printer, *, up: npt.ArrayLike = UP, step_mm: float | None = None) -> list[Orientation]:
    """Orientations of a solid's surface worth considering, the best first: those that no other beats in everything, and `up` itself.

    Tried are `up`, its tilts by TILTS_DEG towards TURNS directions, and lying on each side."""
    frame = frame_of(up)
    found = [judge(surface, printer, way, up, step_mm) for way in _candidates(frame)]
    costs = np.array(
        [(not o.fits, o.islands, o.overhang_mm2, o.peak_mm2, o.height_mm, o.held_mm3 > 27 * o.step_mm**3) for o in found],
        np.float64,
    )
    beaten = [any((c <= own).all() and (c < own).any() for c in costs) for own in costs]
    ranks = np.array([[float((column < value).mean()) for value in column] for column in costs.T]).sum(axis=0)
    order = np.argsort(ranks + 10.0 * costs[:, 0], kind="stable")
    return [found[i] for i in order if i == 0 or not beaten[i]]


def _candidates(frame: FloatArray) -> list[FloatArray]:
    right, front, up = frame
    ways = [up]
    for tilt in TILTS_DEG:
        for turn in range(TURNS):
            angle = 2 * math.pi * turn / TURNS
            side = math.cos(angle) * right + math.sin(angle) * front
            ways.append(math.cos(math.radians(tilt)) * up + math.sin(math.radians(tilt)) * side)
    return [*ways, right, -right, front, -front]


def judge(
    surface: Surface, printer: Printer, way: npt.ArrayLike, up: npt.ArrayLike = UP, step_mm: float | None = None
) -> Orientation:
    """One orientation: `way` points away from the build plate; the tilt is told from `up`."""
    frame = frame_of(way)
    local = surface.vertices @ frame.T
    step = step_mm or float(np.ptp(surface.vertices, axis=0).max()) / CELLS_ACROSS
    cells = cells_of(surface, step, frame[2]).solid
    count, area = _islands(cells)
    kept = retained(np.ascontiguousarray(np.moveaxis(cells, 2, 0)))
    wide, deep, _ = smallest_footprint(local[:, :2])
    tall = float(np.ptp(local[:, 2]))
    bed = sorted(printer.build_mm[:2], reverse=True)
    down = np.nan_to_num(surface.face_normals) @ -frame[2]
    on_plate = local[:, 2][surface.faces].max(axis=1) <= local[:, 2].min() + printer.layer_mm
    over = (down > math.cos(math.radians(printer.overhang_deg)) * (1 + 1e-9)) & ~on_plate
    own_up = frame_of(up)[2]
    x, y, z = (float(value) for value in frame[2])
    return Orientation(
        up=(round(x, 6), round(y, 6), round(z, 6)),
        tilt_deg=round(math.degrees(math.acos(min(1.0, float(frame[2] @ own_up)))), 3),
        height_mm=tall,
        islands=count,
        island_mm2=area * step**2,
        overhang_mm2=float(surface.face_areas[over].sum()),
        peak_mm2=float(cells.sum(axis=(0, 1)).max()) * step**2,
        held_mm3=float(kept.sum()) * step**3,
        fits=bool(wide <= bed[0] and deep <= bed[1] and tall <= printer.build_mm[2]),
        step_mm=step,
    )


def _islands(solid: BoolArray) -> tuple[int, int]:
    """Pieces of layers (third axis) with no cell below them or beside that, above the first layer that holds any; and their cells."""
    from scipy import ndimage

    flat = np.zeros((3, 3, 3), bool)
    flat[:, :, 1] = True
    label, count = ndimage.label(solid, flat)
    below = np.zeros_like(solid)
    spread = np.zeros((3, 3, 3), bool)
    spread[:, :, 1] = True
    below[:, :, 1:] = ndimage.binary_dilation(solid, spread)[:, :, :-1]
    carried = np.zeros(count + 1, bool)
    carried[label[solid & below]] = True
    carried[np.unique(label[:, :, int(np.argmax(solid.any(axis=(0, 1))))])] = True
    carried[0] = True
    return int((~carried).sum()), int((~carried)[label].sum())
