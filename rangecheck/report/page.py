"""The report as one HTML file that asks nothing of the network: style, scripts, pictures, mesh and maps are inside it.

Its Content-Security-Policy allows the scripts and styles that it was written with, by their hashes, and no connection. three.js is embedded as
it was published (vendor/); the page links its two modules when it is opened.
"""

from __future__ import annotations

import base64
import hashlib
import zlib
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.export.legend import colour_table
from rangecheck.files import read_bytes, write_bytes
from rangecheck.kernels import in_chunks
from rangecheck.report.content import DistanceMap, Model, ReportContent, Turntable, data_uri
from rangecheck.report.pack import octahedral, packed, packed_floats
from rangecheck.report.sphere import halves, seen_share
from rangecheck.surface import ORIGIN_NAMES
from rangecheck.surface.topology import is_closed

#: bytes that all frames together may take in the page
FRAME_BUDGET = 4_500_000
_QUALITIES = (88, 80, 70)
#: PNG pictures above this size enter the page as WebP, no side longer than _PICTURE_PX
_PICTURE_BYTES, _PICTURE_PX, _PICTURE_QUALITY = 60_000, 800, 86
_STOPS = 33
_SCRIPTS = ("shared.js", "turn.js", "controls.js", "viewer.js", "maps.js")
#: what the page calls the places that the turntable rings; no finding: a place that bends unlike its surroundings may well be form
STANDS_OUT = "stands out"
_LIBRARY = ("three.core.min.js", "three.module.min.js")


def write_report(content: ReportContent, path: str | Path, *, force: bool = True) -> None:
    """Write the report as one HTML file at `path`."""
    write_bytes(path, report_html(content).encode(), force=force)


def report_html(content: ReportContent) -> str:
    """The page."""
    import jinja2

    room = resources.files("rangecheck.report")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    style = (room / "page.css").read_text("utf-8")
    script = "\n".join((room / name).read_text("utf-8") for name in _SCRIPTS)
    tables, frames_note = _turntables(content.turntables)
    data: dict[str, Any] = {"tables": tables, "colours": _colours(content), "front": content.front_deg}
    data["maps"] = [_map_form(one) for one in content.distance_maps]
    data["findings"] = [
        {"code": f.code, "severity": f.severity, "places": np.round(f.places_mm, 3).tolist()} for f in content.findings
    ]
    if len(content.stands_out):
        data["findings"].append({"code": STANDS_OUT, "severity": "note", "places": np.round(content.stands_out, 3).tolist()})
    if content.model is not None:
        data["model"] = _model_form(content.model)
        data["library"] = [_deflated((room / "vendor" / name).read_bytes()) for name in _LIBRARY]
    return environment.from_string((room / "page.html.j2").read_text("utf-8")).render(
        content=content,
        data=data,
        frames_note=frames_note,
        hides={"plaster", "steel"} <= {table["name"] for table in tables},
        sphere=None if content.coverage is None else halves(content.coverage),
        seen=None if content.coverage is None else seen_share(content.coverage.counts),
        embedded=_light,
        style=style,
        script=script,
        policy=(
            f"default-src 'none'; script-src 'sha256-{_digest(script)}' blob:; style-src 'sha256-{_digest(style)}'; "
            "img-src data: blob:; base-uri 'none'; form-action 'none'"
        ),
    )


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _deflated(content: bytes) -> str:
    return base64.b64encode(zlib.compress(content, 9)).decode()


def _colours(content: ReportContent) -> dict[str, list[list[int]]]:
    """The colour tables that the page uses, at evenly spaced stops."""
    names = {"viridis"} | ({f.colours for f in content.model.fields} if content.model else set())
    at = np.linspace(0, 255, _STOPS).round().astype(int)
    return {name: np.rint(255 * colour_table(name)[at]).astype(int).tolist() for name in sorted(names)}


