"""What scans have seen of the space around an object, what they have not, and from where the rest could be seen.

Space is cut into cubic cells. A cell is measured where a reading falls into it or close behind its wall, empty where some scan looked
through it, unknown otherwise. A region without readings that reaches the picture's edge is taken for background, but it may also be
shadow or a rim too oblique to measure: it empties a cell only if more scans see background there than see it behind the surface.
Where unknown touches empty is the frontier: a surface that must be there, or something behind it, and that nobody has seen
(Connolly, *The determination of next best views*, 1985).

World frame, millimetres. A direction is a unit vector from the object to the viewer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from rangecheck.kernels import in_chunks, kernel
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.registration.samples import Samples

UNKNOWN, EMPTY, MEASURED = 0, 1, 2
#: what a scan can say of a cell: before a reading, or at one
_BEFORE, _AT = 1, 2
#: cells of margin around the readings
_MARGIN = 3
#: a surface seen more obliquely than this adds nothing
_OBLIQUE_DEG = 70.0


@dataclass(frozen=True, eq=False)
class Space:
    """Cells around the object.

    state     (nx, ny, nz) uint8 UNKNOWN, EMPTY or MEASURED
    corner_mm world position of the first cell's outer corner
    cell_mm   edge of a cell
    """

    state: IntArray = field(repr=False)
    corner_mm: FloatArray
    cell_mm: float

    def centres_mm(self, index: IntArray) -> FloatArray:
        """World positions (n, 3) of the middles of cells (n, 3)."""
        return self.corner_mm + (index + 0.5) * self.cell_mm


@dataclass(frozen=True, eq=False)
class Shell:
    """Cells that face empty space: what has been measured of the surface, and the frontier.

    index     (n, 3) cells
    area_mm2  (n,) area of each
    normal    (n, 3) unit, towards the empty space
    measured  (n,) True: measured; False: frontier
    """

    index: IntArray = field(repr=False)
    area_mm2: FloatArray = field(repr=False)
    normal: FloatArray = field(repr=False)
    measured: BoolArray = field(repr=False)


@dataclass(frozen=True)
class Gap:
    """One connected piece of the surface that no scan has seen.

    area_mm2   of the frontier, which spans the hole rather than following what lies behind
    centre_mm  its middle, world
    reachable  share of it that can be seen from somewhere allowed
    """

    area_mm2: float
    centre_mm: tuple[float, float, float]
    reachable: float


@dataclass(frozen=True)
class NextView:
    """The direction from which another scan would add most.

    direction  unit vector from the object to the viewer, world
    azimuth_deg, elevation_deg  the same, azimuth 0 along world z towards x about `up`
    gain_mm2   unseen area it would see, weighted by the cosine it is seen under
    overlap    share of what it sees that is measured already, by which the scan could be aligned
    reason     in words
    """

    direction: tuple[float, float, float]
    azimuth_deg: float
    elevation_deg: float
    gain_mm2: float
    overlap: float
    reason: str


def carve(scans: Sequence[RangeScan], samples: Sequence[Samples], cells: int) -> Space:
    """Cells along the longest side of the readings' box: about `cells`, fewer if the samples are too far apart for that."""
    points = [rigid.move_points(s.world_from_scan, m.points_mm[m.usable]) for s, m in zip(scans, samples)]
    low, high = np.min([p.min(axis=0) for p in points], axis=0), np.max([p.max(axis=0) for p in points], axis=0)
    cell = max(float((high - low).max()) / cells, 1.5 * float(np.median([m.spacing_mm for m in samples])))
    shape = np.ceil((high - low) / cell).astype(int) + 2 * _MARGIN
    corner = 0.5 * (low + high) - 0.5 * cell * shape
    evidence, background = np.zeros(int(np.prod(shape)), np.uint8), np.zeros(int(np.prod(shape)), np.int32)
    index = np.stack(np.unravel_index(np.arange(evidence.size), tuple(shape)), axis=1)
    for scan, sample in zip(scans, samples):
        if sample.projects:
            looks = _looks_through(scan, sample)

            def work(first: int, last: int, scan=scan, sample=sample, looks=looks) -> None:
                centres = corner + (index[first:last] + 0.5) * cell
                there = rigid.move_points(rigid.inverse(scan.world_from_scan), centres)
                pixel, ranges = scan.camera.project(there)
                _carve(pixel / sample.stride, ranges, *looks, cell, evidence[first:last], background[first:last])

            in_chunks(work, len(index), 1 << 16)
    empty = (evidence & _BEFORE > 0) | (background > 0)
    state = np.where(empty, EMPTY, np.where(evidence & _AT > 0, MEASURED, UNKNOWN)).astype(np.uint8).reshape(tuple(shape))
    for p in points:
        place = ((p - corner) / cell).astype(int)
        state[place[:, 0], place[:, 1], place[:, 2]] = MEASURED
    _drop_loose(state)
    return Space(state, corner, cell)


