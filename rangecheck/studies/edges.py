"""Two edges of pictures: how rough facets may be before steel's highlights break up, and how far from the origin shadows hold.

Highlights: noise along the normals of a mesh tilts its facets, and a mirror doubles every tilt. `scatter` is the share of a highlight's light
that falls outside the place where the noiseless mesh has it, a pixel's width added; half a highlight astray counts as broken up.
Shadows: Embree counts in float32, whose steps grow with the distance from the origin.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.kernels import kernel
from rangecheck.raycast import EmbreeCaster, direct
from rangecheck.reflectance import GREY_UM, load_material
from rangecheck.scene import Scene, Source
from rangecheck.studies.scenes import RADIUS_MM, ball, bust_relief, floor, view
from rangecheck.study import EdgeChart, Line, LineChart, Part, find_edge
from rangecheck.study.charts import Chart
from rangecheck.surface import Surface
from rangecheck.surface.surface import join
from rangecheck.transport import Settings, Tracer

#: share of a highlight's light outside its place at which it counts as broken up
BROKEN = 0.5
#: share of shadow rays answered wrongly at which shadows count as leaking
LEAKING = 1e-3
_SEEDS = 3


def facet_noise_deg(surface: Surface, moved: FloatArray) -> float:
    """Root mean square angle, degrees, between the facets of `surface` and the same facets with vertices `moved` (n, 3)."""
    bent = Surface(moved, surface.faces)
    cosine = np.einsum("ij,ij->i", surface.face_normals, bent.face_normals)
    sine = np.linalg.norm(np.cross(surface.face_normals, bent.face_normals), axis=1)
    return math.degrees(math.sqrt(float((np.arctan2(sine, cosine) ** 2).mean())))


class _Highlights:
    """Highlights of polished steel on one surface under one lamp of 4 degrees' radius, as its facets are tilted."""

    def __init__(self, surface: Surface, size: int) -> None:
        self.surface, self.size = surface, size
        self.normals = surface.vertex_normals
        self.steel = load_material("steel").at(GREY_UM)
        trial = surface.vertices + 1e-4 * self._draws(0)[:, None] * self.normals
        self.deg_per_mm = facet_noise_deg(surface, trial) / 1e-4
        still = self._picture(surface.vertices)
        grown = still > 0.05 * still.max()
        wide = np.pad(grown, 1)
        grown = wide[:-2, 1:-1] | wide[2:, 1:-1] | wide[1:-1, :-2] | wide[1:-1, 2:] | wide[1:-1, 1:-1]
        self.place: BoolArray = grown
        self.pieces_still = self._pieces(still)

    def _draws(self, seed: int) -> FloatArray:
        return np.random.default_rng(seed).standard_normal(len(self.surface.vertices))

    def _picture(self, vertices: FloatArray) -> FloatArray:
        lamp = Source(np.array([120.0, 160.0, 260.0]), 24.0, np.array([50.0]))
        tracer = Tracer(Scene(Surface(vertices, self.surface.faces), (self.steel,), sources=(lamp,), smooth=True))
        settings = Settings(passes=1, each=8, depth=1, lobe=False, diffuse=False, shadow_rays=0, backdrop=False, glints="ray")
        lit = tracer.render(*view(self.size, 24.0), settings).radiance[..., 0].astype(np.float64)
        # the lobe's haze under the highlight is not it
        return np.where(lit > 0.02 * 50.0, lit, 0.0)

    def _pieces(self, picture: FloatArray) -> int:
        import cv2

        return cv2.connectedComponents((picture > 0.1 * 50.0).astype(np.uint8), connectivity=8)[0] - 1

    def at(self, degrees: float, seed: int) -> tuple[float, int]:
        """(share of the light outside the noiseless highlights' place, number of pieces) with facets tilted by so much."""
        amplitude = math.tan(math.radians(degrees)) / math.radians(self.deg_per_mm)
        picture = self._picture(self.surface.vertices + amplitude * self._draws(seed)[:, None] * self.normals)
        total = float(picture.sum())
        return (float(picture[~self.place].sum()) / total if total > 0 else 1.0), self._pieces(picture)

    def scatter(self, degrees: float) -> float:
        return float(np.mean([self.at(degrees, 1 + seed)[0] for seed in range(_SEEDS)]))


