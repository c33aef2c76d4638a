"""Every JSON document that the commands write or read, described as JSON Schema (draft 2020-12), and the settings as editors take them.

A document of schema rangecheck/NAME/1 is described under NAME. Lengths in millimetres, angles in degrees, as the keys say; a document
that comes in several forms is `anyOf` them. What the rooms' own classes become is taken from those classes.
"""

from __future__ import annotations

import functools
from typing import Any

from rangecheck.config import Settings
from rangecheck.pipeline.json_shapes import (
    ANYTHING,
    COUNT,
    FLAG,
    NUMBER,
    TEXT,
    Shape,
    by_name,
    fields_of,
    many,
    maybe,
    one_of,
    or_null,
    record,
    ref,
    with_others,
)

DIALECT = "https://json-schema.org/draft/2020-12/schema"
CONFIGURATION = "configuration"
OF_LINES = ("dataset-row",)
POINT, POSE = many(NUMBER, 3), many(many(NUMBER, 4), 4)
SEVERITY = one_of("note", "warning", "error")
NUMBERS, TEXTS, NAMES = by_name(NUMBER), many(TEXT), by_name(TEXT)


@functools.cache
def schemas() -> dict[str, Shape]:
    """All schemas by name: the configuration, and each document."""
    return {CONFIGURATION: _configuration()} | {name: _whole(name, *forms) for name, forms in _documents().items()}


def _configuration() -> Shape:
    """The settings file: every key may be absent."""
    return {"$schema": DIALECT, **Settings.model_json_schema(), "title": "Settings of rangecheck"}


def _whole(name: str, about: str, *forms: Shape) -> Shape:
    """A schema that stands alone: its forms, and those of the shared shapes that they use."""
    shared = _shared()
    used: dict[str, Shape] = {}
    waiting = list(_references(forms))
    while waiting:
        wanted = waiting.pop()
        if wanted not in used:
            used[wanted] = shared[wanted]
            waiting += _references(shared[wanted])
    tagged = [_tagged(form, name) for form in forms]
    body = tagged[0] if len(tagged) == 1 else {"anyOf": tagged}
    whole = {"$schema": DIALECT, "title": f"rangecheck/{name}/1", "description": about, **body}
    return whole | ({"$defs": dict(sorted(used.items()))} if used else {})


def _tagged(form: Shape, name: str) -> Shape:
    """The form, saying its schema: at its top, or in its `info` where it is an annotation file; lines of a file leave it to another."""
    tag = {"const": f"rangecheck/{name}/1"}
    if "info" in form["properties"]:
        return form | {"properties": form["properties"] | {"info": record(schema=tag)}}
    if name in OF_LINES:
        return form
    return form | {"properties": {"schema": tag} | form["properties"], "required": ["schema", *form["required"]]}


def _references(shape: Any) -> list[str]:
    if isinstance(shape, dict):
        own = [shape["$ref"].rsplit("/", 1)[1]] if "$ref" in shape else []
        return own + [name for value in shape.values() for name in _references(value)]
    return [name for part in shape for name in _references(part)] if isinstance(shape, (list, tuple)) else []


