"""One function per kind of defect: each looks at a surface and returns findings with places, or none."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray, IntArray
from rangecheck.solid.containment import shell_depths, shell_sizes
from rangecheck.solid.findings import Finding, finding
from rangecheck.surface import intersections as meet
from rangecheck.surface import topology as topo
from rangecheck.surface.surface import Surface

Severities = Mapping[str, str] | None
#: shells below this share of the largest shell's volume (closed) or area are noise
NOISE_SHARE = 0.01


def _middles(surface: Surface, faces: IntArray) -> FloatArray:
    return surface.vertices[surface.faces[faces]].mean(axis=1)


def _edge_middles(surface: Surface, edges: IntArray) -> FloatArray:
    return surface.vertices[edges].mean(axis=1)


def _faces_with(surface: Surface, vertices: IntArray) -> IntArray:
    mark = np.zeros(len(surface.vertices), bool)
    mark[vertices.ravel()] = True
    return np.flatnonzero(mark[surface.faces].any(axis=1))


def rims(surface: Surface, severities: Severities = None) -> list[Finding]:
    """Open edges, by loop with length and size."""
    edges = topo.boundary_edges(surface)
    if not len(edges):
        return []
    loops = topo.boundary_loops(surface)
    lengths = topo.loop_lengths_mm(surface, loops)
    spans = [np.ptp(surface.vertices[r], axis=0) for r in loops]
    longest = int(np.argmax(lengths))
    return [
        finding(
            "open-edges",
            len(edges),
            f"surface is open: {len(edges)} boundary edges in {len(loops)} loops, the longest {lengths[longest]:.1f} mm",
            np.array([surface.vertices[r].mean(axis=0) for r in loops]),
            topo.faces_at_edges(surface, topo.edge_table(surface).uses == 1),
            severities,
            loops=[
                {"edges": len(r), "length_mm": round(float(n), 4), "size_mm": [round(float(x), 4) for x in s]}
                for r, n, s in list(zip(loops, lengths, spans))[:200]
            ],
        )
    ]


def manifoldness(surface: Surface, severities: Severities = None) -> list[Finding]:
    """Edges with more than two faces, vertices with more than one fan, neighbours wound against each other."""
    found = []
    table = topo.edge_table(surface)
    edges = topo.non_manifold_edges(surface)
    if len(edges):
        message = f"{len(edges)} edges have more than two faces, up to {int(table.uses.max())}"
        found.append(
            finding(
                "non-manifold-edges",
                len(edges),
                message,
                _edge_middles(surface, edges),
                topo.faces_at_edges(surface, table.uses > 2),
                severities,
            )
        )
    vertices = topo.non_manifold_vertices(surface)
    if len(vertices):
        message = f"{len(vertices)} vertices join sheets in a point only"
        found.append(
            finding(
                "non-manifold-vertices",
                len(vertices),
                message,
                surface.vertices[vertices],
                _faces_with(surface, vertices),
                severities,
            )
        )
    turned = (table.uses == 2) & (table.along != 1)
    if turned.any():
        message = f"{int(turned.sum())} edges lie between faces that face opposite ways"
        found.append(
            finding(
                "inconsistent-winding",
                int(turned.sum()),
                message,
                _edge_middles(surface, table.ends[turned]),
                topo.faces_at_edges(surface, turned),
                severities,
            )
        )
    return found


def idle_parts(surface: Surface, severities: Severities = None) -> list[Finding]:
    """Faces laid twice or without area, vertices without faces."""
    found = []
    for code, culprits, words in (
        ("duplicate-faces", topo.duplicate_faces(surface), "faces lie where another face with the same corners lies"),
        ("degenerate-faces", topo.degenerate_faces(surface), "faces have no area"),
    ):
        if len(culprits):
            found.append(
                finding(code, len(culprits), f"{len(culprits)} {words}", _middles(surface, culprits), culprits, severities)
            )
    idle = topo.unreferenced_vertices(surface)
    if len(idle):
        message = f"{len(idle)} vertices belong to no face"
        found.append(finding("unreferenced-vertices", len(idle), message, surface.vertices[idle], None, severities))
    return found


def bodies(surface: Surface, closed: bool, severities: Severities = None) -> tuple[list[Finding], dict[str, Any]]:
    """Shells and, where all are closed, their roles: body, cavity, inside-out, nested; crumbs of noise. With facts about them."""
    count, shell = topo.shells(surface)
    euler = topo.euler_numbers(surface)
    facts: dict[str, Any] = {"shells": count, "euler_number": int(euler.sum()), "area_mm2": 0.0}
    found: list[Finding] = []
    if not count:
        return found, facts
    areas, volumes = shell_sizes(surface.vertices, surface.faces, shell, count)
    facts["area_mm2"] = float(areas.sum())
    if not closed:
        return _crumbs(surface, shell, areas, "area", severities), facts
    facts["volume_mm3"] = float(volumes.sum())
    depth = shell_depths(surface, count, shell)
    outside_in = (depth % 2 == 0) & (volumes < 0)
    nested = (depth % 2 == 1) & (volumes > 0)
    facts["genus"] = int((2 * count - euler.sum()) // 2)
    facts["shell_roles"] = [
        {
            "role": "inside-out" if o else "nested body" if n else "body" if d % 2 == 0 else "cavity",
            "volume_mm3": round(float(v), 6),
            "area_mm2": round(float(a), 6),
            "genus": int((2 - e) // 2),
        }
        for o, n, d, v, a, e in list(zip(outside_in, nested, depth, volumes, areas, euler))[:200]
    ]
    for code, culprits, words in (
        ("inside-out", outside_in, "shells face inwards"),
        ("nested-shells", nested, "bodies lie wholly inside another body"),
    ):
        if culprits.any():
            faces = np.flatnonzero(culprits[shell])
            first = np.flatnonzero(culprits)
            message = f"{int(culprits.sum())} of {count} {words}, {float(volumes[culprits].sum()):.6g} mm3"
            found.append(finding(code, int(culprits.sum()), message, _shell_middles(surface, shell, first), faces, severities))
    solid_bodies = int(((depth % 2 == 0) & ~outside_in).sum())
    if solid_bodies > 1:
        middles = _shell_middles(surface, shell, np.flatnonzero(depth % 2 == 0))
        found.append(finding("several-bodies", solid_bodies, f"{solid_bodies} separate bodies", middles, None, severities))
    found.extend(_crumbs(surface, shell, np.abs(volumes), "volume", severities))
    return found, facts


def _crumbs(surface: Surface, shell: IntArray, sizes: FloatArray, what: str, severities: Severities) -> list[Finding]:
    small = sizes < NOISE_SHARE * sizes.max()
    if not small.any():
        return []
    message = f"{int(small.sum())} of {len(sizes)} shells have less than {100 * NOISE_SHARE:.0f} % of the largest one's {what}"
    middles = _shell_middles(surface, shell, np.flatnonzero(small))
    return [finding("noise-shells", int(small.sum()), message, middles, np.flatnonzero(small[shell]), severities)]


def _shell_middles(surface: Surface, shell: IntArray, wanted: IntArray) -> FloatArray:
    """(k, 3) middle of the box around each wanted shell, at most 200."""
    wanted = wanted[:200]
    number = np.full(int(shell.max()) + 1, -1)
    number[wanted] = np.arange(len(wanted))
    mine = np.flatnonzero(number[shell] >= 0)
    low, high = np.full((len(wanted), 3), np.inf), np.full((len(wanted), 3), -np.inf)
    corners, at = surface.vertices[surface.faces[mine]].reshape(-1, 3), np.repeat(number[shell[mine]], 3)
    np.minimum.at(low, at, corners)
    np.maximum.at(high, at, corners)
    return 0.5 * (low + high)


def meetings(surface: Surface, severities: Severities = None) -> list[Finding]:
    """Faces that cross, overlap or touch."""
    met = meet.self_intersections(surface)
    found = []
    for code, kind, words in (
        ("self-intersections", meet.CROSSING, "run through each other"),
        ("overlapping-faces", meet.OVERLAP, "overlap in one plane"),
        ("touching-faces", meet.TOUCHING, "touch without sharing an edge"),
    ):
        pairs = met.of_kind(kind)
        if len(pairs):
            faces = np.unique(pairs)
            message = f"{len(pairs)} pairs of faces ({len(faces)} faces) {words}"
            found.append(
                finding(code, len(pairs), message, _middles(surface, pairs[:, 0]), faces, severities, faces_involved=len(faces))
            )
    return found
