"""The report of a job: what it needs is kept in the job's folder, so that the page can be made again without the job.

`keep_for_report` writes brightness/, likeness.npz and maps/ring.npz; `page_of` reads them, the other results and run.json's content.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.animation import orbit_around
from rangecheck.config import Settings
from rangecheck.errors import InputError
from rangecheck.export.map_files import read_maps_npz
from rangecheck.export.mapped import contour_picture
from rangecheck.export.pictures import png_bytes
from rangecheck.files import DAMAGED_ARCHIVE, read_bytes, read_json, whole_file, write_bytes
from rangecheck.maps import trace_maps
from rangecheck.optics import PinholeCamera
from rangecheck.pipeline.likeness import likeness
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.progress import Reporter
from rangecheck.raycast import EmbreeCaster
from rangecheck.report import (
    Coverage,
    DistanceMap,
    Field,
    Figure,
    Finding,
    Model,
    ReportContent,
    Scan,
    Turntable,
    write_report,
)
from rangecheck.scan import RangeScan
from rangecheck.scan.quality_sphere import counted
from rangecheck.scan.readers.limits import beside
from rangecheck.solid import Verdict
from rangecheck.solid.findings import explain
from rangecheck.surface import Surface

#: focal points of the ring, counted from the front, and the longer side of their maps in pixels
RING_DEG = tuple(float(a) for a in range(0, 360, 30))
RING_PX = 240
#: walls thicker than this share of the extent have one colour
THICK = 1 / 20
_ABOUT = {
    "error_mm": "Expected standard error of the surface along its normal, from the noise and number of the readings behind it. Grey: nothing was measured.",
    "deviation_mm": "Mean signed distance of the scans' readings nearest to each point, positive outside. Grey: no reading lies there.",
    "thickness_mm": "Straight inwards to the opposite side, the least around each point; thicker than the scale is as its end. Grey: no side faces it there.",
}


def contours_of(scan: RangeScan, settings: Settings) -> Any:
    """The contour picture of a scan, RGB."""
    return contour_picture(
        scan.depth_mm.astype(np.float64), settings.maps.contour_step_mm, title=f"Depth contours of {scan.name}"
    )


def keep_for_report(
    folder: Path,
    shown: Surface,
    meshed: Surface,
    scans: Sequence[RangeScan],
    found: Verdict | None,
    settings: Settings,
    *,
    front_deg: float,
) -> None:
    """Write what only the running job knows: the scans' brightness, the bust's likeness, distances from a ring of focal points.

    `found` names faces of `shown`; None when they are not its own."""
    for scan in scans:
        if scan.brightness is not None:
            grey = np.rint(255 * np.nan_to_num(np.clip(scan.brightness, 0, 1))).astype(np.uint8)
            write_bytes(folder / "brightness" / f"{scan.name}.png", png_bytes(grey))
    same_place = settings.solid.height_mm is None
    made = likeness(shown, meshed, scans, found, same_place=same_place)
    light = made.surface
    _write_arrays(
        folder / "likeness.npz",
        vertices_mm=light.vertices.astype(np.float32),
        faces=light.faces,
        part_of_face=light.part_of_face,
        origin_of_face=light.origin_of_face,
        part_names=np.array(light.part_names),
        **({} if light.refined_of_face is None else {"refined_of_face": light.refined_of_face}),
        error_mm=made.error_mm.astype(np.float32),
        deviation_mm=made.deviation_mm.astype(np.float32),
        thickness_mm=made.thickness_mm.astype(np.float32),
        flagged=made.flagged,
        off_mm=np.array([made.off_mm, made.off_99_mm]),
        faces_before=np.array(made.faces),
        coverage=counted([scan.points_mm() for scan in scans], (shown if same_place else meshed).bounds_mm.mean(axis=0)),
    )
    shrink = min(1.0, RING_PX / max(settings.picture.width, settings.picture.height))
    size = {key: max(8, round(shrink * getattr(settings.picture, key))) for key in ("width", "height")}
    camera = PinholeCamera.from_field_of_view(size["width"], size["height"], settings.picture.field_of_view_deg)
    caster = EmbreeCaster(shown.vertices, shown.faces)
    orbit = orbit_around(
        shown,
        camera,
        frames=len(RING_DEG),
        elevation_deg=settings.maps.elevation_deg,
        margin=settings.turntable.margin,
        start_deg=front_deg,
    )
    ring = [trace_maps(shown, camera, orbit.world_from_camera(k), caster) for k in range(len(RING_DEG))]
    _write_arrays(
        folder / "maps" / "ring.npz",
        distance_mm=np.stack([one.distance_mm for one in ring]).astype(np.float32),
        world_from_camera=np.stack([one.world_from_camera for one in ring]),
        intrinsics=np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        azimuths_deg=np.array(RING_DEG),
    )


def _write_arrays(path: Path, **arrays: Any) -> None:
    with whole_file(path) as part, part.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def _read_arrays(path: Path) -> dict[str, Any] | None:
    """The arrays of an NPZ, None where there is no such file. Raises InputError."""
    if not path.is_file():
        return None
    try:
        with np.load(io.BytesIO(read_bytes(path)), allow_pickle=False) as found:
            return dict(found)
    except DAMAGED_ARCHIVE as error:
        raise InputError(path, f"cannot be read ({error}); run the job again with --force") from None


def report(folder: str, *, studies: Sequence[str] = (), pdf: bool = False, reporter: Reporter) -> Outcome:
    """The report of the finished job in `folder`, made again; with `studies`, folders of studies whose charts it shows; with `pdf`, printed too."""
    where = Path(folder)
    if not (where / "run.json").is_file():
        raise InputError(where, "holds no finished job (no run.json); `rangecheck run` makes one")
    content = read_json(where / "run.json")
    with reporter.stage("report"):
        try:
            page = page_of(where, content, studies)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            told = " ".join(f"{type(error).__name__}: {error}".split())[:160]
            raise InputError(where / "run.json", f"is not what `rangecheck run` leaves ({told}); run the job again") from None
        write_report(page, where / "report.html")
    size = (where / "report.html").stat().st_size
    lines = [f"{where / 'report.html'}: {size / 1e6:.1f} MB, no network"]
    if pdf:
        from rangecheck.export.paper import write_pdf

        with reporter.stage("printing"):
            write_pdf(where / "report.html", where / "report.pdf")
        lines.append(f"{where / 'report.pdf'}: the same on paper")
    return Outcome(document("report", output=where / "report.html", bytes=size, pdf=where / "report.pdf" if pdf else None), lines)


def page_of(folder: Path, content: dict[str, Any], studies: Sequence[str | Path] = ()) -> ReportContent:
    """What the report shows of the job in `folder`, whose run.json holds (or will hold) `content`."""
    stl, quality = content["stl"], content.get("quality")
    names = [scan["name"] for scan in content["scans"]]
    kept = _read_arrays(folder / "likeness.npz")
    return ReportContent(
        title=f"Bust from {len(names)} scans" if len(names) != 1 else f"Bust from one scan, {names[0]}",
        fit=content["fit"],
        verdict="bust.stl can be built." if stl else "No STL was written: what stands against it is listed under Findings.",
        reasons=_reasons(content),
        scans=[_scan(folder, facts, content) for facts in content["scans"]],
        worth=_worth(quality),
        coverage=None if kept is None or not kept["coverage"].any() else _coverage(kept["coverage"], quality),
        model=None if kept is None else _model(kept),
        front_deg=content.get("front_deg", 0.0),
        turntables=[
            Turntable(t["material"], frames, content["settings"]["turntable"].get("start_deg", 0.0))
            for t in content["turntables"]
            if (frames := sorted(beside(folder / "run.json", f"frames/{t['material']}").glob("*.png")))
        ],
        distance_maps=_distance_maps(folder),
        findings=[*_findings_of_solid(content), *_findings_of_scans(content)],
        shown=[
            Figure(
                "Consistency",
                f"From the {side}. {_RINGS}",
                read_bytes(path),
                alt=f"Places that the turntable flags, from the {side}",
            )
            for side in ("front", "back")
            if (path := folder / "consistency" / f"consistency_{side}.png").is_file()
        ],
        stands_out=np.reshape([place["centre_mm"] for place in (content.get("consistency") or {}).get("places", ())], (-1, 3)),
        charts=[figure for study in studies for figure in _charts(Path(study))],
        decisions=[*content["decisions"], *(f"{t['material']}: {line}" for t in content["turntables"] for line in t["plan"])],
        settings=json.dumps(content["settings"], indent=1),
        provenance={
            "Versions": list(content["versions"].items()),
            "Time": [(stage, f"{seconds:.1f} s") for stage, seconds in content["seconds"].items()],
            "Inputs, sha256": list(content["inputs"].items()),
        },
        files=[(name, about) for name, about in _FILES if (folder / name).exists()],
    )


def _findings_of_solid(content: dict[str, Any]) -> list[Finding]:
    return [
        Finding(f["code"], f["severity"], f["count"], f["message"], f["why"], f["mend"], np.reshape(f["places_mm"], (-1, 3)))
        for f in content["verdict"]["findings"]
    ]


def _findings_of_scans(content: dict[str, Any]) -> list[Finding]:
    """What the scans are not good for; their places are the bust's where it has their size."""
    same_place = content["settings"]["solid"].get("height_mm") is None
    found = []
    for f in (content.get("quality") or {}).get("findings", ()):
        told, places = explain(f["code"]), f.get("places_mm", ()) if same_place else ()
        where = f"scan {f['scan']}" if f["scan"] else "all scans"
        found.append(Finding(f["code"], f["severity"], 1, f["text"], told.why, told.mend, np.reshape(places, (-1, 3)), where))
    return found


