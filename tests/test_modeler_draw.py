"""Line drawings agree with the maps: where the ID changes there is a line, and where there is a line something changes."""

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest

from rangecheck import rigid
from rangecheck.errors import SceneError
from rangecheck.modeler import draw, model_from_dict, svg_text, write_svg
from rangecheck.modeler.draw import BORDER, CREASE, SILHOUETTE
from rangecheck.optics import OrthographicCamera, PinholeCamera
from rangecheck.studies.pictures_lines import SCENES, agreement, shipped

CAMERA = PinholeCamera.from_field_of_view(240, 200, 30)
BLOCK = {"name": "block", "shape": "box", "size_mm": [60, 40, 50]}
POSE = rigid.look_at((120, 110, 170), (0, 5, 0))


@pytest.mark.parametrize("name", SCENES)
def test_visible_lines_and_borders_of_the_id_map_agree_to_a_pixel(name):
    model = shipped(name)
    # half the pixels each way: the same view, drawn coarser
    camera = PinholeCamera.from_field_of_view(
        model.camera.width // 2, model.camera.height // 2, 2 * math.degrees(math.atan(0.5 * model.camera.width / model.camera.fx))
    )
    found = agreement(replace(model, camera=camera))
    assert found.border_px <= 1.0 and found.line_px <= 1.0, found


def test_a_box_shows_nine_edges_and_hides_three():
    model = model_from_dict({"body": [BLOCK]})
    drawing = draw(model, CAMERA, POSE, hidden=True)
    # six edges of the outline make one closed line; three creases meet in the near corner; three are hidden
    outline = [line for line in drawing.visible() if line.kind == SILHOUETTE]
    creases = [line for line in drawing.visible() if line.kind == CREASE]
    assert len(outline) == 1 and (outline[0].points[0] == outline[0].points[-1]).all() and len(outline[0].points) == 7
    assert len(creases) == 3
    hidden = [line for line in drawing.lines if not line.visible]
    assert len(hidden) == 3
    corners = CAMERA.project(rigid.move_points(rigid.inverse(POSE), model.surface.vertices))[0]
    for line in drawing.lines:
        for point in line.points[[0, -1]]:
            assert np.abs(corners - point).max(axis=1).min() < 1e-3


def test_a_ball_is_drawn_as_its_outline_only():
    model = model_from_dict({"tolerance_mm": 0.01, "body": [{"name": "b", "shape": "sphere", "radius_mm": 30}]})
    pose = rigid.look_at((0, 0, 200), (0, 0, 0))
    (circle,) = draw(model, CAMERA, pose).visible()
    radius = np.hypot(*(circle.points - [CAMERA.cx, CAMERA.cy]).T)
    exact = CAMERA.fx * 30 / np.sqrt(200**2 - 30**2)
    # facets lie inside the sphere by at most the tolerance
    assert radius.max() <= exact + 1e-6 and radius.min() >= exact - 2 * 0.01 * CAMERA.fx / 200
    assert circle.kind == SILHOUETTE and np.ptp(np.arctan2(*(circle.points - [CAMERA.cx, CAMERA.cy]).T)) > 6


def test_orthographic_views_and_sheets_are_drawn_too():
    model = model_from_dict({"body": [{"name": "s", "shape": "plane", "size_mm": [40, 20]}]})
    camera = OrthographicCamera(100, 80, 1.0, 49.5, 39.5)
    for above in (1, -1):
        drawing = draw(model, camera, rigid.look_at((0, 50 * above, 0), (0, 0, 0), up=(0, 0, -1)))
        (border,) = drawing.visible()
        assert border.kind == BORDER
        assert sorted(np.ptp(border.points, axis=0).tolist()) == pytest.approx([20, 40])


def test_edges_through_the_camera_plane_are_cut_and_those_behind_are_left_out():
    model = model_from_dict({"body": [{"name": "s", "shape": "plane", "size_mm": [400, 400]}, BLOCK | {"at_mm": [0, 20, 300]}]})
    drawing = draw(model, CAMERA, rigid.look_at((0, 50, 100), (0, 0, -100)))
    assert all(np.isfinite(line.points).all() for line in drawing.lines) and drawing.visible()
    with pytest.raises(SceneError, match="behind the camera"):
        draw(model, CAMERA, rigid.look_at((0, 50, 1000), (0, 50, 2000)))


def test_the_svg_is_well_formed_and_the_same_each_time(tmp_path):
    model = shipped("workshop")
    drawing = draw(model, model.camera, model.world_from_camera, hidden=True)
    write_svg(tmp_path / "a.svg", drawing, "a < b & c")
    root = ElementTree.parse(tmp_path / "a.svg").getroot()
    assert root.attrib["viewBox"] == "0 0 640 480"
    classes = {path.attrib["class"] for path in root.iter("{http://www.w3.org/2000/svg}path")}
    assert {"silhouette", "crease", "border", "crease hidden"} <= classes
    again = svg_text(draw(model, model.camera, model.world_from_camera, hidden=True), "a < b & c")
    assert (tmp_path / "a.svg").read_text() == again
