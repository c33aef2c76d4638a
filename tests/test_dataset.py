"""A data set's pictures agree with their truth, its index and masks with both; a stopped one goes on to the same bytes."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import schemas_kept
from rangecheck_cli.main import exit_status

from rangecheck.dataset import check_picture, read_index, read_ranges, runs_of
from rangecheck.dataset.index import mask_of
from rangecheck.errors import SettingError
from rangecheck.export.pictures import read_png
from rangecheck.files import presets_folder
from rangecheck.modeler import read_model
from rangecheck.pipeline.documents import schemas

WORKSHOP = presets_folder() / "scenes" / "workshop.toml"
SMALL = ["--count", "8", "--size", "48x40", "--seed", "5", "-q"]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A data set that nobody disturbed."""
    out = tmp_path_factory.mktemp("data set") / "workshop"
    assert exit_status(["dataset", str(WORKSHOP), "-o", str(out), *SMALL]) == 0
    return out


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_every_truth_map_agrees_with_its_picture(made):
    surface = read_model(WORKSHOP).surface
    rows = read_index(made / "index.jsonl")
    assert [row["index"] for row in rows] == list(range(8))
    for row in rows:
        assert row["wrong"] == []
        picture, truth = read_png(made / row["picture"]), (made / row["truth"]).read_bytes()
        assert check_picture(row, picture, truth, surface) == []
        assert len({json.dumps(r["world_from_camera"]) for r in rows}) == 8
    # a picture with another's truth is found out
    other = (made / rows[1]["truth"]).read_bytes()
    assert check_picture(rows[0], read_png(made / rows[0]["picture"]), other, surface)
    # and one with a patch of other light
    dimmed = read_png(made / rows[0]["picture"]).copy()
    dimmed[20:24, 20:24] = 255 - dimmed[20:24, 20:24]
    assert any("noise" in said for said in check_picture(rows[0], dimmed, (made / rows[0]["truth"]).read_bytes(), surface))


def test_what_a_data_set_says_of_itself_keeps_its_schemas(made):
    for name in ("index.jsonl", "masks.json", "dataset.json"):
        schemas_kept.require_text(made / name, (made / name).read_bytes())
    row = read_index(made / "index.jsonl")[0]
    assert "colour" in schemas_kept.complaint(row | {"colour": "red"}, "dataset-row")
    assert "roll_deg" in schemas_kept.complaint(row | {"parameters": {**row["parameters"], "roll_deg": "level"}}, "dataset-row")
    assert json.loads((made / "dataset.json").read_text())["rows"] == schemas()["dataset-row"]["title"]


def test_masks_are_coco_and_every_pixel_has_one(made):
    document = json.loads((made / "masks.json").read_text())
    assert {image["id"] for image in document["images"]} == set(range(8))
    names = {c["id"]: c["name"] for c in document["categories"]}
    for image in document["images"]:
        with np.load(made / "truth" / f"{image['id']:06d}.npz") as truth:
            ids = truth["part_id"]
        drawn = np.zeros_like(ids)
        for note in document["annotations"]:
            if note["image_id"] == image["id"]:
                assert note["category_id"] in names
                mask = mask_of(note["segmentation"]["counts"], *note["segmentation"]["size"])
                assert mask.sum() == note["area"]
                x, y, w, h = note["bbox"]
                assert mask[y : y + h, x : x + w].sum() == note["area"] and mask[y].any() and mask[:, x].any()
                drawn[mask] = note["category_id"]
        assert (drawn == ids).all()


def test_a_killed_data_set_goes_on_to_the_same_bytes(made, tmp_path):
    out = tmp_path / "killed"
    process = subprocess.Popen([sys.executable, "-m", "rangecheck_cli", "dataset", str(WORKSHOP), "-o", str(out), *SMALL])
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        if (out / "underway.jsonl").exists() and (out / "underway.jsonl").read_bytes().count(b"\n") >= 2:
            break
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert exit_status(["dataset", str(WORKSHOP), "-o", str(out), *SMALL, "--threads", "1"]) == 0
    assert files_of(out) == files_of(made)


def test_runs_of_a_mask_give_it_back():
    rng = np.random.default_rng(0)
    for mask in (rng.random((7, 5)) > 0.5, np.ones((3, 2), bool), np.zeros((2, 3), bool)):
        runs = runs_of(mask)
        assert sum(runs) == mask.size and (mask_of(runs, *mask.shape) == mask).all()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[camera]\nazimut_deg = [0, 1]", "did you mean camera.azimuth_deg"),
        ("[camera]\nfill = [2, 1]", "must be [low, high]"),
        ("[camera]\nelevation_deg = [0, 89]", "between -85 and 85"),
        ("[weather]\nrain = 1", "there are camera, light"),
        ("[material]\nnames = []", "list of materials"),
    ],
)
def test_ranges_that_cannot_be_are_refused(tmp_path, text, words):
    (tmp_path / "r.toml").write_text(text)
    with pytest.raises(SettingError, match=words.replace("[", "\\[")):
        read_ranges(tmp_path / "r.toml")


def test_the_draw_of_a_picture_does_not_depend_on_the_others():
    ranges = read_ranges()
    assert ranges.draw(3, 7) == ranges.draw(3, 7) != ranges.draw(3, 8)
    drawn = [ranges.draw(0, k) for k in range(200)]
    assert {s.material for s in drawn} == set(ranges.names) and {len(s.lamps) for s in drawn} == {1, 2, 3}
    assert min(s.azimuth_deg for s in drawn) < -150 and max(s.azimuth_deg for s in drawn) > 150
