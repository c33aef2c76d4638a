"""Line drawings as SVG: one path per kind of line, pixel coordinates with (0, 0) at the upper left corner."""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from rangecheck.files import write_bytes
from rangecheck.modeler.draw import KINDS, Drawing, Line

#: stroke widths as shares of the longer side, from the outline down to seams
WIDTHS = {"silhouette": 2.4e-3, "border": 2.0e-3, "crease": 1.6e-3, "seam": 0.8e-3}
#: points that leave the straight line between their neighbours by less are left out
STRAIGHT_PX = 0.02


def svg_text(drawing: Drawing, title: str = "") -> str:
    """The drawing as an SVG document; hidden lines, if it has any, dashed and pale under the others."""
    w, h = drawing.width, drawing.height
    longest = max(w, h)
    rows = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {w} {h}" width="{w}" height="{h}" fill="none" '
        'stroke="#1c1e22" stroke-linecap="round" stroke-linejoin="round">',
    ]
    if title:
        rows.append(f"<title>{escape(title)}</title>")
    rows.append(f'<rect width="{w}" height="{h}" fill="#ffffff" stroke="none"/>')
    for visible in (False, True):
        for kind in (3, 2, 1, 0):
            lines = [line for line in drawing.lines if line.kind == kind and line.visible == visible]
            if not lines:
                continue
            name = KINDS[kind]
            width = WIDTHS[name] * longest * (1.0 if visible else 0.6)
            dash = "" if visible else f' stroke="#9aa0a8" stroke-dasharray="{3 * width:.2f} {4 * width:.2f}"'
            path = " ".join(_path(line) for line in lines)
            rows.append(f'<path class="{name}{"" if visible else " hidden"}" stroke-width="{width:.2f}"{dash} d="{path}"/>')
    return "\n".join([*rows, "</svg>"]) + "\n"


def write_svg(path: str | Path, drawing: Drawing, title: str = "", *, force: bool = True) -> None:
    """Write the drawing, whole or not at all."""
    write_bytes(path, svg_text(drawing, title).encode(), force=force)


def _path(line: Line) -> str:
    points = _thinned(line.points) + 0.5
    closed = len(points) > 2 and (points[0] == points[-1]).all()
    text = " L".join(f"{x:.2f} {y:.2f}" for x, y in (points[:-1] if closed else points))
    return f"M{text}" + ("Z" if closed else "")


def _thinned(points: np.ndarray) -> np.ndarray:
    """Without the points that are within STRAIGHT_PX of the line their neighbours make (Douglas & Peucker 1973)."""
    keep = np.zeros(len(points), bool)
    keep[[0, -1]] = True
    spans = [(0, len(points) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        a, along = points[first], points[last] - points[first]
        length = float(np.hypot(*along))
        offset = points[first + 1 : last] - a
        if length > 0:
            share = np.clip(offset @ along / length**2, 0, 1)
            offset = offset - share[:, None] * along
        distance = np.hypot(offset[:, 0], offset[:, 1])
        worst = int(np.argmax(distance))
        if distance[worst] > STRAIGHT_PX:
            keep[first + 1 + worst] = True
            spans += [(first, first + 1 + worst), (first + 1 + worst, last)]
    return points[keep]
