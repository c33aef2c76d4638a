"""The planner keeps its promise, says why, and repeats itself; small mirrored sources keep their energy."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_transport import ball, floor, lamp, looking

from rangecheck import kernels
from rangecheck.errors import SettingError
from rangecheck.reflectance import GREY_UM, Material
from rangecheck.scene import DARKNESS, Scene, constant, gradient, stripes
from rangecheck.surface import Surface
from rangecheck.surface.surface import join
from rangecheck.transport import REPORT, Settings, Tracer, make_plan, render
from rangecheck.transport.adaptive import render_to
from rangecheck.transport.glint import circle_in_wedge
from rangecheck.transport.settings import FULL

PLASTER = Material("plaster", K_lm=0.85, wavelengths_um=GREY_UM)
STEEL = Material("steel", K_s=0.62, sigma_um=0.02, correlation_um=3.0, wavelengths_um=GREY_UM)
SATIN = Material("satin", K_s=0.62, sigma_um=0.1, correlation_um=3.0, wavelengths_um=GREY_UM)
MIRROR = Material("mirror", K_ss=0.8, wavelengths_um=GREY_UM)
LAMPS = (lamp((200, 260, 220), 30.0, 20.0), lamp((-260, 120, 160), 25.0, 8.0))


def bowl():
    """The inside of half a sphere, open towards +z."""
    whole = ball(4, 50.0, inward=True)
    return whole.with_faces(whole.triangles.mean(axis=1)[:, 2] < 0)


def scene(name):
    shape, material, sky = name.split()
    surface: Surface = {"ball": ball(4), "table": join([floor(200.0, -50.0), ball(4)]), "bowl": bowl()}[shape]
    made = {"plaster": PLASTER, "steel": STEEL, "satin": SATIN}[material]
    around = {
        "dark": DARKNESS,
        "even": constant(0.3),
        "sky": gradient(0.05, 0.5),
        "stripes": stripes(0.05, 0.8, 30.0, softness=0.3),
    }
    lamps = () if sky == "stripes" else LAMPS
    return Scene(
        surface, (made,), sources=lamps, surroundings=around[sky], smooth_of_part=(False, True)[-len(surface.part_names) :]
    )


SCENES = [
    "ball plaster dark", "ball plaster sky", "table plaster dark", "table plaster even", "bowl plaster dark", "bowl plaster sky",
    "ball steel sky", "ball satin sky", "table steel stripes", "table satin even", "bowl steel sky", "bowl satin stripes",
]  # fmt: skip


def difference(film, reference):
    """Root mean square over the frame, relative to the reference's mean."""
    gap = film.radiance.astype(float) - reference.radiance
    return math.sqrt((gap**2).mean()) / reference.mean_radiance


@pytest.mark.parametrize("name", SCENES)
def test_the_plan_keeps_its_promise(name):
    tolerance = 0.04
    tracer = Tracer(scene(name))
    camera, pose = looking(20, 20, fov=26.0, eye=(0, 60, 290))
    plan = make_plan(tracer, camera, pose, tolerance=tolerance)
    film = render(tracer, camera, pose, plan=plan, seed=3)
    full = tracer.render(camera, pose, Settings(passes=96, each=4, depth=32), seed=11)
    # the reference's own noise is allowed for, and nothing else
    noise = full.standard_error() / full.mean_radiance
    assert difference(film, full) < math.hypot(tolerance, noise), plan.explain()


def test_the_plan_leaves_out_what_is_not_there_and_says_so():
    tracer = Tracer(scene("ball plaster dark"))
    plan = make_plan(tracer, *looking(32, 32), tolerance=0.02)
    # a convex body in the dark: nothing but light straight from the sources
    assert plan.settings.depth == 1 and not (plan.settings.spike or plan.settings.lobe or plan.settings.diffuse)
    said = "\n".join(plan.explain())
    assert "mirroring (spike): no material has it" in said and "diffuse interreflection: left out; the pilot finds" in said
    concave = make_plan(Tracer(scene("bowl plaster dark")), *looking(32, 32), tolerance=0.02)
    assert concave.settings.diffuse and concave.settings.depth > 1
    assert any("diffuse interreflection: kept" in line for line in concave.explain())


