"""Line drawings against ID maps: every border of the map has a visible line within so many pixels, every visible line a border.

The map has four times as many pixels each way as the drawing; distances are in pixels of the drawing. A line may also stand where a face
hides a part of itself: there the depth jumps or bends, not the ID.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.errors import SceneError
from rangecheck.files import presets_folder
from rangecheck.maps import Maps, trace_maps
from rangecheck.modeler import Drawing, draw, read_model
from rangecheck.modeler.model import Model
from rangecheck.optics import PinholeCamera
from rangecheck.study import Part

SCENES = ("workshop", "bored_block", "ring_on_sheet", "cone_before_ball", "crossed_bars")
FINER = 4
#: a bend of depth over three pixels of the map that counts as a jump, as a share of the depth
_BEND = 6e-4


@dataclass(frozen=True)
class Agreement:
    """border_px: how far a border of the ID map lies from the nearest visible line, at most; line_px: how far a visible line lies from the
    nearest border or jump of depth, at most; lines: how many there are."""

    border_px: float
    line_px: float
    lines: int


def shipped(name: str) -> Model:
    """A scene of configs/scenes. Raises InputError."""
    return read_model(presets_folder() / "scenes" / f"{name}.toml")


def agreement(model: Model) -> Agreement:
    """How well the line drawing of a scene, seen by its own camera, agrees with its ID map. Raises SceneError without a camera."""
    camera, pose = model.camera, model.world_from_camera
    if camera is None or pose is None:
        raise SceneError(f"{model.name} has no [camera]; give it one")
    drawing = draw(model, camera, pose)
    maps = trace_maps(model.surface, _finer(camera), pose)
    borders = _borders(maps)
    to_line = _distance_px(~_inked(drawing))
    to_border = _distance_px(~(borders | _jumps(maps)))
    worst = 0.0
    for line in drawing.visible():
        steps = np.linspace(0, 1, 50)
        points = np.concatenate([a + steps[:, None] * (b - a) for a, b in zip(line.points, line.points[1:])])
        at = np.rint((points + 0.5) * FINER - 0.5).astype(int)
        inside = (at >= 0).all(axis=1) & (at < borders.shape[::-1]).all(axis=1)
        worst = max(worst, float(to_border[at[inside, 1], at[inside, 0]].max(initial=0)))
    return Agreement(float(to_line[borders].max(initial=0)), worst, len(drawing.visible()))


def _finer(camera: PinholeCamera) -> PinholeCamera:
    """The same view with FINER times as many pixels each way."""
    return replace(
        camera, width=camera.width * FINER, height=camera.height * FINER, fx=camera.fx * FINER, fy=camera.fy * FINER,
        cx=(camera.cx + 0.5) * FINER - 0.5, cy=(camera.cy + 0.5) * FINER - 0.5,
    )  # fmt: skip


def _borders(maps: Maps) -> BoolArray:
    ids = maps.part_id
    changes = np.zeros(ids.shape, bool)
    changes[:, 1:] |= ids[:, 1:] != ids[:, :-1]
    changes[1:] |= ids[1:] != ids[:-1]
    return changes


def _jumps(maps: Maps) -> BoolArray:
    depth = np.nan_to_num(maps.depth_mm, nan=1e4)
    bent = np.zeros(depth.shape, bool)
    least = _BEND * float(np.nanmedian(maps.depth_mm))
    bent[:, 1:-1] |= np.abs(depth[:, 2:] - 2 * depth[:, 1:-1] + depth[:, :-2]) > least
    bent[1:-1] |= np.abs(depth[2:] - 2 * depth[1:-1] + depth[:-2]) > least
    return bent


def _inked(drawing: Drawing) -> BoolArray:
    import cv2

    paper = np.zeros((drawing.height * FINER, drawing.width * FINER), np.uint8)
    for line in drawing.visible():
        cv2.polylines(paper, [np.rint((line.points + 0.5) * FINER - 0.5).astype(np.int32)], False, 1)
    return paper > 0


def _distance_px(away: BoolArray) -> FloatArray:
    """Pixels of the drawing from each pixel to the nearest that is not `away`."""
    import cv2

    return np.asarray(cv2.distanceTransform(away.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)) / FINER


def drawings_part(quick: bool) -> Part:
    """The shipped scenes' line drawings against their ID maps."""
    rows, findings = [], []
    for name in SCENES[1:3] if quick else SCENES:
        found = agreement(shipped(name))
        rows.append({"scene": name} | vars(found))
        kept = "kept" if max(found.border_px, found.line_px) <= 1.0 else "missed"
        findings.append(
            f"{name}: borders of the ID map lie within {found.border_px:.2f} px of a visible line, {found.lines} visible lines within "
            f"{found.line_px:.2f} px of a border (bar 1 px: {kept})"
        )
    return Part(findings=findings, tables={"drawings": rows})
