"""What scans are worth before anything is made of them: sampling, noise, obliquity, overlap, what was never seen, and the next view.

`assess` measures; a `Profile` says what is asked for; every finding carries the number, its limit and what mends it. World frame,
millimetres. Figures "at the print" are scaled by the profile's height over the object's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from rangecheck import rigid
from rangecheck.arrays import FloatArray, IntArray, require, unit_vectors
from rangecheck.errors import ScanError, SettingError
from rangecheck.kernels import in_chunks
from rangecheck.scan.quality_expected import expected
from rangecheck.scan.quality_space import (
    Gap,
    NextView,
    Shell,
    Space,
    angles_deg,
    carve,
    directions,
    gaps_of,
    shell_of,
    upright_frame,
    views_from,
)  # fmt: skip
from rangecheck.scan.quality_sphere import LETTERS_SHAPE, counted, in_letters, legend
from rangecheck.scan.range_scan import RangeScan
from rangecheck.scan.registration.decide import judge_all
from rangecheck.scan.registration.evidence import Pair, Rules
from rangecheck.scan.registration.samples import Samples, facing, samples_of

#: angle between normal and line of sight beyond which a reading counts as grazing
GRAZING_DEG = 60.0
#: directions that coverage is counted in (a cell is 4.5 degrees wide) and that the next view is chosen from
_COVERAGE, _CANDIDATES = 2048, 400
#: overlap with what is known that a next view should have, so that it can be aligned
_TO_ALIGN = 0.25
#: heights of what range finders are pointed at; outside, the unit is in doubt
LIKELY_MM = (5.0, 20_000.0)
#: gaps whose places a remark keeps, the largest first
_PLACES = 20


@dataclass(frozen=True)
class Profile:
    """What a print asks of its scans.

    height_mm, layer_mm  of the print
    most_spacing_mm  between samples, at the print: details of twice that size survive
    most_error_mm    expected error of the surface (one standard deviation), at the print: more than a layer shows as texture
    most_unseen      share of the surface that can be seen from the allowed directions and was not
    most_grazing     share of readings at more than 60 degrees from the normal
    least_overlap    share of each scan's points that another confirms
    """

    name: str
    height_mm: float
    layer_mm: float
    most_spacing_mm: float = 0.5
    most_error_mm: float = 0.05
    most_unseen: float = 0.05
    most_grazing: float = 0.25
    least_overlap: float = 0.25


PROFILES = {
    "bust-150": Profile("bust-150", 150.0, 0.05),
    "bust-75": Profile("bust-75", 75.0, 0.025, most_spacing_mm=0.25, most_error_mm=0.025),
    "bust-300": Profile("bust-300", 300.0, 0.1, most_spacing_mm=1.0, most_error_mm=0.1),
}


@dataclass(frozen=True)
class Finding:
    """One remark: what was measured, what is allowed, what mends it. `code` is stable; `scan` is empty for all together; `places_mm` are
    in the world frame, the worst first."""

    code: str
    severity: Literal["note", "warning", "error"]
    text: str
    value: float
    limit: float
    scan: str = ""
    places_mm: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True)
class ViewQuality:
    """One scan.

    readings       cells that hold a distance; `returned` their share of the grid
    spacing_mm     median distance between neighbouring samples on the surface
    noise_mm       standard deviation of a reading along its ray, from the scan's own local quadrics
    stated_noise_mm  what the scanner states, if it does
    grazing        share of readings at more than 60 degrees from the normal
    range_mm       median distance to the surface
    azimuth_deg, elevation_deg  where the scan was taken from, about the object
    overlap        share of its points that at least one other scan confirms; NaN when there is no other
    error_mm       expected error of the surface across itself, from this scan alone (one standard deviation)
    """

    name: str
    readings: int
    returned: float
    spacing_mm: float
    noise_mm: float
    stated_noise_mm: float | None
    grazing: float
    range_mm: float
    azimuth_deg: float
    elevation_deg: float
    overlap: float
    error_mm: float


@dataclass(frozen=True, eq=False)
class ScanQuality:
    """All scans together.

    views        one per scan
    pairs        every pair of scans that share points, at the poses given
    height_mm    extent of the readings along `up`; `scale` from there to the print
    coverage     share of the directions from the object's middle in which a sample lies; `sphere` counts in each how many scans have one
    seen         share of the surface seen, of what can be seen from the allowed directions
    unseen_mm2   area of the frontier that can be seen from there, and `hidden_mm2` that cannot
    gaps         unseen pieces, the largest first; `mean_gap_mm` is the mean of the square roots of their areas, weighted by area
    spacing_mm   median over the surface of the distance between samples, of the finest scan there
    error_mm     expected error of the fused surface (root mean square of one standard deviation over the surface)
    step_mm      of it, what overlapping scans disagree beyond their noise; 0 without overlap
    next_view    None when nothing unseen can be seen from the allowed directions
    profile, findings, verdict  "fit", "fit with reservations" (warnings) or "unfit" (errors)
    """

    views: tuple[ViewQuality, ...]
    pairs: tuple[Pair, ...] = field(repr=False)
    height_mm: float
    scale: float
    coverage: float
    sphere: IntArray = field(repr=False)
    seen: float
    unseen_mm2: float
    hidden_mm2: float
    gaps: tuple[Gap, ...] = field(repr=False)
    mean_gap_mm: float
    spacing_mm: float
    error_mm: float
    step_mm: float
    next_view: NextView | None
    profile: Profile
    findings: tuple[Finding, ...]

    @property
    def verdict(self) -> Literal["fit", "fit with reservations", "unfit"]:
        severities = {f.severity for f in self.findings}
        return "unfit" if "error" in severities else "fit with reservations" if "warning" in severities else "fit"

    @property
    def lines(self) -> list[str]:
        """The verdict and what it rests on, in sentences."""
        lines = [
            f"{self.verdict} for {self.profile.name} ({self.profile.height_mm:g} mm high in layers of {self.profile.layer_mm:g} mm)",
            f"{len(self.views)} {'scan sees' if len(self.views) == 1 else 'scans see'} {100 * self.seen:.1f} % of the surface in reach; samples {self.spacing_mm:.2f} mm apart, expected error "
            f"{self.error_mm:.3f} mm; at the print {self.scale * self.spacing_mm:.2f} and {self.scale * self.error_mm:.3f} mm",
        ]
        lines += [f"{f.severity}: {f.text}" for f in self.findings]
        if self.next_view is not None:
            lines.append(f"next view: {self.next_view.reason}")
        return lines

    @property
    def drawing(self) -> list[str]:
        """The coverage sphere in letters, below what they mean."""
        following = None if self.next_view is None else (self.next_view.azimuth_deg, self.next_view.elevation_deg)
        stood = [(view.azimuth_deg, view.elevation_deg) for view in self.views]
        return [legend(following is not None), *in_letters(self.sphere, stood, following)]


def assess(
    scans: Sequence[RangeScan],
    *,
    profile: str | Profile = "bust-150",
    up: npt.ArrayLike = (0.0, 1.0, 0.0),
    elevation_deg: tuple[float, float] = (-30.0, 90.0),
    cells: int = 72,
    candidates: int = _CANDIDATES,
    samples: Sequence[Samples] | None = None,
) -> ScanQuality:
    """Measure `scans` at their poses against `profile` (a name of PROFILES or one of your own).

    up             world direction in which the object stands
    elevation_deg  lowest and highest elevation from which a scanner could look
    cells          of the space along the object's longest side (8 to 400): gaps smaller than one are not found
    candidates     directions that the next view is chosen from
    samples        those of the scans, if they are at hand

    Raises ScanError without scans or when one has no surface, SettingError for a setting out of its range."""
    wanted = _checked(scans, profile, elevation_deg, cells, candidates)
    upward = unit_vectors(require("up", up, (3,), finite=True))
    if not np.isfinite(upward).all():
        raise SettingError("up has length 0; say which way the object stands", key="up")
    if samples is None:
        samples = in_chunks(lambda i, _: samples_of(scans[i]), len(scans), 1)
    poses = [s.world_from_scan for s in scans]
    judged = judge_all(samples, poses, Rules())
    step = _step_mm([pair for pair, *_ in judged.values()])
    space = carve(scans, samples, cells)
    shell = shell_of(space)
    if not shell.measured.any():
        raise ScanError("no reading of the scans has empty space before it; check that their poses and cameras belong together")
    middle = np.average(space.centres_mm(shell.index[shell.measured]), axis=0, weights=shell.area_mm2[shell.measured])
    spacing, error = _over_surface(space, shell, scans, samples, step)

    allowed = directions(candidates)
    elevations = np.degrees(np.arcsin(np.clip(allowed @ upward, -1, 1)))
    allowed = allowed[(elevations >= elevation_deg[0]) & (elevations <= elevation_deg[1])]
    _, _, reachable = views_from(space, shell, allowed)
    unseen = float(shell.area_mm2[~shell.measured & reachable].sum())
    hidden = float(shell.area_mm2[~shell.measured & ~reachable].sum())
    seen = float(shell.area_mm2[shell.measured].sum())
    gaps = gaps_of(space, shell, reachable)
    open_gaps = [g for g in gaps if g.reachable > 0.1]
    areas = np.array([g.area_mm2 for g in open_gaps])

    clouds = [rigid.move_points(p, s.points_mm[s.usable]) for p, s in zip(poses, samples)]
    points = np.concatenate(clouds)
    extent = points @ upward
    height = float(np.percentile(extent, 99.9) - np.percentile(extent, 0.1))
    views = tuple(_view(k, scans, samples, judged, middle, upward) for k in range(len(scans)))
    scale = wanted.height_mm / max(height, 1e-9)
    share = seen / max(seen + unseen, 1e-9)
    upright = upright_frame(upward)
    sphere = counted([cloud @ upright.T for cloud in clouds], upright @ middle, LETTERS_SHAPE)
    findings = _findings(views, wanted, scale, share, unseen, spacing, error, step, open_gaps, middle, upward)
    return ScanQuality(
        views, tuple(p for p, *_ in judged.values() if p.overlap > 0), height, scale, _coverage(points, middle), sphere, share, unseen, hidden,
        tuple(gaps), float(np.average(np.sqrt(areas), weights=areas)) if len(areas) else 0.0, spacing, error, step,
        _next_view(allowed, space, upward), wanted, tuple(findings),
    )  # fmt: skip


def _step_mm(pairs: Sequence[Pair]) -> float:
    """What scans disagree by beyond their noise, per scan: the excess variance is shared by the two."""
    good = [p for p in pairs if p.accepted]
    if not good:
        return 0.0
    weights = [p.points * (p.overlap_a + p.overlap_b) for p in good]
    excess = float(np.average([max(p.residual_mm**2 - p.expected_mm**2, 0.0) for p in good], weights=weights))
    return math.sqrt(0.5 * excess)


def _over_surface(
    space: Space, shell: Shell, scans: Sequence[RangeScan], samples: Sequence[Samples], step_mm: float
) -> tuple[float, float]:
    """Median sample spacing and RMS expected error over the measured cells.

    In a cell a scan contributes one reading's error across the surface (range error times the cosine); looks of several scans
    average, each with its share of the disagreement between scans, which more readings of the same scan do not reduce."""
    finest = np.full(space.state.shape, np.inf)
    weight = np.zeros(space.state.shape)
    for scan, sample in zip(scans, samples):
        cosine = np.clip(facing(sample)[sample.usable], 0.05, 1.0)
        place = (
            (rigid.move_points(scan.world_from_scan, sample.points_mm[sample.usable]) - space.corner_mm) / space.cell_mm
        ).astype(int)
        flat = np.ravel_multi_index(tuple(place.T), space.state.shape)
        count = np.bincount(flat, minlength=space.state.size)
        mean_cosine = np.bincount(flat, cosine, space.state.size) / np.maximum(count, 1)
        looked = count.reshape(space.state.shape) > 0
        cosines = mean_cosine.reshape(space.state.shape)
        # samples of an oblique surface lie farther apart along it
        flat_on = sample.spacing_mm / sample.stride * math.sqrt(float(np.median(cosine)))
        with np.errstate(divide="ignore"):
            finest = np.where(looked, np.minimum(finest, flat_on / np.sqrt(cosines)), finest)
            weight += np.where(looked, 1.0 / ((_noise_mm(scan, sample) * cosines) ** 2 + step_mm**2 + 1e-12), 0.0)
    at = tuple(shell.index[shell.measured].T)
    looked = weight[at] > 0
    area = shell.area_mm2[shell.measured][looked]
    if not len(area):
        return math.nan, math.nan
    return float(np.median(finest[at][looked])), math.sqrt(float(np.average(1.0 / weight[at][looked], weights=area)))


def _noise_mm(scan: RangeScan, sample: Samples) -> float:
    """What a reading errs by: what its neighbours show, or what the scanner states if that is more, for errors that neighbours share do
    not show among them."""
    return max(sample.noise_mm, scan.noise_mm or 0.0)


def _coverage(points: FloatArray, middle: FloatArray) -> float:
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(directions(_COVERAGE)).query(unit_vectors(points - middle))
    return len(np.unique(nearest)) / _COVERAGE


def _view(k: int, scans, samples: Sequence[Samples], judged, middle: FloatArray, up: FloatArray) -> ViewQuality:
    scan, sample = scans[k], samples[k]
    cosine = facing(sample)[sample.usable]
    rays = scan.camera.pixel_rays()[1]
    # the viewer's side, as the mean of the directions that the readings were taken in
    toward = unit_vectors(-rigid.move_directions(scan.world_from_scan, np.asarray(rays)[scan.valid].mean(axis=0)))
    azimuth, elevation = angles_deg(toward, up)
    confirmed = [of_i if i == k else of_j for (i, j), (_, of_i, of_j) in judged.items() if k in (i, j)]
    overlap = float(np.any([c.agrees for c in confirmed], axis=0).mean()) if confirmed else math.nan
    return ViewQuality(
        scan.name, int(scan.valid.sum()), float(scan.valid.mean()), sample.spacing_mm / sample.stride, sample.noise_mm, scan.noise_mm,
        float((cosine < math.cos(math.radians(GRAZING_DEG))).mean()), float(np.nanmedian(scan.range_mm)), azimuth, elevation, overlap,
        _noise_mm(scan, sample) * float(np.sqrt(np.mean(np.clip(cosine, 0, 1) ** 2))),
    )  # fmt: skip


def _next_view(allowed: FloatArray, space: Space, up: FloatArray) -> NextView | None:
    """The allowed direction that sees most of the surface that may be expected where none was measured."""
    if not len(allowed):
        return None
    likely = expected(space)
    shell = shell_of(likely)
    gain, known, reachable = views_from(likely, shell, allowed)
    if not gain.max(initial=0.0) > 4 * space.cell_mm**2:
        return None
    unseen = float(shell.area_mm2[~shell.measured & reachable].sum())
    overlap = known / np.maximum(known + gain, 1e-12)
    # a view that could not be aligned adds nothing; of equal ones the first
    k = int(np.argmax(np.where(overlap >= _TO_ALIGN, gain, gain * overlap / _TO_ALIGN)))
    azimuth, elevation = angles_deg(allowed[k], up)
    _, _, sees = views_from(likely, shell, allowed[k : k + 1])
    adds = sees & ~shell.measured
    where = np.average(likely.centres_mm(shell.index[adds]), axis=0, weights=shell.area_mm2[adds])
    reason = (
        f"from azimuth {azimuth:.0f}, elevation {elevation:.0f} degrees it sees {gain[k] / 100:.1f} cm2 (foreshortened) of the "
        f"{unseen / 100:.1f} cm2 that may be expected where no scan has seen anything, around ({', '.join(f'{x:z.0f}' for x in where)}) mm; "
        f"{100 * overlap[k]:.0f} % of its picture is known already"
    )
    return NextView(tuple(allowed[k].tolist()), azimuth, elevation, float(gain[k]), float(overlap[k]), reason)


def _findings(views, wanted: Profile, scale, seen, unseen, spacing, error, step, gaps, middle, up) -> list[Finding]:
    found: list[Finding] = []

    def add(code: str, value: float, limit: float, too_bad: float, text: str, scan: str = "", places=()) -> None:
        worse = value > limit if too_bad >= limit else value < limit
        far = value > too_bad if too_bad >= limit else value < too_bad
        if worse:
            found.append(Finding(code, "error" if far else "warning", text, value, limit, scan, places))

    largest = f", the largest around ({', '.join(f'{x:z.0f}' for x in gaps[0].centre_mm)}) mm" if gaps else ""
    # what a single scan cannot see is no fault of it: never more than a warning
    add("scan-unseen", 1 - seen, wanted.most_unseen, 4 * wanted.most_unseen if len(views) > 1 else 1.0,
        f"{100 * (1 - seen):.1f} % of the surface in reach ({unseen / 100:.0f} cm2) was never seen (at most {100 * wanted.most_unseen:.0f} %), "
        f"in {len(gaps)} gaps{largest}; "
        + ("one scan makes a relief, and a bust takes more" if len(views) == 1 else "scan again from the next view"),
        places=tuple(gap.centre_mm for gap in gaps[:_PLACES]))  # fmt: skip
    height = wanted.height_mm / scale
    if not LIKELY_MM[0] <= height <= LIKELY_MM[1]:
        found.append(Finding("scan-size", "warning", f"the object is {height:.3g} mm high (from {LIKELY_MM[0]:g} to {LIKELY_MM[1]:g} mm is likely); "
                             "is its unit right? Say another --unit, if not", height, LIKELY_MM[0] if height < LIKELY_MM[0] else LIKELY_MM[1]))  # fmt: skip
    add("scan-spacing", scale * spacing, wanted.most_spacing_mm, 3 * wanted.most_spacing_mm,
        f"samples lie {scale * spacing:.2f} mm apart at the print (at most {wanted.most_spacing_mm:g} mm); scan from nearer, or print smaller")  # fmt: skip
    add("scan-error", scale * error, wanted.most_error_mm, 4 * wanted.most_error_mm,
        f"expected error of the surface is {scale * error:.3f} mm at the print (at most {wanted.most_error_mm:g} mm); more scans of the same "
        "places average noise, smoothing trades it for detail")  # fmt: skip
    if step > 0 and scale * step > wanted.most_error_mm:
        found.append(Finding("scan-step", "warning", f"overlapping scans lie {scale * step:.3f} mm (at the print) from where noise lets them; "
                             "register them again, or suspect the scanner's calibration", scale * step, wanted.most_error_mm))  # fmt: skip
    for view in views:
        add("scan-grazing", view.grazing, wanted.most_grazing, 1.0,
            f"{view.name}: {100 * view.grazing:.0f} % of its readings are at more than {GRAZING_DEG:.0f} degrees from the normal "
            f"(at most {100 * wanted.most_grazing:.0f} %); look at those places from their front", view.name)  # fmt: skip
        if not math.isnan(view.overlap):
            add("scan-overlap", view.overlap, wanted.least_overlap, 0.0,
                f"{view.name}: other scans confirm only {100 * view.overlap:.0f} % of it (at least {100 * wanted.least_overlap:.0f} %); its pose "
                "rests on little, or is wrong: register the scans, or add one between it and its neighbour", view.name)  # fmt: skip
        if view.stated_noise_mm and view.noise_mm > 3 * view.stated_noise_mm:
            found.append(Finding("scan-noise", "warning", f"{view.name}: its noise is {view.noise_mm:.3f} mm, {view.noise_mm / view.stated_noise_mm:.1f} "
                                 "times what the scanner states; filter it, or check the scanner", view.noise_mm, 3 * view.stated_noise_mm, view.name))  # fmt: skip
    return found


def _checked(scans, profile: str | Profile, elevation_deg, cells: int, candidates: int) -> Profile:
    if not scans:
        raise ScanError("there are no scans to assess; give at least one")
    if isinstance(profile, str) and profile not in PROFILES:
        raise SettingError(f"profile is {profile!r}; known are {', '.join(PROFILES)}", key="profile")
    low, high = elevation_deg
    if not -90 <= low <= high <= 90:
        raise SettingError(
            f"elevation_deg is {elevation_deg}; it must be a lowest and a highest angle within -90 to 90", key="elevation_deg"
        )
    for key, value, least, most in (("cells", cells, 8, 400), ("candidates", candidates, 1, 100_000)):
        if not least <= value <= most:
            raise SettingError(f"{key} is {value}; it must lie between {least} and {most}", key=key, value=value)
    return PROFILES[profile] if isinstance(profile, str) else profile