def test_light_of_many_reflections_is_followed_to_its_end_or_left_out_early():
    # white surfaces that nearly touch hold a pilot's rarest light: a depth between would rest on a few of its paths
    for name in ("table plaster dark", "bowl plaster dark"):
        plan = make_plan(Tracer(scene(name)), *looking(16, 16, eye=(0, 60, 290)), tolerance=0.005)
        assert plan.settings.depth <= 4 or plan.settings.depth == FULL.depth


def test_a_tighter_tolerance_never_models_less():
    tracer = Tracer(scene("table satin even"))
    camera, pose = looking(24, 24)
    loose, tight = (make_plan(tracer, camera, pose, tolerance=t) for t in (0.3, 0.005))
    assert tight.settings.depth >= loose.settings.depth
    for key in ("spike", "lobe", "diffuse"):
        assert getattr(tight.settings, key) >= getattr(loose.settings, key)
    assert tight.error < loose.error


def test_grey_scenes_are_computed_at_one_wavelength_and_shown_in_all():
    colour = (0.65, 0.55, 0.45)
    scene = Scene(ball(3), (Material("white", K_lm=0.8, wavelengths_um=colour),), sources=LAMPS[:1])
    tracer = Tracer(scene)
    camera, pose = looking(16, 16)
    plan = make_plan(tracer, camera, pose)
    assert plan.grey
    film = render(tracer, camera, pose, plan=plan)
    assert film.radiance.shape == (16, 16, 3) and (np.ptp(film.radiance, axis=2) == 0).all()
    red = Scene(ball(3), (Material("red", K_lm=(0.8, 0.2, 0.2), wavelengths_um=colour),), sources=LAMPS[:1])
    assert not make_plan(Tracer(red), camera, pose).grey


def test_a_plan_and_its_picture_have_the_same_bytes_on_any_number_of_threads():
    tracer = Tracer(scene("table satin even"))
    camera, pose = looking(40, 40)
    films = []
    for count in (1, 2):
        with kernels.threads(count):
            plan = make_plan(tracer, camera, pose, tolerance=0.1, seed=5)
            films.append((plan, render(tracer, camera, pose, plan=plan, seed=5)))
    assert films[0][0] == films[1][0]
    assert films[0][1].radiance.tobytes() == films[1][1].radiance.tobytes()


def test_samples_go_where_the_error_is():
    tracer = Tracer(scene("table plaster dark"))
    camera, pose = looking(64, 64, fov=26.0, eye=(0, 60, 290))
    direct = Settings(spike=False, lobe=False, diffuse=False, depth=1)
    film = render_to(tracer, camera, pose, direct, 0.02)
    assert (film.samples == 1).mean() > 0.3 and film.samples.max() > 4 * film.samples.mean()


@pytest.mark.parametrize("tolerance", [0.0, -1.0, 0.6, math.nan])
def test_a_tolerance_must_be_one(tolerance):
    with pytest.raises(SettingError, match="it must lie between"):
        make_plan(Tracer(scene("ball plaster dark")), *looking(8, 8), tolerance=tolerance)


def test_the_dark_has_a_plan_too():
    tracer = Tracer(Scene(ball(2), (PLASTER,)))
    camera, pose = looking(8, 8)
    plan = make_plan(tracer, camera, pose)
    assert "no light at all" in "\n".join(plan.explain())
    assert (render(tracer, camera, pose, plan=plan).radiance == 0).all()


def test_a_circle_inside_a_polygon_has_its_own_area_and_a_polygon_inside_a_circle_its():
    def shared(corners, radius):
        return sum(circle_in_wedge(*corners[k], *corners[(k + 1) % len(corners)], radius) for k in range(len(corners)))

    square = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
    assert shared(square, 0.5) == pytest.approx(math.pi * 0.25, rel=1e-12)
    assert shared(square, 2.0) == pytest.approx(4.0, rel=1e-12)
    # a circle of radius 1.2 cut by four chords at distance 1
    segment = 1.44 * math.acos(1 / 1.2) - math.sqrt(0.44)
    assert shared(square, 1.2) == pytest.approx(math.pi * 1.44 - 4 * segment, rel=1e-12)
    beside = [(x + 3.0, y) for x, y in square]
    assert shared(beside, 1.0) == pytest.approx(0.0, abs=1e-12)
    assert shared([(x + 1.0, y) for x, y in square], 1.0) == pytest.approx(math.pi / 2, rel=1e-12)


