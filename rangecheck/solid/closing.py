"""An open or damaged surface made closed: as a relief that gets a back, or as a body whose defects are repaired.

What was seen from one side faces one way: its area vectors add up instead of cancelling. Such a sheet has one long rim that no patch can
close without running through the sheet, so it gets a skirt and a back; everything else is repaired where it is.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rangecheck.errors import SettingError, SurfaceError
from rangecheck.solid.relief import close_relief
from rangecheck.solid.repair import MAX_MOVE_MM, MAX_VANISHED, Repaired, Step, leash, repair
from rangecheck.solid.solid import Solid, check_solid
from rangecheck.surface.surface import Surface
from rangecheck.surface.topology import is_closed

WAYS = ("auto", "repair", "relief")
#: a surface whose area vectors add up to more than this share of its area faces one way; a half ball has 0.5
ONE_WAY = 0.4
#: the leash is never longer than this share of the part: a file in metres read as millimetres must not be welded to a point
LONGEST_LEASH = 0.002


@dataclass(frozen=True, eq=False)
class Closed(Repaired):
    """A surface closed as far as it went, proved nowhere but judged in `after`.

    way, reason   "repair" or "relief", and why
    solid         the surface as it was proved, where that was done on the way
    """

    way: str = "repair"
    reason: str = ""
    solid: Solid | None = field(default=None, repr=False)


def close_surface(
    surface: Surface,
    *,
    way: str = "auto",
    back_mm: float = 20.0,
    eye_mm: npt.ArrayLike | None = None,
    max_move_mm: float = MAX_MOVE_MM,
    max_vanished: float = MAX_VANISHED,
    longest_hole_mm: float | None = None,
) -> Closed:
    """`surface` closed by repair, or as a relief with a back `back_mm` behind it. With "auto", where one way fails the other is tried.

    eye_mm is where a single scan was taken from; the other arguments are those of `repair` and `close_relief`. A surface that cannot be
    closed comes back with its verdict and what was refused. Raises SettingError for an unknown way."""
    if way not in WAYS:
        raise SettingError(f"there is no way {way!r} to close a surface; choose one of {', '.join(WAYS)}", key="close")
    chosen, reason = (way, "asked for") if way != "auto" else choose_way(surface, one_scan=eye_mm is not None)
    longest = LONGEST_LEASH * surface.extent_mm
    allowed = min(max_move_mm, longest)
    short = (
        f"the leash is {allowed:.3g} mm, {100 * LONGEST_LEASH:.1f} % of the part, and not {max_move_mm:g} mm"
        if allowed < max_move_mm
        else ""
    )

    def by_repair() -> Closed:
        mended = repair(surface, max_move_mm=allowed, max_vanished=max_vanished, longest_hole_mm=longest_hole_mm)
        refused = (*mended.refused, short) if short else mended.refused
        return Closed(**vars(mended) | {"refused": refused}, way="repair", reason=reason)

    if chosen == "relief":
        try:
            return _as_relief(surface, back_mm, eye_mm, reason)
        except SurfaceError as refusal:
            if way == "relief":
                raise
            reason = f"as a relief it cannot be closed: {refusal}"
            return by_repair()
    made = by_repair()
    if made.after.fit or way == "repair" or is_closed(surface):
        return made
    try:
        return _as_relief(surface, back_mm, eye_mm, f"repair left it open: {'; '.join(made.refused)}")
    except SurfaceError:
        return made


def choose_way(surface: Surface, *, one_scan: bool = False) -> tuple[str, str]:
    """ "repair" or "relief", and why in one sentence."""
    if is_closed(surface):
        return "repair", "it is closed already"
    if one_scan:
        return "relief", "it was seen from one place"
    share = float(np.linalg.norm(surface.area_vectors.sum(axis=0)) / max(surface.area_mm2, 1e-300))
    if share > ONE_WAY:
        return "relief", f"it faces one way: its area vectors add up to {100 * share:.0f} % of its area"
    return "repair", f"it faces all ways: its area vectors add up to {100 * share:.0f} % of its area"


def _as_relief(surface: Surface, back_mm: float, eye_mm: npt.ArrayLike | None, reason: str) -> Closed:
    # it is open, and only faces that lie side by side as seen from the eye are kept: where it runs through itself need not be asked
    before = check_solid(surface, intersections=False, engine=False)
    made = close_relief(surface, back_mm=back_mm, eye_mm=eye_mm)
    moved, vanished = leash(surface, made.surface)
    steps = tuple(
        Step("close-relief", 1, note) for note in (*made.notes, f"skirt and back plane {back_mm:g} mm behind its deepest point")
    )
    return Closed(made.surface, steps, (), moved, vanished, before, made.verdict, "relief", reason, made)
