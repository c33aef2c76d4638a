"""A solid made hollow, with drains, and the proof that it drains.

The cavity is the surface at wall depth inside, ridges and all; where the part is thinner than two walls it stays full. Each pocket of the cavity that
keeps resin when the part stands along `up` gets a drain from its lowest place straight down through the wall, until nothing is kept;
what is drilled out is returned as plugs, smaller by a clearance. The wall is measured afterwards, not assumed.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import FloatArray
from rangecheck.errors import SettingError, SurfaceError
from rangecheck.modeler.engine import manifold3d_module
from rangecheck.solid.drainage import Pocket, pockets
from rangecheck.solid.engine import from_engine, simplified, to_engine
from rangecheck.solid.offset import inner_offset
from rangecheck.solid.ridges import with_ridges
from rangecheck.solid.room import proved_without_room
from rangecheck.solid.slices import frame_of
from rangecheck.solid.solid import Solid
from rangecheck.solid.thickness import Samples, sample_surface
from rangecheck.solid.untangle import untangle
from rangecheck.surface import topology as topo
from rangecheck.surface.distance import SurfaceDistance
from rangecheck.surface.surface import INVENTED, Surface

SIDES = 48
#: grid of the cavity's surface, in walls
STEP = 0.15
#: shares of the wall's tolerance by which the cavity may lose faces, and by which its vertices may move so that no faces cross
FEWER, LOOSER = 1 / 16, 1 / 2
#: how far a plug stays clear of its drain, all round
CLEARANCE_MM = 0.1
#: drilling stops after this many drains; so many places without room for a cavity are listed
MOST_DRAINS, MOST_PLACES = 12, 24
#: of the outside, from which the wall is measured
MOST_SAMPLES = 40_000


@dataclass(frozen=True)
class Wall:
    """The wall between cavity and outside. At a place of either skin it is the distance to the nearest place of the other, as programs that
    hollow by offset define it; measured from both.

    least_mm, median_mm, largest_mm, share_within  from the cavity to the outside, by the cavity's area; within `tolerance_mm` of `asked_mm`
    outer_within  from the outside to the cavity: share within the tolerance of the area that may have such a wall
    full_share    share of the outside's area that is proved not to: no cavity that keeps the wall everywhere comes within a wall and the
                  tolerance of it, because no place at least a wall deep does (room.py)
    full          places (x, y, z) of that area, and their distance from the cavity: edges, ears, noses; the farthest first, a few walls apart
    """

    asked_mm: float
    least_mm: float
    median_mm: float
    largest_mm: float
    tolerance_mm: float
    share_within: float
    outer_within: float = 1.0
    full_share: float = 0.0
    full: tuple[tuple[float, float, float, float], ...] = ()


@dataclass(frozen=True)
class Drain:
    """A drilled hole: from inside the cavity to the outside, and its diameter."""

    inside_mm: FloatArray
    outside_mm: FloatArray
    diameter_mm: float


@dataclass(frozen=True, eq=False)
class Hollow:
    """The hollowed surface (closed and manifold; `solid` proves it), its plugs, the wall as measured, the drains, the pockets that still keep
    resin (empty: proved to drain) when it stands along `up`, and the volume of the cavity."""

    surface: Surface
    plugs: tuple[Solid, ...]
    wall: Wall
    drains: tuple[Drain, ...]
    kept: tuple[Pocket, ...]
    cavity_mm3: float
    up: tuple[float, float, float]
    notes: tuple[str, ...] = field(default=(), repr=False)

    @cached_property
    def solid(self) -> Solid:
        """The hollowed part as a proven solid. Raises NotSolid."""
        return Solid.from_surface(self.surface, notes=self.notes)

    def lines(self) -> list[str]:
        """Wall, drains and what is kept, for people."""
        w = self.wall
        lines = [
            f"wall asked {w.asked_mm:g} mm; measured from the cavity {w.least_mm:.3f} to {w.largest_mm:.3f} mm, median {w.median_mm:.3f}, "
            f"within {w.tolerance_mm:g} mm over {100 * w.share_within:.2f} % of its area; from outside over {100 * w.outer_within:.2f} % of what leaves room for "
            f"it; {100 * w.full_share:.1f} % is proved too sharp or too thin for a cavity and stays thicker",
        ]
        if w.full:
            listed = ", ".join(f"({x:z.1f}, {y:z.1f}, {z:z.1f}) {d:.1f} mm" for x, y, z, d in w.full[:6])
            lines.append(f"thicker where the shape leaves no room for a cavity: {listed}")
        lines += [
            f"drain of {d.diameter_mm:g} mm from ({', '.join(f'{x:z.1f}' for x in d.inside_mm)}) to ({', '.join(f'{x:z.1f}' for x in d.outside_mm)}) mm"
            for d in self.drains
        ]
        tilt = ", ".join(f"{x:g}" for x in self.up)
        if not self.kept:
            lines.append(f"proved to drain with ({tilt}) up: from every cell of the cavity a way leads out that never rises")
        lines += [
            f"keeps {p.volume_mm3:.1f} mm3 with ({tilt}) up, {'closed for ever' if p.closed else f'{p.depth_mm:.1f} mm deep'}, lowest at "
            f"({', '.join(f'{x:z.1f}' for x in p.lowest_mm)}) mm"
            for p in self.kept
        ]
        return lines

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "wall": asdict(self.wall),
            "drains": [
                {"inside_mm": d.inside_mm.tolist(), "outside_mm": d.outside_mm.tolist(), "diameter_mm": d.diameter_mm}
                for d in self.drains
            ],
            "kept": [
                {"volume_mm3": p.volume_mm3, "depth_mm": p.depth_mm, "lowest_mm": p.lowest_mm.tolist(), "closed": p.closed}
                for p in self.kept
            ],
            "cavity_mm3": self.cavity_mm3,
            "plugs_mm3": [plug.volume_mm3 for plug in self.plugs],
            "up": self.up,
        }


def hollow(
    solid: Solid | Surface,
    *,
    wall_mm: float,
    up: npt.ArrayLike = (0.0, 1.0, 0.0),
    drain_mm: float = 4.0,
    step_mm: float | None = None,
    tolerance_mm: float = 0.15,
    least_pocket_mm3: float = 5.0,
) -> Hollow:
    """A solid, or a closed surface, with a cavity `wall_mm` below its surface and drains of `drain_mm` diameter (0: none) for standing along `up`.

    step_mm           grid of the cavity's surface; None means STEP walls
    least_pocket_mm3  pockets below this do not count as resin kept
    Raises SurfaceError when nothing lies deeper than the wall."""
    if not (wall_mm > 0 and drain_mm >= 0):
        raise SettingError(f"wall_mm is {wall_mm} and drain_mm {drain_mm}; lengths are needed", key="wall_mm")
    outside, notes = (solid.surface, solid.notes) if isinstance(solid, Solid) else (solid, ())
    step = step_mm or STEP * wall_mm
    inner = inner_offset(outside, wall_mm, step)
    inner = _without_specks(inner, (drain_mm or wall_mm) ** 3) if inner is not None else None
    if inner is None:
        raise SurfaceError(
            f"nothing lies {wall_mm:g} mm deep in the part, so a wall of {wall_mm:g} mm leaves no cavity; ask for a thinner wall",
            wall_mm=wall_mm,
        )
    inner = _fewer_faces(with_ridges(inner, SurfaceDistance(outside), wall_mm, step), tolerance_mm)
    outer, outer_name = to_engine(outside)
    cavity, cavity_name = to_engine(inner)
    sources = [(outer_name, outside), (cavity_name, inner)]
    wall = outer - cavity
    drains: list[Drain] = []
    plugs: list[Solid] = []
    made, surface = wall, from_engine(wall, sources, "drain")
    kept = _kept(surface, outside, up, wall_mm, least_pocket_mm3)
    while kept and drain_mm > 0 and len(drains) < MOST_DRAINS:
        new = [_drain_for(pocket, outside, up, wall_mm, drain_mm) for pocket in kept[: MOST_DRAINS - len(drains)]]
        for drain in new:
            rod = _rod(drain, drain.diameter_mm / 2, wall_mm)
            made = made - rod
            plugs += _plug(wall, rod, drain, wall_mm)
        drains += new
        surface = from_engine(made, sources, "drain")
        before = kept
        kept = _kept(surface, outside, up, wall_mm, least_pocket_mm3)
        if kept and np.allclose(kept[0].lowest_mm, before[0].lowest_mm) and kept[0].volume_mm3 >= 0.99 * before[0].volume_mm3:
            break
    volume = inner.volume_mm3
    x, y, z = (float(value) for value in frame_of(up)[2])
    done = (
        f"hollowed to a wall of {wall_mm:g} mm: {volume / 1000:.2f} cm3 less resin",
        f"{len(drains)} drains of {drain_mm:g} mm; "
        + (f"{len(kept)} pockets keep {sum(p.volume_mm3 for p in kept):.1f} mm3" if kept else "every pocket drains"),
    )
    measured = measured_wall(outside, inner, wall_mm, tolerance_mm)
    return Hollow(surface, tuple(plugs), measured, tuple(drains), tuple(kept), volume, (x, y, z), (*notes, *done))


def _fewer_faces(inner: Surface, tolerance_mm: float) -> Surface:
    """The grid's many faces say no more than a few: collapsed within a share of the tolerance, and no farther than they stay out of each
    other's way."""
    for share in (FEWER, FEWER / 4):
        loose = untangle(simplified(inner, share * tolerance_mm), max_move_mm=LOOSER * tolerance_mm)
        if not loose.after:
            return loose.surface
    return inner


