"""The smallest dents that pictures show, in plaster and in steel, at places drawn by chance on both cheeks of the sample bust.

A dent is a Gaussian hollow, of a depth and a half width. It is looked for in normals measured in the pictures of the dented bust's own
turntable (`animation.measured_normals`), by how it bends unlike its surroundings (`animation.standing_out`), and counts as found where a place
there stands out by more than chance would have at one place of all in twenty such surfaces. The same is asked of the sound bust, where
nothing may be found. In steel the pictures are of waves of light, in plaster of two lamps that stand still while the bust turns. The
camera has a sensor of 8 bits whose white pixel holds 20 000 electrons.

What the method's numbers were chosen on are other places of the same cheeks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rangecheck.analytic.bust import bust_first_hit
from rangecheck.analytic.bust_form import mirrored_in_head
from rangecheck.animation.measured_normals import MeasuredNormals, lit_picture, normals_in_shading, normals_in_waves
from rangecheck.animation.standing_out import Look, look_at_places, normals_around, spots
from rangecheck.arrays import FloatArray
from rangecheck.optics import PinholeCamera, Sensor
from rangecheck.reflectance import load_material
from rangecheck.rigid import look_at
from rangecheck.scene import Scene, studio
from rangecheck.study import Line, LineChart, Part
from rangecheck.surface import Surface
from rangecheck.transport import Settings, Tracer

#: the cheek ends at the eyelid, this far from its middle; how far drawn places lie from each other
CHEEK_REACH_MM, APART_MM = 18.0, 4.0
#: places drawn on each cheek, by which seed; of them so many are charted
PLACES, SEED, CHARTED = 14, 2026, 4
AWAY_MM = 600.0
#: frames of the turntable that see a cheek: azimuths from it, degrees; every frame of 72 in plaster, every other in steel
VIEWS_DEG = {"steel": tuple(range(-60, 61, 10)), "plaster": tuple(range(-60, 61, 5))}
#: the dent that must be found in steel: its depth and its half width, where its depth falls to e^-1/2; and all that are charted
WANTED_MM, DENT_MM = 0.1, 1.0
DEPTHS_MM, HALF_WIDTHS_MM = (0.0125, 0.025, 0.05, 0.1, 0.2, 0.4), (0.7, 1.0, 2.0, 3.0)
#: sides of the face as the whole turntable shows it, and of the part that tells of one place, and distance of their points, mm
WHOLE_MM, NEAR_MM, STEP_MM = 190.0, 50.0, 0.5
#: width of a pixel at the cheek: that of the bust in a frame of 720x720
PIXEL_MM = 0.44
SENSOR = Sensor(full_well=20_000.0, read_noise=10.0, response="srgb")
#: rays through each pixel; mirrors see waves straight, plaster its lamps
_MIRRORED = Settings(passes=1, each=4, diffuse=False, depth=1, backdrop=False)
_MATT = Settings(passes=1, each=4, spike=False, lobe=False, diffuse=False, depth=1, backdrop=False)
#: known normals are averaged over this where the search for the measured ones begins
_AROUND_MM = 2.0
_BRIDGE = 6.0


@dataclass(frozen=True, eq=False)
class Cheek:
    """middle_mm (3,), and the unit direction (3,) that it is looked at from."""

    name: str
    middle_mm: FloatArray
    towards: FloatArray

    def pose(self, degrees: float, middle_mm: FloatArray | None = None) -> FloatArray:
        """The camera on its way around the vertical axis through the middle (or another place), so far from the front."""
        centre = self.middle_mm if middle_mm is None else middle_mm
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        x, y, z = self.towards
        return look_at(centre + AWAY_MM * np.array([c * x + s * z, y, c * z - s * x]), centre)


def cheeks() -> tuple[Cheek, Cheek]:
    """The sitter's left cheek, and the right one: its mirror image in the head."""
    middle, towards = np.array([37.6, 205.7, 39.1]), np.array([218.0, 11.0, 295.0])
    towards /= np.linalg.norm(towards)
    other = mirrored_in_head(middle)
    return Cheek("left", middle, towards), Cheek("right", other, mirrored_in_head(middle + towards) - other)