def _drop_loose(state: IntArray) -> None:
    """Empty the unknown pieces that touch nothing measured: they hang in the air where few scans look."""
    from scipy import ndimage

    near = np.ones((3, 3, 3))
    pieces, count = ndimage.label(state == UNKNOWN, structure=near)
    touched = np.unique(pieces[ndimage.binary_dilation(state == MEASURED, structure=near)])
    loose = np.setdiff1d(np.arange(1, count + 1), touched)
    state[np.isin(pieces, loose)] = EMPTY


def _looks_through(scan: RangeScan, sample: Samples) -> tuple[FloatArray, FloatArray]:
    """(h, w) how far each ray of the thinned grid went: its reading, inf over background, NaN where it is not known; and the least of
    that among its 3 x 3 neighbours, because between two rays that meet an oblique surface it lies anywhere between their readings."""
    from scipy import ndimage

    ranges = np.array(sample.range_mm, dtype=np.float64)
    # a cell without a reading beside background may be a lost reading of the rim: background starts one cell further out
    background = ndimage.binary_erosion(np.isnan(ranges), border_value=1)
    regions, _ = ndimage.label(background)
    rim = np.unique(np.concatenate([regions[0], regions[-1], regions[:, 0], regions[:, -1]]))
    ranges[np.isin(regions, rim[rim > 0])] = np.inf
    least = ndimage.minimum_filter(np.where(np.isnan(ranges), np.inf, ranges), 3, mode="nearest")
    return ranges, np.where(np.isnan(ranges), np.nan, least)


@kernel
def _carve(pixel, ranges, looks, least, cell, evidence, background):
    """What one scan says about each cell, added to what others said; `background` counts scans for it and against."""
    h, w = looks.shape
    for i in range(len(evidence)):
        if not (pixel[i, 0] > -0.5 and pixel[i, 1] > -0.5 and pixel[i, 0] < w - 0.5 and pixel[i, 1] < h - 0.5):
            continue
        row, column = math.floor(pixel[i, 1] + 0.5), math.floor(pixel[i, 0] + 0.5)
        reading = looks[row, column]
        if reading == np.inf:
            if least[row, column] == np.inf or ranges[i] < least[row, column] - cell:
                background[i] += 1
        elif ranges[i] < least[row, column] - cell:
            evidence[i] |= _BEFORE
        elif ranges[i] > reading + 1.5 * cell:
            background[i] -= 1
        elif ranges[i] == ranges[i] and reading == reading:
            evidence[i] |= _AT
            background[i] -= 1


def shell_of(space: Space) -> Shell:
    """Cells with empty neighbours. A cell's area is the length of the sum of its open faces, which is exact for a plane at any slant."""
    state = space.state
    empty = np.pad(state == EMPTY, 1)
    normal = np.zeros((*state.shape, 3))
    middle = (slice(1, -1),) * 3
    for axis in range(3):
        before, after = list(middle), list(middle)
        before[axis], after[axis] = slice(0, -2), slice(2, None)
        normal[..., axis] = empty[tuple(after)].astype(float) - empty[tuple(before)]
    length = np.sqrt((normal**2).sum(axis=-1))
    on = (state != EMPTY) & (length > 0)
    index = np.argwhere(on)
    return Shell(index, length[on] * space.cell_mm**2, normal[on] / length[on][:, None], state[on] == MEASURED)


