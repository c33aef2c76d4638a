"""Shapes that are solid and yet make trouble: folds, slivers, edges that float32 hardly tells from points."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from rangecheck.arrays import float32_spacing_mm
from rangecheck.kernels import in_chunks, kernel
from rangecheck.solid.findings import Finding, finding
from rangecheck.surface import topology as topo
from rangecheck.surface.surface import Surface

#: edges whose two faces enclose less than this are folded
FOLD_DEG = 10.0
#: faces whose longest side is more than this many times their height are slivers
SLIVER_RATIO = 200.0
#: edges of fewer float32 steps than this are short
SHORT_STEPS = 8
_CHUNK = 1 << 16


def shape_findings(surface: Surface, *, fold_deg: float = FOLD_DEG, severities: Mapping[str, str] | None = None) -> list[Finding]:
    """Folded edges, slivers and short edges of `surface`, with places."""
    if not len(surface.faces):
        return []
    found: list[Finding] = []
    table = topo.edge_table(surface)
    ends = table.ends
    normals, area, longest = np.empty((len(surface.faces), 3)), np.empty(len(surface.faces)), np.empty(len(surface.faces))
    in_chunks(
        lambda first, last: measured_faces(surface.vertices, surface.faces, first, last, normals, area, longest),
        len(surface.faces),
        _CHUNK,
    )
    length, cosine = np.empty(len(ends)), np.empty(len(ends))
    in_chunks(
        lambda first, last: measured_edges(
            surface.vertices, ends, table.start, table.halves, table.along, normals, first, last, length, cosine
        ),
        len(ends),
        _CHUNK,
    )
    # faces that enclose an angle a have normals that differ by 180 - a degrees
    folded = np.flatnonzero(cosine < -math.cos(math.radians(fold_deg)))
    if len(folded):
        edges = ends[folded]
        message = f"{len(folded)} edges are folded to less than {fold_deg:g} degrees"
        pair = table.start[:-1][folded]
        faces = np.unique(np.concatenate([table.halves[pair], table.halves[pair + 1]]) // 3)
        found.append(finding("folded-edges", len(folded), message, surface.vertices[edges].mean(axis=1), faces, severities))
    whole = (table.edge_of_half.reshape(-1, 3) >= 0).all(axis=1)
    thin = np.flatnonzero(whole & (longest**2 > SLIVER_RATIO * 2 * area) & (area > 0))
    if len(thin):
        message = f"{len(thin)} faces are more than {SLIVER_RATIO:g} times longer than high"
        found.append(finding("sliver-faces", len(thin), message, surface.triangles[thin].mean(axis=1), thin, severities))
    step = float32_spacing_mm(float(np.abs(surface.bounds_mm).max()))
    short = np.flatnonzero(length < SHORT_STEPS * step)
    if len(short):
        message = f"{len(short)} edges are shorter than {SHORT_STEPS} float32 steps ({SHORT_STEPS * step:.2g} mm), the shortest {length.min():.2g} mm"
        found.append(finding("short-edges", len(short), message, surface.vertices[ends[short]].mean(axis=1), None, severities))
    return found


@kernel
def measured_faces(vertices, faces, first, last, normals, area, longest):
    """Unit normal (0 without area), area and longest side of the faces first:last."""
    for f in range(first, last):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        ux, uy, uz, vx, vy, vz = b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]
        wx, wy, wz = vx - ux, vy - uy, vz - uz
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        size = math.sqrt(x * x + y * y + z * z)
        scale = 1.0 / size if size > 0.0 else 0.0
        normals[f, 0], normals[f, 1], normals[f, 2] = x * scale, y * scale, z * scale
        area[f] = 0.5 * size
        longest[f] = math.sqrt(max(ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz))


@kernel
def measured_edges(vertices, ends, start, halves, along, normals, first, last, length, cosine):
    """Length of the edges first:last, and the cosine between the normals of the two faces of each that has two, wound alike; else 1."""
    for e in range(first, last):
        a, b = vertices[ends[e, 0]], vertices[ends[e, 1]]
        x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        length[e] = math.sqrt(x * x + y * y + z * z)
        cosine[e] = 1.0
        if start[e + 1] - start[e] == 2 and along[e] == 1:
            f, g = halves[start[e]] // 3, halves[start[e] + 1] // 3
            cosine[e] = normals[f, 0] * normals[g, 0] + normals[f, 1] * normals[g, 1] + normals[f, 2] * normals[g, 2]
