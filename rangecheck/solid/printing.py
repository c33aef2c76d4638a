"""Whether a solid prints: fits, stands, has walls, begins nowhere in mid-air, holds no resin; and what it takes.

`up` is the direction away from the build plate. Lengths in mm, areas in mm2, volumes in mm3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import BoolArray, FloatArray, IntArray
from rangecheck.solid.drainage import pockets
from rangecheck.solid.findings import Finding, Verdict, finding, verdict
from rangecheck.solid.printer import Printer
from rangecheck.solid.slices import frame_of, section_areas_mm2
from rangecheck.solid.solid import Solid
from rangecheck.solid.thickness import gap_mm, sample_surface, wall_thickness_mm
from rangecheck.surface import topology as topo
from rangecheck.surface.surface import Surface

UP = (0.0, 1.0, 0.0)


def check_printing(
    solid: Solid, printer: Printer, *, up: npt.ArrayLike = UP, severities: Mapping[str, str] | None = None
) -> Verdict:
    """All that stands against printing `solid` on `printer` as it is oriented, and what it takes."""
    surface = solid.surface
    frame = frame_of(up)
    local = surface.vertices @ frame.T
    found: list[Finding] = []
    facts: dict[str, Any] = {"printer": printer.name, "up": frame[2].tolist(), "volume_mm3": solid.volume_mm3}
    found += _fits(local, printer, facts, severities)
    found += _stands(surface, local, frame, printer, facts, severities)
    found += _walls(surface, local, printer, facts, severities)
    found += _begins(surface, local, frame[2], printer, facts, severities)
    found += _overhangs(surface, local, frame, printer, facts, severities)
    found += _hollows(surface, frame[2], facts, severities)
    low, high = float(local[:, 2].min()), float(local[:, 2].max())
    layers = np.arange(low + printer.layer_mm / 2, high, printer.layer_mm)
    areas = section_areas_mm2(surface, layers, up)
    peak = int(np.argmax(areas))
    mass = solid.volume_mm3 / 1000 * printer.density_g_cm3
    facts |= {
        "layers": len(layers),
        "peak_section_mm2": float(areas[peak]),
        "peak_section_height_mm": float(layers[peak] - low),
        "mass_g": mass,
        "cost": solid.volume_mm3 / 1e6 * printer.price_per_litre if printer.price_per_litre else None,
    }
    return verdict(found, facts)


def _fits(local: FloatArray, printer: Printer, facts: dict[str, Any], severities: Mapping[str, str] | None) -> list[Finding]:
    wide, deep, turn = smallest_footprint(local[:, :2])
    tall = float(np.ptp(local[:, 2]))
    facts |= {"footprint_mm": [wide, deep], "footprint_turn_deg": math.degrees(turn), "height_mm": tall}
    bed = sorted(printer.build_mm[:2], reverse=True)
    if wide <= bed[0] and deep <= bed[1] and tall <= printer.build_mm[2]:
        return []
    scale = min(bed[0] / wide, bed[1] / deep, printer.build_mm[2] / tall)
    x, y, z = printer.build_mm
    message = f"{wide:.1f} x {deep:.1f} x {tall:.1f} mm does not fit {x:g} x {y:g} x {z:g} mm; at {100 * scale:.1f} % of its size it would"
    return [finding("does-not-fit", 1, message, severities=severities, fits_at=scale)]


def smallest_footprint(points: FloatArray) -> tuple[float, float, float]:
    """Longer and shorter side of the smallest-area rectangle around plane points (n, 2), and its turn in radians. One of its sides lies
    along a side of the hull (Freeman and Shapira 1975)."""
    hull = convex_hull(points)
    sides = np.roll(hull, -1, axis=0) - hull
    best = (math.inf, 0.0, 0.0, 0.0)
    for angle in np.unique(np.arctan2(sides[:, 1], sides[:, 0])):
        c, s = math.cos(angle), math.sin(angle)
        a, b = np.ptp(hull @ [c, s]), np.ptp(hull @ [-s, c])
        if a * b < best[0]:
            best = (float(a * b), float(a), float(b), float(angle))
    return max(best[1:3]), min(best[1:3]), best[3]


def convex_hull(points: FloatArray) -> FloatArray:
    """(k, 2) corners of the hull, counter-clockwise (Andrew 1979)."""
    rows = np.unique(points, axis=0)
    if len(rows) < 3:
        return rows

    def half(ordered: FloatArray) -> list[FloatArray]:
        chain: list[FloatArray] = []
        for p in ordered:
            while len(chain) > 1:
                u, v = chain[-1] - chain[-2], p - chain[-1]
                if u[0] * v[1] - u[1] * v[0] > 0:
                    break
                chain.pop()
            chain.append(p)
        return chain[:-1]

    # points well inside the box's diagonals cannot be on the hull: keep the extremes of 64 directions' outer ring
    return np.array(half(_outer(rows)) + half(_outer(rows)[::-1]))


def _outer(rows: FloatArray) -> FloatArray:
    if len(rows) < 1000:
        return rows
    turn = np.arange(64) * np.pi / 32
    extremes = rows[np.unique(np.argmax(rows @ np.stack([np.cos(turn), np.sin(turn)]), axis=0))]
    centre = extremes.mean(axis=0)
    ring = extremes[np.argsort(np.arctan2(*(extremes - centre).T[::-1]))]
    sides = np.roll(ring, -1, axis=0) - ring
    depth = np.min(
        [side[0] * (rows[:, 1] - p[1]) - side[1] * (rows[:, 0] - p[0]) for p, side in zip(ring, sides) if np.any(side)], axis=0
    )
    return rows[depth <= 1e-9 * np.ptp(rows, axis=0).max() ** 2]


def _stands(
    surface: Surface,
    local: FloatArray,
    frame: FloatArray,
    printer: Printer,
    facts: dict[str, Any],
    severities: Mapping[str, str] | None,
) -> list[Finding]:
    low = float(local[:, 2].min())
    down = surface.area_vectors @ -frame[2]
    # flat enough that one layer covers the whole base
    on_plate = (local[:, 2][surface.faces].max(axis=1) <= low + printer.layer_mm) & (down > 0)
    contact = float(down[on_plate].sum())
    centre = centre_of_mass(surface)
    facts |= {"contact_area_mm2": contact, "centre_of_mass_mm": centre.tolist()}
    footprint = smallest_footprint(local[:, :2])
    if contact < 0.01 * footprint[0] * footprint[1]:
        message = f"{contact:.2f} mm2 touch the plate under a footprint of {footprint[0]:.1f} x {footprint[1]:.1f} mm"
        return [
            finding(
                "base-not-flat", 1, message, surface.vertices[[int(np.argmin(local[:, 2]))]], np.flatnonzero(on_plate), severities
            )
        ]
    hull = convex_hull(local[np.unique(surface.faces[on_plate])][:, :2])
    inside, margin = _inside_hull(hull, (frame @ centre)[:2])
    facts["tipping_margin_mm"] = margin if inside else -margin
    if inside:
        return []
    message = f"its centre of mass lies {margin:.1f} mm outside the hull of its base"
    return [finding("does-not-stand", 1, message, centre[None], np.flatnonzero(on_plate), severities)]


def centre_of_mass(surface: Surface) -> FloatArray:
    """(3,) of the enclosed volume, uniform density."""
    middle = surface.vertices.mean(axis=0)
    local = surface.triangles - middle
    six = np.einsum("ij,ij->i", local[:, 0], np.cross(local[:, 1], local[:, 2]))
    return middle + (local.sum(axis=1) / 4 * six[:, None]).sum(axis=0) / six.sum()


def _inside_hull(hull: FloatArray, point: FloatArray) -> tuple[bool, float]:
    """Whether a point lies inside a convex polygon, and how far from its outline."""
    side = np.roll(hull, -1, axis=0) - hull
    length = np.maximum(np.linalg.norm(side, axis=1), 1e-300)
    depth = (side[:, 0] * (point[1] - hull[:, 1]) - side[:, 1] * (point[0] - hull[:, 0])) / length
    along = np.clip(((point - hull) * side).sum(axis=1) / length**2, 0, 1)
    return bool((depth >= 0).all()), float(np.linalg.norm(hull + along[:, None] * side - point, axis=1).min())


def _walls(
    surface: Surface, local: FloatArray, printer: Printer, facts: dict[str, Any], severities: Mapping[str, str] | None
) -> list[Finding]:
    least = printer.least_wall_mm(float(np.ptp(local, axis=0).sum()))
    samples = sample_surface(surface, max(surface.extent_mm / 100, least))
    wall = wall_thickness_mm(surface, samples, edge_mm=printer.feature_mm)
    thin = wall < least * (1 - 1e-6)
    finite = np.isfinite(wall)
    facts |= {"least_wall_allowed_mm": least, "least_wall_mm": float(wall[finite].min()) if finite.any() else None}
    found = []
    if thin.any():
        area = float(samples.area_mm2[thin].sum())
        message = f"{area:.1f} mm2 of wall are thinner than {least:g} mm, the thinnest {float(wall[thin].min()):.3f} mm"
        worst = np.argsort(wall[thin], kind="stable")
        found.append(
            finding(
                "thin-walls",
                int(thin.sum()),
                message,
                samples.places_mm[thin][worst],
                np.unique(samples.face[thin]),
                severities,
                area_mm2=area,
                least_mm=float(wall[thin].min()),
            )
        )
    gap = gap_mm(surface, samples, edge_mm=printer.feature_mm)
    near = gap < printer.pixel_mm
    if near.any():
        message = (
            f"{float(samples.area_mm2[near].sum()):.1f} mm2 face another side across less than a pixel of {printer.pixel_mm:g} mm"
        )
        found.append(
            finding("near-sheets", int(near.sum()), message, samples.places_mm[near], np.unique(samples.face[near]), severities)
        )
    return found


def minima(surface: Surface, heights: FloatArray) -> tuple[IntArray, IntArray]:
    """Lowest vertices of places that begin in mid-air, and of hollows' bottoms: groups of equally high vertices with no lower neighbour,
    told apart by whether the material is above or below them."""
    ends = topo.edge_table(surface).ends
    level = np.round(heights / (1e-7 * max(surface.extent_mm, 1e-300))).astype(np.int64)
    even = ends[level[ends[:, 0]] == level[ends[:, 1]]]
    group = _groups(len(heights), even)
    has_lower = np.zeros(len(heights), bool)
    lower_second = level[ends[:, 1]] < level[ends[:, 0]]
    has_lower[group[np.where(lower_second, ends[:, 0], ends[:, 1])[level[ends[:, 0]] != level[ends[:, 1]]]]] = True
    used = np.zeros(len(heights), bool)
    used[surface.faces.ravel()] = True
    lowest = np.flatnonzero((group == np.arange(len(heights))) & ~has_lower & used)
    return lowest, group


def _groups(count: int, edges: IntArray) -> IntArray:
    """(count,) lowest member of the connected group of each vertex."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    number, label = connected_components(
        coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count)), False
    )
    first = np.full(number, count)
    np.minimum.at(first, label, np.arange(count))
    return first[label]


