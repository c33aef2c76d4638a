"""Pictures obey the laws of light: closed forms, no leaks, no bias, and the same bytes however they are computed."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rangecheck import kernels, rigid
from rangecheck.analytic import light
from rangecheck.optics import OrthographicCamera, PinholeCamera
from rangecheck.reflectance import GREY_UM, Material
from rangecheck.scene import Scene, Source, constant, gradient
from rangecheck.surface import Surface
from rangecheck.surface.surface import join
from rangecheck.transport import DIRECT, Plan, Settings, Tracer, Tracers, image_irradiance, render
from rangecheck.transport.camera_rays import pixel_order

WHITE = Material("white", K_lm=0.8, wavelengths_um=GREY_UM)
MIRROR = Material("mirror", K_ss=0.7, wavelengths_um=GREY_UM)
SATIN = Material("satin", K_s=0.9, sigma_um=0.1, correlation_um=3.0, wavelengths_um=GREY_UM)


def ball(n=5, radius_mm=50.0, centre=(0.0, 0.0, 0.0), name="ball", inward=False):
    """A sphere of 20 x 4^n faces whose vertices lie on it."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=n, radius=1.0)
    points = np.asarray(mesh.vertices) / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    faces = np.asarray(mesh.faces, np.int32)
    return Surface(points * radius_mm + centre, faces[:, ::-1] if inward else faces, part_names=(name,))


def floor(size_mm=400.0, y_mm=0.0, name="floor"):
    corners = 0.5 * size_mm * np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], float) + [0, y_mm, 0]
    return Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]), part_names=(name,))


def lamp(centre, radius_mm, radiance=10.0):
    return Source(np.array(centre, float), radius_mm, np.atleast_1d(np.asarray(radiance, float)))


def looking(width=48, height=48, fov=30.0, eye=(0, 0, 300), at=(0, 0, 0)):
    return PinholeCamera.from_field_of_view(width, height, fov), rigid.look_at(np.array(eye, float), np.array(at, float))


def seen_points(camera, pose, caster):
    origins, directions = camera.pixel_rays()
    o, d = rigid.move_points(pose, origins).reshape(-1, 3), rigid.move_directions(pose, directions).reshape(-1, 3)
    hits = caster.closest(o, d)
    return o + np.where(np.isfinite(hits.distance_mm), hits.distance_mm, np.nan)[:, None] * d, hits


def test_a_plane_under_one_source_is_its_closed_form():
    scene = Scene(floor(), (WHITE,), sources=(lamp((40, 160, -30), 25.0),))
    camera, pose = looking(64, 48, eye=(0, 250, 200))
    tracer = Tracer(scene)
    film = tracer.render(camera, pose, DIRECT)
    points, hits = seen_points(camera, pose, tracer.caster)
    truth = light.lit_patch_radiance(points, np.array([0.0, 1, 0]), (40, 160, -30), 25.0, 10.0, 0.8)
    met = hits.face >= 0
    assert met.any()
    # rays leave a skin above the plane, and light falls with the square of the distance
    assert film.radiance.ravel()[met] == pytest.approx(truth[met], rel=4 * tracer.caster.skin_mm / 160 + 1e-6)


def test_a_ball_under_one_source_is_its_closed_form_also_where_the_horizon_cuts_the_source():
    surface = ball(6)
    scene = Scene(surface, (WHITE,), sources=(lamp((120, 60, 90), 30.0),), smooth=True, vertex_normals=surface.vertices / 50.0)
    camera, pose = looking(64, 64, fov=24.0)
    tracer = Tracer(scene)
    film = tracer.render(camera, pose, DIRECT)
    points, hits = seen_points(camera, pose, tracer.caster)
    points = np.where(np.isnan(points), [0.0, 0.0, 50.0], points)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    # smooth faces are lit as the round surface that their normals describe
    points = 50.0 * normals
    truth = light.lit_patch_radiance(points, normals, (120, 60, 90), 30.0, 10.0, 0.8)
    to_light = np.array([120.0, 60, 90]) - points
    cosine = (normals * to_light).sum(1) / np.linalg.norm(to_light, axis=1)
    # the middle of the source decides about shadow, so compare where it is above the horizon
    lit = (hits.face >= 0) & (cosine > 0.02)
    assert lit.sum() > 1000
    # near the horizon the skin of float32 that rays keep from the surface shows, as a share of the cosine
    share = 1e-4 + tracer.caster.skin / cosine[lit]
    assert (np.abs(film.radiance.ravel()[lit] - truth[lit]) <= share * truth[lit]).all()