def highlights_part(quick: bool) -> Part:
    """Scatter and number of pieces of steel's highlights against the tilt of facets, on a ball and on the bust."""
    size, samples = (64, 5) if quick else (256, 13)
    edges, lines, rows, said = [], [], [], []
    subjects: dict[str, Callable[[], Surface]] = {"ball": partial(ball, 5 if quick else 6), "bust": bust_relief}
    for name, make in subjects.items():
        made = _Highlights(make(), size)
        edge = find_edge(f"{name}, steel", made.scatter, 0.02, 20.0, BROKEN, logarithmic=True, samples=samples, tolerance=0.05)
        edges.append(edge)
        counts = [float(np.mean([made.at(d, 1 + s)[1] for s in range(_SEEDS)])) for d in edge.knobs]
        lines.append(Line(name, edge.knobs, counts, marked=True))
        doubled = next((d for d, c in zip(edge.knobs, counts) if c >= 2 * made.pieces_still), None)
        rows += [
            {"subject": name, "facet_noise_deg": d, "scatter": e, "pieces": c} for d, e, c in zip(edge.knobs, edge.errors, counts)
        ]
        said.append(
            f"steel's highlights on the {name} ({made.pieces_still} without noise): half their light is astray from "
            f"{edge.breaks_at or math.nan:.3g} degrees of facet noise; "
            + (f"twice as many pieces at {doubled:.3g} degrees (step of the sweep)" if doubled else "never twice as many pieces")
        )
    charts: list[Chart] = [
        EdgeChart(
            "highlights", "Where steel's highlights break up", "facet noise, degrees (root mean square)",
            "share of the highlights' light outside their place", edges, log="x",
        ),
        LineChart(
            "pieces", "Pieces that highlights fall into", "facet noise, degrees (root mean square)", "connected pieces", lines, log="xy"
        ),
    ]  # fmt: skip
    return Part(charts, said, {"highlights": rows})


@cache
def _shadow_case(count: int) -> tuple[Surface, FloatArray, FloatArray, BoolArray]:
    """A ball over a plane: the mesh, points on the plane, unit directions to a lamp, and whether the exact ball hides it."""
    surface = join([floor(400.0), ball(5)])
    rng = np.random.default_rng(4)
    points = np.stack([rng.uniform(-180, 180, count), np.full(count, -RADIUS_MM), rng.uniform(-180, 180, count)], axis=1)
    towards = np.array([150.0, 300.0, 120.0]) - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    along = -np.einsum("ij,ij->i", points, towards)
    nearest = np.linalg.norm(points + along[:, None] * towards, axis=1)
    # between the facets and the exact ball anything may happen: rays there are not asked
    edge_mm = float(np.linalg.norm(surface.triangles[:, 0] - surface.triangles[:, 1], axis=1)[2:].max())
    clear = np.abs(nearest - RADIUS_MM) > edge_mm**2 / (2 * RADIUS_MM)
    return surface, points[clear], towards[clear], (nearest < RADIUS_MM)[clear] & (along > 0)[clear]


@kernel
def _lifted(points, skin, out):
    for i in range(len(points)):
        out[i, 0], out[i, 1], out[i, 2] = points[i, 0], points[i, 1] + skin, points[i, 2]


def _wrong(recentred: bool, count: int, offset_mm: float) -> float:
    """Share of shadow rays answered wrongly with the scene `offset_mm` from the origin along all axes."""
    surface, points, towards, hidden = _shadow_case(count)
    shift = np.full(3, offset_mm)
    vertices = surface.vertices + shift
    if recentred:
        caster = EmbreeCaster(vertices, surface.faces)
        origins = points + shift + [0.0, caster.skin_mm, 0.0]
        return float((caster.occluded(origins, towards, 600.0) != hidden).mean())
    # the same engine and skin, fed with the world's own coordinates
    local = direct.with_room(len(vertices))
    local[:] = vertices
    tree = direct.DirectScene(local, surface.faces)
    origins = np.empty_like(points)
    _lifted(points + shift, 64 * float(np.spacing(np.float32(200.0))), origins)
    blocked = np.empty(len(points), np.bool_)
    far = np.full(len(points), 600.0, np.float32)
    tree.occluded(np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(towards, np.float32), far, blocked, False)
    return float((blocked != hidden).mean())


def leaks_part(quick: bool) -> Part:
    """Wrong shadows against the distance from the origin: single precision as it is, and about the object's own middle."""
    count, samples = (2_000, 9) if quick else (50_000, 41)
    edges = [
        find_edge(words, partial(_wrong, recentred, count), 1.0, 1e17, LEAKING, logarithmic=True, samples=samples, tolerance=0.02)
        for words, recentred in (("float32 about the origin", False), ("about the object, in float64 before", True))
    ]
    rows: list[dict[str, Any]] = [
        {"method": edge.method, "offset_mm": k, "wrong": e} for edge in edges for k, e in zip(edge.knobs, edge.errors)
    ]
    said = [
        f"shadows, {edge.method}: more than {LEAKING:g} of the rays wrong from {edge.breaks_at or math.nan:.3g} mm off the origin"
        for edge in edges
    ]
    said.append(f"at the origin {edges[1].errors[0]:.2g} of the rays are wrong, recentred or not {edges[0].errors[0]:.2g}")
    chart = EdgeChart(
        "leaks", "Wrong shadows far from the origin: a 100 mm ball over a plane", "offset of the scene along each axis, mm",
        "share of shadow rays answered wrongly", edges, log="x",
    )  # fmt: skip
    return Part([chart], said, {"leaks": rows})
