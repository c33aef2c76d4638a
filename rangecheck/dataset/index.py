"""The index: one JSON line a picture, and masks in COCO's form (uncompressed runs, column by column)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rangecheck.arrays import BoolArray
from rangecheck.errors import InputError
from rangecheck.files import read_bytes

SCHEMA, ROW_SCHEMA = "rangecheck/dataset/1", "rangecheck/dataset-row/1"


def runs_of(mask: BoolArray) -> list[int]:
    """Lengths of the runs of a mask (h, w), column by column, the first of False, as COCO counts them."""
    flat = np.asarray(mask, bool).ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    runs = np.diff(np.r_[0, changes, len(flat)]).tolist()
    return [0, *runs] if len(flat) and flat[0] else runs


def mask_of(runs: Sequence[int], height: int, width: int) -> BoolArray:
    """(h, w) the mask whose runs these are. Raises InputError where they do not fill it."""
    if sum(runs) != height * width:
        raise InputError("mask", f"has runs of {sum(runs)} pixels; the picture has {height * width}")
    values = np.arange(len(runs)) % 2 == 1
    return np.repeat(values, runs).reshape(width, height).T


def regions(part_id: Any, names: Sequence[str]) -> list[dict[str, Any]]:
    """One row for every part seen: name, area, bounding box [x, y, w, h], runs."""
    found = []
    for number in np.unique(part_id[part_id > 0]):
        mask = part_id == number
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        box = [int(columns[0]), int(rows[0]), int(np.ptp(columns) + 1), int(np.ptp(rows) + 1)]
        found.append(
            {"part": int(number), "name": names[number - 1], "area": int(mask.sum()), "bbox": box, "runs": runs_of(mask)}
        )
    return found


def masks_document(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> dict[str, Any]:
    """The pictures and masks of an index in the form of a COCO annotation file."""
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for row in rows:
        images.append({"id": row["index"], "file_name": row["picture"], "width": row["width"], "height": row["height"]})
        for region in row["regions"]:
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": row["index"],
                    "category_id": region["part"],
                    "area": region["area"],
                    "bbox": region["bbox"],
                    "iscrowd": 1,
                    "segmentation": {"size": [row["height"], row["width"]], "counts": region["runs"]},
                }
            )
    categories = [{"id": k + 1, "name": name, "supercategory": "surface"} for k, name in enumerate(names)]
    return {"info": {"schema": SCHEMA}, "images": images, "annotations": annotations, "categories": categories}


def read_index(path: str | Path) -> list[dict[str, Any]]:
    """The rows of an index; a last line that was cut off by a stop is left out. Raises InputError for any other broken line."""
    lines = read_bytes(path).split(b"\n")
    rows = []
    for number, line in enumerate(lines):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
            if not isinstance(row, dict) or not {"index", "picture", "truth"} <= row.keys():
                raise ValueError("it lacks index, picture or truth")
        except (ValueError, RecursionError) as error:
            if number == len(lines) - 1:
                break
            raise InputError(path, f"line {number + 1} is no row of an index ({error})") from None
        rows.append(row)
    return rows