def test_two_sources_add_and_shadows_take_away():
    both = join([floor(), ball(3, 20.0, (0, 60, 0))])
    lamps = (lamp((0, 300, 0), 5.0), lamp((250, 200, 0), 5.0))
    camera, pose = looking(48, 32, fov=40.0, eye=(0, 200, 300))

    def picture(*sources):
        return Tracer(Scene(both, (WHITE,), sources=sources)).render(camera, pose, DIRECT).radiance

    assert np.allclose(picture(*lamps), picture(lamps[0]) + picture(lamps[1]), rtol=1e-6)
    # straight under the ball the floor is dark, beside it lit
    under = Tracer(Scene(both, (WHITE,), sources=lamps[:1]))
    camera = OrthographicCamera(3, 1, 90.0, 1.0, 0.0)
    film = under.render(camera, rigid.look_at((0, 5, 200), (0, 5, 0)), DIRECT)
    assert film.radiance.shape == (1, 3, 1)
    down = rigid.look_at((0, 30.0, 1e-3), (0, 0, 0), up=(0, 0, 1))
    assert under.render(PinholeCamera.from_field_of_view(1, 1, 1.0), down, DIRECT).radiance.item() == 0.0


def test_the_background_is_exactly_the_surroundings_or_dark():
    scene = Scene(ball(2, 10.0), (WHITE,), sources=(lamp((0, 200, 0), 5.0),), surroundings=constant(0.25))
    camera, pose = looking()
    film = Tracer(scene).render(camera, pose, DIRECT)
    outside = film.coverage == 0
    assert outside.any() and (film.radiance[outside] == np.float32(0.25)).all()
    dark = Tracer(scene).render(camera, pose, Settings(centre=True, depth=1, backdrop=False))
    assert (dark.radiance[outside] == 0).all()


def test_a_source_in_view_is_seen_with_its_radiance():
    scene = Scene(ball(2, 10.0), (WHITE,), sources=(lamp((60, 0, 0), 8.0, 7.0),))
    camera, pose = looking(200, 200)
    film = Tracer(scene).render(camera, pose, DIRECT)
    uv, _ = camera.project(rigid.move_points(rigid.inverse(pose), np.array([60.0, 0, 0])))
    u, v = np.round(uv).astype(int)
    assert film.radiance[v, u, 0] == 7.0
    # its disc has the area of its solid angle, drawn out away from the axis by 1/cos^3; pixels on its rim go either way
    cosine = 300.0 / math.hypot(300.0, 60.0)
    area = math.pi * 8.0**2 / (300.0**2 + 60.0**2) * camera.fx**2 / cosine**3
    assert (film.radiance == 7.0).sum() == pytest.approx(area, abs=3 * math.sqrt(2 * math.sqrt(math.pi * area)))


@pytest.mark.parametrize("material", [WHITE, MIRROR, SATIN], ids=lambda m: m.name)
def test_nothing_is_negative_or_undefined_where_light_grazes(material):
    both = join([floor(4000.0), ball(3, 30.0, (0, 30.0, 0))])
    scene = Scene(both, (material,), sources=(lamp((1500, 1.0, 0), 0.9), lamp((-300, 200, 0), 20.0)), surroundings=constant(0.1))
    camera, pose = looking(64, 64, fov=50.0, eye=(0, 0.5, 900), at=(0, 10, 0))
    film = Tracer(scene).render(camera, pose, Settings(passes=4, depth=5))
    assert np.isfinite(film.radiance).all() and (film.radiance >= 0).all()


