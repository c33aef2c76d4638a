"""What `import rangecheck as rc` offers: ten names, loaded when used, which look like what they are in a notebook."""

import inspect
import subprocess
import sys

import cv2
import numpy as np
import pytest

import rangecheck as rc
from rangecheck.modeler.primitives import sphere
from rangecheck.optics import PinholeCamera

#: the public names and what they take; a change here is a change for everybody who uses them
FROZEN = {
    "RangeScan": "range_mm camera world_from_scan brightness name unit noise_mm",
    "Solid": "surface verdict notes _proof",
    "Surface": "vertices faces part_of_face origin_of_face part_names vertex_error_mm refined_of_face",
    "check_solid": None,
    "load_material": "name_or_path",
    "mesh_scans": None,
    "read_mesh": None,
    "read_scans": None,
    "render": "what material size azimuth_deg elevation_deg camera_mm tolerance_percent seed",
    "run": "scans out unit force preset settings",
}


def test_the_public_names_are_these_ten_and_take_what_they_took():
    assert set(rc.__all__) == set(FROZEN)
    assert set(rc.__all__) <= set(dir(rc))
    for name, parameters in FROZEN.items():
        if parameters is not None:
            assert " ".join(inspect.signature(getattr(rc, name)).parameters) == parameters, name


def test_importing_loads_nothing_heavy():
    code = "import sys, rangecheck; print(*sorted({'numpy', 'numba', 'cv2', 'trimesh', 'matplotlib'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == ""


def test_an_unknown_name_is_answered_with_the_known_ones():
    with pytest.raises(AttributeError, match="read_scans"):
        _ = rc.scan_everything


def _decoded(png: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.fixture(scope="module")
def ball():
    body = sphere(40.0, 0.5)
    return rc.Surface(body.vertices, body.faces)


def test_a_surface_a_solid_and_a_frame_look_round_in_a_notebook(ball):
    film = rc.render(ball, size=(64, 64))
    for thing in (ball, rc.Solid.from_surface(ball), film):
        picture = _decoded(thing._repr_png_()).astype(float)
        edge, middle = picture[0, 0].mean(), picture[len(picture) // 2, len(picture) // 2].mean()
        assert abs(edge - middle) > 40  # an object before a background
    assert film.coverage[32, 32] == 1.0 and film.coverage[0, 0] == 0.0


def test_a_scan_looks_lit_from_one_side():
    camera = PinholeCamera.from_field_of_view(64, 48, 40.0)
    _, directions = camera.pixel_rays()
    along = directions @ [0.0, 0.0, 300.0]
    inside = along**2 - (300.0**2 - 60.0**2)
    scan = rc.RangeScan(np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), np.nan).astype(np.float32), camera)
    picture = _decoded(scan._repr_png_()).astype(float)
    assert picture[0, 0].min() == 255  # where nothing returned it is white
    assert picture[17, 25] > picture[31, 39] + 50  # the light is at the upper left


def test_a_material_shows_its_polar_plots():
    assert "<svg" in rc.load_material("steel")._repr_html_()


def test_azimuth_0_is_the_front_and_the_orbit_goes_round(ball):
    front = rc.render(ball, size=(32, 32))
    assert np.array_equal(front.radiance, rc.render(ball, size=(32, 32), azimuth_deg=0.0).radiance)
    assert not np.array_equal(front.radiance, rc.render(ball, size=(32, 32), azimuth_deg=120.0).radiance)