def highlight(size, glints):
    surface = ball(4)
    lamps = (lamp((180, 160, 260), 2.0, 1e4),)
    room = Scene(surface, (MIRROR,), sources=lamps, smooth=True, vertex_normals=surface.vertices / 50.0)
    settings = Settings(centre=True, depth=1, lobe=False, diffuse=False, glints=glints, backdrop=False)
    return Tracer(room).render(*looking(size, size, fov=22.0), settings).radiance.mean(dtype=float)


def test_the_energy_of_a_small_highlight_does_not_depend_on_the_size_of_the_pixels():
    energies = np.array([highlight(size, "fraction") for size in (64, 128, 256, 512, 1024)])
    assert np.ptp(energies) <= 0.01 * energies[-1]


def test_corner_rays_light_more_the_larger_the_pixels():
    coarse, fine = highlight(64, "corners"), highlight(512, "corners")
    assert coarse > 3 * fine > 3 * 0.9 * highlight(512, "fraction")


def test_the_share_of_a_pixel_that_mirrors_a_source_is_what_many_rays_find():
    surface = ball(4)
    room = Scene(
        surface, (MIRROR,), sources=(lamp((180, 160, 260), 12.0, 100.0),), smooth=True, vertex_normals=surface.vertices / 50.0
    )
    camera, pose = looking(48, 48, fov=22.0)
    base = Settings(depth=1, lobe=False, diffuse=False, backdrop=False)
    share = Tracer(room).render(camera, pose, replace(base, centre=True, glints="fraction"))
    rays = Tracer(room).render(camera, pose, replace(base, passes=16, each=64, glints="ray"))
    assert rays.radiance.max() > 0
    # 1024 rays spread evenly over a pixel find an area to about one in 1024^0.75; cells are straight-sided
    assert np.abs(share.radiance - rays.radiance).max() < 80.0 * (4 / 1024**0.75 + 0.01)
    assert share.mean_radiance == pytest.approx(rays.mean_radiance, rel=0.01)


def test_the_fan_of_rings_gathers_what_drawn_rays_gather_where_it_is_fine_enough():
    # a lobe of 15 degrees in surroundings that change slowly: rings 5 degrees apart are enough
    wide = Material("wide", K_s=0.8, sigma_um=1.0, correlation_um=10.0, wavelengths_um=GREY_UM)
    room = Scene(floor(4000.0), (wide,), surroundings=gradient(0.1, 1.0))
    camera, pose = looking(12, 12, eye=(0, 400, 300))
    tracer = Tracer(room)
    drawn = tracer.render(camera, pose, Settings(passes=256, each=4, depth=1, spike=False))
    rings = Settings(centre=True, depth=1, spike=False, gather="fan", lobe_rays=14)
    assert difference(tracer.render(camera, pose, rings), drawn) < 0.02
    # one ray weighs a narrow lobe wrongly, whatever its solid angle
    narrow = Scene(floor(4000.0), (SATIN,), surroundings=constant(1.0))
    coarse = Tracer(narrow).render(camera, pose, replace(rings, fan_step_deg=5.0, lobe_rays=3))
    fine = Tracer(narrow).render(camera, pose, replace(rings, fan_step_deg=0.5, lobe_rays=40))
    exact = Tracer(narrow).render(camera, pose, Settings(passes=64, each=4, depth=1, spike=False))
    assert difference(fine, exact) < 0.02 < difference(coarse, exact)


def test_the_reports_own_approximations_can_be_had():
    tracer = Tracer(scene("table satin even"))
    camera, pose = looking(16, 16)
    plan = make_plan(tracer, camera, pose, model="report")
    assert plan.settings == REPORT and plan.error is None
    film = render(tracer, camera, pose, plan=plan)
    assert np.isfinite(film.radiance).all() and film.radiance.max() > 0
    full = make_plan(tracer, camera, pose, model="full", tolerance=0.15)
    assert full.settings.depth == 64
    best = render(tracer, camera, pose, plan=full)
    assert best.standard_error() <= 0.05 * best.mean_radiance
    with pytest.raises(SettingError, match="plan, full, report"):
        make_plan(tracer, camera, pose, model="fast")