def _without_specks(inner: Surface, least_mm3: float) -> Surface | None:
    """The cavity without bubbles too small to drain; a bubble within full material is better left full."""
    from rangecheck.solid.containment import shell_volumes_mm3

    count, shell = topo.shells(inner)
    large = shell_volumes_mm3(inner, count, shell) >= least_mm3
    # shells that face inwards are islands of material around which the cavity runs: they go with the body that they lie in
    islands = shell_volumes_mm3(inner, count, shell) < 0
    keep = large | islands
    return inner.with_faces(np.flatnonzero(keep[shell])) if large.any() else None


def measured_wall(outer: Surface, inner: Surface, asked_mm: float, tolerance_mm: float) -> Wall:
    """The wall between an outer surface and a cavity, over the area of both."""
    samples = sample_surface(inner, max(asked_mm, inner.extent_mm / 200))
    solid = SurfaceDistance(outer)
    distance, _ = solid.distance_mm(samples.places_mm)
    order = np.argsort(distance, kind="stable")
    cumulated = np.cumsum(samples.area_mm2[order])
    median = float(distance[order][np.searchsorted(cumulated, cumulated[-1] / 2)])
    within = float(samples.area_mm2[np.abs(distance - asked_mm) <= tolerance_mm].sum() / cumulated[-1])
    outside = _evenly(sample_surface(outer, asked_mm / 4), MOST_SAMPLES)
    far, _ = SurfaceDistance(inner).distance_mm(outside.places_mm)
    limited = far > asked_mm + tolerance_mm
    limited[limited] = proved_without_room(solid, outside.places_mm[limited], asked_mm, asked_mm + tolerance_mm)
    full: list[tuple[float, float, float, float]] = []
    waiting = np.flatnonzero(limited)[np.argsort(-far[limited], kind="stable")]
    while len(waiting) and len(full) < MOST_PLACES:
        x, y, z = (float(v) for v in outside.places_mm[waiting[0]])
        full.append((x, y, z, float(far[waiting[0]])))
        apart = np.linalg.norm(outside.places_mm[waiting] - outside.places_mm[waiting[0]], axis=1)
        waiting = waiting[apart > 8 * asked_mm]
    good = np.abs(far - asked_mm) <= tolerance_mm
    roomy = float(outside.area_mm2[~limited].sum())
    share = float(outside.area_mm2[good].sum()) / roomy if roomy else 0.0
    none = 1.0 - roomy / float(outside.area_mm2.sum())
    return Wall(asked_mm, float(distance.min()), median, float(distance.max()), tolerance_mm, within, share, none, tuple(full))


