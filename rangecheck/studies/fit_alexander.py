"""Faults planted in a real scan, looked for with the photographs that it was decoded from: are they named, where, and what else is?

The scan is the structured-light bust of the real data, in the left camera's frame; its picture under the white projector lies on its grid. First material
and lamp are fitted to that picture, and it is said how much of the picture they explain: paint decides what shading can show. Then the scan is held against the
right camera's picture. Places and directions of what is planted are drawn from a seed among the places that the unaltered scan is judged at. The method's
constants were chosen on the first of them; those held out were drawn by seeds of their own once the constants stood. Last the cameras' roles are swapped: the
right camera's scan has other cells, gaps and highlights, and the left picture judges.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.export.mapped import coloured_map
from rangecheck.export.pictures import png_bytes
from rangecheck.optics import Sensor
from rangecheck.recover.compare import compare
from rangecheck.recover.dents import JUDGED_MM, RADII_MM, Dents
from rangecheck.recover.fit import Fitted
from rangecheck.recover.grid import ScanGrid, masked_gauss, normals_at, scan_grid
from rangecheck.recover.lamp import lamp_of
from rangecheck.recover.second_view import DISC_MM, WINDOW_MM, Agreement, second_view
from rangecheck.recover.shading import shading_of
from rangecheck.scan import RangeScan
from rangecheck.scan.decode import Capture, View, decode_gray_code, read_capture
from rangecheck.studies.bust_scans import real_data
from rangecheck.study import Line, LineChart

_STEP, _SHADED_STEP, _SEED, _APART_MM = 2, 3, 20, 25.0
#: dents (depth, radius) and steps, mm
_DENTS = ((1.0, 8.0), (1.0, 4.0), (0.5, 8.0), (0.25, 8.0))
_STEPS = (0.3, 0.2)
#: seeds of places held out, as many each as of the others
_HELD_OUT = (77201, 77202, 77203, 77204)
_FACING, _NORMALS_MM = 0.3, 2.0


def dented(scan: RangeScan, centre_mm: FloatArray, depth_mm: float, radius_mm: float) -> RangeScan:
    """The scan with a dent, a raised cosine in range, about a place of its own frame."""
    apart = np.linalg.norm(scan.grid_points_mm - centre_mm, axis=-1) / radius_mm
    deeper = np.where(apart < 1.0, 0.5 * depth_mm * (1.0 + np.cos(math.pi * np.minimum(apart, 1.0))), 0.0)
    return replace(scan, range_mm=(scan.range_mm + deeper).astype(np.float32))


def stepped(scan: RangeScan, centre_mm: FloatArray, angle: float, step_mm: float) -> RangeScan:
    """The scan with all that lies on one side of a line through a place further away."""
    beyond = along(scan.grid_points_mm, centre_mm, angle) > 0.0
    return replace(scan, range_mm=(scan.range_mm + np.where(beyond, step_mm, 0.0)).astype(np.float32))


def along(points: FloatArray, centre_mm: FloatArray, angle: float) -> FloatArray:
    """Distance (signed, mm, across the view) from the line through a place."""
    from_centre = points[..., :2] - centre_mm[:2]
    return np.asarray(math.cos(angle) * from_centre[..., 0] + math.sin(angle) * from_centre[..., 1])


def alexander_pair(capture: Capture, *, swapped: bool = False) -> tuple[RangeScan, FloatArray, View]:
    """The decoded scan on the left camera's grid with its picture, the right camera's picture, both linear in light, and that camera; or, `swapped`, the right
    camera's scan with the left picture."""
    assert capture.right is not None and capture.right_view is not None
    first, second = (capture.left, capture.left_view), (capture.right, capture.right_view)
    if swapped:
        first, second = second, first
    scan = decode_gray_code(*first, *second, name="swapped" if swapped else "alexander").scan
    assert scan.brightness is not None
    sensor = Sensor(bits=0, response="srgb")
    linear = replace(scan, brightness=sensor.linearise(scan.brightness).astype(np.float32))
    return linear, sensor.linearise(second[0].white / second[0].full_scale), second[1]


def places_of(scan: RangeScan, found: Agreement, count: int, seed: int) -> FloatArray:
    """(k, 3) judged places of the scan, drawn from a seed, at least _APART_MM apart and a dent's radius inside what is judged."""
    from scipy.ndimage import distance_transform_edt

    inside = distance_transform_edt(np.isfinite(found.offset_mm)) * found.spacing_mm
    return drawn(scan_grid(scan, found.step).points, np.isfinite(found.jump_mm) & (inside > DISC_MM), count, seed)


def drawn(points: FloatArray, among: BoolArray, count: int, seed: int) -> FloatArray:
    """(k, 3) of the points (h, w, 3) of the cells `among` (h, w), drawn from a seed, at least _APART_MM apart."""
    cells = np.argwhere(among)
    chosen: list[FloatArray] = []
    for row, column in np.random.default_rng(seed).permutation(cells):
        place = points[row, column]
        if all(np.linalg.norm(place - other) > _APART_MM for other in chosen):
            chosen.append(place)
        if len(chosen) == count:
            break
    return np.array(chosen)


