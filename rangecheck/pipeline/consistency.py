"""What a turntable shows of a surface, measured: speckle and jumping highlights, slope noise, outlines against the scans; and the verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.animation import (
    Consistency,
    Orbit,
    Speckle,
    faces_seen,
    measure_consistency,
    outline_of,
    speckle_of,
    verdict_for,
)
from rangecheck.animation.consistency import Outline
from rangecheck.animation.measured_normals import (
    SHIFTS,
    LitPicture,
    MeasuredNormals,
    noise_of,
    normals_in_shading,
    normals_in_waves,
)
from rangecheck.animation.standing_out import (
    FALSE_PLACES,
    HALF_WIDTHS_MM,
    Look,
    Spot,
    look_at_places,
    normals_around,
    pixel_width_mm,
    spots,
)
from rangecheck.config import Settings
from rangecheck.export.mapped import coloured_map
from rangecheck.export.pictures import write_png
from rangecheck.files import write_json
from rangecheck.maps import Maps, trace_maps
from rangecheck.optics import PinholeCamera, Sensor
from rangecheck.pipeline.outcome import document
from rangecheck.raycast import EmbreeCaster
from rangecheck.scan import RangeScan
from rangecheck.scene import Scene
from rangecheck.solid.printer import Printer, printer
from rangecheck.surface import Surface
from rangecheck.transport import Settings as LightSettings

#: views of the orbit from which it is told what was seen, and pixels across each
VIEWS, VIEW_PX = 8, 320
#: facets that are judged: enough for the noise to a hundredth, and for places of a few millimetres
JUDGED = 40_000
#: flagged places that are named
NAMED = 10
#: poses of the turntable, and rays through each pixel, from which normals are measured in mirrored waves
STANDING_VIEWS, STANDING_RAYS = 12, 4
#: frames of a matt turntable that are measured, at most: every so many of them
STANDING_FRAMES = 72
#: darker and brighter pixels of a frame, in shares of white, tell nothing of how much light there was
DARKEST, BRIGHTEST = 0.02, 0.98
#: pixels over which known normals are averaged where the search for the measured ones begins
SMOOTHED_PX = 4.0
#: by a sensor of 8 bits, where the settings have none
PLAIN_SENSOR = Sensor(full_well=20_000.0, read_noise=10.0, response="srgb")
#: without a printer in the settings
PRINTER = "prusa-sl1s"


@dataclass(frozen=True)
class Known:
    """What a surface and its scans tell of a turntable before any of its frames is made: slopes, outlines, views of the orbit, and drawings."""

    found: Consistency
    outlines: dict[str, Outline]
    views: int
    drawn: list[npt.NDArray[np.uint8]]


def known_of(
    surface: Surface, scans: Sequence[RangeScan], orbit: Orbit, settings: Settings, standing: Standing | None = None
) -> Known:
    """Everything of `judge` that needs no frames."""
    camera = PinholeCamera.from_field_of_view(VIEW_PX, VIEW_PX, settings.picture.field_of_view_deg)
    caster = EmbreeCaster(surface.vertices, surface.faces)
    step = max(1, orbit.frames // VIEWS)
    poses = [orbit.world_from_camera(k) for k in range(0, orbit.frames, step)]
    views = [trace_maps(surface, camera, pose, caster, allow_inside=True) for pose in poses]
    # a pixel sees one facet of several; those between are seen as well
    seen = _near_seen(surface, faces_seen(views, len(surface.faces)))
    found = measure_consistency(surface, seen, most=JUDGED)
    outlines = {scan.name: outline_of(surface, scan, caster) for scan in scans}
    return Known(found, outlines, len(views), _drawn(surface, found, views, () if standing is None else standing.spots))


@dataclass(frozen=True)
class Standing:
    """Places that bend unlike their surroundings in normals that pictures tell, and the looks at the surface that name them.

    shown: `waves` in a mirror, `frames` of a matt surface; pictures: how many were measured, from how many views; noise_deg: the median of how well
    a slope is known at a vertex"""

    spots: tuple[Spot, ...]
    looks: tuple[Look, ...]
    shown: str
    pictures: int
    views: int
    pixel_mm: float
    noise_deg: float | None

    @property
    def places(self) -> int:
        """How many places were judged, of all half widths."""
        return sum(len(look.ratios) for look in self.looks)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "places": [vars(spot) for spot in self.spots[:NAMED]], "flagged": len(self.spots), "places_judged": self.places,
            "false_places_expected": FALSE_PLACES, "shown": self.shown, "pictures": self.pictures, "views": self.views,
            "pixel_mm": self.pixel_mm, "noise_deg": self.noise_deg,
            "looks": [
                {"half_width_mm": look.half_width_mm, "threshold": look.threshold, "places": len(look.ratios)} for look in self.looks
            ],
        }  # fmt: skip

    def lines(self) -> list[str]:
        """For people."""
        if not any(np.isfinite(look.threshold) for look in self.looks):
            return [
                f"places that bend unlike their surroundings: not told; pixels of {self.pixel_mm:.2g} mm leave {self.places} places to "
                "compare (larger --size shows more)"
            ]
        how = (
            f"{self.pictures} further pictures of mirrored waves, from {self.views} poses"
            if self.shown == "waves"
            else f"{self.pictures} frames"
        )
        said = [
            f"{how} tell slopes to {self.noise_deg:.2g} degrees; {len(self.spots)} of {self.places:,} places bend unlike their surroundings, where "
            f"chance would name {FALSE_PLACES:g}"
        ]
        for spot in self.spots[:3]:
            x, y, z = spot.centre_mm
            said.append(
                f"  a {'dent' if spot.depth_mm > 0 else 'bump'} at ({x:z.1f}, {y:z.1f}, {z:z.1f}) mm, about {2 * spot.half_width_mm:g} mm wide and "
                f"{abs(spot.depth_mm):.2g} mm {'deep' if spot.depth_mm > 0 else 'high'}: {spot.ratio:.1f} times what is left around it "
                f"({spot.asked:.1f} are asked)"
            )
        return said


def standing_in_waves(scene: Scene, camera: PinholeCamera, orbit: Orbit, sensor: Sensor | None, seed: int) -> Standing:
    """What stands out of its surroundings in the mirrors of a turntable, surrounded by waves, from STANDING_VIEWS of its poses."""
    straight = replace(camera, distortion=())
    chosen = sorted({k * orbit.frames // STANDING_VIEWS for k in range(STANDING_VIEWS)})
    poses = [orbit.world_from_camera(k) for k in chosen]
    followed = LightSettings(passes=1, each=STANDING_RAYS, diffuse=False, depth=1, backdrop=False)
    pixel = pixel_width_mm(trace_maps(scene.surface, straight, poses[0], allow_inside=True))
    measured = normals_in_waves(scene, straight, poses, followed, sensor or PLAIN_SENSOR, seed=seed) if _widths(pixel) else None
    return _standing(measured, "waves", 3 * SHIFTS * len(poses), len(poses), pixel)


def standing_in_frames(
    scene: Scene, camera: PinholeCamera, orbit: Orbit, picture: Callable[[int], npt.NDArray[Any]], exposure: float, sensor: Sensor | None
) -> Standing:  # fmt: skip
    """What stands out of its surroundings in the frames themselves of a matt turntable whose model turns under lights that stand still.

    picture(i) is frame i as developed with `exposure`, or by `sensor`."""
    seen_by = sensor or PLAIN_SENSOR
    step = -(-orbit.frames // STANDING_FRAMES)
    lit, chosen = [], range(0, orbit.frames, step)
    pixel = pixel_width_mm(trace_maps(scene.surface, camera, orbit.world_from_camera(0), allow_inside=True))
    for index in chosen if _widths(pixel) else ():
        shown = seen_by.linearise(picture(index))
        share = shown if shown.ndim == 2 else shown.mean(axis=2)
        light = np.where((share > DARKEST) & (share < BRIGHTEST), share / exposure, np.nan)
        turned = scene.lights_moved(orbit.world_from_turned(index))
        lit.append(LitPicture(light, noise_of(seen_by, share) / exposure, orbit.world_from_camera(index), turned.sources))
    measured = None
    if lit:
        around = normals_around(scene.surface, SMOOTHED_PX * pixel)
        measured = normals_in_shading(scene.surface, camera, lit, around)
    return _standing(measured, "frames", len(chosen), len(chosen), pixel)


def _widths(pixel_mm: float) -> list[float]:
    """Half widths of what can be looked for: it must be at least as wide as two pixels."""
    return [width for width in HALF_WIDTHS_MM if pixel_mm <= width]


def _standing(measured: MeasuredNormals | None, shown: str, pictures: int, views: int, pixel_mm: float) -> Standing:
    found = [] if measured is None else look_at_places(measured, _widths(pixel_mm))
    noise = math.degrees(float(np.median(measured.noise_rad))) if measured is not None and len(measured.noise_rad) else None
    return Standing(tuple(spots(found)), tuple(found), shown, pictures, views, pixel_mm, noise)


def judge(
    surface: Surface, scans: Sequence[RangeScan], orbit: Orbit, settings: Settings, frames: Iterable[npt.NDArray[np.uint8]] = (),
    known: Known | None = None, standing: Standing | None = None,
) -> tuple[dict[str, Any], list[str], list[npt.NDArray[np.uint8]]]:  # fmt: skip
    """JSON-ready numbers, lines for people, and pictures of the flagged places from the sides that show most of them.

    `frames` are pictures of the turntable in a material that mirrors; `known` saves measuring what needs none; `standing` is what bends
    unlike its surroundings: in mirrors it takes pictures of its own, which the whole job does not make."""
    known = known or known_of(surface, scans, orbit, settings, standing)
    speckle = speckle_of(frames)
    machine = printer(settings.solid.printer or PRINTER)
    height = float(np.ptp(surface.bounds_mm[:, 1]))
    wanted = settings.solid.height_mm or height
    said = verdict_for(known.found, height, wanted, machine.layer_mm, machine.pixel_mm)
    content = _content(known.found, speckle, known.outlines, machine) | {
        "height_mm": wanted, "fit": said.fit, "verdict": said.sentence, "views": known.views,
        "standing_out": None if standing is None else standing.to_dict(),
    }  # fmt: skip
    lines = _lines(known.found, speckle, known.outlines, said.sentence) + ([] if standing is None else standing.lines())
    return content, lines, known.drawn


def _near_seen(surface: Surface, seen: Any) -> Any:
    """Faces of which a corner belongs to a face that was seen."""
    corner = np.zeros(len(surface.vertices), bool)
    corner[surface.faces[seen > 0]] = True
    return corner[surface.faces].any(axis=1)


def _content(found: Consistency, speckle: Speckle | None, outlines: dict[str, Any], machine: Printer) -> dict[str, Any]:
    return {
        "slope_noise_deg": found.slope_noise_deg,
        "slope_rms_deg": found.slope_rms_deg,
        "highlight_jump_deg": found.highlight_jump_deg,
        "height_noise_mm": found.height_noise_mm,
        "facets_judged": found.facets,
        "speckle": None if speckle is None else vars(speckle),
        "outlines": {name: vars(outline) for name, outline in outlines.items()},
        "places": [vars(place) for place in found.places[:NAMED]],
        "places_flagged": len(found.places),
        "printer": machine.name,
    }


def _lines(found: Consistency, speckle: Speckle | None, outlines: dict[str, Any], sentence: str) -> list[str]:
    lines = [
        sentence,
        f"slopes are off by {found.slope_noise_deg:.2f} degrees, so highlights jump by {found.highlight_jump_deg:.2f}; heights by "
        f"{found.height_noise_mm:.3f} mm",
    ]
    if speckle is not None:
        lines.append(
            f"in mirrors: speckle {100 * speckle.contrast:.1f} % of the light; {speckle.pieces:.0f} pieces of highlight a frame, of which {100 * speckle.jumps:.0f} % are gone "
            "in the next"
        )
    if outlines:
        worst = max(outlines.items(), key=lambda item: item[1].worst_px)
        missing = max(o.missing_share for o in outlines.values())
        lines.append(
            f"outlines: up to {100 * missing:.2f} % of a scan's cells show no surface; the worst lies {worst[1].worst_px:.1f} px off, in {worst[0]}"
        )
    for place in found.places[:3]:
        x, y, z = place.centre_mm
        lines.append(
            f"  stands out at ({x:z.1f}, {y:z.1f}, {z:z.1f}) mm: {place.size_mm:.1f} mm wide, {place.peak_deg:.0f} degrees"
        )
    return lines


def _drawn(surface: Surface, found: Consistency, views: Sequence[Maps], standing: Sequence[Spot]) -> list[npt.NDArray[np.uint8]]:
    """Slope residuals in colour from the first view and the one opposite, flagged places ringed: blue by their facets' slopes, green by
    those that pictures tell."""
    import cv2
    from scipy.spatial import cKDTree

    known = np.flatnonzero(np.isfinite(found.residual_deg))
    judged = cKDTree(surface.triangles[known].mean(axis=1))
    high = max(4 * found.slope_noise_deg, 1e-6)
    pictures = []
    for maps in (views[0], views[len(views) // 2]):
        values = np.full(maps.hit.shape, np.nan)
        near = judged.query(maps.points_mm()[maps.hit], min(4, len(known)))[1].reshape(int(maps.hit.sum()), -1)
        values[maps.hit] = found.residual_deg[known][near].mean(axis=1)
        picture = coloured_map(
            values, "Slopes that do not fit their neighbours", "deg", low=0.0, high=high, colours="magma", picture_px=VIEW_PX
        )
        shown = np.array(picture)
        top = shown.shape[0] - VIEW_PX
        rings = [(place.centre_mm, place.size_mm, 7, (0, 160, 255)) for place in found.places[:NAMED]]
        rings += [(spot.centre_mm, 2 * spot.half_width_mm, 10, (40, 220, 90)) for spot in standing[:NAMED]]
        for centre_mm, size_mm, radius, colour in rings:
            uv, depth = maps.camera.project(_moved(maps, np.array([centre_mm])))
            column, row = (round(float(c)) for c in np.nan_to_num(uv[0], nan=-1))
            if not (0 <= column < VIEW_PX and 0 <= row < VIEW_PX):
                continue
            if not float(depth[0]) <= np.nan_to_num(maps.distance_mm[row, column]) + size_mm:
                continue
            left, head = _origin(shown, top)
            cv2.circle(shown, (left + column, head + row), radius, colour, 2, cv2.LINE_AA)
        pictures.append(shown)
    return pictures


def _origin(picture: Any, below: int) -> tuple[int, int]:
    """Where the map begins inside its frame: as far from the left as its lower edge is from the bottom."""
    from rangecheck.export.legend import letter_px

    border = round(1.2 * letter_px(VIEW_PX))
    return border, below - border


def _moved(maps: Maps, points: Any) -> Any:
    from rangecheck.rigid import inverse, move_points

    return move_points(inverse(maps.world_from_camera), points)


def write_consistency(folder: str | Path, content: dict[str, Any], pictures: Sequence[npt.NDArray[np.uint8]]) -> list[Path]:
    """consistency.json and consistency_front.png, consistency_back.png in `folder`."""
    where = Path(folder)
    write_json(where / "consistency.json", document("consistency", **content))
    paths = [where / "consistency.json"]
    for name, picture in zip(("front", "back"), pictures):
        paths.append(where / f"consistency_{name}.png")
        write_png(paths[-1], picture)
    return paths