def figure_scene(name):
    """Figure 8's ball, or figure 11's ball on a plane, of an intermediately rough perfect conductor."""
    rough = Material("rough", K_s=1.0, sigma_um=0.1, correlation_um=3.0, wavelengths_um=(0.555,))
    surface = ball(5)
    if name == "figure 8":
        room = Scene(
            surface, (rough,), sources=(lamp((250, 300, 260), 4.0, 60.0),), smooth=True, vertex_normals=surface.vertices / 50.0
        )
        return room, looking(128, 128, fov=24.0)
    both = join([floor(300.0, -50.0), surface])
    lamps = (lamp((150, 200, 300), 12.0, 30.0),)
    room = Scene(both, (rough,), sources=lamps, surroundings=gradient(0.05, 0.4), smooth_of_part=(False, True))
    return room, looking(48, 48, fov=34.0, eye=(0, 130, 300), at=(0, -15, 0))


def test_figure_8_shows_a_broad_lobe_and_a_small_bright_spot_at_once():
    room, (camera, pose) = figure_scene("figure 8")
    both = Tracer(room).render(camera, pose, Settings(centre=True, depth=1, shadow_rays=4)).radiance[..., 0]
    lobe = Tracer(room).render(camera, pose, Settings(centre=True, depth=1, shadow_rays=4, spike=False)).radiance[..., 0]
    row, column = np.unravel_index(np.argmax(both), both.shape)
    # the spot stands above the lobe under it, and is a few pixels wide, while the lobe covers ten times as many
    assert both[row, column] > 1.5 * lobe[row, column]
    spot = (both - lobe) > 0.5 * (both - lobe).max()
    wide = lobe > 0.5 * lobe.max()
    assert spot.sum() <= 4 and wide.sum() > 10 * spot.sum()


