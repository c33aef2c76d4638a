"""dataset: many pictures with their truth, over sampled parameters; resumed where it was stopped, spread over cores or machines."""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck import __version__, kernels
from rangecheck.animation.frames import key_of
from rangecheck.config import Settings
from rangecheck.dataset import (
    ROW_SCHEMA,
    SCHEMA,
    Made,
    Ranges,
    check_picture,
    make_picture,
    masks_document,
    read_index,
    read_ranges,
)
from rangecheck.errors import SettingError
from rangecheck.export.camera_files import write_colmap
from rangecheck.export.pictures import read_png
from rangecheck.files import read_bytes, sha256, write_bytes, write_json
from rangecheck.optics import camera_from_dict
from rangecheck.pipeline.folder import job_folder
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.pictures import scene_of
from rangecheck.pipeline.subject import read_subject
from rangecheck.progress import Reporter
from rangecheck.reflectance import Material, load_material, side_by_side
from rangecheck.scene import Scene
from rangecheck.transport import Tracer

FINISHED, UNDERWAY = "index.jsonl", "underway.jsonl"


@dataclass(frozen=True, eq=False)
class Job:
    """Everything that determines the pictures; it travels to other machines as it is."""

    scene: Scene
    ranges: Ranges
    materials: dict[str, Material]
    size: tuple[int, int]
    seed: int
    normals: Any = None


def pictures_of(job: Job) -> Callable[[int], tuple[Made, list[str]]]:
    """The function that makes picture k, and says what its check found."""
    tracer = Tracer(job.scene)

    def make(index: int) -> tuple[Made, list[str]]:
        sample = job.ranges.draw(job.seed, index)
        made = make_picture(tracer, sample, job.materials[sample.material], index, job.size, job.seed, job.normals)
        return made, check_picture(made.row, _pixels(made.picture), made.truth, job.scene.surface)

    return make


def _pixels(png: bytes) -> Any:
    import cv2

    picture: Any = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    return picture if picture.ndim == 2 else picture[..., ::-1]


def dataset(
    path: str,
    out: str,
    *,
    settings: Settings,
    unit: str | None,
    count: int,
    ranges: str | None = None,
    size: tuple[int, int] = (128, 128),
    scheduler: str | None = None,
    force: bool,
    reporter: Reporter,
) -> Outcome:
    """`count` pictures of what is in `path`, with truth maps, index and masks, in the folder `out`. Pictures that are there are kept."""
    if not 1 <= count <= 10_000_000:
        raise SettingError(f"count is {count}; it must lie between 1 and 10000000", key="count")
    asked = read_ranges(ranges)
    materials = dict(zip(asked.names, side_by_side([load_material(name) for name in asked.names])))
    subject = read_subject(path, settings, unit, reporter)
    scene = replace(scene_of(subject, next(iter(materials.values()))), sources=())
    model = subject.model
    job = Job(scene, asked, materials, size, settings.seed, None if model is None else model.normals_at)
    key = key_of(
        {
            "version": __version__, "vertices": scene.surface.vertices, "faces": scene.surface.faces, "parts": scene.surface.part_of_face,
            "ranges": asked.to_dict(), "materials": [repr(m) for m in (*materials.values(), *scene.materials)], "size": list(size),
            "seed": settings.seed,
        }
    )  # fmt: skip
    with job_folder(out, key, FINISHED, force=force) as folder:
        rows = _kept(folder, key, count)
        missing = [k for k in range(count) if k not in rows]
        if len(missing) < count:
            reporter.note(f"{count - len(missing)} pictures are there already")
        with reporter.stage("pictures", count), (folder / UNDERWAY).open("ab") as underway:
            for done, (made, wrong) in enumerate(_made(job, missing, scheduler, key, reporter)):
                row = made.row | {"wrong": wrong}
                for name, content in (("picture", made.picture), ("truth", made.truth)):
                    write_bytes(folder / row[name], content)
                    row[f"{name}_sha256"] = hashlib.sha256(content).hexdigest()
                underway.write(json.dumps(row | {"key": key}, separators=(",", ":")).encode() + b"\n")
                underway.flush()
                rows[row["index"]] = row
                reporter.advance(count - len(missing) + done + 1)
        ordered = [{name: value for name, value in rows[k].items() if name not in ("key",)} for k in range(count)]
        with reporter.stage("index"):
            _write_index(folder, ordered, scene, asked, settings.seed)
        (folder / UNDERWAY).unlink()
    wrong = [f"picture {row['index']}: {said}" for row in ordered for said in row["wrong"]]
    seconds = reporter.seconds["pictures"]
    lines = [
        f"{out}: {count} pictures of {size[0]}x{size[1]} with their truth in {seconds:.1f} s",
        f"{count - len({line.split(':')[0] for line in wrong})} of them agree with every truth map"
        if wrong
        else "all agree with every truth map",
        *wrong[:10],
    ]
    return Outcome(
        document(
            "dataset", output=out, pictures=count, size=list(size), ranges=asked.to_dict(), wrong=wrong, seconds=reporter.seconds
        ),
        lines,
        not wrong,
    )


