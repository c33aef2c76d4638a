"""What a report shows, as plain values. World frame, millimetres; y is up.

Everything is optional but the verdict: what was not made is not shown.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rangecheck.arrays import FloatArray, IntArray, require
from rangecheck.errors import ArrayError
from rangecheck.surface import Surface

_MEDIA = {
    b"\x89PNG": "image/png",
    b"\xff\xd8\xff": "image/jpeg",
    b"RIFF": "image/webp",
    b"<svg": "image/svg+xml",
    b"<?xm": "image/svg+xml",
}


def data_uri(picture: bytes) -> str:
    """Encoded bytes (PNG, JPEG, WebP or SVG) as a data URI."""
    kind = next((media for start, media in _MEDIA.items() if picture.startswith(start)), "image/png")
    return f"data:{kind};base64,{base64.b64encode(picture).decode()}"


@dataclass(frozen=True)
class Figure:
    """A picture (encoded bytes: PNG, JPEG, WebP or SVG) with what it shows. `alt` describes it to who cannot see it."""

    title: str
    caption: str
    picture: bytes = field(repr=False)
    alt: str = ""


@dataclass(frozen=True)
class Turntable:
    """Frames of one material over the same orbit; frame i of n stands at azimuth start_deg + 360 i / n degrees from the front."""

    name: str
    frames: Sequence[Path]
    start_deg: float = 0.0


@dataclass(frozen=True)
class Finding:
    """One row of the findings table; places_mm (k, 3) are marked in the 3-D view. `where` says where it is when there are none."""

    code: str
    severity: str
    count: int
    message: str
    why: str
    mend: str
    places_mm: FloatArray = field(default_factory=lambda: np.empty((0, 3)), repr=False)
    where: str = "everywhere"


@dataclass(frozen=True)
class Scan:
    """One scan: facts (label, value) and its pictures."""

    name: str
    facts: Sequence[tuple[str, str]]
    pictures: Sequence[Figure] = ()


@dataclass(frozen=True)
class Coverage:
    """From where the surface was seen.

    counts (rows, columns) number of scans with a sample in each direction from the middle: rows from elevation +90 to -90 degrees, columns
    from azimuth 0 (towards +z) through +90 (towards +x); views (name, azimuth, elevation) in degrees, and the next view, if any."""

    counts: IntArray = field(repr=False)
    views: Sequence[tuple[str, float, float]] = ()
    next_view: tuple[float, float] | None = None
    advice: str = ""


@dataclass(frozen=True)
class Field:
    """A quantity on the model's vertices: values (n,), NaN where there is none. Colours run from `low` to `high`.

    `colours` is a name of export.legend's tables; `about` says what is shown and how it was found."""

    key: str
    label: str
    unit: str
    values: FloatArray = field(repr=False)
    low: float
    high: float
    about: str
    colours: str = "viridis"


@dataclass(frozen=True)
class Model:
    """The bust for the 3-D view: a surface light enough to embed, `about` with how far it is from the real one, within `off_mm` for 99 % of its
    points (0: it is that one), and what is known on its vertices. `flagged` (n,) uint8 is 0, or 1 note, 2 warning, 3 error, where faces of a finding lie."""

    surface: Surface
    about: str
    fields: Sequence[Field] = ()
    flagged: IntArray | None = None
    off_mm: float = 0.0

    def __post_init__(self) -> None:
        count = len(self.surface.vertices)
        for one in self.fields:
            require(one.key, one.values, (count,))
        if self.flagged is not None and np.shape(self.flagged) != (count,):
            raise ArrayError(f"flagged is {np.shape(self.flagged)}; the model has {count} vertices", name="flagged")


@dataclass(frozen=True)
class DistanceMap:
    """distance_mm (h, w), NaN where nothing is seen, from the focal point at `world_from_camera` (4, 4); intrinsics fx, fy,
    cx, cy in pixels where it is a pinhole without distortion, so that a pixel's place is known."""

    label: str
    distance_mm: FloatArray = field(repr=False)
    intrinsics: tuple[float, float, float, float] | None
    world_from_camera: FloatArray = field(repr=False)


@dataclass(frozen=True)
class ReportContent:
    """Everything the report shows. `findings` are those of the solid, then those of its scans; `worth` are facts about all scans together;
    `shown` are pictures of what the turntable shows, measured, and `stands_out` (k, 3) the places ringed there; `provenance` are groups of
    facts by heading.

    Azimuths of turntables and focal points count from the front, which lies `front_deg` from +z towards +x."""

    title: str
    fit: bool
    verdict: str
    reasons: Sequence[str]
    scans: Sequence[Scan] = ()
    worth: Sequence[tuple[str, str]] = ()
    coverage: Coverage | None = None
    model: Model | None = None
    turntables: Sequence[Turntable] = ()
    distance_maps: Sequence[DistanceMap] = ()
    front_deg: float = 0.0
    findings: Sequence[Finding] = ()
    shown: Sequence[Figure] = ()
    stands_out: FloatArray = field(default_factory=lambda: np.empty((0, 3)), repr=False)
    charts: Sequence[Figure] = ()
    decisions: Sequence[str] = ()
    settings: str = "{}"
    provenance: Mapping[str, Sequence[tuple[str, str]]] = field(default_factory=dict)
    files: Sequence[tuple[str, str]] = ()
