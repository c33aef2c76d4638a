"""What can be told of a surface's slopes: noise planted and measured, the smallest dent that pictures show in plaster and in steel, and
whether the places that are named on a scanned bust are faults of it.

The dent is a Gaussian hollow in the cheek of the sample bust, its depth and its half width the knobs. It is looked for in frames of the
dented bust's own turntable, as `animation.standing_out` says: where the pictures depart from what the normals around lead to expect by
more times than anything around it than chance would have at one place of all in twenty such surfaces. The same is asked of the
sound bust, where nothing may be found. The camera has a sensor of 8 bits whose white pixel holds 20 000 electrons.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.analytic.bust import bust_first_hit, bust_normals
from rangecheck.animation import measure_consistency
from rangecheck.animation.standing_out import Look, look_at_places, spots
from rangecheck.arrays import FloatArray
from rangecheck.optics import PinholeCamera, Sensor
from rangecheck.reflectance import load_material
from rangecheck.rigid import look_at
from rangecheck.scene import studio
from rangecheck.studies.whole_commands import sample_mesh
from rangecheck.study import Line, LineChart, Part, study_of_parts
from rangecheck.surface import Surface
from rangecheck.surface.mesh_files import read_mesh
from rangecheck.transport import Settings

PLANTED_DEG = (0.2, 0.5, 1.0, 2.0)
#: a measured slope noise may be off by this share
_SHARE = 0.15
#: middle of the cheek, and where it is looked at from
CHEEK_MM = np.array([37.6, 205.7, 39.1])
_TOWARDS = np.array([218.0, 11.0, 295.0]) / np.linalg.norm([218.0, 11.0, 295.0])
AWAY_MM = 600.0
#: frames of the turntable that see the cheek: azimuths from it, degrees
VIEWS_DEG = (-40, -30, -20, -10, 0, 10, 20, 30, 40)
#: half width of the dent that must be found, mm: its depth falls to e^-1/2 there; and of those that are charted
DENT_MM = 1.0
HALF_WIDTHS_MM = (0.7, 1.0, 2.0)
#: side of the part of the face in which the smallest dents are looked for, mm: all that is compared with the dent lies in it
NEAR_MM = 50.0
#: the dent that must be found in steel, and all that are tried
WANTED_MM, DEPTHS_MM = 0.1, (0.0125, 0.025, 0.05, 0.1, 0.2)
#: width of a pixel at the cheek: that of the bust in a frame of 720x720
PIXEL_MM = 0.44
SENSOR = Sensor(full_well=20_000.0, read_noise=10.0, response="srgb")
_BRIDGE = 6.0
#: facets that are judged for places, and places that are held against the truth: as many as a run names
JUDGED, _NAMED = 40_000, 10


def roughened(surface: Surface, slope_deg: float, seed: int) -> Surface:
    """The surface with independent heights at its vertices, scaled until its facets lean by `slope_deg` RMS."""
    heights = np.random.default_rng(seed).normal(size=len(surface.vertices))[:, None] * surface.vertex_normals
    scale = 1e-3
    for _ in range(12):
        rough = Surface(surface.vertices + scale * heights, surface.faces)
        cosine = np.clip((rough.face_normals * surface.face_normals).sum(axis=1), -1, 1)
        scale *= math.radians(slope_deg) / math.sqrt(float(np.average(np.arccos(cosine) ** 2, weights=surface.face_areas)))
    return rough


def _slopes_part(quick: bool) -> Part:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=5 if quick else 6, radius=50.0)
    surface = Surface(ball.vertices, ball.faces)
    rows, measured = [], []
    for planted in PLANTED_DEG:
        found = measure_consistency(roughened(surface, planted, seed=int(10 * planted)))
        measured.append(found.slope_noise_deg)
        rows.append({"planted_deg": planted, "measured_deg": found.slope_noise_deg, "share": found.slope_noise_deg / planted - 1})
    worst = max(abs(float(row["share"])) for row in rows)
    findings = [
        f"slope noise planted {row['planted_deg']:g} degrees, measured {row['measured_deg']:.3f} ({row['share']:+.1%})"
        for row in rows
    ]
    findings.append(f"slope noise is measured within {worst:.1%} (bar {_SHARE:.0%})")
    lines = [Line("measured", PLANTED_DEG, measured, marked=True), Line("planted", PLANTED_DEG, PLANTED_DEG)]
    chart = LineChart(
        "slopes",
        "Slope noise planted in a ball of 50 mm, and measured",
        "planted, degrees",
        "measured, degrees",
        lines,
        log="xy",
    )
    return Part([chart], findings, {"slopes": rows})


def face(size_mm: float, step_mm: float) -> Surface:
    """The sample bust's face as seen from FROM_MM's side, a square of `size_mm` about the cheek, points `step_mm` apart."""
    eye = CHEEK_MM + AWAY_MM * _TOWARDS
    pose = look_at(eye, CHEEK_MM)
    points = round(size_mm / step_mm)
    step = (np.arange(points) - points / 2) * step_mm
    x, y = (axis.reshape(-1, 1) for axis in np.meshgrid(step, step))
    origins = np.ascontiguousarray(eye + x * pose[:3, 0] + y * pose[:3, 1])
    ahead = np.ascontiguousarray(np.broadcast_to(pose[:3, 2], origins.shape))
    distance = bust_first_hit(origins, ahead)
    met = np.isfinite(distance)
    place = origins + np.where(met, distance, 0.0)[:, None] * ahead
    corner = np.arange(points * points).reshape(points, points)
    a, b, c, d = (corner[i : points - 1 + i, j : points - 1 + j].ravel() for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])[:, ::-1]
    edges = place[faces] - place[np.roll(faces, 1, axis=1)]
    # longer edges bridge from one thing to another behind it
    faces = faces[met[faces].all(axis=1) & ((edges * edges).sum(axis=2).max(axis=1) < (_BRIDGE * step_mm) ** 2)]
    used, numbered = np.unique(faces, return_inverse=True)
    return Surface(place[used], numbered.reshape(faces.shape))


def dented(surface: Surface, depth_mm: float, half_width_mm: float = DENT_MM) -> Surface:
    """The face with a Gaussian hollow in its cheek."""
    middle = surface.vertices[np.argmin(np.linalg.norm(surface.vertices - CHEEK_MM, axis=1))]
    away = np.linalg.norm(surface.vertices - middle, axis=1)
    sunk = depth_mm * np.exp(-0.5 * (away / half_width_mm) ** 2)
    return Surface(surface.vertices - sunk[:, None] * surface.vertex_normals, surface.faces)


class _Turned:
    """A surface's turntable in one material, as far as it shows the cheek."""

    def __init__(self, material: str, light: str) -> None:
        self._material, self._light = load_material(material), light
        mirrors = light == "stripes"
        self._settings = Settings(passes=1, each=4, spike=mirrors, lobe=mirrors, diffuse=False, depth=1, backdrop=False)

    def looks(self, surface: Surface) -> list[Look]:
        """What its frames show of the surface."""
        scene = studio(surface, self._material, self._light, front=_TOWARDS, smooth=True)
        across = float(np.ptp(surface.vertices @ look_at(CHEEK_MM + _TOWARDS, CHEEK_MM)[:3, 0]))
        pixels = round(across / PIXEL_MM)
        camera = PinholeCamera.from_field_of_view(pixels, pixels, 2 * math.degrees(math.atan(0.5 * across / AWAY_MM)))
        return look_at_places(scene.grey(), camera, [_pose(degrees) for degrees in VIEWS_DEG], self._settings, SENSOR, seed=1)