@functools.cache
def _shared() -> dict[str, Shape]:
    """Shapes that several documents have in common, by name."""
    from rangecheck.animation.consistency import Outline, Place
    from rangecheck.animation.speckle import Speckle
    from rangecheck.scan import quality as worth
    from rangecheck.scan.registration.evidence import Pair
    from rangecheck.scan.registration.result import ScanState

    settings = Settings.model_json_schema(mode="serialization")
    sections = settings.pop("$defs")
    finding = record(
        code=TEXT, severity=SEVERITY, count=COUNT, message=TEXT, places_mm=many(POINT), faces=many(COUNT), why=TEXT, mend=TEXT
    )
    verdict = record(fit=FLAG, sentence=TEXT, facts=by_name(ANYTHING), findings=many(ref("finding")))
    return sections | {
        "settings": settings,
        "camera": with_others(record(model=one_of("pinhole", "orthographic", "cylindrical", "raygrid"), width=COUNT, height=COUNT)),
        "finding": with_others(finding) | {"description": "Further keys are what the finding measured."},
        "verdict": verdict,
        "read_back": record(verdict["properties"] | {"faces": COUNT, "moved_by_rounding_mm": NUMBER, "weld_mm": NUMBER}),
        "standing": record(up=one_of("z"), file_from_scans=POSE, scans_from_file=POSE),
        "scan": record(
            name=TEXT, width=maybe(COUNT), height=maybe(COUNT), camera=or_null(TEXT), unit=TEXT, valid=COUNT, valid_share=NUMBER,
            nearest_mm=maybe(NUMBER), farthest_mm=maybe(NUMBER), spacing_mm=maybe(NUMBER), noise_mm=maybe(NUMBER), brightness=maybe(FLAG),
        ),
        "registration": record(
            verdict=one_of("given", "aligned", "partial", "refused"), why=maybe(TEXT), guess=maybe(TEXT), residual_mm=maybe(NUMBER),
            left_out=TEXTS, states=maybe(many(fields_of(ScanState))), pairs=many(fields_of(Pair)), lines=maybe(TEXTS),
        ),
        "quality": record(
            verdict=TEXT, profile=fields_of(worth.Profile), height_mm=NUMBER, scale=NUMBER, coverage=NUMBER, seen=NUMBER,
            never_seen=NUMBER, unseen_mm2=NUMBER, hidden_mm2=NUMBER, gaps=COUNT, spacing_mm=NUMBER, expected_error_mm=NUMBER,
            step_mm=NUMBER, views=many(fields_of(worth.ViewQuality)),
            pairs=many(record(a=TEXT, b=TEXT, overlap=NUMBER, residual_mm=NUMBER, expected_mm=NUMBER)),
            next_view=or_null(fields_of(worth.NextView, direction=POINT)), findings=many(fields_of(worth.Finding, places_mm=maybe(many(POINT)))),
        ),
        "refined": record(name=TEXT, refined=NUMBER, refused=maybe(TEXT), moved_rms_mm=maybe(NUMBER), painted=maybe(NUMBER)),
        "consistency": record(_consistency(fields_of(Speckle), fields_of(Outline), fields_of(Place, centre_mm=POINT))),
    }  # fmt: skip


def _consistency(speckle: Shape, outline: Shape, place: Shape) -> dict[str, Shape]:
    return {
        "slope_noise_deg": NUMBER, "slope_rms_deg": NUMBER, "highlight_jump_deg": NUMBER, "height_noise_mm": NUMBER, "facets_judged": COUNT,
        "speckle": or_null(speckle), "outlines": by_name(outline), "places": many(place), "places_flagged": COUNT, "printer": TEXT,
        "height_mm": NUMBER, "fit": FLAG, "verdict": TEXT, "views": COUNT,
        "standing_out": maybe(or_null(record(
            places=many(record(centre_mm=POINT, half_width_mm=NUMBER, depth_mm=NUMBER, ratio=NUMBER, asked=NUMBER, by_chance=NUMBER)), flagged=COUNT,
            places_judged=COUNT, false_places_expected=NUMBER, shown=one_of("waves", "frames"), pictures=COUNT, views=COUNT, pixel_mm=NUMBER,
            noise_deg=or_null(NUMBER), looks=many(record(half_width_mm=NUMBER, threshold=NUMBER, places=COUNT)),
        ))),
    }  # fmt: skip


