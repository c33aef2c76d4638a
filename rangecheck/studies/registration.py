"""Registration: error and time by overlap, initial misalignment and noise, and the edges of the basin from which scans come back.

Scans of the sample bust at known poses are shaken and aligned. The error of a scan is the median distance of its points from where the
truth puts them. A refusal is not an error but an answer; a scan called aligned that lies farther off than half its sample spacing is
silently wrong, and is counted. Millimetres and degrees.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np

from rangecheck import rigid
from rangecheck.arrays import FloatArray
from rangecheck.errors import InputError
from rangecheck.scan import RangeScan
from rangecheck.scan.registration import register
from rangecheck.scan.registration.result import Guess, Registration
from rangecheck.studies.bust_scans import bust_ring, real_data
from rangecheck.study import EdgeChart, Line, LineChart, Part, find_edge, study_of_parts
from rangecheck.surface.meshing.oriented import spacing_of

#: views of a full ring, and cells along the width of each, in the studies of one knob
VIEWS, WIDTH = 8, 320
NOISE_MM = 0.2
#: degrees of misalignment that go with a millimetre of it: the edge of a bust of 150 mm radius then moves about as far
DEGREES_PER_MM = 1.0


def shaken(scans: Sequence[RangeScan], mm: float, deg: float, seed: int) -> list[RangeScan]:
    """All scans but the first, shifted by `mm` and turned by `deg` about their middles in directions drawn from `seed`."""
    rng = np.random.default_rng(seed)
    result = list(scans[:1])
    for scan in scans[1:]:
        middle = scan.points_mm().mean(axis=0)
        shift = rng.normal(size=3)
        turn = rigid.about_axis(rng.normal(size=3), math.radians(deg))
        turn[:3, 3] = middle + mm * shift / np.linalg.norm(shift) - turn[:3, :3] @ middle
        result.append(scan.moved(turn @ scan.world_from_scan))
    return result


def strays_mm(result: Registration, truth: Sequence[RangeScan]) -> FloatArray:
    """(n,) for each scan the median distance of its points from the truth, after an aligned scan is laid on its truth; NaN: refused."""
    kept = [k for k, state in enumerate(result.states) if state.aligned]
    strays = np.full(len(truth), np.nan)
    if not kept:
        return strays
    back = truth[kept[0]].world_from_scan @ rigid.inverse(result.scans[kept[0]].world_from_scan)
    for k in kept:
        apart = rigid.move_points(back, result.scans[k].points_mm()) - truth[k].points_mm()
        strays[k] = np.median(np.linalg.norm(apart, axis=1))
    return strays


def tried(scans: Sequence[RangeScan], truth: Sequence[RangeScan], guess: Guess, seed: int = 1) -> dict[str, Any]:
    """One registration against the truth, from the guess alone, with its time and the number of scans called aligned that are not."""
    begin = time.perf_counter()
    result = register(scans, guess=guess, seed=seed, rescue=False)
    seconds = time.perf_counter() - begin
    strays = strays_mm(result, truth)
    limit = 0.5 * spacing_of(truth)
    known = strays[np.isfinite(strays)]
    return {
        "verdict": result.verdict, "aligned": len(known), "scans": len(truth), "seconds": seconds,
        "median_mm": float(np.median(known)) if len(known) else math.nan, "largest_mm": float(known.max(initial=0.0)),
        "silently_wrong": int((known > limit).sum()), "residual_mm": result.residual_mm,
        "expected_mm": float(np.median([s.pose_error_mm for s in result.states if s.aligned] or [math.nan])),
    }  # fmt: skip


@lru_cache(maxsize=8)
def _ring(views: int, width: int, noise_mm: float) -> tuple[RangeScan, ...]:
    return tuple(bust_ring(views, width=width, noise_mm=noise_mm, step_mm=noise_mm / 10))


@lru_cache(maxsize=256)
def _misaligned(mm: float, width: int, noise_mm: float, seed: int) -> dict[str, Any]:
    truth = _ring(VIEWS, width, noise_mm)
    return tried(shaken(truth, mm, DEGREES_PER_MM * mm, seed), truth, "poses")


def misalignment(quick: bool) -> Part:
    """Error and time against how far the poses given are off, and the edge of the basin."""
    width = 200 if quick else WIDTH
    amounts = (2.0, 20.0) if quick else (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0)
    rows = [{"misaligned_mm": mm, "misaligned_deg": DEGREES_PER_MM * mm, **_misaligned(mm, width, NOISE_MM, 1)} for mm in amounts]
    edge = find_edge("poses as the guess", partial(_not_back, width=width, seed=1), 1.0, 150.0, 0.5, logarithmic=True,
                     samples=2 if quick else 6, tolerance=0.5 if quick else 0.08)  # fmt: skip
    lines = [
        Line("median error, mm", amounts, [r["median_mm"] for r in rows], marked=True),
        Line("time, s", amounts, [r["seconds"] for r in rows], marked=True),
    ]
    chart = LineChart("misalignment", f"Registration of {VIEWS} scans of the bust", f"misalignment, mm (and {DEGREES_PER_MM:g} degree each)",
                      "mm, and s", lines, log="xy")  # fmt: skip
    basin = EdgeChart("basin", "Where poses are no longer found from the guess given", "misalignment, mm and degrees",
                      "share of scans not brought back", [edge], log="x")  # fmt: skip
    findings = [_said(f"{r['misaligned_mm']:g} mm and {r['misaligned_deg']:g} degrees off", r) for r in rows]
    words = (
        "holds throughout"
        if edge.breaks_at is None
        else f"more than half are not brought back from {edge.breaks_at:.3g} mm and degrees on"
    )
    return Part([chart, basin], [*findings, f"basin: {words}", _silence(rows)], {"misalignment": rows})


def _not_back(mm: float, *, width: int, seed: int) -> float:
    row = _misaligned(mm, width, NOISE_MM, seed)
    return 1.0 - (row["aligned"] - row["silently_wrong"]) / row["scans"]


def overlap(quick: bool) -> Part:
    """Two views at a growing angle: error, time, verdict, and the angle at which they are no longer aligned."""
    width = 200 if quick else WIDTH
    angles = (30.0, 90.0) if quick else (15.0, 30.0, 45.0, 60.0, 75.0, 90.0, 105.0)
    rows = []
    for angle in angles:
        truth = _two(angle, width)
        rows.append({"angle_deg": angle, "overlap": _shared(truth), **tried(shaken(truth, 3.0, 3.0, 1), truth, "poses")})
    edge = find_edge("two views", partial(_apart, width), 10.0, 130.0, 0.5, samples=2 if quick else 6, tolerance=0.03)
    lines = [
        Line(
            "median error, mm",
            [r["overlap"] for r in rows],
            [r["median_mm"] if r["aligned"] == 2 else math.nan for r in rows],
            marked=True,
        )
    ]
    chart = LineChart(
        "overlap",
        "Registration of two views by their overlap",
        "share of points that the other view confirms",
        "mm",
        lines,
        log="y",
    )
    findings = [_said(f"{r['angle_deg']:g} degrees apart, {100 * r['overlap']:.0f} % in common", r) for r in rows]
    words = (
        "never"
        if edge.breaks_at is None
        else f"at {edge.breaks_at:.0f} degrees, {100 * _shared(_two(edge.breaks_at, width)):.0f} % in common"
    )
    return Part([chart], [*findings, f"two views are no longer aligned: {words}", _silence(rows)], {"overlap": rows})


@lru_cache(maxsize=64)
def _two(angle_deg: float, width: int) -> tuple[RangeScan, ...]:
    """Two level views of the bust, `angle_deg` apart."""
    from rangecheck.studies.bust_scans import bust_views

    return tuple(bust_views((0.0, angle_deg), width=width))


def _shared(truth: Sequence[RangeScan]) -> float:
    from rangecheck.scan.registration.decide import judge_all
    from rangecheck.scan.registration.evidence import Rules
    from rangecheck.scan.registration.samples import samples_of

    [(pair, _, _)] = judge_all([samples_of(s) for s in truth], [s.world_from_scan for s in truth], Rules()).values()
    return pair.overlap


def _apart(width: int, angle_deg: float) -> float:
    truth = _two(angle_deg, width)
    row = tried(shaken(truth, 3.0, 3.0, 1), truth, "poses")
    return 1.0 - (row["aligned"] - row["silently_wrong"]) / 2


def noise(quick: bool) -> Part:
    """Error and time against noise."""
    width = 200 if quick else WIDTH
    amounts = (0.2,) if quick else (0.05, 0.2, 0.8, 3.2)
    rows = [{"noise_mm": n, **_misaligned(5.0, width, n, 1)} for n in amounts]
    lines = [Line("median error, mm", amounts, [r["median_mm"] for r in rows], marked=True)]
    chart = LineChart("noise", f"Registration of {VIEWS} scans by their noise", "noise, mm", "mm", lines, log="xy")
    return Part([chart], [*(_said(f"noise {r['noise_mm']:g} mm", r) for r in rows), _silence(rows)], {"noise": rows})


def unknown(quick: bool) -> Part:
    """No poses at all: the ring of eight views, all at one pose."""
    truth = _ring(VIEWS, 200 if quick else WIDTH, NOISE_MM)
    row = {"subject": "sample bust", **tried([s.moved(rigid.identity()) for s in truth], truth, "none")}
    return Part(findings=[_said("no poses, sample bust", row), _silence([row])], tables={"unknown": [row]})


def bunny(quick: bool) -> Part:
    """The ten scans of the Stanford bunny, 5 mm and 5 degrees off and without any poses; truth is its published poses."""
    from rangecheck.scan.readers import read_scans

    try:
        folder = real_data("stanford_bunny")
    except InputError as error:
        return Part(findings=[f"bunny: not measured; {error}"])
    begin = time.perf_counter()
    truth = read_scans(folder / "bun.conf", unit="m")
    reading = time.perf_counter() - begin
    rows = [{"subject": "bunny, 5 mm and 5 degrees off", **tried(shaken(truth, 5.0, 5.0, 1), truth, "poses")}]
    if not quick:
        rows.append({"subject": "bunny, no poses", **tried([s.moved(rigid.identity()) for s in truth], truth, "none")})
    findings = [f"reading the bunny's ten scans takes {reading:.2f} s", *(_said(r["subject"], r) for r in rows)]
    return Part(findings=findings, tables={"bunny": rows})


def _said(what: str, row: dict[str, Any]) -> str:
    return (
        f"{what}: {row['verdict']}, {row['aligned']} of {row['scans']} scans, median error {row['median_mm']:.3f} mm, largest {row['largest_mm']:.3f} "
        f"(expected: {row['expected_mm']:.3f}), {row['seconds']:.1f} s"
    )


def _silence(rows: Sequence[dict[str, Any]]) -> str:
    return f"silently wrong poses: {sum(r['silently_wrong'] for r in rows)} of {sum(r['aligned'] for r in rows)} called aligned"


_PARTS = {"overlap": overlap, "misalignment": misalignment, "noise": noise, "unknown": unknown, "bunny": bunny}
PARTS = tuple(_PARTS)
study = study_of_parts("registration", "Registration: error, time, and the edges of its basin", _PARTS)