def directions(count: int) -> FloatArray:
    """(count, 3) unit vectors spread evenly over the sphere (Fibonacci's spiral)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    azimuth = math.pi * (1 + math.sqrt(5)) * k
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(azimuth), z, ring * np.sin(azimuth)], axis=1)


def views_from(space: Space, shell: Shell, candidates: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Of each candidate direction (k, 3): frontier area and measured area (k,) in mm^2 that it sees, weighted by cosine, and
    (n,) which cells of the shell any of them sees."""
    positions = np.ascontiguousarray((shell.index - 0.5 * np.array(space.state.shape)) * space.cell_mm)
    gain, known = np.zeros(len(candidates)), np.zeros(len(candidates))
    limit = math.cos(math.radians(_OBLIQUE_DEG))

    def work(first: int, last: int) -> BoolArray:
        seen = np.zeros(len(positions), np.bool_)
        for k in range(first, last):
            across = np.linalg.svd(candidates[k][None])[2][1:]
            _see(
                positions,
                shell.normal,
                shell.area_mm2,
                shell.measured,
                candidates[k],
                across,
                space.cell_mm,
                limit,
                k,
                gain,
                known,
                seen,
            )
        return seen

    seen = in_chunks(work, len(candidates), 16)
    return gain, known, np.any(seen, axis=0) if seen else np.zeros(len(positions), np.bool_)


@kernel
def _see(positions, normals, areas, measured, direction, across, cell, limit, k, gain, known, seen):
    """Parallel projection along one direction: in each square the cell nearest to the viewer hides the others."""
    pitch = 1.25 * cell
    reach = 0.0
    for i in range(len(positions)):
        for axis in range(3):
            reach = max(reach, abs(positions[i, axis]))
    size = int(2 * 1.74 * reach / pitch) + 4
    front = np.full((size, size), -np.inf)
    for i in range(len(positions)):
        u, v, d = 0.0, 0.0, 0.0
        for axis in range(3):
            u += positions[i, axis] * across[0, axis]
            v += positions[i, axis] * across[1, axis]
            d += positions[i, axis] * direction[axis]
        p, q = int(u / pitch + 0.5 * size), int(v / pitch + 0.5 * size)
        front[p, q] = max(front[p, q], d)
    for i in range(len(positions)):
        u, v, d, facing = 0.0, 0.0, 0.0, 0.0
        for axis in range(3):
            u += positions[i, axis] * across[0, axis]
            v += positions[i, axis] * across[1, axis]
            d += positions[i, axis] * direction[axis]
            facing += normals[i, axis] * direction[axis]
        p, q = int(u / pitch + 0.5 * size), int(v / pitch + 0.5 * size)
        if facing < limit or d < front[p, q] - 1.75 * cell:
            continue
        seen[i] = True
        if measured[i]:
            known[k] += areas[i] * facing
        else:
            gain[k] += areas[i] * facing


def gaps_of(space: Space, shell: Shell, reachable: BoolArray) -> list[Gap]:
    """Connected pieces of the frontier, the largest first."""
    from scipy import ndimage

    frontier = ~shell.measured
    grid = np.zeros(space.state.shape, np.bool_)
    index = shell.index[frontier]
    grid[index[:, 0], index[:, 1], index[:, 2]] = True
    pieces, count = ndimage.label(grid, structure=np.ones((3, 3, 3)))
    piece = pieces[index[:, 0], index[:, 1], index[:, 2]] - 1
    area = shell.area_mm2[frontier]
    total = np.bincount(piece, area, count)
    reach = np.bincount(piece, area * reachable[frontier], count)
    centres = space.centres_mm(index)
    middle = (
        np.stack([np.bincount(piece, area * centres[:, axis], count) for axis in range(3)], axis=1)
        / np.maximum(total, 1e-300)[:, None]
    )
    order = np.argsort(-total, kind="stable")
    return [Gap(float(total[k]), tuple(middle[k].tolist()), float(reach[k] / total[k])) for k in order]


def angles_deg(direction: FloatArray, up: FloatArray) -> tuple[float, float]:
    """Azimuth (0 where the world's z axis points, or x if that is upright; growing towards up x z) and elevation of a direction."""
    x, y, z = upright_frame(up) @ direction
    return math.degrees(math.atan2(x, z)), math.degrees(math.asin(np.clip(y, -1, 1)))


def upright_frame(up: FloatArray) -> FloatArray:
    """(3, 3) rows: where azimuth 90 degrees is, up, and where azimuth 0 is."""
    start = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    start = unit_vectors(start - (start @ up) * up)
    return np.stack([np.cross(up, start), up, start])