_RINGS = (
    "Colour is the angle between a facet and what its neighbours let expect: hair and folds are rough by themselves. Rings mark where it "
    "is far larger than around it."
)
_FILES = (
    ("bust.stl", "the solid, for the slicer"),
    ("surface.ply", "the surface, each face labelled measured, interpolated or invented, and whether shading refined it"),
    ("plaster.mp4", "turntable in plaster"),
    ("steel.mp4", "turntable in steel"),
    ("stripes.mp4", "turntable in mirrored stripes"),
    ("consistency", "what the turntable shows, measured"),
    ("maps", "distance, depth, normals and IDs, full precision"),
    ("contours", "iso-lines of depth of every scan"),
    ("run.json", "verdict with places, decisions, versions, input hashes, timings"),
    ("settings.json", "every setting as it was resolved"),
)


def _reasons(content: dict[str, Any]) -> list[str]:
    """The three that weigh most: what is wrong comes first, then what the solid is, what was measured of it and how well."""
    found = content["verdict"]["findings"]
    shares, quality = content["area_shares"], content.get("quality")
    reasons = [f["message"] for f in found if f["severity"] == "error"]
    sentence = content["verdict"]["sentence"]
    reasons += [sentence] if not any(reason in sentence for reason in reasons) else []
    reasons.append(
        "of the whole surface, with base and back, "
        + ", ".join(f"{100 * share:.1f} % is {name}" for name, share in shares.items())
    )
    if quality:
        reasons.append(
            f"the scans are {quality['verdict']} for {quality['profile']['name']}: expected error {_length(quality['expected_error_mm'], 3)}, "
            f"{100 * quality['never_seen']:.1f} % of the surface in reach never seen"
        )
    reasons.append(f"meshed by {content['method']}: {content['reason']}")
    return list(dict.fromkeys(reasons))[:3]