def test_a_mirror_shows_what_is_in_the_mirror_direction():
    room = gradient(0.2, 1.0)
    scene = Scene(floor(4000.0), (MIRROR,), surroundings=room)
    camera, pose = looking(32, 32, eye=(0, 300, 400))
    tracer = Tracer(scene)
    film = tracer.render(camera, pose, Settings(centre=True, depth=2))
    _, hits = seen_points(camera, pose, tracer.caster)
    directions = rigid.move_directions(pose, camera.pixel_rays()[1]).reshape(-1, 3)
    mirrored = directions * [1, -1, 1]
    met = hits.face >= 0
    assert met.all()
    assert film.radiance.ravel() == pytest.approx(0.7 * room.radiance(mirrored)[:, 0], rel=1e-5)


def test_a_body_that_reflects_everything_vanishes_in_even_surroundings():
    # a white furnace: whatever the shape, every path ends in the same radiance with nothing lost on the way
    for material in (Material("all", K_lm=1.0, wavelengths_um=GREY_UM), Material("mirror", K_ss=1.0, wavelengths_um=GREY_UM)):
        both = join([floor(60.0, -30.0), ball(3, 25.0)])
        scene = Scene(both, (material,), surroundings=constant(0.5))
        film = Tracer(scene).render(*looking(24, 24), Settings(passes=8, depth=64, roulette_from=0))
        lost = 1 - film.radiance / 0.5
        # only paths cut off after 64 reflections are missing
        assert lost.min() > -1e-5 and lost.mean() < 1e-3


def test_steel_never_gains_light():
    smooth = Scene(ball(4), (SATIN,), surroundings=constant(1.0), smooth=True)
    film = Tracer(smooth).render(*looking(32, 32), Settings(passes=32, depth=4))
    met = film.coverage == 1
    error = np.sqrt(film.variance[met].mean() / met.sum())
    assert film.radiance[met].mean() < 0.9 + 4 * error
    assert film.radiance[met].mean() > 0.8


@pytest.mark.parametrize("scatterings", [1, 2, 4, None])
def test_an_enclosure_is_its_closed_form_after_each_scattering(scatterings):
    wall = ball(4, 100.0, inward=True)
    bulb = lamp((0, 0, 0), 5.0, 20.0)
    flux = 4 * math.pi * math.pi * 5.0**2 * 20.0
    truth = light.enclosure_radiance(0.8, flux, 100.0, scatterings)
    camera = PinholeCamera.from_field_of_view(24, 24, 60.0)
    scene = Scene(wall, (WHITE,), sources=(bulb,))
    settings = Settings(passes=64, depth=scatterings or 64, shadow_rays=0)
    film = Tracer(scene).render(camera, rigid.look_at((0, 0, 50.0), (0, 0, 100.0)), settings)
    # 5 120 flat faces lie inside the sphere by 0.04 % of its radius, and light falls as its square
    tolerance = 2e-3 * truth + 4 * np.sqrt(film.variance.mean() / film.variance.size)
    assert film.radiance.mean() == pytest.approx(truth, abs=tolerance)


def test_soft_shadows_have_the_mean_of_their_closed_form():
    # the floor in the shadow of a ball as large as the source: compare with many point sources on it
    both = join([floor(600.0), ball(4, 20.0, (0, 80, 0))])
    camera = OrthographicCamera(16, 1, 10.0, 7.5, 0.0)
    down = rigid.look_at((0, 50, 0), (0, 0, 0), up=(0, 0, 1))
    scene = Scene(both, (WHITE,), sources=(lamp((0, 300, 0), 40.0),))
    film = Tracer(scene).render(camera, down, Settings(passes=64, centre=True, shadow_rays=4, depth=1))
    more = Tracer(scene).render(camera, down, Settings(passes=16, centre=True, shadow_rays=64, depth=1), seed=5)
    error = np.sqrt(film.variance + more.variance)
    assert (np.abs(film.radiance - more.radiance) <= 4.5 * error + 1e-6).all()
    profile = more.radiance.ravel()
    assert profile.max() > 2 * profile[7:9].max() >= 0
    assert np.allclose(profile, profile[::-1], atol=float(6 * error.max()) + 1e-6)


