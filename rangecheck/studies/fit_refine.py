"""Shape refined by shading, against truth: slopes and heights of the sample bust's scans before and after, clean and painted.

The sample range finder (0.2 mm of noise, 640 x 480) sees the bust from four sides; its picture has 1 % of full scale of Gaussian noise. Errors of slope are
angles to the true normal. Slopes of all cells are differences to their neighbours on the same surface, which truth tells (`slopes`): a difference across a
depth step is no slope. The cells are those between four that returned, and, told apart, those at rims too. Beside them stand central differences whatever lies
between the neighbours, of the same cells, and of those whose neighbours the ranges themselves put on one surface. Where folds are as narrow as cells even the true ranges' differences miss the true normals: by how much is said too.
Heights are compared in windows of 16 x 16 cells, wherever a quarter of them is measured: the rms error of such a window, 64 to 256 cells, scatters by 9 to 4 %
by itself, and after over before by less, as both share some noise. The seeds are none that the method was made on.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.errors import ScanError
from rangecheck.recover.refine import Refined, linked, refine
from rangecheck.scan import RangeScan
from rangecheck.scan.sample import CAMERA, FINDER, TARGET_MM
from rangecheck.scan.simulate import Finish, SimulatedScan, ring_of_poses, simulate_scan
from rangecheck.studies.slopes import one_surface, surface_slope_errors_deg
from rangecheck.study import Line, LineChart

#: share of light that the bust gives back, and noise of its picture
ALBEDO, PICTURE_NOISE = 0.7, 0.01
_WINDOW = 16
_FRESH = 99700


def bust_picture(azimuth_deg: float, seed: int, *, spots: int = 0, step: int = 1) -> tuple[SimulatedScan, RangeScan]:
    """A view of the sample bust with its truth, and the scan with a noisy picture; `spots` round spots of darker paint, 6 to 15 mm in radius.

    step: only every step-th pixel along both sides."""
    from rangecheck.raycast.implicit import ImplicitCaster

    camera = replace(
        CAMERA, width=CAMERA.width // step, height=CAMERA.height // step, fx=CAMERA.fx / step, fy=CAMERA.fy / step, cx=CAMERA.cx / step,
        cy=CAMERA.cy / step,
    )  # fmt: skip
    pose = ring_of_poses(1, FINDER.working_distance_mm, target_mm=TARGET_MM, first_deg=azimuth_deg)[0]
    made = simulate_scan(
        ImplicitCaster.of_bust(), camera, pose, FINDER, seed, with_brightness=True, name="bust", finish=Finish(diffuse=ALBEDO)
    )
    assert made.scan.brightness is not None
    rng = np.random.default_rng(seed)
    bright = made.scan.brightness.astype(np.float64)
    points = made.scan.grid_points_mm
    for _ in range(spots):
        x, y, radius, paint = rng.normal(0.0, 60.0), rng.normal(0.0, 90.0), rng.uniform(6.0, 15.0), rng.uniform(0.4, 0.85)
        bright = np.where(np.hypot(points[..., 0] - x, points[..., 1] - y) < radius, paint * bright, bright)
    noisy = np.clip(bright + rng.normal(0.0, PICTURE_NOISE, bright.shape), 0.0, 1.0)
    return made, replace(made.scan, brightness=noisy.astype(np.float32))


def slope_errors_deg(scan: RangeScan, made: SimulatedScan) -> FloatArray:
    """(h, w) angle between the grid's normals by central differences and the true ones, NaN where either is missing."""
    points = scan.grid_points_mm
    u, v = np.full(points.shape, np.nan), np.full(points.shape, np.nan)
    u[:, 1:-1], v[1:-1] = points[:, 2:] - points[:, :-2], points[2:] - points[:-2]
    normals = np.cross(v, u)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    truth = made.true_normal @ scan.world_from_scan[:3, :3]
    return np.asarray(np.degrees(np.arccos(np.clip((normals * truth).sum(-1), -1.0, 1.0))))


def window_ratios(before: FloatArray, after: FloatArray) -> FloatArray:
    """(k,) rms of height errors after over before, window by window."""
    known = np.isfinite(before) & np.isfinite(after)
    found = []
    for row in range(0, before.shape[0] - _WINDOW + 1, _WINDOW):
        for column in range(0, before.shape[1] - _WINDOW + 1, _WINDOW):
            here = (slice(row, row + _WINDOW), slice(column, column + _WINDOW))
            if known[here].sum() >= _WINDOW**2 // 4:
                found.append(_rms(after[here][known[here]]) / _rms(before[here][known[here]]))
    return np.array(found)