def _evenly(samples: Samples, most: int) -> Samples:
    """Every n-th sample, so that no more than `most` are left."""
    every = -(-len(samples.face) // most)
    return Samples(samples.places_mm[::every], samples.face[::every], samples.area_mm2[::every])


def _kept(surface: Surface, outside: Surface, up: npt.ArrayLike, wall_mm: float, least_mm3: float) -> list[Pocket]:
    """Pockets of the cavity that keep resin; hollows of the outside, which held water before, are not the cavity's."""
    step = max(wall_mm / 3, float(np.ptp(surface.vertices, axis=0).max()) / 256)
    found = pockets(surface, up, step_mm=step, least_mm3=least_mm3)
    if not found:
        return []
    places = np.array([p.lowest_mm for p in found])
    depth, _ = SurfaceDistance(outside).signed_distance_mm(places)
    return [p for p, d in zip(found, depth) if d < -wall_mm / 2]


def _drain_for(pocket: Pocket, outer: Surface, up: npt.ArrayLike, wall_mm: float, drain_mm: float) -> Drain:
    """From the pocket's lowest place straight down, or, where that way is longer than five walls, the shortest way out."""
    from rangecheck.raycast import EmbreeCaster

    down = -frame_of(up)[2]
    inside = pocket.lowest_mm
    hit = EmbreeCaster(outer.vertices, outer.faces).closest(inside[None], down[None])
    if hit.face[0] >= 0 and hit.distance_mm[0] <= 5 * wall_mm:
        return Drain(inside, inside + hit.distance_mm[0] * down, drain_mm)
    nearest = SurfaceDistance(outer).nearest(inside[None])
    return Drain(inside, nearest.place_mm[0], drain_mm)


def _rod(drain: Drain, radius_mm: float, wall_mm: float) -> Any:
    """A rod along the drain, half a wall longer inside and a whole wall outside."""
    way = drain.outside_mm - drain.inside_mm
    length = float(np.linalg.norm(way))
    frame = frame_of(way)
    rod = manifold3d_module().Manifold.cylinder(length + 1.5 * wall_mm, radius_mm, radius_mm, SIDES)
    start = drain.inside_mm - 0.5 * wall_mm * frame[2]
    return rod.transform(np.column_stack([frame.T, start]))


def _plug(wall: Any, rod: Any, drain: Drain, wall_mm: float) -> list[Solid]:
    """What the drain takes out of the wall, smaller all round by the clearance: flush outside, and inside as the cavity is."""
    # only the neighbourhood of the rod: the whole wall need not be divided again
    taken = wall ^ rod
    radius = drain.diameter_mm / 2 - CLEARANCE_MM
    if radius <= 0:
        return []
    cut = taken ^ _rod(drain, radius, wall_mm)
    pieces = [p for p in cut.decompose() if p.volume() > 0.1 * math.pi * radius**2 * wall_mm]
    return [Solid.from_surface(from_engine(p, [], "plug", INVENTED)) for p in pieces]
