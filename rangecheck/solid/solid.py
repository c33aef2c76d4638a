"""`Solid`: a surface that bounds a volume. It cannot exist unless every check passed, so what takes one need not check again.

Closed, manifold at edges and vertices, consistently wound and outward, of positive volume, without faces that cross or overlap, and
accepted by manifold3d, whose word is last; where memory was bounded and has no room for it, the verdict says that it was left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

from rangecheck import memory
from rangecheck.errors import NotSolid
from rangecheck.solid import checks
from rangecheck.solid.engine import needed_mb, to_engine
from rangecheck.solid.findings import Finding, Verdict, finding, verdict
from rangecheck.surface import topology as topo
from rangecheck.surface.surface import Surface

_PROOF = object()
#: whole checks with the severities of the catalogue, kept as long as their surface lives
_verdicts: WeakKeyDictionary[Surface, Verdict] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class Solid:
    """A proven solid. Made by `Solid.from_surface` only.

    surface  its boundary, faces outward
    verdict  the check that it passed, with facts and notes
    notes    what was done on the way here, in sentences
    """

    surface: Surface
    verdict: Verdict = field(repr=False)
    notes: tuple[str, ...] = field(default=(), repr=False)
    _proof: object = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self._proof is not _PROOF:
            raise NotSolid("a Solid is made by Solid.from_surface(), which checks it; it cannot be claimed", findings=())

    @classmethod
    def from_surface(cls, surface: Surface, *, notes: tuple[str, ...] = (), severities: Mapping[str, str] | None = None) -> Solid:
        """`surface` as a Solid. `severities` overrides those of findings by code; what is in HARD stands against it whatever they say.
        Raises NotSolid, whose `findings` and `verdict` say why not and where."""
        judged = check_solid(surface, severities=severities)
        if not judged.fit or any(f.code in HARD for f in judged.findings):
            raise NotSolid(judged.sentence(), findings=judged.findings, verdict=judged)
        return cls(surface, judged, notes, _PROOF)

    def _repr_png_(self) -> bytes:
        """A notebook's look at the solid."""
        return self.surface._repr_png_()

    @property
    def volume_mm3(self) -> float:
        """Volume enclosed, cavities not counted."""
        return self.surface.volume_mm3

    @property
    def area_mm2(self) -> float:
        """Area of all faces."""
        return self.surface.area_mm2


#: whatever severities say, a surface with one of these is no solid
HARD = (
    "open-edges",
    "non-manifold-edges",
    "non-manifold-vertices",
    "inconsistent-winding",
    "inside-out",
    "nested-shells",
    "duplicate-faces",
    "no-volume",
    "self-intersections",
    "overlapping-faces",
    "engine-refuses",
)


def check_solid(
    surface: Surface, *, intersections: bool = True, engine: bool = True, severities: Mapping[str, str] | None = None
) -> Verdict:
    """Everything that keeps `surface` from being the boundary of a solid, with places, and what was measured.

    `intersections` and `engine` leave out the two slower checks (the verdict's facts say so); `severities` overrides the default
    severity of findings by code. Raises nothing: a surface without faces has the finding no-volume. A whole check with the default severities
    is made once of each surface."""
    whole = intersections and engine and not severities
    if not whole:
        return _checked(surface, intersections, engine, severities)
    known = _verdicts.get(surface)
    if known is None:
        known = _verdicts[surface] = _checked(surface, True, True, None)
    return known


def _checked(surface: Surface, intersections: bool, engine: bool, severities: Mapping[str, str] | None) -> Verdict:
    found: list[Finding] = []
    closed = topo.is_closed(surface)
    low, high = surface.bounds_mm
    facts: dict[str, Any] = {
        "vertices": len(surface.vertices),
        "faces": len(surface.faces),
        "closed": closed,
        "bounds_mm": [low.tolist(), high.tolist()],
        "intersections_checked": intersections,
        "engine_asked": engine,
    }
    found += checks.rims(surface, severities)
    found += checks.manifoldness(surface, severities)
    found += checks.idle_parts(surface, severities)
    about_bodies, body_facts = checks.bodies(surface, closed, severities)
    found += about_bodies
    facts |= body_facts
    volume = facts.get("volume_mm3", 0.0)
    smallest = 1e-12 * surface.extent_mm**3
    if not len(surface.faces) or (closed and abs(volume) <= smallest):
        found.append(finding("no-volume", 1, f"it encloses {volume:.3g} mm3", severities=severities))
    if intersections:
        found += checks.meetings(surface, severities)
    if engine and closed and len(surface.faces):
        takes_mb = needed_mb(len(surface.faces))
        if takes_mb <= memory.left_mb():
            found += _engine_word(surface, severities)
        else:
            facts["engine_asked"] = False
            words = f"not judged: manifold3d, which takes about {takes_mb:,.0f} MB, more than memory_mb leaves"
            found.append(finding("left-out", 1, words, severities=severities))
    return verdict(found, facts)


def _engine_word(surface: Surface, severities: Mapping[str, str] | None) -> list[Finding]:
    try:
        to_engine(surface)
    except NotSolid as refusal:
        return [engine_refuses(refusal.measured["word"], severities)]
    return []


def engine_refuses(word: str, severities: Mapping[str, str] | None = None) -> Finding:
    """The finding that manifold3d refused a surface, with its word."""
    return finding("engine-refuses", 1, f"manifold3d refuses the surface: {word}", severities=severities, word=word)