def face(cheek: Cheek, size_mm: float, step_mm: float = STEP_MM, middle_mm: FloatArray | None = None) -> Surface:
    """The sample bust's face as the cheek's camera sees it, a square of `size_mm` about its middle (or another place), points
    `step_mm` apart."""
    pose = cheek.pose(0.0, middle_mm)
    points = round(size_mm / step_mm)
    step = (np.arange(points) - points / 2) * step_mm
    x, y = (axis.reshape(-1, 1) for axis in np.meshgrid(step, step))
    origins = np.ascontiguousarray(pose[:3, 3] + x * pose[:3, 0] + y * pose[:3, 1])
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


def places_on(cheek: Cheek, surface: Surface, count: int, seed: int = SEED) -> FloatArray:
    """(count, 3) places drawn on the cheek."""
    near = np.flatnonzero(np.linalg.norm(surface.vertices - cheek.middle_mm, axis=1) < CHEEK_REACH_MM)
    drawn: list[FloatArray] = []
    for vertex in np.random.default_rng([seed, len(cheek.name)]).permutation(near):
        if len(drawn) == count:
            break
        if all(math.dist(surface.vertices[vertex], other) > APART_MM for other in drawn):
            drawn.append(surface.vertices[vertex])
    return np.array(drawn)


def dented(surface: Surface, place_mm: FloatArray, depth_mm: float, half_width_mm: float = DENT_MM) -> Surface:
    """The face with a Gaussian hollow at a place of it."""
    away = np.linalg.norm(surface.vertices - place_mm, axis=1)
    sunk = depth_mm * np.exp(-0.5 * (away / half_width_mm) ** 2)
    return Surface(surface.vertices - sunk[:, None] * surface.vertex_normals, surface.faces)


def measured(material: str, cheek: Cheek, surface: Surface, middle_mm: FloatArray | None = None) -> MeasuredNormals:
    """What the turntable of a face tells of its normals, as far as it shows the cheek."""
    made_of = load_material(material)
    poses = [cheek.pose(degrees, middle_mm) for degrees in VIEWS_DEG[material]]
    across = float(np.ptp(surface.vertices @ cheek.pose(0.0)[:3, 0]))
    pixels = round(across / PIXEL_MM)
    camera = PinholeCamera.from_field_of_view(pixels, pixels, 2 * math.degrees(math.atan(0.5 * across / AWAY_MM)))
    if material == "steel":
        return normals_in_waves(Scene(surface, (made_of,), smooth=True), camera, poses, _MIRRORED, SENSOR, seed=1)
    tracer, pictures = None, []
    for k, pose in enumerate(poses):
        # lamps that stand still in the room go round the bust with the camera
        scene = studio(surface, made_of, "dark", front=-pose[:3, 2], smooth=True).grey()
        tracer = Tracer(scene) if tracer is None else tracer.lit_as(scene)
        pictures.append(lit_picture(tracer, camera, pose, _MATT, SENSOR, seed=1 + k))
    return normals_in_shading(surface, camera, pictures, normals_around(surface, _AROUND_MM))


def over_what_is_asked(looks: Sequence[Look], told_by: Sequence[Look], place_mm: FloatArray, reach_mm: float) -> float:
    """The highest ratio within `reach_mm` of a place over what the whole face's looks `told_by` ask there: found from 1 on."""
    best = 0.0
    for look, telling in zip(looks, told_by):
        near = np.linalg.norm(look.points_mm - place_mm, axis=1) <= reach_mm
        best = max(best, float(look.ratios[near].max(initial=0.0)) / telling.threshold)
    return best