def _documents() -> dict[str, tuple[Any, ...]]:
    """Of each document what it is, and its forms."""
    from rangecheck.recover.polish import Estimate
    from rangecheck.recover.regions import Region
    from rangecheck.solid.findings import Explanation
    from rangecheck.solid.hollow import Wall
    from rangecheck.solid.orientation import Orientation
    from rangecheck.solid.repair import Step

    shares = record(measured=NUMBER, interpolated=NUMBER, invented=NUMBER)
    placed = {"registration": or_null(ref("registration")), "filtered": TEXTS, "refined": many(ref("refined"))}
    refused = record(fit={"const": False}, output={"type": "null"}, registration=ref("registration"), seconds=NUMBERS)
    shown = {"camera": ref("camera"), "world_from_camera": POSE}
    simulated = {
        "kind": TEXT, "distance_mm": NUMBER, "noise_mm": NUMBER, "seed": COUNT, "inputs": NAMES, "instrument": by_name(ANYTHING),
        "finish": or_null(NUMBERS), "motion": or_null(by_name(ANYTHING)),
    }  # fmt: skip
    optics = {"vignetting": FLAG, "lens": maybe(NUMBERS), "sensor": maybe(by_name(ANYTHING))}
    explanation = fields_of(Explanation)
    regions = many(fields_of(Region, middle_mm=POINT))
    repair = record(
        way=TEXT, reason=TEXT, steps=many(fields_of(Step)), refused=TEXTS, moved_mm=NUMBER, vanished=NUMBER,
        table=many(record(what=TEXT, original=NUMBER, final=NUMBER)),
    )  # fmt: skip
    hollow = record(
        wall=fields_of(Wall), drains=many(record(inside_mm=POINT, outside_mm=POINT, diameter_mm=NUMBER)),
        kept=many(record(volume_mm3=NUMBER, depth_mm=NUMBER, lowest_mm=POINT, closed=FLAG)), cavity_mm3=NUMBER, plugs_mm3=many(NUMBER), up=POINT,
    )  # fmt: skip
    mesh_checked = record(
        file=TEXT, kind=one_of("mesh"), sha256=TEXT, notes=TEXTS, fit=FLAG, sentence=TEXT, facts=by_name(ANYTHING), findings=many(ref("finding"))
    )  # fmt: skip
    scans_checked = record(
        file=TEXT, kind=one_of("scans"), scans=many(ref("scan")), fit=FLAG, registration=or_null(ref("registration")), filtered=maybe(TEXTS),
        quality=or_null(ref("quality")), findings=many(ref("finding")),
        pictures=many(record(name=TEXT, by=one_of("second picture", "shading", "none"), judged=NUMBER, excluded=maybe(NUMBERS), least_mm=maybe(or_null(NUMBER)),
                             dents=maybe(many(record(radius_mm=NUMBER, judged=NUMBER))), paint=maybe(NUMBER), refused=maybe(TEXT), regions=regions)),
    )  # fmt: skip
    posed = record(picture=TEXT, world_from_camera=POSE)
    view = {"camera": ref("camera"), "world_from_camera": maybe(POSE)}
    taken = record(view, pictures=many(with_others(record(file=TEXT, kind=one_of("white", "black", "gray", "phase")))))
    entry = record(
        name=maybe(TEXT), image=maybe(TEXT), measures=one_of("depth", "range"), step=NUMBER, camera=ref("camera"), world_from_scan=maybe(POSE),
        brightness=maybe(or_null(TEXT)), noise_mm=maybe(NUMBER),
    )  # fmt: skip
    unit = maybe(one_of("mm", "cm", "m", "um", "in"))
    return {
        "run": (
            "run.json and `run --json`: a finished job, or the refusal of scans that do not belong together",
            record(
                fit=FLAG, verdicts=many(record(about=TEXT, word=TEXT, why=TEXT)), verdict=ref("verdict"), method=TEXT, reason=TEXT, area_shares=shares, scans=many(ref("scan")),
                stl=or_null(record(file=TEXT, faces=COUNT, moved_by_rounding_mm=NUMBER, standing=or_null(ref("standing")), verdict=ref("verdict"))),
                quality=or_null(ref("quality")), **placed, faces=COUNT, decisions=TEXTS, front_deg=NUMBER, consistency=ref("consistency"),
                turntables=many(record(material=TEXT, film=TEXT, frames=COUNT, plan=TEXTS)), inputs=NAMES, settings=ref("settings"),
                versions=NAMES, seconds=NUMBERS, peak_memory_mb=NUMBER,
            ),
            refused,
        ),
        "run-each": (
            "`run --each`: a row for each subject",
            record(subjects=many(with_others(record(name=TEXT, folder=TEXT, fit=FLAG, said=TEXT))), fit=FLAG, seconds=NUMBERS),
        ),
        "rehearsal": (
            "--dry-run of `run`, `turntable` and `dataset`",
            record(command=TEXT, scans=maybe(COUNT), distances=maybe(COUNT), pictures=maybe(COUNT), bytes_needed=COUNT, bytes_free=COUNT,
                   encoder=maybe(TEXT), settings=ref("settings")),
        ),
        "check": ("`check`: a row for each file", record(fit=FLAG, files=many({"anyOf": [mesh_checked, scans_checked]}), seconds=NUMBERS)),
        "mesh": (
            "`mesh`",
            record(output=TEXT, method=TEXT, reason=TEXT, faces=COUNT, vertices=COUNT, boundary_edges=COUNT, shares=shares, **placed,
                   inputs=NAMES, seconds=NUMBERS, settings=ref("settings")),
            refused,
        ),
        "solid": (
            "`solid`, and the JSON beside what it wrote",
            record(
                output=or_null(TEXT), solid=FLAG, fit=FLAG, verdict=ref("verdict"), repair=or_null(repair), hollow=or_null(hollow),
                simplified=ANYTHING, areas=record(parts=by_name(shares), origins=shares),
                options=record(unit=or_null(TEXT), ascii=FLAG, force_open=FLAG, settings=ref("settings")), inputs=NAMES, versions=NAMES,
                read_back=maybe(ref("read_back")), walls=maybe(record(thin_mm=NUMBER, median_mm=NUMBER)),
                printing=maybe(record(schema={"const": "rangecheck/printing/1"}, fit=FLAG, sentence=TEXT, facts=by_name(ANYTHING),
                                      findings=many(ref("finding")))),
                orientations=maybe(many(fields_of(Orientation))), standing=maybe(or_null(ref("standing"))), plugs=maybe(TEXTS),
                seconds=NUMBERS, decisions=TEXTS,
            ),
        ),
        "render": (
            "`render`",
            record(output=TEXT, material=TEXT, **shown, exposure=NUMBER, plan=TEXTS, seconds=NUMBERS, **optics,
                   film=record(mean_radiance=NUMBER, covered=NUMBER, samples_per_pixel=NUMBER, shares=by_name(NUMBERS))),
        ),
        "turntable": (
            "`turntable`",
            record(output=TEXT, frames=TEXTS, material={"anyOf": [TEXT, TEXTS]}, show=TEXT, sheet=or_null(TEXT), plan=TEXTS, seconds=NUMBERS,
                   consistency=or_null(ref("consistency"))),
        ),
        "consistency": ("consistency.json: what a turntable shows of the surface", _shared()["consistency"]),
        "maps": (
            "`maps`, and `description` within maps.npz",
            record(files=TEXTS, nearest_mm=NUMBER, farthest_mm=NUMBER, pixels=COUNT, part_names=TEXTS, **shown, seconds=NUMBERS,
                   back_projection=record(distance_max_mm=NUMBER, depth_max_mm=NUMBER, bound_mm=NUMBER, holds=FLAG),
                   deviation=or_null(record({"from": TEXT}, pixels=COUNT, mean_mm=NUMBER, rms_mm=NUMBER, median_mm=NUMBER, p95_mm=NUMBER,
                                            lowest_mm=NUMBER, highest_mm=NUMBER))),
            record(**shown, part_names=TEXTS, length_unit=one_of("mm")),
        ),
        "reflections": (
            "reflections.json: which surface mirrors which, by pixels",
            record(part_names=TEXTS, pairs=many(record(surface=TEXT, mirrors=TEXT, pixels=COUNT))),
        ),
        "draw": ("`draw`", record(output=TEXT, lines=COUNT, visible=COUNT, **shown)),
        "camera": (
            "A picture's camera and pose; further keys say how it was taken",
            with_others(record(length_unit=one_of("mm"), **shown)),
        ),
        "cameras": (
            "The camera of a sequence, and its pose in each picture; further keys say how they were taken",
            with_others(record(length_unit=one_of("mm"), camera=ref("camera"), pictures=many(posed))),
        ),
        "simulate": (
            "`simulate`",
            record(manifest=TEXT, valid=many(COUNT), reasons=by_name(COUNT), **simulated),
            record(captures=TEXTS, **simulated),
        ),
        "sample": ("`sample`", record(manifests=TEXTS, files=NAMES)),
        "decode": (
            "`decode`",
            record(output=TEXT, valid=COUNT, measured=COUNT, counts=by_name(COUNT), lost=TEXTS, inputs=NAMES, seconds=NUMBERS,
                   reprojection_px=record(median=NUMBER, p90=NUMBER),
                   against=or_null(record(points=COUNT, compared=COUNT, median_mm=NUMBER, p90_mm=NUMBER))),
        ),
        "dataset": (
            "`dataset`, its dataset.json, and its masks.json, a COCO annotation file",
            record(output=TEXT, pictures=COUNT, size=many(COUNT, 2), ranges=by_name(ANYTHING), wrong=TEXTS, seconds=NUMBERS),
            with_others(record(pictures=COUNT, part_names=TEXTS, length_unit=one_of("mm"), seed=COUNT, rows=one_of("rangecheck/dataset-row/1"))),
            record(info=ANYTHING, images=many(by_name(ANYTHING)), annotations=many(by_name(ANYTHING)), categories=many(by_name(ANYTHING))),
        ),
        "dataset-row": (
            "A line of a data set's index.jsonl: a picture, its truth, and all that they were made with; dataset.json names this schema for all",
            _row_of_a_dataset(shown),
        ),
        "fit": (
            "`fit` of a material to photographs",
            record(output=TEXT, estimates=many(fields_of(Estimate)), lights=many(POINT), not_determined=TEXTS, residual_in_noises=NUMBER,
                   rms=NUMBER, outliers=NUMBER, converged=FLAG, fit=FLAG, inputs=NAMES, seconds=NUMBERS, world_from_camera=or_null(POSE),
                   camera_within_mm=or_null(POINT), camera_turn_within_deg=or_null(NUMBER)),
        ),
        "lights": (
            "`fit --calibrate`",
            record(kind=one_of("chrome", "matt", "bust"), directions=many(POINT), inputs=NAMES, gains=maybe(many(NUMBER)), slope=maybe(NUMBER),
                   gloss=maybe(NUMBER), paint=maybe(NUMBER), rms=maybe(NUMBER), apart=maybe(many(NUMBER)), uneven=maybe(many(many(NUMBER))),
                   closeness=maybe(many(NUMBER)), within_deg=maybe(many(NUMBER)), strengths=maybe(many(NUMBER)), residual_in_noises=maybe(NUMBER),
                   converged=maybe(FLAG), fit=maybe(FLAG), seconds=maybe(NUMBERS)),
        ),
        "explained": (
            "`fit` of a scan to its own brightness",
            record(fit=FLAG, inputs=NAMES, seconds=NUMBERS,
                   scans=many(record(name=TEXT, judged=NUMBER, excluded=NUMBERS, paint=NUMBER, light_direction=POINT, light_distance_mm=NUMBER, material=by_name(ANYTHING),
                                     not_determined=TEXTS, regions=regions))),
        ),
        "study": (
            "`study`: charts of numbers, sentences, tables of rows, and the machine that made them",
            record(name=TEXT, title=TEXT, machine=by_name(ANYTHING), findings=TEXTS, tables=by_name(many(by_name(ANYTHING))),
                   charts=many(with_others(record(kind=one_of("speed", "edge", "line"), slug=TEXT, title=TEXT)))),
        ),
        "materials": (
            "`materials`",
            record(materials=many(record(name=TEXT, description=TEXT, source=TEXT, sigma_um=NUMBER, correlation_um=NUMBER, concerns=TEXTS,
                                         stated=TEXTS, energy=many(NUMBERS)))),
        ),
        "explain": ("`explain`: all codes, or one", record(codes=many(explanation)), explanation),
        "doctor": (
            "`doctor`",
            record(version=TEXT, fit=FLAG, checks=many(record(name=TEXT, state=one_of("ok", "missing", "broken"), detail=TEXT, mend=TEXT, needed=FLAG))),
        ),
        "init": ("`init`", record(output=TEXT, json_schema=TEXT)),
        "schema": ("`schema`: the names that there are", record(names=by_name(TEXT))),
        "completion": ("`completion`", record(shell=TEXT, script=TEXT, put_it=TEXT)),
        "report": ("`report`", record(output=TEXT, bytes=COUNT, pdf=or_null(TEXT))),
        "settings": ("settings.json: every setting as it was resolved", _settings()),
        "scans": (
            "A manifest of depth pictures, or the companion of one",
            record(unit=unit, scans=many(entry) | {"minItems": 1}),
            record(entry["properties"] | {"unit": unit}),
        ),
        "capture": (
            "capture.json: structured-light pictures and their calibration",
            record(unit=one_of("mm", "cm", "m", "um", "in"), left=taken, right=maybe(taken), projector=maybe(record(view)),
                   cells=maybe(many(COUNT, 2))),
        ),
        "frames": (
            "The list of a turntable's finished frames, by which it is resumed",
            record(key=TEXT, frames=COUNT, suffix=TEXT, exposure=NUMBER, done=NAMES),
        ),
        "unfinished": ("The mark of a job that was not finished, with the key of what it was asked", record(key=TEXT)),
    }  # fmt: skip


def _row_of_a_dataset(shown: dict[str, Shape]) -> Shape:
    from rangecheck.dataset.ranges import Sample

    return record(
        index=COUNT, picture=TEXT, truth=TEXT, picture_sha256=TEXT, truth_sha256=TEXT, width=COUNT, height=COUNT, **shown, exposure=NUMBER,
        sensor=record(full_well=NUMBER, read_noise=NUMBER, bits=COUNT, response=one_of("linear")),
        sources=many(record(centre_mm=POINT, radius_mm=NUMBER, radiance=many(NUMBER))), parameters=fields_of(Sample), seed=COUNT,
        regions=many(record(part=COUNT, name=TEXT, area=COUNT, bbox=many(COUNT, 4), runs=many(COUNT))), wrong=TEXTS,
    )  # fmt: skip


def _settings() -> Shape:
    """The resolved settings, every key there."""
    whole = Settings.model_json_schema(mode="serialization")
    return {
        "type": "object",
        "properties": whole["properties"],
        "required": list(whole["properties"]),
        "additionalProperties": False,
    }
