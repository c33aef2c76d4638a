"""Holes filled: a ring of open edges gets a patch as fine as its rim, bent like a thin plate so that slopes continue across it.

A ring that lies in a plane (a bust sawn off at its base) gets a flat patch; so does one whose plate would swing wider than the hole.
Every face of a patch is invented and of part "filled". No vertex outside a patch moves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray, IntArray
from rangecheck.solid.engine import triangulate
from rangecheck.surface import topology as topo
from rangecheck.surface.intersections import CROSSING, OVERLAP, self_intersections
from rangecheck.surface.patches import refined, smooth_values
from rangecheck.surface.surface import INVENTED, Surface

#: a ring departing from its plane by less than this share of its size is flat
FLAT_SHARE = 0.01
#: rings of faces around a hole that tell the plate its slope
RINGS = 2


class Filled(NamedTuple):
    """surface with patches; holes filled, holes left open with the reason, and the area of the patches in mm2."""

    surface: Surface
    filled: int
    left: list[str]
    area_mm2: float


def fill_holes(surface: Surface, *, longest_mm: float | None = None) -> Filled:
    """`surface` with all holes filled whose rim is at most `longest_mm` long (None: all) and whose patch runs through nothing.

    A patch that would run through the surface or through another is tried again as a membrane, then left out."""
    loops = topo.boundary_loops(surface)
    lengths = topo.loop_lengths_mm(surface, loops)
    left: list[str] = []
    patches: list[tuple[IntArray, FloatArray, IntArray]] = []
    known = _edge_keys(topo.edge_table(surface).ends)
    faces_known = {
        tuple(sorted(f)) for f in surface.faces[topo.faces_at_edges(surface, topo.edge_table(surface).uses == 1)].tolist()
    }
    broken = 0
    for ring, length in zip(loops, lengths):
        if longest_mm is not None and length > longest_mm:
            left.append(f"a rim of {length:.1f} mm is longer than {longest_mm:g} mm")
            continue
        if len(ring) < 3 or tuple(sorted(ring.tolist())) in faces_known:
            broken += 1
            continue
        made = _patch(surface, ring[::-1], known)
        if made is None:
            left.append(f"a rim of {len(ring)} edges, {length:.2f} mm long, has no patch that does not cross itself")
            continue
        patches.append((ring[::-1], *made))
        index = _index(ring[::-1], made[0], len(surface.vertices))
        known |= _edge_keys(np.sort(index[made[1]][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1))
    if broken:
        left.append(f"{broken} rims are the outline of a single face or end at edges with more than two faces")
    shapes = [_bent(surface, ring, points, faces, plate=True) for ring, points, faces in patches]
    for attempt in range(4):
        result, of_patch, area = _with_patches(surface, patches, shapes)
        culprits = _crossing_patches(result, of_patch)
        if not len(culprits):
            break
        if attempt == 0:
            for k in culprits:
                shapes[k] = _bent(surface, *patches[k], plate=False)
            continue
        for k in sorted(culprits, reverse=True):
            ring, _, _ = patches[k]
            left.append(f"a patch over {len(ring)} edges would run through the surface")
            del patches[k], shapes[k]
    else:
        return Filled(surface, 0, [*left, "the patches run through each other"], 0.0)
    return Filled(result, len(patches), left, area)


def _index(ring: IntArray, points: FloatArray, first: int) -> IntArray:
    """Numbers of a patch's points in the whole surface, when its inner ones begin at `first`."""
    return np.concatenate([ring, np.arange(first, first + len(points) - len(ring))])


def _with_patches(
    surface: Surface, patches: list[tuple[IntArray, FloatArray, IntArray]], shapes: list[FloatArray]
) -> tuple[Surface, IntArray, float]:
    """The surface with all patches, the patch of each face (-1: none), and the area of the patches."""
    if not patches:
        return surface, np.full(len(surface.faces), -1), 0.0
    vertices, new, number = [surface.vertices], [], []
    count, area = len(surface.vertices), 0.0
    for k, ((ring, _, faces), points) in enumerate(zip(patches, shapes)):
        new.append(_index(ring, points, count)[faces])
        number.append(np.full(len(faces), k))
        vertices.append(points[len(ring) :])
        count += len(points) - len(ring)
        a, b, c = (points[faces[:, corner]] for corner in range(3))
        area += 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    faces = np.concatenate(new)
    names = surface.part_names if "filled" in surface.part_names else (*surface.part_names, "filled")
    part = np.concatenate([surface.part_of_face, np.full(len(faces), names.index("filled"))])
    origin = np.concatenate([surface.origin_of_face, np.full(len(faces), INVENTED)])
    error = surface.vertex_error_mm
    if error is not None:
        error = np.concatenate([error, np.full(count - len(error), np.nan)])
    result = Surface(np.concatenate(vertices), np.concatenate([surface.faces, faces]), part, origin, names, error)
    return result, np.concatenate([np.full(len(surface.faces), -1), *number]), area


def _crossing_patches(surface: Surface, of_patch: IntArray) -> list[int]:
    """Patches that run through something; of two that run through each other, the larger."""
    if not (of_patch >= 0).any():
        return []
    pairs = of_patch[self_intersections(surface).of_kind(CROSSING, OVERLAP)]
    sizes = np.bincount(of_patch[of_patch >= 0])
    found: set[int] = set()
    for i, j in pairs[(pairs >= 0).any(axis=1)].tolist():
        found.add(max(i, j) if min(i, j) < 0 else i if sizes[i] >= sizes[j] else j)
    return sorted(found)


