"""The report: everything it shows is handed to it; it only lays out and embeds.

The page asks nothing of the network: style, script and pictures are inside it.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

from rangecheck.files import read_bytes, write_bytes

_MEDIA = {
    b"\x89PNG": "image/png",
    b"\xff\xd8\xff": "image/jpeg",
    b"RIFF": "image/webp",
    b"<svg": "image/svg+xml",
    b"<?xm": "image/svg+xml",
}


@dataclass(frozen=True)
class Figure:
    """A picture (encoded bytes: PNG, JPEG, WebP or SVG) with what it shows."""

    title: str
    caption: str
    picture: bytes = field(repr=False)

    @property
    def source(self) -> str:
        """The picture as a data URI."""
        kind = next((media for start, media in _MEDIA.items() if self.picture.startswith(start)), "image/png")
        return f"data:{kind};base64,{base64.b64encode(self.picture).decode()}"


@dataclass(frozen=True)
class Turntable:
    """Frames of one material over the same orbit."""

    name: str
    frames: Sequence[Path]


@dataclass(frozen=True)
class Finding:
    """One row of the findings table."""

    code: str
    severity: str
    count: int
    message: str
    place: str
    why: str
    mend: str


@dataclass(frozen=True)
class Section:
    """A heading with facts (label, value) and figures below it."""

    title: str
    text: str = ""
    facts: Sequence[tuple[str, str]] = ()
    figures: Sequence[Figure] = ()


@dataclass(frozen=True)
class ReportContent:
    """Everything the report shows."""

    title: str
    fit: bool
    verdict: str
    reasons: Sequence[str]
    sections: Sequence[Section]
    turntables: Sequence[Turntable]
    findings: Sequence[Finding]
    settings: str
    provenance: Sequence[tuple[str, str]]


def _frame(path: Path, quality: int) -> Figure:
    """A frame made small: JPEG at `quality`."""
    import cv2
    import numpy as np

    picture = cv2.imdecode(np.frombuffer(read_bytes(path), np.uint8), cv2.IMREAD_COLOR)
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return Figure(path.stem, "", encoded.tobytes())


def write_report(content: ReportContent, path: str | Path, *, frame_quality: int = 85, force: bool = True) -> None:
    """Write the report as one HTML file at `path`."""
    import jinja2

    room = resources.files("rangecheck.report")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page = environment.from_string((room / "page.html.j2").read_text("utf-8")).render(
        content=content,
        turntables=[(table.name, [_frame(f, frame_quality).source for f in table.frames]) for table in content.turntables],
        style=(room / "page.css").read_text("utf-8"),
        script=(room / "page.js").read_text("utf-8"),
    )
    write_bytes(path, page.encode(), force=force)