def _turntables(tables: Sequence[Turntable]) -> tuple[list[dict[str, Any]], str]:
    """Names and frames as data URIs within the budget, and how many of how many frames, at what quality."""
    if not tables:
        return [], ""
    every = 1
    while True:
        for quality in _QUALITIES:
            # a few frames tell which qualities need not be tried
            few = [path for table in tables for path in table.frames[:: max(every, len(table.frames) // 6)]]
            count = sum(len(table.frames[::every]) for table in tables)
            if sum(map(len, _jpegs(few, quality))) / len(few) * count * 4 / 3 > 1.05 * FRAME_BUDGET:
                continue
            shown = [_jpegs(table.frames[::every], quality) for table in tables]
            size = sum(len(frame) for frames in shown for frame in frames)
            if size * 4 / 3 <= FRAME_BUDGET:
                total, count = sum(len(table.frames) for table in tables), sum(len(frames) for frames in shown)
                note = f"{count} of {total} frames are in this file, as JPEG of quality {quality}"
                forms = [
                    {
                        "name": table.name,
                        "start": table.start_deg,
                        "step": 360 * every / len(table.frames),
                        "frames": [data_uri(f) for f in frames],
                    }
                    for table, frames in zip(tables, shown)
                ]
                return forms, note
        every += 1


def _jpegs(paths: Sequence[Path], quality: int) -> list[bytes]:
    return in_chunks(lambda start, _: _jpeg(paths[start], quality), len(paths), 1)


def _jpeg(path: Path, quality: int) -> bytes:
    import cv2

    picture = cv2.imdecode(np.frombuffer(read_bytes(path), np.uint8), cv2.IMREAD_COLOR)
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return encoded.tobytes()


def _light(picture: bytes) -> str:
    """A picture as a data URI, large PNGs made lighter."""
    if len(picture) <= _PICTURE_BYTES or not picture.startswith(b"\x89PNG"):
        return data_uri(picture)
    import cv2

    image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return data_uri(picture)
    shrink = _PICTURE_PX / max(image.shape[:2])
    if shrink < 1:
        image = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, _PICTURE_QUALITY])
    return data_uri(encoded.tobytes())


def _map_form(one: DistanceMap) -> dict[str, Any]:
    height, width = one.distance_mm.shape
    return {
        "label": one.label,
        "width": width,
        "height": height,
        "distance": packed_floats(np.asarray(one.distance_mm, np.float64).reshape(-1)),
        "intrinsics": one.intrinsics,
        "pose": np.asarray(one.world_from_camera, np.float64).tolist(),
    }


def _model_form(model: Model) -> dict[str, Any]:
    """The mesh with its vertices in the order of a curve through space, so that neighbours stand beside each other; vertices at which faces
    of different origin or part meet are taken once for each."""
    surface = model.surface
    names, origin_of_face = list(ORIGIN_NAMES), surface.origin_of_face
    if surface.refined_of_face is not None:
        names.append("measured, refined by shading")
        origin_of_face = np.where(surface.refined_of_face, len(ORIGIN_NAMES), origin_of_face)
    parts, origins = len(surface.part_names), len(names)
    of_face = surface.part_of_face.astype(np.int64) * origins + origin_of_face
    # one number for vertex, part and origin: sorted many times as fast as rows of three
    keys, corners = np.unique(
        surface.faces.reshape(-1).astype(np.int64) * (parts * origins) + np.repeat(of_face, 3), return_inverse=True
    )
    vertex, origin = keys // (parts * origins), (keys % origins).astype(np.uint8)
    normals = _normals(model, keys // origins)
    order = np.argsort(_curve(surface.vertices[vertex]), kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    faces = place[corners.reshape(-1, 3)].astype(np.uint32)
    faces = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    vertex, origin = vertex[order], origin[order]
    low, high = surface.bounds_mm
    step = float((high - low).max()) / 65535 or 1.0
    return {
        "about": model.about,
        "exactness": "measured in this page on the mesh in it, "
        + (f"of which 99 % lies within {model.off_mm:.3f} mm of the bust" if model.off_mm else f"kept in steps of {step:.2g} mm"),
        "closed": is_closed(surface),
        "low": low.tolist(),
        "high": high.tolist(),
        "step": step,
        "positions": packed(np.rint((surface.vertices[vertex] - low) / step).astype(np.uint16)),
        "normals": packed(octahedral(normals[order])),
        "faces": packed(faces),
        "origins": names,
        "origin": packed(origin),
        "flagged": None if model.flagged is None else packed(model.flagged[vertex].astype(np.uint8)),
        "fields": [
            {
                "key": f.key, "label": f.label, "unit": f.unit, "about": f.about, "colours": f.colours,
                "from": f.low, "to": f.high, "values": packed_floats(f.values[vertex]),
            }
            for f in model.fields
        ],
    }  # fmt: skip


def _normals(model: Model, keys: Any) -> Any:
    """(k, 3) unit normals of the vertices in `keys` (vertex x parts + part), smooth within a part and sharp between parts."""
    surface = model.surface
    corner = surface.faces.reshape(-1).astype(np.int64) * len(surface.part_names) + np.repeat(surface.part_of_face, 3)
    pairs, of_corner = np.unique(corner, return_inverse=True)
    of_corner = of_corner.reshape(-1)
    area = np.repeat(surface.area_vectors, 3, axis=0)
    total = np.stack([np.bincount(of_corner, area[:, axis], minlength=len(pairs)) for axis in range(3)], axis=1)
    total = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    return total[np.searchsorted(pairs, keys)]


def _curve(points: Any) -> Any:
    """(n,) places of points along a Morton curve with 2^10 cells a side."""
    low = points.min(axis=0)
    cell = np.minimum((points - low) * (1023.0 / (float(np.ptp(points, axis=0).max()) or 1.0)), 1023.0).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code