def _edge_keys(ends: IntArray) -> set[int]:
    return set((ends[:, 0].astype(np.int64) << 32 | ends[:, 1]).tolist())


def _patch(surface: Surface, ring: IntArray, known: set[int]) -> tuple[FloatArray, IntArray] | None:
    """Points (ring first) and faces of a patch along `ring`, which runs the way the patch's faces do. None where it cannot be."""
    rim = surface.vertices[ring]
    centre = rim.mean(axis=0)
    following = np.roll(rim, -1, axis=0)
    normal = np.cross(rim - centre, following - centre).sum(axis=0)
    length = float(np.linalg.norm(normal))
    if len(ring) < 3 or length == 0.0:
        return None
    normal /= length
    flat = (rim - centre) @ np.stack(rigid.across(normal), axis=1)
    faces = triangulate([flat]) if not _crosses_itself(flat) else least_area_triangles(rim)
    if faces is None or not len(faces):
        return None
    points, fine = refined(rim, faces)
    if not _is_new(ring, fine, known):
        # one middle point leaves no edge between two rim vertices
        points = np.concatenate([rim, centre[None]])
        n = len(ring)
        fine = np.stack([np.arange(n), (np.arange(n) + 1) % n, np.full(n, n)], axis=1).astype(np.int32)
    return points, fine


def _is_new(ring: IntArray, faces: IntArray, known: set[int]) -> bool:
    """Whether no inner edge of the patch joins two rim vertices that the surface joins already."""
    n = len(ring)
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    inner = ends[(ends < n).all(axis=1)]
    inner = inner[((inner[:, 1] - inner[:, 0]) % n != 1) & ((inner[:, 0] - inner[:, 1]) % n != 1)]
    return not (_edge_keys(np.sort(ring[inner].reshape(-1, 2), axis=1)) & known)


def _bent(surface: Surface, ring: IntArray, points: FloatArray, faces: IntArray, *, plate: bool) -> FloatArray:
    """The patch's inner points moved to where a membrane, and then a plate joined to the faces around, has them."""
    n = len(ring)
    if len(points) == n:
        return points
    rim = points[:n]
    size = float(np.ptp(rim, axis=0).max())
    spread = np.linalg.svd(rim - rim.mean(axis=0), compute_uv=False)
    plate = plate and spread[2] / np.sqrt(n) > FLAT_SHARE * size
    mark = np.zeros(len(surface.vertices), bool)
    mark[ring] = True
    for _ in range(RINGS):
        near = mark[surface.faces].any(axis=1)
        mark[surface.faces[near].ravel()] = True
    around = surface.faces[near]
    others = np.setdiff1d(np.unique(around), ring)
    place = np.full(len(surface.vertices), -1)
    place[ring], place[others] = np.arange(n), np.arange(len(points), len(points) + len(others))
    everything = np.concatenate([points, surface.vertices[others]])
    mesh = np.concatenate([faces, place[around]])
    free = np.zeros(len(everything), bool)
    free[n : len(points)] = True
    flat = smooth_values(everything, everything, free, mesh, plate=False)
    if not plate:
        return flat[: len(points)]
    bent = flat
    for _ in range(2):
        bent = smooth_values(bent, bent, free, mesh, plate=True)
    swing = np.linalg.norm(bent - flat, axis=1).max()
    return (bent if swing < size / 2 else flat)[: len(points)]


def _crosses_itself(polygon: FloatArray) -> bool:
    """Whether any two sides of a plane polygon (n, 2) that are not neighbours meet."""
    n = len(polygon)
    if n <= 3:
        return False
    if n > 4000:
        return True
    p, q = polygon, np.roll(polygon, -1, axis=0)

    def side(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
        return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])

    one, two = side(p[:, None], q[:, None], p[None]), side(p[:, None], q[:, None], q[None])
    apart = one * two > 0
    meets = ~apart & ~apart.T
    i = np.arange(n)
    for shift in (-1, 0, 1):
        meets[i, (i + shift) % n] = False
    return bool(meets.any())


def least_area_triangles(rim: FloatArray, most: int = 160) -> IntArray | None:
    """Triangles over a closed ring of points in space with the least total area (Barequet and Sharir 1995); cost n^3."""
    n = len(rim)
    if n > most:
        return None
    cost, cut = np.zeros((n, n)), np.zeros((n, n), np.int64)
    for width in range(2, n):
        for i in range(n - width):
            k = i + width
            j = np.arange(i + 1, k)
            area = 0.5 * np.linalg.norm(np.cross(rim[j] - rim[i], rim[k] - rim[i]), axis=1)
            total = cost[i, j] + cost[j, k] + area
            best = int(np.argmin(total))
            cost[i, k], cut[i, k] = total[best], i + 1 + best
    faces, waiting = [], [(0, n - 1)]
    while waiting:
        first, last = waiting.pop()
        if last - first < 2:
            continue
        middle = int(cut[first, last])
        faces.append((first, middle, last))
        waiting += [(first, middle), (middle, last)]
    return np.array(faces, np.int64)