_SHARES = (("Grazing", "grazing"), ("Confirmed by others", "overlap"))


def _length(value: float | None, digits: int) -> str:
    """Millimetres in words; a length that could not be told is null in JSON."""
    return "unknown" if value is None else f"{value:.{digits}f} mm"


def _scan(folder: Path, facts: dict[str, Any], content: dict[str, Any]) -> Scan:
    name, quality = facts["name"], content.get("quality")
    if facts["camera"] is None:
        return Scan(name, [("Points", f"{facts['valid']:,}, a cloud without a grid")])
    rows = [
        ("Readings", f"{facts['valid']:,} ({100 * facts['valid_share']:.0f} % of {facts['width']} × {facts['height']})"),
        ("Distances", f"{facts['nearest_mm']:.1f} to {facts['farthest_mm']:.1f} mm"),
        ("Spacing", _length(facts["spacing_mm"], 2)),
    ]
    view = next((v for v in (quality or {}).get("views", ()) if v["name"] == name), None)
    rows.append(("Noise", _length(facts["noise_mm"] if view is None else view["noise_mm"], 3)))
    if view is not None:
        rows += [(label, f"{100 * view[key]:.0f} %") for label, key in _SHARES if view[key] is not None]
    rows += [
        ("Refined by shading", one.get("refused") or f"{100 * one['refined']:.0f} %, moved by {_length(one['moved_rms_mm'], 3)}")
        for one in content.get("refined", ())
        if one["name"] == name
    ]
    pictures = [
        Figure(kind, "", read_bytes(path), alt=f"{kind} of {name}")
        for kind in ("Brightness", "Contours")
        if (path := beside(folder / "run.json", f"{kind.lower()}/{name}.png")).is_file()
    ]
    return Scan(name, rows, pictures)


def _worth(quality: dict[str, Any] | None) -> list[tuple[str, str]]:
    """What the scans are worth, as lines of a table."""
    if quality is None:
        return []
    return [
        ("Worth", f"{quality['verdict']} for {quality['profile']['name']}"),
        ("Never seen", f"{100 * quality['never_seen']:.1f} % of the surface in reach, in {quality['gaps']} gaps"),
        ("Readings apart", _length(quality["spacing_mm"], 2)),
        ("Expected error", _length(quality["expected_error_mm"], 3)),
    ]


def _coverage(counts: Any, quality: dict[str, Any] | None) -> Coverage:
    views = [(v["name"], v["azimuth_deg"], v["elevation_deg"]) for v in (quality or {}).get("views", ())]
    following = (quality or {}).get("next_view")
    if following is None:
        return Coverage(counts, views)
    return Coverage(counts, views, (following["azimuth_deg"], following["elevation_deg"]), following["reason"])


