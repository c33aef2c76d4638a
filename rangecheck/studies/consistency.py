"""What can be told of a surface's slopes: noise planted and measured, and the smallest dent that pictures show in plaster and in steel.

The dent is a Gaussian hollow in the cheek of the sample bust, its depth the knob. It is looked for in a frame of the dented bust's own
animation, as `animation.standing_out` says: where the picture departs from what the normals around lead to expect by so many times what it
departs by all around, and by more than the tail of that very picture's places leads to expect. The same is asked of the sound bust,
where nothing may be found. The camera has a sensor of 8 bits whose white
pixel holds 20 000 electrons.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rangecheck.analytic.bust import bust_first_hit
from rangecheck.animation import measure_consistency
from rangecheck.animation.standing_out import Departure, departure_in, spots, threshold_of
from rangecheck.optics import PinholeCamera, Sensor
from rangecheck.reflectance import load_material
from rangecheck.rigid import look_at
from rangecheck.scene import studio
from rangecheck.study import EdgeChart, Line, LineChart, Part, find_edge, study_of_parts
from rangecheck.surface import Surface
from rangecheck.transport import Settings

PLANTED_DEG = (0.2, 0.5, 1.0, 2.0)
#: a measured slope noise may be off by this share
_SHARE = 0.15
#: middle of the cheek, and where it is looked at from
CHEEK_MM = np.array([37.6, 205.7, 39.1])
_TOWARDS = np.array([218.0, 11.0, 295.0]) / np.linalg.norm([218.0, 11.0, 295.0])
AWAY_MM = 600.0
#: half width of the dent, mm: its depth falls to e^-1/2 there
DENT_MM = 1.0
#: the dent that must be found in steel, the deepest and the shallowest that are tried
WANTED_MM, DEEPEST_MM, LEAST_MM = 0.1, 0.2, 5e-3
SENSOR = Sensor(full_well=20_000.0, read_noise=10.0, response="srgb")
_BRIDGE = 6.0


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


def dented(surface: Surface, depth_mm: float) -> Surface:
    """The face with a Gaussian hollow in its cheek."""
    middle = surface.vertices[np.argmin(np.linalg.norm(surface.vertices - CHEEK_MM, axis=1))]
    away = np.linalg.norm(surface.vertices - middle, axis=1)
    sunk = depth_mm * np.exp(-0.5 * (away / DENT_MM) ** 2)
    return Surface(surface.vertices - sunk[:, None] * surface.vertex_normals, surface.faces)


class _Looks:
    """Pictures of the face in one material, and what stands out in them."""

    def __init__(self, material: str, light: str, surface: Surface, pixels: int) -> None:
        self._material, self._light, self._surface = load_material(material), light, surface
        across = float(np.ptp(surface.vertices @ look_at(CHEEK_MM + _TOWARDS, CHEEK_MM)[:3, 0]))
        self._camera = PinholeCamera.from_field_of_view(pixels, pixels, 2 * math.degrees(math.atan(0.5 * across / AWAY_MM)))
        self._pose = look_at(CHEEK_MM + AWAY_MM * _TOWARDS, CHEEK_MM)
        mirrors = light == "stripes"
        self._settings = Settings(passes=1, each=9, spike=mirrors, lobe=mirrors, diffuse=False, depth=1, backdrop=False)

    def departure(self, surface: Surface) -> Departure:
        """One frame of this surface's own animation, and how far each of its spots departs from what is around it."""
        scene = studio(surface, self._material, self._light, front=_TOWARDS, smooth=True)
        return departure_in(scene.grey(), self._camera, self._pose, self._settings, SENSOR, seed=1)

    def stands_out(self, depth_mm: float) -> tuple[float, float, int]:
        """By how many sigmas a dent stands out at its place, how many its picture asks for, and how many other places have them."""
        seen = self.departure(dented(self._surface, depth_mm))
        needed = threshold_of([seen]).sigmas
        found = spots([seen], 1.0)
        near = [np.linalg.norm(np.subtract(spot.centre_mm, CHEEK_MM)) <= 3 * DENT_MM for spot in found]
        at = max((spot.sigmas for spot, here in zip(found, near) if here), default=0.0)
        return at, needed, sum(spot.sigmas > needed and not here for spot, here in zip(found, near))


def _dent_part(quick: bool) -> Part:
    size, step, pixels, samples = (60.0, 0.5, 200, 3) if quick else (190.0, 0.5, 620, 6)
    surface = face(size, step)
    edges, rows, findings = [], [], []
    for material, light in (("plaster", "dark"), ("steel", "stripes")):
        look = _Looks(material, light, surface, pixels)
        sound = look.departure(surface)
        threshold = threshold_of([sound]).sigmas
        false = len(spots([sound], threshold))
        highest = float(np.nanmax(sound.sigmas, initial=0.0))
        at, needed, elsewhere = look.stands_out(WANTED_MM)

        def hidden(depth: float, look: _Looks = look) -> float:
            height, asked, _ = look.stands_out(depth)
            return asked / max(height, 1.0)

        shown = "steel in stripes" if light == "stripes" else "plaster"
        edge = find_edge(shown, hidden, DEEPEST_MM, LEAST_MM, 1.0, logarithmic=True, samples=samples, tolerance=0.2)
        edges.append(edge)
        rows.append(
            {
                "material": material, "light": light, "sigmas_at_0.1_mm": at, "threshold_at_0.1_mm": needed, "threshold_on_the_sound": threshold, "elsewhere_at_0.1_mm": elsewhere, "false_on_the_sound": false,
                "highest_on_the_sound": highest, "found_at_mm": edge.holds_at, "lost_at_mm": edge.breaks_at,
                "judged_share": float(np.isfinite(sound.sigmas).sum() / sound.maps.hit.sum()),
            }
        )  # fmt: skip
        least = "not at any depth tried" if edge.holds_at is None else f"down to {1000 * edge.holds_at:.2g} µm"
        findings.append(
            f"{shown}: a dent of {WANTED_MM:g} mm stands out of its own surroundings by {at:.1f} sigmas ({'found' if at >= needed else 'NOT found'}: "
            f"its own picture asks for {needed:.1f}, with {elsewhere} places elsewhere); on the sound bust {false} places pass its {threshold:.1f}, the highest of all has "
            f"{highest:.1f}; found {least}; "
            f"{rows[-1]['judged_share']:.0%} of the surface in the picture is judged"
        )
    chart = EdgeChart(
        "dent", f"A dent of {2 * DENT_MM:g} mm across in the cheek, found without a picture of the sound one", "depth of the dent, mm",
        "sigmas that its picture asks for over those it stands out by", edges,
    )  # fmt: skip
    return Part([chart], findings, {"dents": rows})


_PARTS: dict[str, Any] = {"slopes": _slopes_part, "dent": _dent_part}
PARTS = tuple(_PARTS)
study = study_of_parts("consistency", "Slope noise and dents: what is measured of them, and what pictures show", _PARTS)
