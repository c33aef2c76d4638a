"""One thing wrong at a time: is a place that the scan does not explain named as what it is?

A ball of slight gloss, its scan (0.02 mm of noise) and its picture (1 % of full scale), rendered by the model itself. Into each scene one thing is planted at a
place drawn from its seed: a dent or a badly joined step in the scan alone, a spot of paint, the shadow of a rod that the scan does not hold, a drop of varnish
in the highlight; lines cross the light, which shows no relief along itself. The strongest place that is named within reach of what was planted counts; all others
are places named elsewhere. Where the picture is too dark to be compared nothing can be named: such scenes are told apart. Camera frame, millimetres.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from rangecheck.analytic.shapes import Sphere
from rangecheck.arrays import FloatArray
from rangecheck.optics import PinholeCamera
from rangecheck.recover.compare import compare
from rangecheck.recover.grid import scan_grid, sight_of
from rangecheck.recover.lights import Light
from rangecheck.recover.problem import Guess, Photograph, Problem
from rangecheck.recover.regions import KINDS
from rangecheck.scan import RangeScan
from rangecheck.studies.fit_alexander import along, dented, stepped
from rangecheck.study import Line, LineChart

SIZE, RADIUS_MM, AWAY_MM = 200, 80.0, 600.0
LAMP = np.array([0.5, -0.4, -0.77]) / np.linalg.norm([0.5, -0.4, -0.77])
#: matt with a broad highlight;  the same under a drop of varnish
_BALL = Guess(0.4, 0.0, 0.15, 0.8, 5.0)
_VARNISH = Guess(0.4, 0.0, 0.15, 0.8, 6.5)
_RANGE_NOISE_MM, _PICTURE_NOISE, _SCALE_MM = 0.02, 0.01, 2.5
_FRESH = 41000
_DENT_MM, _DENT_RADIUS_MM, _STEP_MM = 1.0, 10.0, 0.4
_SPOT_MM, _PAINT, _ROD_MM, _DROP_MM = 6.0, 0.8, 6.0, 8.0
#: how far from what was planted its place may be named: the larger filter's reach
_REACH_MM = 14.0


def ball(seed: int, guess: Guess = _BALL) -> tuple[RangeScan, FloatArray]:
    """The ball's scan with its picture, and the picture (h, w) without noise."""
    camera = PinholeCamera.from_field_of_view(SIZE, SIZE, 16.0)
    _, rays = camera.pixel_rays()
    centre = np.array([0.0, 0.0, AWAY_MM])
    sphere = Sphere(RADIUS_MM)
    distance = sphere.first_hit(-centre, rays)
    met = np.isfinite(distance)
    normals = sphere.normal(np.where(met, distance, AWAY_MM)[..., None] * rays - centre)
    seen = met & (-(normals * rays).sum(-1) > 0.25)
    exact = RangeScan(np.where(seen, distance, np.nan).astype(np.float32), camera, brightness=np.zeros((SIZE, SIZE), np.float32))
    cell = np.flatnonzero(seen)
    n = len(cell)
    photo = Photograph(
        sight_of(scan_grid(exact), cell, normals.reshape(-1, 3)[cell]), np.zeros(n), np.ones(n), np.ones((n, 1), bool), (0,)
    )
    problem = Problem((photo,), (Light(LAMP, 0.9 * math.pi, centre, 1e5, 1.0),), guess)
    picture = np.zeros(SIZE * SIZE)
    picture[cell] = problem.predict(problem.start(), 0, slopes=False).values
    bright = picture.reshape(SIZE, SIZE)
    rng = np.random.default_rng(seed)
    ranges = np.where(seen, distance + rng.normal(0, _RANGE_NOISE_MM, seen.shape), np.nan).astype(np.float32)
    return noisy(replace(exact, range_mm=ranges, noise_mm=_RANGE_NOISE_MM), bright, seed), bright


def noisy(scan: RangeScan, picture: FloatArray, seed: int) -> RangeScan:
    """The scan with `picture` and its noise."""
    grain = np.random.default_rng((seed, 1)).normal(0, _PICTURE_NOISE, picture.shape)
    return replace(scan, brightness=np.clip(picture + grain, 0, 1).astype(np.float32))


def _nothing(seed: int, place: FloatArray, angle: float) -> RangeScan:
    return ball(seed)[0]


def _shape(seed: int, place: FloatArray, angle: float) -> RangeScan:
    return dented(ball(seed)[0], place, _DENT_MM, _DENT_RADIUS_MM)


def _registration(seed: int, place: FloatArray, angle: float) -> RangeScan:
    return stepped(ball(seed)[0], place, angle, _STEP_MM)


