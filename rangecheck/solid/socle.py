"""A socle under a bust by boolean: a plinth in the shape of the bust's own footprint, stepped in towards it; a nameplate where one is asked for.

The bust stands on a plane across `up` already (base.py). All parts of the socle are convex, so their unions are simple; they reach into
the bust by a little, so that no two faces lie in one plane. Faces are invented and of part "socle" or "nameplate".
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray
from rangecheck.errors import SurfaceError
from rangecheck.solid.base import UP
from rangecheck.solid.engine import cross_section, from_engine, hull_of, prism, to_engine
from rangecheck.solid.slices import frame_of
from rangecheck.surface.surface import INVENTED, Surface

#: of the footprint's smaller side: how far plinth and neck stand out, how high the socle is, how far it reaches into the bust
PLINTH, NECK, HEIGHT, REACH = 0.12, 0.03, 0.35, 0.01


def with_socle(surface: Surface, *, up: npt.ArrayLike = UP, height_mm: float | None = None, nameplate: str = "") -> Surface:
    """A closed surface that stands flat across `up`, united with a socle of `height_mm` (None: HEIGHT of the footprint) below it.

    `nameplate` is engraved on a plate at the front (+z). Closed and manifold, its solidity not proved here. Raises SurfaceError where the
    surface does not stand flat."""
    frame = frame_of(up)
    local = surface.vertices @ frame.T
    bottom = float(local[:, 2].min())
    standing = local[local[:, 2] <= bottom + 1e-6 * surface.extent_mm][:, :2]
    if len(standing) < 3 or np.linalg.matrix_rank(standing - standing[0], tol=1e-9 * surface.extent_mm) < 2:
        raise SurfaceError("the part does not stand flat, so a socle has nothing to carry; cut its base first (base_height_mm)")
    small = float(np.ptp(standing, axis=0).min())
    tall = HEIGHT * small if height_mm is None else height_mm
    plinth, neck = PLINTH * small, NECK * small

    def slab(margin: float, low: float, high: float) -> Any:
        return prism(cross_section(standing, margin), bottom + low, bottom + high)

    thin = 1e-3 * tall
    # a little narrower below and wider above than what it joins: no two walls in one plane
    cove = hull_of([slab(0.96 * plinth, -0.62 * tall, -0.62 * tall + thin), slab(1.2 * neck, -0.25 * tall - thin, -0.25 * tall)])
    socle = slab(plinth, -tall, -0.6 * tall) + cove + slab(neck, -0.26 * tall, REACH * small)
    part, number = to_engine(surface)
    united = part + socle.transform(np.column_stack([frame.T, np.zeros(3)]))
    sources = [(number, surface)]
    if nameplate:
        plate = _nameplate(nameplate, standing @ frame[:2] + (bottom - 0.8 * tall) * frame[2], plinth, 0.3 * tall, frame)
        carved = from_engine(plate, [], "nameplate", INVENTED)
        solid, name = to_engine(carved)
        united, sources = united + solid, [*sources, (name, carved)]
    return from_engine(united, sources, "socle", INVENTED)


def _nameplate(text: str, footprint: FloatArray, plinth_mm: float, height_mm: float, frame: FloatArray) -> Any:
    """A plate at the front of the plinth with the text raised on it."""
    right, up, front = np.cross(frame[2], [0.0, 0.0, 1.0]), frame[2], np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 0.5:
        raise SurfaceError("a nameplate faces +z, so the part must stand across another axis")
    right = right / np.linalg.norm(right)
    front = np.cross(right, up)
    letters = text_outlines(text)
    low, high = np.min([r.min(axis=0) for r in letters], axis=0), np.max([r.max(axis=0) for r in letters], axis=0)
    wide = 0.7 * float(np.ptp(footprint @ right))
    scale = min(0.85 * wide / (high[0] - low[0]), 0.55 * height_mm / (high[1] - low[1]))
    deep = 0.12 * height_mm
    # the plate's back lies inside the plinth, whose front is curved
    outermost = float((footprint @ front).max()) + plinth_mm
    plate_box = np.array(
        [[-wide / 2, -height_mm / 2], [wide / 2, -height_mm / 2], [wide / 2, height_mm / 2], [-wide / 2, height_mm / 2]]
    )
    plate = prism(cross_section(plate_box, 0.0), outermost - 6 * deep, outermost + deep)
    rings = [(r - 0.5 * (low + high)) * scale for r in letters]
    raised = prism(cross_section(rings, 0.0), outermost + 0.5 * deep, outermost + 1.6 * deep)
    middle = footprint.mean(axis=0)
    place = np.column_stack([right, up, front])
    shift = (middle @ right) * right + (middle @ up) * up
    return (plate + raised).transform(np.column_stack([place, shift]))


def text_outlines(text: str) -> list[FloatArray]:
    """Rings (n, 2) of a text's letters, one unit high, holes among them. Raises SurfaceError for a text without ink."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    path = TextPath((0, 0), text, size=1.0, prop=FontProperties(family="DejaVu Sans", weight="bold"))
    rings: list[FloatArray] = [np.asarray(ring, np.float64)[:-1] for ring in path.to_polygons(closed_only=True)]
    rings = [ring for ring in rings if len(ring) >= 3]
    if not rings:
        raise SurfaceError(f"{text!r} has no letter to engrave; give the nameplate a text or leave it out")
    return rings
