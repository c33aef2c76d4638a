"""What can be told of a surface's slopes: noise planted and measured, and the smallest dent that pictures show in plaster and in steel.

The dent is a Gaussian hollow in the cheek of the sample bust, its depth the knob. It is found where the picture of the dented cheek
differs from that of the sound one by more than five standard deviations of what two pictures of the sound one differ by, in means of
3 x 3 pixels, of which none may be elsewhere than at the dent. The camera has a sensor of 8 bits whose white pixel holds 20 000 electrons.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rangecheck.analytic.bust import bust_first_hit
from rangecheck.animation import measure_consistency
from rangecheck.arrays import FloatArray
from rangecheck.optics import PinholeCamera, Sensor
from rangecheck.reflectance import load_material
from rangecheck.rigid import look_at
from rangecheck.scene import studio
from rangecheck.study import EdgeChart, Line, LineChart, Part, find_edge, study_of_parts
from rangecheck.surface import Surface
from rangecheck.transport import Settings, Tracer

PLANTED_DEG = (0.2, 0.5, 1.0, 2.0)
#: a measured slope noise may be off by this share
_SHARE = 0.15
#: middle of the cheek as seen from here, and half the width of the patch, mm
CHEEK_MM = np.array([32.0, 189.0, 35.0])
FROM_MM = np.array([250.0, 200.0, 330.0])
HALF_MM = 10.0
#: half width of the dent, mm: its depth falls to e^-1/2 there
DENT_MM = 2.5
#: the dent that must be found in steel
WANTED_MM = 0.1
_SIGMAS = 5.0
_FULL_WELL = 20_000.0


def cheek(points: int) -> Surface:
    """A square patch of the sample bust's cheek, `points` a side, seen from FROM_MM."""
    pose = look_at(FROM_MM, CHEEK_MM)
    step = np.linspace(-HALF_MM, HALF_MM, points)
    x, y = np.meshgrid(step, step)
    origins = FROM_MM + x.reshape(-1, 1) * pose[:3, 0] + y.reshape(-1, 1) * pose[:3, 1]
    ahead = np.broadcast_to(pose[:3, 2], origins.shape)
    distance = bust_first_hit(np.ascontiguousarray(origins), np.ascontiguousarray(ahead))
    corner = np.arange(points * points).reshape(points, points)
    a, b, c, d = (corner[i : points - 1 + i, j : points - 1 + j].ravel() for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
    return Surface(origins + distance[:, None] * ahead, np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])[:, ::-1])


def dented(surface: Surface, depth_mm: float) -> Surface:
    """The patch with a Gaussian hollow in its middle."""
    middle = surface.vertices[len(surface.vertices) // 2]
    away = np.linalg.norm(surface.vertices - middle, axis=1)
    sunk = depth_mm * np.exp(-0.5 * (away / DENT_MM) ** 2)
    return Surface(surface.vertices - sunk[:, None] * surface.vertex_normals, surface.faces)


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


class _Looks:
    """Pictures of the cheek in one material, and how far a dent stands out of their noise."""

    def __init__(self, material: str, light: str, surface: Surface, pixels: int) -> None:
        self._material, self._light, self._surface = load_material(material), light, surface
        self._camera = PinholeCamera.from_field_of_view(pixels, pixels, 2 * math.degrees(math.atan(0.9 * HALF_MM / 300.0)))
        middle = surface.vertices[len(surface.vertices) // 2]
        self._pose = look_at(middle + 300.0 * (FROM_MM - CHEEK_MM) / np.linalg.norm(FROM_MM - CHEEK_MM), middle)
        self._sound = self._radiance(surface)
        self._level = 0.8 / float(np.quantile(self._sound, 0.98))
        pair = _means(self._picture(self._sound, 1) - self._picture(self._sound, 2))
        self._noise = float(pair.std())

    def _radiance(self, surface: Surface) -> FloatArray:
        scene = studio(surface, self._material, self._light, front=FROM_MM - CHEEK_MM, smooth=True)
        mirrors = self._light == "stripes"
        settings = Settings(
            passes=4, each=4, spike=mirrors, lobe=mirrors, diffuse=False, depth=2 if mirrors else 1, backdrop=False
        )
        return Tracer(scene).grey().render(self._camera, self._pose, settings, seed=3).radiance[..., 0].astype(np.float64)

    def _picture(self, radiance: FloatArray, seed: int) -> FloatArray:
        sensor = Sensor(electrons_per_unit=_FULL_WELL * self._level, full_well=_FULL_WELL, read_noise=10.0, response="srgb")
        return sensor.expose(radiance, seed=seed).astype(np.float64)

    def stands_out(self, depth_mm: float) -> float:
        """How many standard deviations the dent stands out by."""
        other = self._picture(self._radiance(dented(self._surface, depth_mm)), 2)
        apart = np.abs(_means(self._picture(self._sound, 1) - other)) / self._noise
        rows = np.arange(apart.shape[0]) - apart.shape[0] // 2
        pixel_mm = 2 * 0.9 * HALF_MM / apart.shape[0]
        near = np.hypot(rows[:, None], rows[None]) * pixel_mm < 2.5 * DENT_MM
        return float(apart[near].max())


def _means(picture: FloatArray) -> FloatArray:
    """Means of 3 x 3 pixels, in steps of three."""
    size = picture.shape[0] // 3 * 3
    return picture[:size, :size].reshape(size // 3, 3, size // 3, 3).mean(axis=(1, 3))


def _dent_part(quick: bool) -> Part:
    points, pixels, samples = (60, 90, 5) if quick else (160, 240, 9)
    smooth = cheek(points)
    surfaces = {"true surface": smooth}
    if not quick:
        surfaces["slope noise 0.3°"] = roughened(smooth, 0.3, seed=4)
    edges, rows, findings = [], [], []
    for words, surface in surfaces.items():
        for material, light in (("plaster", "dark"), ("steel", "stripes")):
            look = _Looks(material, light, surface, pixels)

            def hidden(depth: float, look: _Looks = look) -> float:
                return _SIGMAS / max(look.stands_out(depth), 1e-9)

            shown = "steel in stripes" if light == "stripes" else "plaster"
            edge = find_edge(f"{shown}, {words}", hidden, 0.5, 5e-5, 1.0, logarithmic=True, samples=samples, tolerance=0.05)
            edges.append(edge)
            at = look.stands_out(WANTED_MM)
            rows.append(
                {"surface": words, "material": material, "light": light, "lost_below_mm": edge.breaks_at, "sigmas_at_0.1_mm": at}
            )
            until = "at every depth tried" if edge.breaks_at is None else f"down to {1000 * edge.breaks_at:.2g} µm"
            findings.append(
                f"{shown}, {words}: a dent of {WANTED_MM:g} mm stands out by {at:.0f} standard deviations "
                f"({'found' if at > _SIGMAS else 'NOT found'}); a dent is found {until}"
            )
    chart = EdgeChart(
        "dent", f"A dent of {2 * DENT_MM:g} mm across in the cheek: how deep it must be to be found", "depth of the dent, mm",
        "five standard deviations over what it stands out by", edges,
    )  # fmt: skip
    return Part([chart], findings, {"dents": rows})


_PARTS: dict[str, Any] = {"slopes": _slopes_part, "dent": _dent_part}
PARTS = tuple(_PARTS)
study = study_of_parts("consistency", "Slope noise and dents: what is measured of them, and what pictures show", _PARTS)