def _kept(folder: Path, key: str, count: int) -> dict[int, dict[str, Any]]:
    """Rows of the pictures that a stopped job of this key finished, by number; the others' files are taken as absent."""
    if not (folder / UNDERWAY).is_file():
        return {}
    content = read_bytes(folder / UNDERWAY)
    whole = content[: content.rfind(b"\n") + 1]
    if whole != content:
        write_bytes(folder / UNDERWAY, whole)
    rows = {}
    for row in read_index(folder / UNDERWAY):
        files = [(folder / row[name], row.get(f"{name}_sha256")) for name in ("picture", "truth")]
        if row.get("key") == key and row["index"] < count and all(f.is_file() and sha256(f) == digest for f, digest in files):
            rows[row["index"]] = row
    return rows


def _made(
    job: Job, missing: Sequence[int], scheduler: str | None, key: str, reporter: Reporter
) -> Iterator[tuple[Made, list[str]]]:
    if scheduler is not None:
        from rangecheck.animation.farm import Farm

        with Farm(scheduler) as farm:
            reporter.note(f"pictures are made at {scheduler} by {farm.threads()} threads")
            for _, result in farm.spread(pictures_of, job, key)(missing):
                yield result
        return
    make, workers = pictures_of(job), kernels.thread_count()
    # small pictures: each on one thread, several at a time
    with kernels.threads(1), ThreadPoolExecutor(workers, thread_name_prefix="picture") as pool:
        waiting: deque[Future[tuple[Made, list[str]]]] = deque()
        for index in missing:
            if len(waiting) > 2 * workers:
                yield waiting.popleft().result()
            waiting.append(pool.submit(make, index))
        while waiting:
            yield waiting.popleft().result()


def _write_index(folder: Path, rows: list[dict[str, Any]], scene: Scene, ranges: Ranges, seed: int) -> None:
    names = scene.surface.part_names
    write_bytes(folder / "masks.json", json.dumps(masks_document(rows, names), separators=(",", ":")).encode())
    cameras, poses = [camera_from_dict(row["camera"]) for row in rows], [np.array(row["world_from_camera"]) for row in rows]
    write_colmap(folder / "colmap", cameras, poses, [Path(row["picture"]).name for row in rows])
    write_json(
        folder / "dataset.json",
        {
            "schema": SCHEMA,
            "pictures": len(rows),
            "part_names": list(names),
            "length_unit": "mm",
            "seed": seed,
            "rows": ROW_SCHEMA,
            **ranges.to_dict(),
        },
    )
    write_bytes(folder / FINISHED, b"".join(json.dumps(row, separators=(",", ":")).encode() + b"\n" for row in rows))


def check_dataset(folder: str | Path, scene: Scene) -> list[str]:
    """What is wrong with a finished data set of this scene: the check of every picture, done again from the files."""
    where, wrong = Path(folder), []
    for row in read_index(where / FINISHED):
        said = check_picture(row, read_png(where / row["picture"]), read_bytes(where / row["truth"]), scene.surface)
        wrong += [f"picture {row['index']}: {text}" for text in said]
    return wrong