def judged(made: SimulatedScan, scan: RangeScan, refined: Refined, joined: tuple[BoolArray, BoolArray]) -> dict[str, float]:
    """Errors before and after, each beside the true ranges' own: slopes on the own surface, of which `joined` tells, of all cells between four ("own") and of
    those at rims too ("rims"); central differences of all cells between four, of those on one surface with their neighbours and of those that the picture
    refined; heights; the worst and the middle window."""
    exact = replace(scan, range_mm=np.where(scan.valid, made.true_range_mm, np.nan).astype(np.float32))
    taken = {"before": scan, "after": refined.scan, "exact": exact}
    errors = {when: slope_errors_deg(one, made) for when, one in taken.items()}
    on_own = {when: surface_slope_errors_deg(one, made, joined) for when, one in taken.items()}
    known = np.isfinite(errors["before"]) & np.isfinite(errors["after"])
    chosen = {"all": known, "surface": known & linked(scan, refined.noise_mm), "refined": known & refined.refined}
    high, low = scan.range_mm - made.true_range_mm, refined.scan.range_mm - made.true_range_mm
    both = np.isfinite(high) & np.isfinite(low)
    ratios = window_ratios(high, low)
    slopes = {
        f"{name}_{when}_deg": _rms(error[which]) if which.any() else math.nan
        for name, which in chosen.items() for when, error in errors.items()
    }  # fmt: skip
    rims = np.isfinite(on_own["before"]) & np.isfinite(on_own["after"])
    slopes |= {
        f"{name}_{when}_deg": _rms(error[which]) for name, which in (("own", rims & known), ("rims", rims)) for when, error in on_own.items()
    }  # fmt: skip
    slopes |= {"own_cells": int((rims & known).sum()), "rims_cells": int(rims.sum())}
    return slopes | {
        "cells": int(chosen["refined"].sum()), "height_before_mm": _rms(high[both]), "height_after_mm": _rms(low[both]),
        "worst_window": float(ratios.max()), "middle_window": float(np.median(ratios)), "windows": len(ratios),
        "windows_worse": int((ratios > 1.05).sum()),
    }  # fmt: skip


def _rms(values: FloatArray) -> float:
    return math.sqrt(float((values**2).mean()))


def refinement(quick: bool) -> tuple[list[Any], list[str], list[dict[str, Any]]]:
    """The part `refine` of the study `fit`."""
    from rangecheck.raycast.implicit import ImplicitCaster

    step = 2 if quick else 1
    cases = [(20.0, 0), (20.0, 3)] if quick else [(20.0, 0), (20.0, 3), (20.0, 40), (-60.0, 0), (100.0, 0), (250.0, 0)]
    rows: list[dict[str, Any]] = []
    findings: list[str] = []
    for azimuth, spots in cases:
        made, scan = bust_picture(azimuth, round(_FRESH + azimuth), spots=spots, step=step)
        name = f"{azimuth:g} degrees, {spots if spots else 'no'} painted spots"
        row: dict[str, Any] = {"azimuth_deg": azimuth, "spots": spots, "cells_of_scan": int(scan.valid.sum())}
        try:
            refined = refine(scan)
        except ScanError as refusal:
            rows.append(row | {"refused": str(refusal)})
            findings.append(f"{name}: refused; {refusal}")
            continue
        alone = refine(scan, use_picture=False)
        joined = one_surface(made, ImplicitCaster.of_bust())
        numbers, without = judged(made, scan, refined, joined), judged(made, scan, alone, joined)
        rows.append(row | numbers | {"without_picture_deg": without["surface_after_deg"]})
        findings += [
            f"{name}: slope error on the own surface {_told(numbers, 'own')}, of the {100 * numbers['own_cells'] / scan.valid.sum():.0f} % between four that returned; "
            f"of {100 * numbers['rims_cells'] / scan.valid.sum():.0f} %, rims and all, {_told(numbers, 'rims')}",
            f"  central differences: of cells on one surface with their neighbours {_told(numbers, 'surface')}, without the picture times "
            f"{without['surface_after_deg'] / numbers['surface_before_deg']:.3f}; of all cells, steps and all, {_told(numbers, 'all')}; of the "
            f"{100 * numbers['cells'] / scan.valid.sum():.0f} % that the picture refined {_told(numbers, 'refined')}",
            f"  heights {numbers['height_before_mm']:.4f} to {numbers['height_after_mm']:.4f} mm rms; of {numbers['windows']} windows "
            f"{numbers['windows_worse']} are worse by more than 5 %, the worst is times {numbers['worst_window']:.3f}, the middle one "
            f"{numbers['middle_window']:.3f}",
        ]
    kept = [row for row in rows if "refused" not in row]
    cases_shown = list(range(len(kept)))
    lines = [
        Line(label, cases_shown, [r[f"{key}_{when}_deg"] / r[f"{key}_before_deg"] for r in kept], True)
        for label, key, when in (
            ("slopes on the own surface", "own", "after"), ("rims and all", "rims", "after"), ("of the true ranges", "own", "exact"),
            ("central differences, steps and all", "all", "after"),
        )
    ]  # fmt: skip
    lines.append(Line("worst window of heights", cases_shown, [r["worst_window"] for r in kept], True))
    chart = LineChart(
        "refine", "Errors that refinement by shading leaves, views of the sample bust", "view, azimuth in degrees",
        "rms error after refinement over before", lines, level=0.5, level_name="half", names=[f"{r['azimuth_deg']:g}, {r['spots'] or 'no'} spots of paint" for r in kept],
        note="a window of heights above 1 got worse",
    )  # fmt: skip
    return [chart], findings, rows


def _told(numbers: dict[str, float], key: str) -> str:
    before, after, exact = (numbers[f"{key}_{when}_deg"] for when in ("before", "after", "exact"))
    return f"{before:.2f} to {after:.2f} degrees rms (times {after / before:.3f}; differences of the true ranges {exact / before:.3f})"