def _pose(degrees: float) -> FloatArray:
    """The camera on its way around the vertical axis through the cheek, so far from the cheek's front."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    towards = np.array([c * _TOWARDS[0] + s * _TOWARDS[2], _TOWARDS[1], c * _TOWARDS[2] - s * _TOWARDS[0]])
    return look_at(CHEEK_MM + AWAY_MM * towards, CHEEK_MM)


@dataclass(frozen=True)
class _Found:
    """What looks at a dented face say: by how much the dent exceeds all around and what is asked of it, for the half width that is least
    likely by chance; how many other places would be named; the highest ratio among them."""

    ratio: float
    asked: float
    by_chance: float
    elsewhere: int
    highest: float


def _found(looks: Sequence[Look], told_by: Sequence[Look], reach_mm: float) -> _Found:
    """Of the dent within `reach_mm` of the cheek's middle; thresholds are those of `told_by`, looks at a whole face."""
    best = _Found(0.0, math.inf, math.inf, 0, 0.0)
    elsewhere = [s for s in spots(told_by) if math.dist(s.centre_mm, CHEEK_MM) > reach_mm]
    highest = max((float(k.ratios[_away(k) > reach_mm].max(initial=0.0)) for k in told_by), default=0.0)
    for look, telling in zip(looks, told_by):
        ratio = float(look.ratios[_away(look) <= reach_mm].max(initial=0.0))
        chance = telling.expected(ratio) if ratio > 1.0 else math.inf
        if best.asked == math.inf or chance < best.by_chance:
            best = _Found(ratio, telling.threshold, chance, 0, 0.0)
    return replace(best, elsewhere=len(elsewhere), highest=highest)


