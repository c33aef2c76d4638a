"""What stays in the hollows of a part when it stands in one orientation: the drain proof.

Liquid leaves a place if some path leads from it to the open air without ever rising above it. Cells are taken layer by layer from the
bottom and joined with those around and below; a cell drains when its group, among all cells not above it, touches the open. Volumes are
counted in cells, so they are right to the area of the hollow times half a cell at worst, and much better on average.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.kernels import kernel
from rangecheck.solid.slices import cells_of
from rangecheck.surface.edges import join_sets, root_of
from rangecheck.surface.surface import Surface

#: cells along the longest side, unless a step is given
CELLS_ACROSS = 160


@dataclass(frozen=True)
class Pocket:
    """A hollow that keeps liquid: its volume, the middle of that of its lowest cells which is farthest from its walls, its depth, and whether no way leads out of it at all."""

    volume_mm3: float
    lowest_mm: FloatArray = field(repr=False)
    depth_mm: float
    closed: bool


def pockets(
    surface: Surface, up: npt.ArrayLike = (0.0, 1.0, 0.0), *, step_mm: float | None = None, least_mm3: float | None = None
) -> list[Pocket]:
    """Hollows of the solid that do not empty when `up` points up, the largest first; those below `least_mm3` (default: 27 cells) left out."""
    from scipy import ndimage

    step = step_mm or float(np.ptp(surface.vertices, axis=0).max()) / CELLS_ACROSS
    cells = cells_of(surface, step, up)
    # layer by layer, so each layer lies together in memory
    kept = np.moveaxis(retained(np.ascontiguousarray(np.moveaxis(cells.solid, 2, 0))), 0, 2)
    label, count = ndimage.label(kept)
    if not count:
        return []
    outside = ndimage.label(~cells.solid)[0]
    open_air = outside[0, 0, 0]
    least = (least_mm3 if least_mm3 is not None else 27 * step**3) / step**3
    found = []
    sizes = np.bincount(label.ravel())
    for number, where in enumerate(ndimage.find_objects(label), 1):
        if sizes[number] < least:
            continue
        mine = label[where] == number
        inner = np.argwhere(mine) + [s.start for s in where]
        # the middle of the floor: a drain there leaves the walls around the hollow whole
        floor = ndimage.distance_transform_edt(np.pad(mine[:, :, 0], 1))[1:-1, 1:-1]
        lowest = np.array([*np.unravel_index(np.argmax(floor), floor.shape), 0]) + [s.start for s in where]
        depth = float(np.ptp(inner[:, 2]) + 1) * step
        closed = bool(outside[tuple(lowest)] != open_air)
        found.append(Pocket(float(sizes[number]) * step**3, cells.places_mm(lowest[None])[0], depth, closed))
    return sorted(found, key=lambda p: -p.volume_mm3)


@kernel
def retained(solid) -> BoolArray:
    """(layers, nx, ny) air cells that keep liquid; the first index is height. The grid's sides are open."""
    nz, nx, ny = solid.shape
    # 0 is the open: as the lowest it is always the root of its set
    parent = np.arange(nx * ny * nz + 1)
    kept = np.zeros(solid.shape, np.bool_)
    for z in range(nz):
        for x in range(nx):
            for y in range(ny):
                if solid[z, x, y]:
                    continue
                here = (z * nx + x) * ny + y + 1
                if x == 0 or y == 0 or z == 0 or x == nx - 1 or y == ny - 1 or z == nz - 1:
                    join_sets(parent, here, 0)
                if x > 0 and not solid[z, x - 1, y]:
                    join_sets(parent, here, here - ny)
                if y > 0 and not solid[z, x, y - 1]:
                    join_sets(parent, here, here - 1)
                if z > 0 and not solid[z - 1, x, y]:
                    join_sets(parent, here, here - nx * ny)
        for x in range(nx):
            for y in range(ny):
                if not solid[z, x, y] and root_of(parent, (z * nx + x) * ny + y + 1) != 0:
                    kept[z, x, y] = True
    return kept