def test_figure_11_shows_the_plane_in_the_ball():
    room, (camera, pose) = figure_scene("figure 11")
    alone = Scene(ball(5), room.materials, sources=room.sources, surroundings=room.surroundings, smooth=True)
    settings = Settings(passes=8, each=4, depth=4)
    together, single = Tracer(room).render(camera, pose, settings), Tracer(alone).render(camera, pose, settings)
    below = (single.coverage == 1) & (together.coverage == 1)
    below[: below.shape[0] // 2] = False
    changed = np.abs(together.radiance - single.radiance)[below].mean()
    assert changed > 10 * np.sqrt((together.variance + single.variance)[below].mean() / below.sum())
    assert float(together.shares()["reflections"]["2"]) > 0.05


def test_time_to_an_error_is_read_between_measured_points_and_beyond_them():
    from rangecheck.transport.benchmark import TimedError, time_to_error

    points = [TimedError("a", str(k), 1.0 * 4**k, 0.08 / 2**k) for k in range(3)]
    assert time_to_error(points, "a", 0.04) == pytest.approx(4.0)
    assert time_to_error(points, "a", 0.04 / math.sqrt(2)) == pytest.approx(8.0)
    assert time_to_error(points, "a", 0.01) == pytest.approx(64.0)
    assert time_to_error(points, "a", 0.1) == 1.0
    assert math.isnan(time_to_error(points, "b", 0.1))


def test_the_bare_cast_of_a_picture_casts_the_rays_of_that_picture():
    from rangecheck.transport.benchmark import cast_ratio
    from rangecheck.transport.settings import DIRECT

    tracer = Tracer(scene("table plaster dark"))
    measured = cast_ratio(tracer, *looking(64, 64, fov=26.0, eye=(0, 60, 290)), DIRECT, repeats=1)
    # every pixel, and two shadow rays at most from each
    assert 64 * 64 < measured.rays <= 3 * 64 * 64 and measured.ratio > 0


def test_each_material_gets_the_cheapest_form_of_its_lobe_that_the_picture_allows():
    smooth = Material("polished", K_s=0.6, sigma_um=0.004, correlation_um=3.0, wavelengths_um=GREY_UM)
    room = Scene(
        join([floor(200.0, -50.0), ball(4)]),
        (smooth, SATIN),
        material_of_part=(0, 1),
        sources=LAMPS,
        surroundings=gradient(0.05, 0.5),
    )
    tracer = Tracer(room)
    camera, pose = looking(24, 24, fov=26.0, eye=(0, 60, 290))
    plan = make_plan(tracer, camera, pose, tolerance=0.02)
    assert plan.forms == ("smooth", "fast")
    said = "\n".join(plan.explain())
    assert "lobe of polished: the smooth form" in said and "lobe of satin: the fast form, within 0.1 % of the series" in said
    same = [render(tracer, camera, pose, plan=replace(plan, forms=forms)) for forms in (plan.forms, ())]
    assert difference(*same) < 0.2 * 0.02


def test_nearly_grey_scenes_are_computed_at_one_wavelength_where_the_tolerance_allows():
    nearly = Material("nearly white", K_lm=(0.801, 0.8, 0.799), wavelengths_um=(0.65, 0.55, 0.45))
    tracer = Tracer(Scene(ball(3), (nearly,), sources=LAMPS[:1]))
    plan = make_plan(tracer, *looking(16, 16), tolerance=0.02)
    assert plan.grey and any("the others differ by" in line for line in plan.explain())
    assert not make_plan(tracer, *looking(16, 16), tolerance=0.0002).grey


def test_diffuse_light_is_looked_up_where_interpolation_is_good_enough_and_says_so():
    tracer = Tracer(scene("ball plaster sky"))
    camera, pose = looking(24, 24, fov=26.0, eye=(0, 60, 290))
    loose = make_plan(tracer, camera, pose, tolerance=0.05)
    assert loose.settings.gather_diffuse == "paths"
    assert any("followed path by path, about" in line for line in loose.explain())
    plan = make_plan(tracer, camera, pose, tolerance=0.005)
    assert plan.settings.diffuse and plan.settings.gather_diffuse == "cache"
    assert any("diffuse light: looked up at the surface seen;" in line for line in plan.explain())
    # on a ball that sees nothing of itself what the sky gives is all, and the paths' picture knows it
    full = tracer.render(camera, pose, Settings(passes=64, each=4, depth=4), seed=9)
    noise = full.standard_error() / full.mean_radiance
    assert difference(render(tracer, camera, pose, plan=plan), full) < math.hypot(0.005, noise)


def test_light_looked_up_one_reflection_on_is_that_of_paths():
    tracer = Tracer(scene("table plaster dark"))
    camera, pose = looking(20, 20, fov=26.0, eye=(0, 60, 290))
    settings = Settings(each=16, spike=False, lobe=False, depth=12)
    paths = [tracer.render(camera, pose, replace(settings, passes=6), seed=seed) for seed in (1, 2)]
    kept = tracer.render(camera, pose, replace(settings, gather_diffuse="second", records=3000, passes=2), seed=3)
    noise = math.hypot(kept.standard_error(), paths[0].standard_error()) / kept.mean_radiance
    assert difference(kept, paths[0]) < 1.5 * noise
    # over the frame noise averages out: what keeping shifts the mean by is below a percent and three standard errors of the paths' mean
    mean = 0.5 * (paths[0].mean_radiance + paths[1].mean_radiance)
    assert abs(kept.mean_radiance / mean - 1) < 0.01 + 3 * noise / 20
    assert kept.variance.mean() * 2 * 16 < 0.5 * paths[0].variance.mean() * 6 * 16


def test_two_pictures_tell_the_error_of_their_mean_and_keep_a_tight_promise_with_fewer_samples():
    tracer = Tracer(scene("ball plaster dark"))
    camera, pose = looking(24, 24, fov=26.0, eye=(0, 60, 290))
    plan = make_plan(tracer, camera, pose, tolerance=0.006)
    film = render(tracer, camera, pose, plan=plan, seed=3)
    full = tracer.render(camera, pose, Settings(passes=128, each=16, depth=1, spike=False, lobe=False, diffuse=False), seed=11)
    assert difference(film, full) < 0.006
    assert film.samples.mean() < render_to(tracer, camera, pose, plan.settings, plan.error, seed=3).samples.mean()
