"""Shapes that are solid and yet make trouble: folds, slivers, edges that float32 hardly tells from points."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from rangecheck.arrays import float32_spacing_mm
from rangecheck.solid.findings import Finding, finding
from rangecheck.surface import topology as topo
from rangecheck.surface.surface import Surface

#: edges whose two faces enclose less than this are folded
FOLD_DEG = 10.0
#: faces whose longest side is more than this many times their height are slivers
SLIVER_RATIO = 200.0
#: edges of fewer float32 steps than this are short
SHORT_STEPS = 8


def shape_findings(surface: Surface, *, fold_deg: float = FOLD_DEG, severities: Mapping[str, str] | None = None) -> list[Finding]:
    """Folded edges, slivers and short edges of `surface`, with places."""
    if not len(surface.faces):
        return []
    found: list[Finding] = []
    table = topo.edge_table(surface)
    ends, length = table.ends, np.linalg.norm(surface.vertices[table.ends[:, 1]] - surface.vertices[table.ends[:, 0]], axis=1)
    pair = (table.uses == 2) & (table.along == 1)
    first = table.start[:-1][pair]
    f, g = table.halves[first] // 3, table.halves[first + 1] // 3
    normals = surface.face_normals
    # faces that enclose an angle a have normals that differ by 180 - a degrees
    cosine = np.einsum("ij,ij->i", normals[f], normals[g])
    folded = np.flatnonzero(cosine < -math.cos(math.radians(fold_deg)))
    if len(folded):
        edges = ends[pair][folded]
        message = f"{len(folded)} edges are folded to less than {fold_deg:g} degrees"
        faces = np.unique(np.concatenate([f[folded], g[folded]]))
        found.append(finding("folded-edges", len(folded), message, surface.vertices[edges].mean(axis=1), faces, severities))
    longest = np.zeros(len(surface.faces))
    edge_of_face = table.edge_of_half.reshape(-1, 3)
    whole = (edge_of_face >= 0).all(axis=1)
    longest[whole] = length[edge_of_face[whole]].max(axis=1)
    thin = np.flatnonzero(whole & (longest**2 > SLIVER_RATIO * 2 * surface.face_areas) & (surface.face_areas > 0))
    if len(thin):
        message = f"{len(thin)} faces are more than {SLIVER_RATIO:g} times longer than high"
        found.append(finding("sliver-faces", len(thin), message, surface.triangles[thin].mean(axis=1), thin, severities))
    step = float32_spacing_mm(float(np.abs(surface.bounds_mm).max()))
    short = np.flatnonzero(length < SHORT_STEPS * step)
    if len(short):
        message = f"{len(short)} edges are shorter than {SHORT_STEPS} float32 steps ({SHORT_STEPS * step:.2g} mm), the shortest {length.min():.2g} mm"
        found.append(finding("short-edges", len(short), message, surface.vertices[ends[short]].mean(axis=1), None, severities))
    return found