def test_every_way_of_splitting_a_reflection_has_the_same_mean():
    both = join([floor(), ball(3, 30.0, (0, 30, 0))])
    half = Material("half", K_lm=0.4, K_s=0.5, sigma_um=0.15, correlation_um=3.0, wavelengths_um=GREY_UM)
    scene = Scene(both, (half,), sources=(lamp((150, 250, 100), 30.0, 20.0),), surroundings=gradient(0.1, 0.8))
    camera, pose = looking(24, 24, eye=(0, 150, 250), at=(0, 20, 0))
    tracer = Tracer(scene)
    ways = [
        Settings(passes=48, depth=6, lobe_rays=2, diffuse_rays=2, shadow_rays=1, roulette_from=1),
        Settings(passes=24, depth=6, lobe_rays=6, diffuse_rays=4, shadow_rays=3, roulette_from=0),
    ]
    first, second = (tracer.render(camera, pose, way, seed=k) for k, way in enumerate(ways))
    error = math.sqrt((first.variance.mean() + second.variance.mean()) / first.variance.size)
    assert abs(first.mean_radiance - second.mean_radiance) < 4 * error
    z = (first.radiance - second.radiance) / np.sqrt(first.variance + second.variance + 1e-12)
    # 576 pixels: no z beyond 4.5 is expected once in two hundred runs even if the variances were exact
    assert np.abs(z).max() < 4.5


def test_the_light_budget_adds_up_to_the_picture():
    both = join([floor(), ball(3, 30.0, (0, 30, 0))])
    scene = Scene(both, (SATIN, WHITE), (0, 1), (lamp((150, 250, 100), 30.0, 20.0),), constant(0.3))
    film = Tracer(scene).render(*looking(32, 32, eye=(0, 150, 250)), Settings(passes=4, depth=4))
    assert film.budget.sum() == pytest.approx(film.mean_radiance, rel=1e-4)
    for part in film.shares().values():
        assert sum(part.values()) == pytest.approx(1.0)
    assert set(film.shares()["light"]) == {"source 0", "surroundings"}


def test_the_same_picture_has_the_same_bytes_on_one_thread_and_on_two_and_another_seed_another():
    both = join([floor(), ball(3, 30.0, (0, 30, 0))])
    scene = Scene(both, (SATIN,), sources=(lamp((150, 250, 100), 30.0, 20.0),), surroundings=gradient(0.1, 0.8))
    camera, pose = looking(100, 90, eye=(0, 150, 250))
    settings = Settings(passes=2, depth=4, shadow_rays=2)
    films = []
    for count in (1, 2, 3):
        with kernels.threads(count):
            films.append(Tracer(scene).render(camera, pose, settings, seed=7))
    for film in films[1:]:
        assert film.radiance.tobytes() == films[0].radiance.tobytes()
        assert film.variance.tobytes() == films[0].variance.tobytes()
        assert film.budget.tobytes() == films[0].budget.tobytes()
    assert Tracer(scene).render(camera, pose, settings, seed=8).radiance.tobytes() != films[0].radiance.tobytes()


def test_tracers_of_one_surface_share_its_tree_and_make_the_pictures_of_their_own(monkeypatch):
    one = Scene(ball(), (WHITE,), sources=(lamp((150, 150, 200), 40.0),), smooth=True)
    other = replace(one, materials=(SATIN,), sources=(), surroundings=gradient(0.1, 0.9))
    camera, pose = looking()
    alone = [Tracer(scene).render(camera, pose).radiance for scene in (one, other)]
    built = []
    monkeypatch.setattr("rangecheck.transport.tracers.Tracer", lambda scene: built.append(scene) or Tracer(scene))
    tracers = Tracers()
    assert [tracers.of(s).render(camera, pose).radiance.tobytes() for s in (one, other)] == [a.tobytes() for a in alone]
    flat = replace(one, smooth=False)
    assert tracers.of(flat).render(camera, pose).radiance.tobytes() == Tracer(flat).render(camera, pose).radiance.tobytes()
    assert built == [one, flat]


def test_a_scene_far_from_the_origin_gives_the_same_picture():
    def picture(offset):
        both = join([floor(), ball(3, 30.0, (0, 30, 0))]).moved(rigid.from_rotation_translation(np.eye(3), offset))
        scene = Scene(both, (WHITE,), sources=(lamp(np.array([150, 250, 100]) + offset, 30.0, 20.0),))
        eye = np.array([0, 150, 250.0]) + offset
        camera = PinholeCamera.from_field_of_view(64, 64, 40.0)
        return Tracer(scene).render(camera, rigid.look_at(eye, np.array([0, 30, 0]) + offset), DIRECT).radiance

    here, far = picture(np.zeros(3)), picture(np.array([5e5, 4.5e6, 1e5]))
    # coordinates of millions keep 1e-9 mm: only pixels that rounding moves across an edge may differ
    same = np.isclose(here, far, rtol=1e-4, atol=1e-6)
    assert same.mean() > 0.999


