"""What every reader keeps to: how large a picture may be, which paths a manifest may name, and how a bad file is refused.

A header is believed only as far as the file behind it could hold what it announces, and before anything of that size is made.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

from rangecheck.errors import InputError

#: cells of one scan: 8192 x 4096
MAX_CELLS = 1 << 25
#: deflate cannot shrink more than this (RFC 1951: 258 bytes from 2 bits), so neither can a PNG, a zip or a TIFF
DEFLATE_RATIO = 1032


def check_cells(path: Path, width: int, height: int) -> None:
    """Refuse a grid that is empty or larger than MAX_CELLS. Raises InputError."""
    if width < 1 or height < 1:
        raise InputError(path, f"its header says {width} x {height} cells; a scan needs at least one", width=width, height=height)
    if width > 65536 or height > 65536 or width * height > MAX_CELLS:
        raise InputError(
            path,
            f"its header says {width} x {height} cells; at most {MAX_CELLS} and 65536 a side are read; split the scan",
            width=width,
            height=height,
        )


def check_holds(path: Path, needed: int, present: int, what: str) -> None:
    """Refuse a file that cannot hold the `needed` bytes of `what` that its header announces. Raises InputError."""
    if present < needed:
        raise InputError(
            path,
            f"is cut short: its header announces {what}, which takes at least {needed} bytes, and {present} are there; copy it again",
            needed=needed,
            present=present,
        )


def beside(manifest: Path, name: object) -> Path:
    """The file `name` that `manifest` mentions: relative, and inside the manifest's folder even through links.

    Raises InputError for absolute names, names with `..`, and links that lead out."""
    if not isinstance(name, str) or not name or any(ord(c) < 32 for c in name):
        raise InputError(manifest, f"names a file {name!r}; a file name is a non-empty string")
    parts = PurePosixPath(name.replace("\\", "/"))
    folder = manifest.parent.resolve()
    if parts.is_absolute() or ".." in parts.parts or re.match(r"^[A-Za-z]:", name):
        raise InputError(manifest, f"names {name!r}, outside its own folder; move the file beside it and name it relative to it")
    target = folder.joinpath(*parts.parts)
    try:
        inside = target.resolve().is_relative_to(folder)
    except (OSError, RuntimeError):  # a loop of links
        inside = False
    if not inside:
        raise InputError(manifest, f"names {name!r}, a link that leads out of its folder; put the file itself there")
    return manifest.parent.joinpath(*parts.parts)


def plain_name(name: str, taken: set[str]) -> str:
    """`name` as a file stem that any system accepts and that is not in `taken`; adds it there."""
    stem = re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_")[:80] or "scan"
    result, count = stem, 1
    while result.lower() in taken:
        count += 1
        result = f"{stem}_{count}"
    taken.add(result.lower())
    return result
