"""Shapes that are solid and yet make trouble: folds, slivers, edges that float32 hardly tells from points."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from rangecheck.arrays import IntArray, float32_spacing_mm
from rangecheck.kernels import in_chunks, inline_kernel, kernel
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
_NONE = np.empty(0, np.int64)


def shape_findings(surface: Surface, *, fold_deg: float = FOLD_DEG, severities: Mapping[str, str] | None = None) -> list[Finding]:
    """Folded edges, slivers and short edges of `surface`, with places."""
    if not len(surface.faces):
        return []
    found: list[Finding] = []
    table = topo.edge_table(surface)
    ends = table.ends
    step = float32_spacing_mm(float(np.abs(surface.bounds_mm).max()))
    # what was measured of millions of faces and edges is looked at in passing and not kept
    thin = np.concatenate(
        in_chunks(
            lambda first, last: thin_faces(surface.vertices, surface.faces, table.edge_of_half, first, last, SLIVER_RATIO),
            len(surface.faces),
            _CHUNK,
        )
    )
    passed = in_chunks(lambda first, last: _edges(surface, table, first, last, fold_deg, SHORT_STEPS * step), len(ends), _CHUNK)
    folded, short = (np.concatenate([_NONE, *(some[k] for some in passed)]) for k in (0, 1))
    if len(folded):
        edges = ends[folded]
        message = f"{len(folded)} edges are folded to less than {fold_deg:g} degrees"
        pair = table.start[:-1][folded]
        faces = np.unique(np.concatenate([table.halves[pair], table.halves[pair + 1]]) // 3)
        found.append(finding("folded-edges", len(folded), message, surface.vertices[edges].mean(axis=1), faces, severities))
    if len(thin):
        message = f"{len(thin)} faces are more than {SLIVER_RATIO:g} times longer than high"
        middles = surface.vertices[surface.faces[thin]].mean(axis=1)
        found.append(finding("sliver-faces", len(thin), message, middles, thin, severities))
    if len(short):
        shortest = min(some[2] for some in passed)
        message = f"{len(short)} edges are shorter than {SHORT_STEPS} float32 steps ({SHORT_STEPS * step:.2g} mm), the shortest {shortest:.2g} mm"
        found.append(finding("short-edges", len(short), message, surface.vertices[ends[short]].mean(axis=1), None, severities))
    return found


def _edges(
    surface: Surface, table: topo.EdgeTable, first: int, last: int, fold_deg: float, short_mm: float
) -> tuple[IntArray, IntArray, float]:
    """Which of the edges first:last are folded, which are short, and how short the shortest is."""
    length, cosine = np.empty(last - first), np.empty(last - first)
    measured_edges(
        surface.vertices, surface.faces, table.ends, table.start, table.halves, table.along, first, last, length, cosine
    )
    # faces that enclose an angle a have normals that differ by 180 - a degrees
    folded = first + np.flatnonzero(cosine < -math.cos(math.radians(fold_deg)))
    return folded, first + np.flatnonzero(length < short_mm), float(length.min())


@inline_kernel
def _sides(vertices, faces, f):
    """Two sides of face f from its first corner, and their cross product."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    return ux, uy, uz, vx, vy, vz, uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@kernel
def thin_faces(vertices, faces, edge_of_half, first, last, ratio):
    """(k,) int64 which of the faces first:last have area, edges in the table, and a longest side of more than `ratio` times their height."""
    thin, count = np.empty(last - first, np.int64), 0
    for f in range(first, last):
        if edge_of_half[3 * f] < 0 or edge_of_half[3 * f + 1] < 0 or edge_of_half[3 * f + 2] < 0:
            continue
        ux, uy, uz, vx, vy, vz, x, y, z = _sides(vertices, faces, f)
        wx, wy, wz = vx - ux, vy - uy, vz - uz
        area = 0.5 * math.sqrt(x * x + y * y + z * z)
        longest = math.sqrt(max(ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz))
        if longest * longest > ratio * 2 * area and area > 0.0:
            thin[count] = f
            count += 1
    return thin[:count].copy()


@inline_kernel
def _normal(vertices, faces, f):
    """Unit normal of face f; 0 without area."""
    _, _, _, _, _, _, x, y, z = _sides(vertices, faces, f)
    size = math.sqrt(x * x + y * y + z * z)
    scale = 1.0 / size if size > 0.0 else 0.0
    return x * scale, y * scale, z * scale


@kernel
def measured_edges(vertices, faces, ends, start, halves, along, first, last, length, cosine):
    """Length of the edges first:last, and the cosine between the normals of the two faces of each that has two, wound alike; else 1."""
    for e in range(first, last):
        a, b = ends[e, 0], ends[e, 1]
        x, y, z = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        length[e - first] = math.sqrt(x * x + y * y + z * z)
        cosine[e - first] = 1.0
        if start[e + 1] - start[e] == 2 and along[e] == 1:
            px, py, pz = _normal(vertices, faces, halves[start[e]] // 3)
            qx, qy, qz = _normal(vertices, faces, halves[start[e] + 1] // 3)
            cosine[e - first] = px * qx + py * qy + pz * qz