def test_a_coarse_smooth_ball_does_not_shade_itself_in_facets():
    scene = Scene(ball(2), (WHITE,), sources=(lamp((400, 0, 60), 1.0, 1e4),), smooth=True)
    camera, pose = looking(96, 96, fov=22.0)
    tracer = Tracer(scene)
    shaded = tracer.render(camera, pose, DIRECT).radiance.ravel()
    points, hits = seen_points(camera, pose, tracer.caster)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    to_light = np.array([400.0, 0, 60]) - points
    cosine = (normals * to_light).sum(1) / np.linalg.norm(to_light, axis=1)
    # edges of 320 faces span 0.3 rad: normals are good to 0.3^2/8; every pixel lit by more than that must not be in shadow
    lit = (hits.face >= 0) & (cosine > 0.3**2 / 4)
    assert lit.sum() > 1000 and (shaded[lit] > 0).all()


def test_open_surfaces_are_lit_from_the_side_that_is_seen():
    scene = Scene(floor(), (WHITE,), sources=(lamp((0, -200, 0), 10.0),))
    camera, pose = looking(8, 8, eye=(0, -300, 100))
    assert (Tracer(scene).render(camera, pose, DIRECT).radiance > 0).all()
    camera, pose = looking(8, 8, eye=(0, 300, 100))
    assert (Tracer(scene).render(camera, pose, DIRECT).radiance == 0).all()


def test_samples_spent_where_a_picture_is_uneven_do_what_samples_everywhere_would():
    scene = Scene(
        join([ball(), floor(y_mm=-50.0)]),
        (WHITE,),
        (0, 0),
        (lamp((200, 300, 200), 20.0),),
        constant(0.0),
        smooth_of_part=(True, False),
    )
    tracer, pose = Tracer(scene), looking(64, 64, 30, eye=(0, 120, 300))
    lit = Settings(each=4, uneven=0.15, spike=False, lobe=False, diffuse=False, depth=1, backdrop=False)

    def picture(**other):
        return render(tracer, *pose, plan=Plan("direct", 0.0, replace(lit, **other), None), seed=3)

    reference = picture(each=256, uneven=0.0).radiance
    edges, everywhere, single = picture(), picture(uneven=0.0), picture(each=1, uneven=0.0, centre=True)

    def error(film):
        return float(np.sqrt(np.mean((film.radiance - reference) ** 2)))

    uneven = edges.samples == 4
    assert (edges.samples[~uneven] == 1).all() and 0.02 < uneven.mean() < 0.3
    assert error(edges) < 1.1 * error(everywhere) < 0.7 * error(single)
    assert np.array_equal(edges.radiance, picture().radiance)


def test_image_irradiance_falls_off_towards_the_corners():
    scene = Scene(ball(1, 1.0), (WHITE,), surroundings=constant(2.0))
    camera, pose = looking(41, 41, fov=80.0)
    film = Tracer(scene).render(camera, pose, Settings(centre=True, depth=1))
    image = image_irradiance(film, camera, lens_diameter_mm=10.0, focal_length_mm=50.0)
    cosine = camera.pixel_rays()[1][0, 0, 2]
    assert image[0, 0, 0] == pytest.approx(2.0 * math.pi / 4 * 0.04 * cosine**4, rel=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (64, 64), (130, 67), (3, 500)])
def test_every_pixel_is_visited_once_and_sixteen_neighbours_together(size):
    width, height = size
    order = pixel_order(width, height)
    assert (np.sort(order) == np.arange(width * height)).all()
    if width % 64 == 0 and height % 64 == 0:
        rows, columns = np.divmod(order.reshape(-1, 16), width)
        assert (np.ptp(rows, axis=1) == 3).all() and (np.ptp(columns, axis=1) == 3).all()