class _Faces:
    """Sound faces of one material: what tells how much is asked, and places that are named without cause."""

    def __init__(self, material: str, size_mm: float) -> None:
        self.material = material
        self.cheeks = cheeks()
        self.whole = [face(cheek, size_mm) for cheek in self.cheeks]
        self.looks = [look_at_places(measured(material, cheek, whole)) for cheek, whole in zip(self.cheeks, self.whole)]
        self.false = sum(len(spots(looks)) for looks in self.looks)
        self.judged = sum(len(look.ratios) for looks in self.looks for look in looks)

    def times(self, side: int, place_mm: FloatArray, depth_mm: float, half_width_mm: float) -> float:
        """By how many times what is asked a dent stands out."""
        cheek = self.cheeks[side]
        around = dented(face(cheek, NEAR_MM, middle_mm=place_mm), place_mm, depth_mm, half_width_mm)
        looks = look_at_places(measured(self.material, cheek, around, place_mm))
        return over_what_is_asked(looks, self.looks[side], place_mm, 2 * max(half_width_mm, DENT_MM))


def dent_part(quick: bool) -> Part:
    """Dents at places drawn by chance, and the smallest that are found."""
    size, count, charted = (70.0, 1, 1) if quick else (WHOLE_MM, PLACES, CHARTED)
    widths, depths = (HALF_WIDTHS_MM[1:2], DEPTHS_MM[2:4]) if quick else (HALF_WIDTHS_MM, DEPTHS_MM)
    rows, table, findings, lines = [], [], [], []
    for material in ("plaster", "steel"):
        faces = _Faces(material, size)
        shown = "steel in waves" if material == "steel" else "plaster"
        places = [(side, p) for side in (0, 1) for p in places_on(faces.cheeks[side], faces.whole[side], count)]
        times = np.array([faces.times(side, place, WANTED_MM, DENT_MM) for side, place in places])
        rows += [
            {"shown": shown, "cheek": faces.cheeks[side].name, "place_mm": place.tolist(), "times_asked": float(t)}
            for (side, place), t in zip(places, times)
        ]
        findings.append(
            f"{shown}: dents of {WANTED_MM:g} mm, {2 * DENT_MM:g} mm wide, are found at {(times >= 1).sum()} of {len(times)} places drawn on both cheeks, at the median "
            f"place {np.median(times):.1f} times clearer than is asked, at the worst {times.min():.2f}; on the sound faces {faces.false} of "
            f"{faces.judged:,} places are named"
        )
        some = [pair for side in (0, 1) for pair in [p for p in places if p[0] == side][:charted]]
        for width in widths:
            at_depth = np.array([[faces.times(side, place, depth, width) for side, place in some] for depth in depths])
            share = (at_depth >= 1).mean(axis=1)
            middle = np.median(at_depth, axis=1)
            for depth, found, times_asked in zip(depths, share, middle):
                table.append(
                    {"shown": shown, "width_mm": 2 * width, "depth_mm": depth, "found_share": found, "times_asked": times_asked}
                )
            half = [f"{1000 * depth:g}" for depth, t in zip(depths, middle) if t >= 1]
            named = f"those of {', '.join(half)} µm are" if half else "none is"
            tried = ", ".join(f"{1000 * depth:g}" for depth in depths)
            findings.append(
                f"{shown}, {2 * width:g} mm wide: of dents of {tried} µm {named} found at the median of {len(some)} places"
            )
            lines.append(Line(f"{shown}, {2 * width:g} mm wide", depths, middle.tolist(), marked=True))
    lines.append(Line("asked", depths, [1.0] * len(depths)))
    chart = LineChart(
        "dent", "Dents in the cheeks, looked for without a picture of the sound ones", "depth of the dent, mm",
        "how clear at the median place, over what is asked", lines, log="xy",
    )  # fmt: skip
    return Part([chart], findings, {"dents": rows, "depths": table})
