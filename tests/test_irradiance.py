"""Light kept on surfaces is the light that paths would find there: closed forms, every path traced, and the error that is stated."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_transport import SATIN, WHITE, ball, floor, lamp, looking, seen_points

from rangecheck import kernels
from rangecheck.analytic import light
from rangecheck.errors import SceneError, SettingError
from rangecheck.optics import PinholeCamera
from rangecheck.raycast import EmbreeCaster
from rangecheck.reflectance import GREY_UM, Material
from rangecheck.scene import Scene, constant, gradient
from rangecheck.surface.surface import join
from rangecheck.transport import Settings, Tracer
from rangecheck.transport.geometry import geometry_of
from rangecheck.transport.irradiance import gather_irradiance
from rangecheck.transport.irradiance_nodes import nodes_around, nodes_of

BLACK = Material("black", K_lm=0.0, wavelengths_um=GREY_UM)
KEPT = Settings(gather_diffuse="cache", spike=False, lobe=False, records=400)


@pytest.mark.parametrize("scatterings", [2, 4, None])
def test_an_enclosure_is_its_closed_form_after_each_scattering(scatterings):
    scene = Scene(ball(4, 100.0, inward=True), (WHITE,), sources=(lamp((0, 0, 0), 5.0, 20.0),))
    flux = 4 * math.pi * math.pi * 5.0**2 * 20.0
    truth = light.enclosure_radiance(0.8, flux, 100.0, scatterings)
    settings = replace(KEPT, centre=True, depth=scatterings or 64, shadow_rays=0)
    film = Tracer(scene).render(PinholeCamera.from_field_of_view(24, 24, 60.0), np.eye(4), settings)
    # 5120 flat faces lie inside the sphere by up to (edge/2)^2/(2 r) of 7.5 mm edges, and their area is smaller by twice that share
    edge = math.sqrt(4 * math.pi * 100.0**2 / 5120 * 4 / math.sqrt(3))
    share = 3 * (edge / 2) ** 2 / (2 * 100.0**2) / (1 - 0.8) + 1e-3
    assert film.radiance == pytest.approx(np.full_like(film.radiance, truth), rel=share)


def test_bodies_that_reflect_everything_vanish_in_even_surroundings():
    white = Material("all", K_lm=1.0, wavelengths_um=GREY_UM)
    scene = Scene(join([floor(60.0, -30.0), ball(3, 25.0)]), (white,), surroundings=constant(0.5))
    film = Tracer(scene).render(*looking(24, 24), replace(KEPT, passes=2, depth=64))
    assert film.radiance == pytest.approx(np.full_like(film.radiance, 0.5), rel=2e-3)


def test_a_black_ball_hides_its_form_factor_of_the_sky_from_the_floor():
    scene = Scene(join([floor(400.0), ball(4, 30.0, (0, 50, 0))]), (WHITE, BLACK), (0, 1), surroundings=constant(1.0))
    camera, pose = looking(64, 64, eye=(0, 250, 300))
    tracer = Tracer(scene)
    settings = replace(KEPT, centre=True, depth=4, records=4000)
    film = tracer.render(camera, pose, settings)
    points, hits = seen_points(camera, pose, tracer.caster)
    on_floor = (hits.face >= 0) & (hits.face < 2)
    height = np.linalg.norm(points[on_floor] - [0, 50.0, 0], axis=1)
    truth = 0.8 * (1 - 30.0**2 * 50.0 / height**3)
    gap = film.radiance.ravel()[on_floor] - truth
    cache = tracer.irradiance(4, 4000)
    # a face of the icosphere takes at most (edge/2)^2/(2 r) from its radius of 30; the rest is what the cache states of itself, and the
    # noise of 128 evenly spread rays: below one ray's share
    assert np.sqrt((gap**2).mean()) < 2 * cache.error + 1 / 128
    assert abs(gap.mean()) < 0.003
    assert cache.error < 0.04


def test_a_bowl_looks_as_if_its_paths_were_traced():
    whole = ball(4, 50.0, inward=True)
    bowl = whole.with_faces(whole.triangles.mean(axis=1)[:, 2] < 0)
    scene = Scene(bowl, (WHITE,), sources=(lamp((150, 250, 200), 20.0, 20.0),), surroundings=gradient(0.1, 0.6), smooth=True)
    camera, pose = looking(24, 24, eye=(0, 80, 280))
    tracer = Tracer(scene)
    kept = tracer.render(camera, pose, replace(KEPT, passes=8, each=4, depth=5, backdrop=False), seed=1)
    followed = [
        tracer.render(camera, pose, Settings(passes=96, each=4, depth=5, spike=False, lobe=False, backdrop=False), seed=seed)
        for seed in (2, 3)
    ]
    inside = followed[0].coverage == 1
    gaps = [(kept.radiance - film.radiance)[inside].astype(float) for film in followed]
    off = math.sqrt(max(float((gaps[0] * gaps[1]).mean()), 0.0)) / float(followed[0].radiance[inside].mean())
    cache = tracer.irradiance(5, KEPT.records)
    assert cache.met and off < 0.01 + 2 * cache.error
    assert kept.radiance[inside].mean() == pytest.approx(followed[0].radiance[inside].mean(), rel=0.01)


def test_both_sides_of_an_open_surface_keep_their_own_light():
    sky = gradient(0.0, 1.0)
    scene = Scene(floor(100.0), (WHITE,), surroundings=sky)
    tracer = Tracer(scene)
    above, below = (
        tracer.render(*looking(4, 4, fov=2.0, eye=(0, y, 1), at=(0, 0, 0)), replace(KEPT, centre=True, depth=2)).radiance
        for y in (300, -300)
    )
    # up, the gradient from 0 to 1 gives by cosine 1/2 + 1/3; down the rest
    assert above == pytest.approx(np.full_like(above, 0.8 * 5 / 6), rel=0.01)
    assert below == pytest.approx(np.full_like(below, 0.8 * 1 / 6), rel=0.03)


def test_sides_that_keep_nothing_are_followed_path_by_path():
    # a closed ball keeps light outside only; a camera in it sees the other side of its faces
    scene = Scene(ball(3, 100.0), (WHITE,), sources=(lamp((0, 0, 0), 5.0, 20.0),))
    camera, flux = PinholeCamera.from_field_of_view(16, 16, 60.0), 4 * math.pi * math.pi * 5.0**2 * 20.0
    pose = np.eye(4)
    pose[2, 3] = 50.0
    film = Tracer(scene).render(camera, pose, replace(KEPT, passes=32, depth=3, shadow_rays=0))
    truth = light.enclosure_radiance(0.8, flux, 100.0, 3)
    error = math.sqrt(film.variance.mean() / film.variance.size)
    # 1280 flat faces: (edge/2)^2/(2 r^2) of 15 mm edges, three times over for each of three scatterings
    assert film.mean_radiance == pytest.approx(truth, abs=4 * error + 9 * 7.5**2 / (2 * 100.0**2) * truth)


def test_the_cache_is_the_same_on_any_number_of_threads_and_for_every_picture():
    scene = Scene(join([floor(200.0), ball(3, 30.0, (0, 30, 0))]), (WHITE,), sources=(lamp((150, 250, 100), 30.0, 20.0),))
    camera, pose = looking(40, 30, eye=(0, 150, 250))
    pictures, lights = [], []
    for count in (1, 3):
        with kernels.threads(count):
            tracer = Tracer(scene)
            for _ in range(2):
                pictures.append(tracer.render(camera, pose, KEPT, seed=4).radiance.tobytes())
            lights.append(tracer.irradiance(KEPT.depth, KEPT.records).stored.light.tobytes())
    assert len(set(pictures)) == 1 and len(set(lights)) == 1


def test_the_light_budget_counts_kept_light():
    scene = Scene(join([floor(200.0), ball(3, 30.0, (0, 30, 0))]), (WHITE,), sources=(lamp((150, 250, 100), 30.0, 20.0),))
    film = Tracer(scene).render(*looking(32, 32, eye=(0, 150, 250)), KEPT)
    assert film.budget.sum() == pytest.approx(film.mean_radiance, rel=1e-4)


def test_light_is_not_kept_where_something_shines():
    scene = Scene(ball(2), (SATIN,), surroundings=constant(1.0))
    with pytest.raises(SceneError, match="satin"):
        gather_irradiance(Tracer(scene))
    with pytest.raises(SettingError, match="paths, second, cache"):
        Settings(gather_diffuse="hope")


@kernels.kernel
def _place_at(node_of_face, steps, place, face, u, v, out):
    for i in range(len(u)):
        a, b, d, p, q, r = nodes_around(node_of_face, steps, face, u[i], v[i])
        for axis in range(3):
            out[i, axis] = p * place[a, axis] + q * place[b, axis] + r * place[d, axis]


def test_nodes_around_a_place_are_those_around_it():
    surface = floor(100.0)
    scene = Scene(surface, (WHITE,))
    caster = EmbreeCaster(surface.vertices, surface.faces)
    nodes = nodes_of(geometry_of(scene, caster), 100_000)
    u, v = np.random.default_rng(5).random((2, 500))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    u[:3], v[:3] = (0, 1, 0), (0, 0, 1)
    found = np.empty((len(u), 3))
    _place_at(nodes.node_of_face, nodes.steps, nodes.place, 1, u, v, found)
    corners = caster.vertices[caster.faces[1]]
    truth = (1 - u - v)[:, None] * corners[0] + u[:, None] * corners[1] + v[:, None] * corners[2]
    # nodes stand a twentieth of a cell inside their face
    cell = np.linalg.norm(corners[1] - corners[0]) * math.sqrt(2) / nodes.steps[1]
    assert nodes.steps[1] > 100
    assert np.abs(found - truth).max() < 0.06 * cell