def shading_explained(scan: RangeScan) -> tuple[Fitted, FloatArray, dict[str, float]]:
    """Material and lamp on the scan's own surface; (h, w) ln seen/predicted; spreads (robust) of picture, of the prediction and of what is left in
    the scale of a dent, 4 to 12 mm."""
    grid: ScanGrid = scan_grid(scan, _SHADED_STEP)
    normals = normals_at(grid, _NORMALS_MM)
    facing = np.nan_to_num(-(normals * grid.rays).sum(-1))
    cell = np.flatnonzero(np.isfinite(normals).all(axis=-1) & (facing > _FACING))
    chosen = normals.reshape(-1, 3)[cell]
    fitted = lamp_of(grid, cell, chosen)
    shown = np.full(grid.valid.size, np.nan)
    shown[cell] = shading_of(fitted, grid, cell).at(chosen)[0]
    predicted: FloatArray = shown.reshape(grid.valid.shape)
    known = (np.nan_to_num(predicted) > 0.0) & (np.nan_to_num(grid.picture) > 0.0)
    logs = {"picture": grid.picture, "shading": predicted}
    bands = {}
    for name, values in logs.items():
        level = np.log(np.where(known, values, 1.0))
        fine, broad = (masked_gauss(level, known.astype(float), mm / grid.spacing_mm) for mm in (2.0, 6.0))
        bands[name] = (fine - broad)[known]
    bands["left"] = bands["picture"] - bands["shading"]
    spreads = {name: float(np.median(np.abs(v)) / 0.6744897501960817) for name, v in bands.items()}
    return fitted, np.where(known, np.log(np.where(known, grid.picture, 1.0) / np.where(known, predicted, 1.0)), np.nan), spreads


def _shares(found: Dents) -> str:
    return ", ".join(f"{100 * share:.0f} % (radius {radius:g} mm)" for share, radius in zip(found.judged, RADII_MM))


def _dents_named(
    scan: RangeScan, right: FloatArray, view: View, points: FloatArray, sets: list[FloatArray], depth: float, radius: float
) -> tuple[float, str, list[dict[str, Any]]]:
    """Share named of dents planted in copies of the scan, one for each set of places (k, 3), told of in words, and row by row."""
    rows: list[dict[str, Any]] = []
    elsewhere = 0
    for places in sets:
        planted = scan
        for place in places:
            planted = dented(planted, place, depth, radius)
        found = second_view(planted, right, view, step=_STEP)
        others = list(found.regions)
        for place in places:
            here = [r for r in found.regions if np.linalg.norm(points[r.cell] - place) < radius + DISC_MM]
            others = [r for r in others if r not in here]
            rows.append(
                {"planted": "dent", "depth_mm": depth, "radius_mm": radius, "place_mm": place, "named": [vars(r) for r in here]}
            )
        elsewhere += len(others)
    named, count = sum(bool(row["named"]) for row in rows), len(rows)
    kinds = [region["kind"] for row in rows for region in row["named"]]
    return (
        named / max(1, count),
        (
            f"dents {depth:g} mm deep, radius {radius:g} mm: {named} of {count} named ({kinds.count('shape')} of {len(kinds)} regions as shape); "
            f"{elsewhere} places named elsewhere"
        ),
        rows,
    )


def _swapped(capture: Capture, quick: bool) -> tuple[list[str], list[dict[str, Any]]]:
    """The same with the cameras' roles swapped: other cells, gaps and highlights, and another picture that judges."""
    scan, left, view = alexander_pair(capture, swapped=True)
    clean = second_view(scan, left, view, step=_STEP)
    largest = np.nanmax(clean.dents.z, initial=0.0)
    findings = [
        f"roles of the cameras swapped: {len(clean.regions)} places named on the unaltered scan, the largest z of a dent is {largest:.2f} ({clean.dents.level:.2f} is "
        f"named); {100 * clean.judged:.0f} % judged for steps, dents of {JUDGED_MM:g} mm on {_shares(clean.dents)} of it"
    ]
    rows: list[dict[str, Any]] = [{"planted": "nothing", "swapped": True, "named": [vars(r) for r in clean.regions]}]
    points = scan_grid(scan, _STEP).points
    for depth, radius in _DENTS[:1] if quick else _DENTS[:2]:
        among = clean.dents.judges[RADII_MM.index(radius)]
        sets = [drawn(points, among, 3 if quick else 6, seed) for seed in _HELD_OUT[: 1 if quick else 2]]
        _, said, more = _dents_named(scan, left, view, points, sets, depth, radius)
        findings.append(f"roles swapped, in {len(sets)} scans: {said}")
        rows += [row | {"swapped": True} for row in more]
    return findings, rows