def _begins(
    surface: Surface,
    local: FloatArray,
    up: FloatArray,
    printer: Printer,
    facts: dict[str, Any],
    severities: Mapping[str, str] | None,
) -> list[Finding]:
    heights = local[:, 2]
    lowest, group = minima(surface, heights)
    # the material is above a minimum where the faces around it look down
    down = np.bincount(group[surface.faces].ravel(), np.repeat(surface.area_vectors @ -up, 3), minlength=len(heights))
    alone = np.bincount(group, minlength=len(heights)) == 1
    down = np.where(alone, round_above(surface, local, alone), down)
    begins = lowest[(down[lowest] > 0) & (heights[lowest] > heights.min() + printer.layer_mm)]
    facts["unsupported_minima"] = len(begins)
    if not len(begins):
        return []
    order = np.argsort(heights[begins], kind="stable")
    return [
        finding(
            "unsupported-minima",
            len(begins),
            f"{len(begins)} places begin in mid-air",
            surface.vertices[begins[order]],
            None,
            severities,
        )
    ]


def round_above(surface: Surface, local: FloatArray, wanted: BoolArray) -> FloatArray:
    """(n,) for each vertex of `wanted` without a neighbour as low, the area of the section just above it through the faces around it, as a share
    of the height squared: positive where the material is within, negative where the air is. Walls that hang over do not mislead it."""
    total = np.zeros(len(local))
    for corner in range(3):
        v, a, b = (surface.faces[:, (corner + k) % 3] for k in range(3))
        mine = np.flatnonzero(wanted[v] & (local[a, 2] > local[v, 2]) & (local[b, 2] > local[v, 2]))
        v, a, b = v[mine], a[mine], b[mine]
        p = (local[a, :2] - local[v, :2]) / (local[a, 2] - local[v, 2])[:, None]
        q = (local[b, :2] - local[v, :2]) / (local[b, 2] - local[v, 2])[:, None]
        total += np.bincount(v, 0.5 * (p[:, 1] * q[:, 0] - p[:, 0] * q[:, 1]), minlength=len(local))
    return total