def _model(kept: dict[str, Any]) -> Model:
    surface = Surface(
        kept["vertices_mm"].astype(np.float64),
        kept["faces"],
        kept["part_of_face"],
        kept["origin_of_face"],
        tuple(str(name) for name in kept["part_names"]),
        refined_of_face=kept.get("refined_of_face"),
    )
    off, off_99 = kept["off_mm"]
    about = f"{len(surface.faces):,} faces"
    if int(kept["faces_before"]) != len(surface.faces):
        about = (
            f"{about} of the bust's {int(kept['faces_before']):,}: 99 % of its points lie within {off_99:.2f} mm of this likeness, "
            f"the farthest that was looked at {off:.2f} mm"
        )
    fields = []
    for key, label, colours in (
        ("error_mm", "Expected error", "viridis"),
        ("deviation_mm", "Deviation from the scans", "RdBu_r"),
        ("thickness_mm", "Wall thickness", "viridis"),
    ):
        values = kept[key].astype(np.float64)
        known = values[np.isfinite(values)]
        if not len(known):
            continue
        if key == "deviation_mm":
            high = float(np.quantile(np.abs(known), 0.98)) or 1.0
            low = -high
            says = f" Half of it within {np.median(np.abs(known)):.3f} mm, 95 % within {np.quantile(np.abs(known), 0.95):.3f} mm."
        else:
            low, high = 0.0, float(np.quantile(known, 0.98))
            says = f" One per cent is below {np.quantile(known, 0.01):.3g} mm, half below {np.median(known):.3g} mm."
            if key == "thickness_mm":  # what is far thicker than a wall is all alike
                high = min(high, THICK * surface.extent_mm)
        fields.append(Field(key, label, "mm", values, low, max(high, low + 1e-6), _ABOUT[key] + says, colours))
    lighter = int(kept["faces_before"]) != len(surface.faces)
    return Model(surface, about, fields, kept["flagged"], float(off_99) if lighter else 0.0)


def _distance_maps(folder: Path) -> list[DistanceMap]:
    """The maps asked for and the rest of the ring, by azimuth."""
    found: dict[float, DistanceMap] = {}
    for path in sorted((folder / "maps").glob("azimuth_*/maps.npz"), key=lambda p: float(p.parent.name.split("_")[1])):
        one, azimuth = read_maps_npz(path), float(path.parent.name.split("_")[1])
        camera = one.camera
        inner = None
        if isinstance(camera, PinholeCamera) and not any(camera.distortion):
            inner = (camera.fx, camera.fy, camera.cx, camera.cy)
        found[azimuth] = DistanceMap(f"{azimuth:g}°", one.distance_mm, inner, one.world_from_camera)
    ring = _read_arrays(folder / "maps" / "ring.npz") or {"azimuths_deg": ()}
    for k, azimuth in enumerate(ring["azimuths_deg"]):
        if azimuth % 360 not in {known % 360 for known in found}:
            inner, distance = tuple(ring["intrinsics"].tolist()), ring["distance_mm"][k].astype(np.float64)
            found[float(azimuth)] = DistanceMap(f"{azimuth:g}°", distance, inner, ring["world_from_camera"][k])
    return [found[azimuth] for azimuth in sorted(found, key=lambda a: a % 360)]


def _drawn(path: Path, study: dict[str, Any]) -> list[tuple[str, str]]:
    """Slug and title of every chart of a study's document."""
    try:
        charts = [(chart["slug"], str(chart["title"])) for chart in study["charts"]]
    except (TypeError, KeyError) as error:
        raise InputError(path, f"is no study that `rangecheck study` wrote ({error}); make it again") from None
    if not all(isinstance(slug, str) and re.fullmatch(r"[\w. -]{1,80}", slug) for slug, _ in charts):
        raise InputError(path, "a chart's slug must be a plain name; make the study again")
    return charts


def _charts(folder: Path) -> list[Figure]:
    """The charts of the studies in `folder`, titled as their documents title them."""
    if not folder.is_dir():
        raise InputError(folder, "is no folder; give the folder that `rangecheck study` wrote")
    found = []
    for path in sorted(folder.rglob("*.json")):
        study = read_json(path)
        if not isinstance(study, dict) or study.get("schema") != "rangecheck/study/1":
            continue
        for slug, title in _drawn(path, study):
            picture = path.with_name(f"{path.stem}-{slug}.svg")
            if picture.is_file():
                found.append(Figure(title, str(study.get("title", "")), read_bytes(picture), alt=f"Chart: {title}"))
    if not found:
        raise InputError(folder, "holds no charts; give the folder that `rangecheck study` wrote")
    return found