def alexander(quick: bool) -> tuple[list[Any], list[str], list[dict[str, Any]], dict[str, bytes]]:
    """The part `alexander` of the study `fit`."""
    capture = read_capture(real_data("alexander_bust"))
    scan, right, view = alexander_pair(capture)
    fitted, residual, spreads = shading_explained(scan)
    light = fitted.problem.lights[0]
    towards = ", ".join(f"{v:.3f}" for v in light.direction)
    shaded = compare(scan, step=_SHADED_STEP)
    shown = shaded.least_mm[np.isfinite(shaded.least_mm)]
    clean = second_view(scan, right, view, step=_STEP)
    points = scan_grid(scan, _STEP).points
    findings = [
        f"left picture: lamp towards {towards} (scan's frame), {light.distance_mm:.3g} mm away, K_lm {fitted.problem.material.K_lm:.3f}, K_lobe "
        f"{fitted.problem.material.K_lobe:.3f}",
        f"in structures of a dent's size the picture varies by {100 * spreads['picture']:.1f} %, the fitted shading by {100 * spreads['shading']:.1f} %, what is left by "
        f"{100 * spreads['left']:.1f} %: paint hides shape from shading alone",
        f"by shading {100 * shaded.judged:.0f} % of the scan could be judged to 1 mm: there dents of {np.median(shown) if shown.size else math.nan:.2f} mm (median) "
        f"would be named, from {shaded.level:.1f} sigma; {len(shaded.regions)} places named",
        f"second view: {100 * clean.judged:.0f} % of the scan judged, noise of a jump {clean.noise_mm:.3f} mm, named from {clean.level_mm:.3f} mm",
        f"dents of {JUDGED_MM:g} mm: {_shares(clean.dents)} of the scan judged; amounts of {clean.dents.spread_mm:.3f} mm (one deviation) are found everywhere, z "
        f"is named from {clean.dents.level:.2f}, the largest of the unaltered scan is {np.nanmax(clean.dents.z):.2f}",
        f"unaltered scan: {len(clean.regions)} places named of {clean.places} discs of {DISC_MM:g} mm radius judged for steps and of "
        + ", ".join(f"{n} of {r:g} mm" for n, r in zip(clean.dents.places, RADII_MM))
        + " for dents",
    ]
    rows: list[dict[str, Any]] = [{"planted": "nothing", "named": [vars(r) for r in clean.regions]}]
    places = places_of(scan, clean, 3 if quick else 6, _SEED)
    shares: list[float] = []
    for depth, radius in _DENTS[:1] if quick else _DENTS:
        share, said, more = _dents_named(scan, right, view, points, [places], depth, radius)
        shares.append(share)
        findings.append(said)
        rows += more
    for depth, radius in () if quick else _DENTS[:2]:
        among = clean.dents.judges[RADII_MM.index(radius)]
        held_out = [drawn(points, among, len(places), seed) for seed in _HELD_OUT]
        _, said, more = _dents_named(scan, right, view, points, held_out, depth, radius)
        findings.append(f"held out, in {len(held_out)} scans: {said}")
        rows += [row | {"held_out": True} for row in more]
    rng = np.random.default_rng(_SEED)
    for step in _STEPS[:1] if quick else _STEPS:
        named = as_step = elsewhere = 0
        for place in places:
            angle = float(rng.uniform(0.0, math.pi))
            found = second_view(stepped(scan, place, angle, step), right, view, step=_STEP)
            on = [r for r in found.regions if abs(along(points[r.cell], place, angle)) < DISC_MM + WINDOW_MM]
            named += bool(on)
            as_step += any(r.kind == "registration" for r in on)
            elsewhere += len(found.regions) - len(on)
            rows.append(
                {"planted": "step", "step_mm": step, "angle": angle, "place_mm": place, "named": [vars(r) for r in found.regions]}
            )
        findings.append(
            f"registration steps of {step:g} mm: {named} of {len(places)} named on their line, {as_step} with a region classed as registration; {elsewhere} "
            f"places named elsewhere, in {len(places)} scans"
        )
    told, more = _swapped(capture, quick)
    findings += told
    rows += more
    depths = [d for d, r in _DENTS if r == _DENTS[0][1]]
    of = [share for share, (_, r) in zip(shares, _DENTS) if r == _DENTS[0][1]]
    chart = LineChart(
        "dents", f"Dents of {_DENTS[0][1]:g} mm radius named, by depth", "depth, mm", "share named",
        [Line("second view", depths[: len(of)], of, True)],
    )  # fmt: skip
    pictures = {
        "residual": png_bytes(coloured_map(residual, "Brightness, seen over predicted", "ln", low=-1.0, high=1.0)),
        "offset": png_bytes(coloured_map(clean.offset_mm, "Range by the second picture", "mm", low=-0.5, high=0.5)),
    }
    return [chart], findings, rows, pictures