def _overhangs(
    surface: Surface,
    local: FloatArray,
    frame: FloatArray,
    printer: Printer,
    facts: dict[str, Any],
    severities: Mapping[str, str] | None,
) -> list[Finding]:
    down = np.nan_to_num(surface.face_normals) @ -frame[2]
    on_plate = local[:, 2][surface.faces].max(axis=1) <= local[:, 2].min() + printer.layer_mm
    # a face tilted t from the horizontal has a downward component of cos t
    over = (down > math.cos(math.radians(printer.overhang_deg)) * (1 + 1e-9)) & ~on_plate
    area = float(surface.face_areas[over].sum())
    facts["overhang_area_mm2"] = area
    if not over.any():
        return []
    faces = np.flatnonzero(over)
    order = np.argsort(-surface.face_areas[faces], kind="stable")
    message = f"{area:.1f} mm2 hang over by more than {90 - printer.overhang_deg:g} degrees from the vertical"
    return [
        finding("overhangs", len(faces), message, surface.triangles[faces[order]].mean(axis=1), faces, severities, area_mm2=area)
    ]


def _hollows(surface: Surface, up: FloatArray, facts: dict[str, Any], severities: Mapping[str, str] | None) -> list[Finding]:
    held = pockets(surface, up)
    found = []
    cups = [p for p in held if not p.closed]
    closed = _cavities(surface)
    trapped = sum(v for v, _ in closed)
    facts |= {"held_mm3": sum(p.volume_mm3 for p in cups), "trapped_mm3": trapped}
    if closed:
        message = f"{len(closed)} closed cavities hold {trapped:.1f} mm3 for ever"
        found.append(finding("trapped-volume", len(closed), message, np.array([p for _, p in closed]), None, severities))
    if cups:
        message = f"{len(cups)} hollows hold {sum(p.volume_mm3 for p in cups):.1f} mm3 when set down like this, the largest {cups[0].volume_mm3:.1f} mm3"
        found.append(
            finding(
                "cups",
                len(cups),
                message,
                np.array([p.lowest_mm for p in cups]),
                None,
                severities,
                volumes_mm3=[round(p.volume_mm3, 3) for p in cups[:200]],
            )
        )
    return found


def _cavities(surface: Surface) -> list[tuple[float, FloatArray]]:
    """Volume and middle of each closed cavity: the shells that face inwards, without the bodies that lie in them."""
    from rangecheck.solid.containment import shell_depths, shell_volumes_mm3, winding_numbers

    count, shell = topo.shells(surface)
    volumes = shell_volumes_mm3(surface, count, shell)
    depth = shell_depths(surface, count, shell) if (volumes < 0).any() else np.zeros(count, np.int64)
    bodies = [i for i in np.flatnonzero(volumes > 0) if depth[i] > 0]
    found = []
    for i in np.flatnonzero(volumes < 0):
        cavity = surface.with_faces(shell == i)
        inside = [j for j in bodies if depth[j] == depth[i] + 1]
        places = surface.triangles[[int(np.argmax(shell == j)) for j in inside], 0] if inside else np.empty((0, 3))
        held = np.abs(winding_numbers(cavity, places)) > 0.5
        room = -float(volumes[i]) - sum(float(volumes[j]) for j, here in zip(inside, held) if here)
        found.append((room, cavity.triangles.reshape(-1, 3).mean(axis=0)))
    return found