def _away(look: Look) -> FloatArray:
    return np.linalg.norm(look.points_mm - CHEEK_MM, axis=1)


def _dent_part(quick: bool) -> Part:
    size, step = (NEAR_MM, 0.5) if quick else (190.0, 0.5)
    widths, depths = (HALF_WIDTHS_MM[1:2], DEPTHS_MM[2:4]) if quick else (HALF_WIDTHS_MM, DEPTHS_MM)
    whole, near = face(size, step), face(NEAR_MM, step)
    rows, table, findings, lines = [], [], [], []
    for material, light in (("plaster", "dark"), ("steel", "stripes")):
        turned = _Turned(material, light)
        shown = "steel in stripes" if light == "stripes" else "plaster"
        sound = turned.looks(whole)
        false, nothing = spots(sound), _found(sound, sound, 0.0)
        looks = turned.looks(dented(whole, WANTED_MM))
        dent = _found(looks, looks, 3 * DENT_MM)
        rows.append({"shown": shown, "false_on_the_sound": len(false), "highest_on_the_sound": nothing.highest} | vars(dent))
        findings.append(
            f"{shown}: a dent of {WANTED_MM:g} mm, {2 * DENT_MM:g} mm wide, is {dent.ratio:.1f} times the most that is around it "
            f"({'found' if dent.ratio >= dent.asked else 'NOT found'}: {dent.asked:.1f} are asked, {dent.by_chance:.1g} such places would be expected by "
            f"chance), with {dent.elsewhere} places named elsewhere; on the sound bust {len(false)} of {sum(len(k.ratios) for k in sound):,} places are named, "
            f"the highest of all has {nothing.highest:.1f}"
        )
        for width in widths:
            over = []
            for depth in depths:
                at = _found(turned.looks(dented(near, depth, width)), sound, 3 * max(width, DENT_MM))
                over.append(at.ratio / at.asked)
                table.append({"shown": shown, "width_mm": 2 * width, "depth_mm": depth, "ratio": at.ratio, "asked": at.asked})
            found = [f"{1000 * depth:g}" for depth, times in zip(depths, over) if times >= 1]
            tried = ", ".join(f"{1000 * depth:g}" for depth in depths)
            findings.append(
                f"{shown}, {2 * width:g} mm wide: of dents of {tried} µm those of {', '.join(found)} µm are found"
                if found
                else f"{shown}, {2 * width:g} mm wide: of dents of {tried} µm none is found"
            )
            lines.append(Line(f"{shown}, {2 * width:g} mm wide", depths, over, marked=True))
    lines.append(Line("asked", depths, [1.0] * len(depths)))
    chart = LineChart(
        "dent", "Dents in the cheek, looked for without a picture of the sound one", "depth of the dent, mm",
        "times the most that is around it, over what is asked", lines, log="xy",
    )  # fmt: skip
    return Part([chart], findings, {"dents": rows, "depths": table})


def _places_part(quick: bool) -> Part:
    """Whether the places that are named by their slopes on the sample bust are faults of what was meshed: its truth is known."""
    with tempfile.TemporaryDirectory() as name:
        surface = read_mesh(sample_mesh(Path(name), 4.0 if quick else None), "mm")
    found = measure_consistency(surface, most=JUDGED)
    middles = surface.triangles.mean(axis=1)
    off_deg = np.degrees(np.arccos(np.clip((bust_normals(middles) * surface.face_normals).sum(axis=1), -1, 1)))
    usual = float(np.median(off_deg))
    rows: list[dict[str, Any]] = []
    for place in found.places[:_NAMED]:
        here = np.linalg.norm(middles - np.array(place.centre_mm), axis=1) < place.size_mm / 2 + 0.5
        rows.append(
            {
                "centre_mm": place.centre_mm,
                "width_mm": place.size_mm,
                "facets": int(here.sum()),
                "off_deg": float(np.median(off_deg[here])),
            }
        )
    worse = sum(row["off_deg"] > 2 * usual for row in rows)
    findings = [
        f"{len(found.places)} places of the sample bust stand out by their slopes; at {worse} of the first {len(rows)} the median slope of what was meshed is off "
        f"the true bust's by more than twice the {usual:.1f} degrees of all facets, at the median place by {np.median([r['off_deg'] for r in rows] or [0.0]):.1f}"
    ]
    return Part([], findings, {"places": rows})


_PARTS: dict[str, Any] = {"slopes": _slopes_part, "dent": _dent_part, "places": _places_part}
PARTS = tuple(_PARTS)
study = study_of_parts("consistency", "Slope noise and dents: what is measured of them, and what pictures show", _PARTS)
