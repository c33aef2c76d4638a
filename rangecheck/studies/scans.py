"""Scans as they come in: how long reading takes, and what structured light makes of real pictures, beside another program's points."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rangecheck.errors import InputError
from rangecheck.optics import PinholeCamera
from rangecheck.scan import RangeScan
from rangecheck.scan.readers import read_measured, read_scans, write_scans
from rangecheck.studies.bust_scans import real_data
from rangecheck.study import Part, study_of_parts

SIDE, REPEATS = 2048, 9


def _median_s(read: Callable[[], object], repeats: int) -> float:
    """Seconds, after one reading that does not count: kernels are loaded and files are in memory."""
    read()
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        read()
        taken.append(time.perf_counter() - begin)
    return statistics.median(taken)


def _relief(side: int) -> RangeScan:
    """A ball before nothing, with noise: four of five cells hold a distance."""
    camera = PinholeCamera(side, side, 1.2 * side, 1.2 * side, 0.5 * (side - 1), 0.5 * (side - 1))
    y, x = np.mgrid[0:side, 0:side] / (0.5 * side) - 1.0
    away = x * x + y * y
    depth = 600.0 - 150.0 * np.sqrt(np.clip(1.0 - away, 0.0, 1.0)) + np.random.default_rng(0).normal(0.0, 0.05, away.shape)
    depth[away > 1.0] = np.nan
    return RangeScan((depth / camera.pixel_rays()[1][..., 2]).astype(np.float32), camera, name="relief")


def reading(quick: bool) -> Part:
    """A depth picture of 2048 x 2048, and the ten scans of the bunny."""
    side, repeats = (512, 3) if quick else (SIDE, REPEATS)
    with tempfile.TemporaryDirectory() as folder:
        manifest = write_scans(Path(folder), [_relief(side)], step_mm=0.02)
        rows = [{"what": f"depth PNG of {side} x {side}", "seconds": _median_s(lambda: read_scans(manifest), repeats)}]
    try:
        bunny = real_data("stanford_bunny") / "bun.conf"
        rows.append({"what": "the bunny's ten scans", "seconds": _median_s(lambda: read_scans(bunny, "m"), min(repeats, 3))})
    except InputError as error:
        rows.append({"what": f"the bunny's ten scans: {error}", "seconds": None})
    said = [f"{row['what']}: {row['seconds']:.3f} s (median)" if row["seconds"] else f"{row['what']}" for row in rows]
    return Part(findings=said, tables={"reading": rows})


def alexander(quick: bool) -> Part:
    """The painted bust, from its pictures, beside the points that another program made of them."""
    from scipy.spatial import cKDTree

    from rangecheck.scan.decode import decode_gray_code, read_capture

    try:
        folder = real_data("alexander_bust")
    except InputError as error:
        return Part(findings=[f"alexander: not measured; {error}"])
    found = decode_gray_code(*read_capture(folder)[:4])
    (reference,) = read_measured(folder / "reference_cloud.obj", "mm")
    points = found.scan.points_mm()[:: 100 if quick else 5]
    away, _ = cKDTree(reference.points_mm).query(points)
    row = {
        "valid": int(found.scan.valid.sum()), "measured": found.measured, "interpolated": found.counts()["interpolated"], "cells": found.cells,
        "reprojection_px": float(np.nanmedian(found.both_px)), "median_mm": float(np.median(away)), "p90_mm": float(np.quantile(away, 0.9)),
    }  # fmt: skip
    finding = (
        f"Alexander: {row['valid']:,} points on the left grid, {row['measured']:,} measured and {row['interpolated']:,} interpolated, from "
        f"{row['cells']:,} projector cells; reprojection {row['reprojection_px']:.2f} px (median); to the other program's points "
        f"{row['median_mm']:.3f} mm (median), {row['p90_mm']:.3f} mm (90 %)"
    )
    return Part(findings=[finding, *(f"lost: {what}" for what in found.lost)], tables={"alexander": [row]})


_PARTS = {"reading": reading, "alexander": alexander}
PARTS = tuple(_PARTS)
study = study_of_parts("scans", "Scans as they come in: reading and structured light", _PARTS)