def _albedo(seed: int, place: FloatArray, angle: float) -> RangeScan:
    scan, picture = ball(seed)
    apart = np.linalg.norm(scan.grid_points_mm - place, axis=-1)
    return noisy(scan, np.where(apart < _SPOT_MM, _PAINT * picture, picture), seed)


def _shadow(seed: int, place: FloatArray, angle: float) -> RangeScan:
    """The shadow of a rod, its penumbra a cell wide."""
    scan, picture = ball(seed)
    aside = np.abs(along(np.nan_to_num(scan.grid_points_mm), place, angle))
    return noisy(scan, picture * (0.03 + 0.97 / (1.0 + np.exp((_ROD_MM - aside) / 0.5))), seed)


def _highlight(seed: int, place: FloatArray, angle: float) -> RangeScan:
    """A drop of varnish where the ball mirrors its lamp."""
    scan, picture = ball(seed)
    glossy = ball(seed, _VARNISH)[1]
    apart = np.linalg.norm(scan.grid_points_mm - mirror_mm(), axis=-1)
    return noisy(scan, np.where(apart < _DROP_MM, glossy, picture), seed)


def mirror_mm() -> FloatArray:
    """(3,) where the ball mirrors its lamp."""
    half = LAMP + np.array([0.0, 0.0, -1.0])
    return np.array([0.0, 0.0, AWAY_MM]) + RADIUS_MM * half / np.linalg.norm(half)


PLANTED: dict[str, Callable[[int, FloatArray, float], RangeScan]] = {
    "nothing": _nothing, "shape": _shape, "registration": _registration, "shadow edge": _shadow, "highlight": _highlight, "albedo": _albedo,
}  # fmt: skip


def named(kind: str, seed: int) -> tuple[str, list[str]]:
    """What is named, strongest first, at what was planted ("nothing" where no place is, "not judged" where none could be), and the kinds of all places named
    elsewhere."""
    rng = np.random.default_rng((seed, 2))
    aside = rng.uniform(-25.0, 25.0, 2)
    # a step that runs along the light does not show in it
    angle = math.atan2(LAMP[1], LAMP[0]) + float(rng.uniform(-1.0, 1.0))
    # on the lit side, away from the highlight
    x, y = -8.0 + aside[0], 12.0 + aside[1]
    place = np.array([x, y, AWAY_MM - math.sqrt(RADIUS_MM**2 - x * x - y * y)])
    scan = PLANTED[kind](seed, place, angle)
    found = compare(scan, scale_mm=_SCALE_MM)
    points = scan_grid(scan).points
    at = np.unravel_index(np.nanargmin(np.linalg.norm(points - place, axis=-1)), found.z.shape)
    here: list[str] = []
    elsewhere: list[str] = []
    for region in found.regions:
        middle = points[region.cell]
        if kind in ("registration", "shadow edge"):
            away = abs(float(along(middle, place, angle)))
        else:
            away = float(np.linalg.norm(middle - (mirror_mm() if kind == "highlight" else place)))
        near = kind != "nothing" and away < _REACH_MM
        (here if near else elsewhere).append(region.kind)
    if here:
        return here[0], elsewhere
    compared = kind in ("nothing", "highlight") or np.isfinite(found.z[at])
    return ("nothing" if compared else "not judged"), elsewhere


def classes(quick: bool) -> tuple[list[Any], list[str], list[dict[str, Any]]]:
    """The part `classes` of the study `fit`."""
    scenes = 2 if quick else 16
    rows: list[dict[str, Any]] = []
    findings: list[str] = []
    for kind in PLANTED:
        results = [named(kind, _FRESH + k) for k in range(scenes)]
        counts = {name: sum(result == name for result, _ in results) for name in ("nothing", "not judged", *KINDS)}
        elsewhere = [name for _, others in results for name in others]
        rows.append({"planted": kind, "scenes": scenes, "elsewhere": elsewhere, **{f"named {n}": c for n, c in counts.items()}})
        said = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        findings.append(f"{kind} planted alone in {scenes} scenes: named there {said}; {len(elsewhere)} places named elsewhere")
    judged = [max(1, scenes - row["named not judged"]) for row in rows]
    right = [row[f"named {row['planted']}"] / count for row, count in zip(rows, judged)]
    at_all = [1.0 - row["named nothing"] / count for row, count in zip(rows, judged)]
    chart = LineChart(
        "classes", f"One thing planted in a glossy ball's scan or picture: named as what it is ({scenes} scenes each)", "what was planted",
        "share of the scenes judged",
        [
            Line("named at all", list(range(len(rows))), at_all, True, dashed=True, colour=1),
            Line("called what it is", list(range(len(rows))), right, True, colour=0),
        ],
        level=1.0, names=list(PLANTED), note="where nothing was planted nothing should be named, and that is what it is",
    )  # fmt: skip
    return [chart], findings, rows
