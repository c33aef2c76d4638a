"""Photographed spheres under known lights: what is rendered is what the camera saw."""

import math

import numpy as np
import pytest
from test_transport import ball

from rangecheck import rigid
from rangecheck.optics import OrthographicCamera
from rangecheck.reflectance import GREY_UM, Material
from rangecheck.scene import Scene, Source
from rangecheck.transport import DIRECT, Settings, Tracer

pytestmark = pytest.mark.real_data
FAR_MM = 1e6


def photograph(folder, kind, number):
    import cv2

    return cv2.imread(str(folder / "spheres_photographed" / kind / f"{kind}.{number}.png"), cv2.IMREAD_GRAYSCALE).astype(float)


def lights(folder):
    return np.loadtxt(folder / "spheres_photographed" / "lights.txt", skiprows=1)


def sphere_scene(material, radius, direction, angular_radius_deg):
    """A ball of `radius` pixels (1 mm each) about the origin under one distant lamp that gives irradiance pi."""
    surface = ball(5, radius)
    lamp = Source.giving(math.pi, np.zeros(3), FAR_MM * direction / np.linalg.norm(direction), angular_radius_deg)
    return Scene(surface, (material,), sources=(lamp,), smooth=True, vertex_normals=surface.vertices / radius)


def camera_at(centre, size):
    """One millimetre per pixel, the ball's middle at pixel `centre`, seen from +z."""
    return OrthographicCamera(size[0], size[1], 1.0, *centre), rigid.look_at((0, 0, 1000.0), (0, 0, 0))


def test_the_matt_grey_sphere_is_lambert_with_one_gain_for_all_twelve_photographs(real_data):
    centre, radius = (244.5, 144.5), 108.0
    white = Material("white", K_lm=1.0, wavelengths_um=GREY_UM)
    seen, rendered = [], []
    for k, direction in enumerate(lights(real_data)):
        photo = photograph(real_data, "gray", k)
        camera, pose = camera_at(centre, photo.shape[::-1])
        picture = Tracer(sphere_scene(white, radius, direction, 0.1)).render(camera, pose, DIRECT).radiance[..., 0]
        # more than 15 degrees from the terminator, and off the sphere's rim by two pixels
        rows, columns = np.indices(photo.shape)
        inside = np.hypot(columns - centre[0], rows - centre[1]) < radius - 2
        chosen = inside & (picture > math.sin(math.radians(15))) & (photo < 255)
        seen.append(photo[chosen] / 255)
        rendered.append(picture[chosen])
    photo, picture = np.concatenate(seen), np.concatenate(rendered)
    gain = float((photo @ picture) / (picture @ picture))
    residual = float(np.sqrt(((photo - gain * picture) ** 2).mean()))
    assert len(photo) > 200_000
    assert gain == pytest.approx(0.727, abs=0.02)
    assert residual <= 0.04


def highlight(picture):
    """Middle of the brightest part, (column, row)."""
    rows, columns = np.nonzero(picture >= 0.98 * picture.max())
    weight = picture[rows, columns]
    return np.array([np.average(columns, weights=weight), np.average(rows, weights=weight)])


def test_highlights_on_the_chrome_sphere_lie_where_the_photographs_have_them(real_data):
    import cv2

    mask = cv2.imread(str(real_data / "spheres_photographed" / "chrome" / "chrome.mask.png"), cv2.IMREAD_GRAYSCALE) > 127
    rows, columns = np.nonzero(mask)
    centre = (0.5 * (columns.min() + columns.max()), 0.5 * (rows.min() + rows.max()))
    radius = 0.25 * (np.ptp(columns) + np.ptp(rows) + 2)
    chrome = Material("chrome", K_ss=0.6, wavelengths_um=GREY_UM)
    given, away = lights(real_data), []
    for k in range(12):
        photo = np.where(mask, photograph(real_data, "chrome", k), 0.0)
        place = highlight(photo)
        # the direction that the photograph itself says: mirror the view at the normal under the highlight
        x, y = (place[0] - centre[0]) / radius, -(place[1] - centre[1]) / radius
        normal = np.array([x, y, math.sqrt(1 - x * x - y * y)])
        direction = 2 * normal[2] * normal - [0.0, 0.0, 1.0]
        camera, pose = camera_at(centre, mask.shape[::-1])
        settings = Settings(centre=True, depth=1, lobe=False, diffuse=False, backdrop=False)
        film = Tracer(sphere_scene(chrome, radius, direction, 1.5)).render(camera, pose, settings)
        assert np.linalg.norm(highlight(film.radiance[..., 0].astype(float)) - place) < 1.0
        listed = given[k] / np.linalg.norm(given[k])
        away.append(math.degrees(math.acos(min(1.0, float(direction @ listed)))))
    # lights.txt itself: its directions lie 1 to 8.5 degrees from those of the photographs, 2.5 in the median
    assert min(away) > 1.0 and max(away) < 8.5 and np.median(away) < 2.6
