"""Derivatives of the light that a surface sends to the camera, and what photographs of a known shape say of its material and lamps."""

from dataclasses import replace

import numpy as np
import pytest
from test_transport import ball

from rangecheck import rigid
from rangecheck.errors import SceneError, SettingError
from rangecheck.optics import PinholeCamera
from rangecheck.raycast import EmbreeCaster
from rangecheck.recover.fit import fit
from rangecheck.recover.lights import ONE_NODE, SEVEN_NODES, Light, tangents
from rangecheck.recover.looks import Look, brought_over
from rangecheck.recover.polish import in_own_unit, polish
from rangecheck.recover.problem import Guess, Photograph, Problem, Unknowns
from rangecheck.recover.sight import lit_by, see, sphere_sight
from rangecheck.reflectance import Material
from rangecheck.reflectance.fast import FAST_ERROR
from rangecheck.scene import Scene
from rangecheck.transport import DIRECT, Tracer

FAR_MM = 1e6
EVERYTHING = Unknowns(
    ("K_lm", "K_spike", "K_lobe", "sigma_um", "correlation_um"), True, True, True, True, True, True, True, first_fixed=False
)


def problem_on(sight, lights, guess, unknowns, nodes=ONE_NODE, noise=0.01):
    n = len(sight)
    photo = Photograph(sight, np.zeros(n), np.full(n, noise), np.ones((n, len(lights)), bool), tuple(range(len(lights))))
    return Problem((photo,), lights, guess, unknowns, nodes)


def photographed(problem, seed, noise=0.01):
    """The problem with pictures of its own state, noisy."""
    rng = np.random.default_rng(seed)
    photos = []
    for k, photo in enumerate(problem.photographs):
        clean = problem.predict(problem.start(), k, slopes=False).values
        photos.append(replace(photo, values=np.minimum(clean + rng.normal(0, noise, len(clean)), 1.0)))
    return replace(problem, photographs=tuple(photos))


@pytest.mark.parametrize("masking", ["none", "smith", "v-groove"])
@pytest.mark.parametrize(
    ("nodes", "index"),
    [(ONE_NODE, (0.0, 0.0)), (SEVEN_NODES, (0.0, 0.0)), (SEVEN_NODES, (2.0, 3.7))],
    ids=["middle", "spread", "spread, steel"],
)
def test_every_derivative_of_radiance_is_that_of_finite_differences(masking, nodes, index):
    lights = (
        Light(np.array([0.3, 0.5, 0.8]), 2.0, np.zeros(3), 200.0, 5.0),
        Light(np.array([-0.9, 0.2, 0.1]), 1.0, np.zeros(3), 1e4, 3.0),
    )
    sight = sphere_sight((20, 20), 17, (41, 41), 1.0)
    metal = Guess(0.4, 0.3, 0.5, 0.12, 2.5, masking=masking, n=index[0], k=index[1])
    problem = problem_on(sight, lights, metal, EVERYTHING, nodes)
    parameters = problem.parameters()
    rng = np.random.default_rng(1)
    theta = problem.start() + 0.02 * rng.normal(size=len(parameters)) * [p.unit for p in parameters]
    slopes = problem.predict(theta, 0).slopes
    for k, p in enumerate(parameters):
        step = np.zeros(len(theta))
        step[k] = 1e-5 * p.unit
        if p.kind == "pose":
            continue
        ahead, behind = (problem.predict(theta + s, 0, slopes=False).values for s in (step, -step))
        differences = (ahead - behind) / (2 * step[k])
        assert np.abs(differences - slopes[:, k]).max() < 1e-5 * np.abs(differences).max(), p.name


def test_a_lobe_weaker_than_any_that_is_looked_for_widens_what_is_known_of_the_matt_share():
    matt, lamp = Guess(0.6, 0.0, 0.0, 0.6, 1.6), Light(np.array([0.3, 0.4, 0.8]), 2.0, np.zeros(3), 1e6, 0.25)
    only = Unknowns(("K_lm",), direction=False)
    problem = photographed(problem_on(sphere_sight((30, 30), 25, (61, 61)), (lamp,), matt, only, noise=1e-6), 0, 1e-6)
    found = fit(replace(problem, unknowns=Unknowns(("K_lm", "K_lobe"), direction=False)))
    known = found.estimate("K_lm")
    assert found.estimate("K_lobe").at_bound and known.low <= 0.6 <= known.high and known.high - known.low < 1e-4


def bumpy_ball():
    surface = ball(3, 50.0)
    wave = 1 + 0.05 * np.sin(surface.vertices @ [0.1, 0.07, 0.05])
    return replace(surface, vertices=surface.vertices * wave[:, None])


def test_a_camera_that_looks_past_the_object_is_shifted_until_the_model_lies_on_the_picture():
    surface, camera = bumpy_ball(), PinholeCamera.from_field_of_view(56, 56, 16.0)
    middle, pose = surface.bounds_mm.mean(axis=0), np.array(rigid.look_at((100, 80, 400.0), surface.bounds_mm.mean(axis=0)))
    light = Light(np.array([-0.4, 0.5, 0.8]), 2.0, middle, 1e6, 0.25)
    scene = Scene(surface, (Material("grey", K_lm=0.4, wavelengths_um=(0.555,)),), sources=(light.source(),), smooth=True)
    seen = np.nan_to_num(Tracer(scene).render(camera, pose, DIRECT).radiance[..., 0])
    caster, past = EmbreeCaster(surface.vertices, surface.faces), pose.copy()
    # what is beside the object is as bright as the object is on average, and says nothing
    beside = np.ones(seen.size, bool)
    beside[see(scene, camera, pose, caster).pixel] = False
    seen[beside.reshape(seen.shape)] = 0.1
    past[:3, 3] += 9.0 * pose[:3, 0] - 5.0 * pose[:3, 1]
    look = Look(scene, caster, camera, past, [seen], 0.01)
    problem = problem_on(look.see(), (light,), Guess(0.3, 0.0, 0.0), Unknowns(("K_lm",), direction=False, pose=True))
    problem = brought_over(look.at(problem, problem), look)
    a_pixel = 2.0 * 413.0 * np.tan(np.radians(8.0)) / 56
    assert np.abs((look.pose - pose)[:3, 3]).max() < a_pixel and len(problem.photographs[0].sight)


@pytest.mark.parametrize("pivot", [None, (5.0, -3.0, 2.0)], ids=["about the camera", "about a pivot"])
def test_the_pose_s_derivative_is_the_change_of_the_picture_where_the_same_triangle_is_seen(pivot):
    scene = Scene(bumpy_ball(), (Material("grey", K_lm=0.5, wavelengths_um=(0.555,)),), smooth=True)
    camera, pose = PinholeCamera.from_field_of_view(40, 40, 12.0), rigid.look_at((100, 80, 500.0), (0, 0, 0))
    lights = (Light(np.array([0.5, 0.6, 0.7]), 2.0, np.zeros(3), 400.0, 4.0),)
    guess = Guess(0.4, 0.0, 0.3, 0.2, 3.0)
    unknowns = Unknowns((), direction=False, pose=True)
    middle = None if pivot is None else np.array(pivot)
    start = see(scene, camera, pose, pivot_mm=middle)
    slopes = problem_on(start, lights, guess, unknowns).predict(np.zeros(6), 0).slopes
    for k in range(6):
        step = 4e-6 if k < 3 else 1.2e-3
        shown, faces = {}, []
        for times in (-2, -1, 1, 2):
            moved = pose.copy()
            if k < 3:
                turn = rigid.about_axis(np.eye(3)[k], times * step)[:3, :3]
                moved[:3, :3] = turn @ pose[:3, :3]
                if middle is not None:
                    moved[:3, 3] = middle + turn @ (pose[:3, 3] - middle)
            else:
                moved[k - 3, 3] += times * step
            sight = see(scene, camera, moved)
            values = problem_on(sight, lights, guess, unknowns).predict(np.zeros(6), 0, slopes=False).values
            shown[times] = sight.spread(values)
            faces.append(sight.spread(sight.face.astype(float)))
        same = np.all([face == start.spread(start.face.astype(float)) for face in faces], axis=0)
        # Richardson: what differences of two steps have in common of the step's square falls away
        near, wide = ((shown[n] - shown[-n])[same] / (2 * n * step) for n in (1, 2))
        differences = (4 * near - wide) / 3
        mine = start.spread(slopes[:, k])[same]
        assert same.sum() > 0.9 * len(start)
        assert np.abs(differences - mine).max() < 1e-5 * np.abs(mine).max()


def test_one_camera_s_pose_moves_every_picture_as_its_own_pose_would():
    sight = sphere_sight((20, 20), 17, (41, 41), 1.0)
    light = Light(np.array([0.3, 0.5, 0.8]), 2.0, np.zeros(3), 200.0, 5.0)
    one = problem_on(sight, (light,), Guess(), Unknowns((), direction=False, pose=True))
    two = replace(one, photographs=one.photographs * 2, unknowns=replace(one.unknowns, one_camera=True))
    assert [p.name for p in two.parameters()][:2] == ["camera turn x", "camera turn y"] and len(two.parameters()) == 6
    for k in range(2):
        assert np.array_equal(two.predict(two.start(), k).slopes, one.predict(one.start(), 0).slopes)


@pytest.mark.parametrize("metal", [False, True], ids=["perfect conductor", "steel"])
def test_what_is_predicted_is_what_the_tracer_renders(metal):
    surface = bumpy_ball()
    steel = {"index_um": (0.5, 0.6), "n": (2.06, 2.06), "k": (3.7, 3.7)} if metal else {}
    material = Material(
        "satin", K_lm=0.3, K_sl=0.4, sigma_um=0.15, correlation_um=3.0, wavelengths_um=(0.555,), bounded=False, **steel
    )
    light = Light(np.array([0.5, 0.6, 0.7]), 2.0, np.zeros(3), 400.0, 1.0)
    scene = Scene(surface, (material,), sources=(light.source(),), smooth=True)
    camera, pose = PinholeCamera.from_field_of_view(64, 64, 12.0), rigid.look_at((100, 80, 500.0), (0, 0, 0))
    tracer = Tracer(scene)
    picture = tracer.render(camera, pose, DIRECT).radiance[..., 0].reshape(-1)
    sight = see(scene, camera, pose, tracer.caster)
    guess = Guess(0.3, 0.0, 0.4, 0.15, 3.0, n=2.06 * metal, k=3.7 * metal)
    problem = problem_on(sight, (light,), guess, Unknowns())
    problem = replace(problem, photographs=(replace(problem.photographs[0], lit=lit_by(sight, (light,), tracer.caster)),))
    shown = problem.predict(problem.start(), 0, slopes=False).values
    c_i = (sight.normals * light.direction).sum(1)
    # not at the terminator, where the tracer bends normals and lifts points, and within the table's error and float32 normals
    clear = (c_i > 0.15) & ((sight.normals * sight.views).sum(1) > 0.2) & (picture[sight.pixel] > 0)
    assert clear.sum() > 0.5 * len(sight)
    assert np.abs(shown - picture[sight.pixel])[clear].max() < 3 * FAST_ERROR * picture.max()


def angles_between(started, direction):
    """Where `direction` lies in the two angles of a light's parameters."""
    base = started.direction
    aside = direction - direction @ base * base
    return np.arccos(min(1.0, direction @ base)) / np.linalg.norm(aside) * (tangents(base) @ aside)


def test_material_and_lamp_come_back_from_one_noisy_saturated_photograph_with_outliers():
    sight = sphere_sight((40, 40), 38, (81, 81))
    light = Light(np.array([0.4, 0.3, 0.8]), 1.2, np.zeros(3), FAR_MM, 0.5)
    truth = Guess(0.4, 0.0, 0.3, 0.12, 1.2)
    problem = photographed(problem_on(sight, (light,), truth, Unknowns()), 3)
    photo = problem.photographs[0]
    values = photo.values.copy()
    values[::97] = np.random.default_rng(0).random(len(values[::97]))
    wrong = replace(light, direction=light.direction + [0.1, -0.1, 0.05])
    found = fit(replace(problem, photographs=(replace(photo, values=values),), lights=(wrong,), material=Guess()))
    assert found.converged and 0.9 < found.scale < 1.1 and 0.002 < found.outliers < 0.02
    for estimate in found.estimates[:4]:
        true = getattr(truth, estimate.name)
        width = estimate.high - estimate.low
        assert estimate.low - 0.3 * width < true < estimate.high + 0.3 * width, estimate
        assert width < 0.5 * true
    assert np.degrees(np.arccos(found.problem.lights[0].direction @ light.direction)) < 0.3


def test_intervals_are_wide_enough_where_a_few_pixels_hold_the_highlight():
    sight = sphere_sight((10, 10), 9, (21, 21))
    light = Light(np.array([0.2, 0.3, 0.9]), 0.5, np.zeros(3), FAR_MM, 0.5)
    truth = {"K_lm": 0.05, "K_lobe": 0.3, "light 0 direction a": 0.0, "light 0 direction b": 0.0}
    problem = problem_on(sight, (light,), Guess(0.05, 0.0, 0.3, 1.0, 25.0), Unknowns(("K_lm", "K_lobe")))
    brightest = problem.predict(problem.start(), 0, slopes=False).values.max()
    problem = replace(problem, lights=(replace(light, irradiance=0.45 / brightest),))
    found = [e for seed in range(100) for e in polish(photographed(problem, seed)).estimates if e.low is not None]
    inside = np.mean([e.low <= truth[e.name] <= e.high for e in found])
    # the fit follows such pixels: their residuals, taken as they are, made it two in three
    assert len(found) > 300 and abs(inside - 0.95) < 3 * np.sqrt(0.95 * 0.05 / len(found))


def test_a_cast_shadow_is_not_taken_for_dark_paint():
    sight = sphere_sight((40, 40), 36, (81, 81))
    lights = (
        Light(np.array([0.4, 0.3, 0.8]), 2.0, np.zeros(3), FAR_MM),
        Light(np.array([-0.5, 0.1, 0.8]), 0.6, np.zeros(3), FAR_MM),
    )
    put = problem_on(sight, lights, Guess(0.4, 0.0, 0.2, 0.15, 2.0), Unknowns(direction=False))
    lit = np.stack([sight.points[:, 0] < 0.2 * sight.points[:, 1], np.ones(len(sight), bool)], axis=1)
    shaded = photographed(replace(put, photographs=(replace(put.photographs[0], lit=lit),)), seed=5)
    found = fit(replace(shaded, material=Guess()))
    blind = fit(replace(shaded, material=Guess(), photographs=(replace(shaded.photographs[0], lit=np.ones_like(lit)),)))
    assert found.estimate("K_lm").low < 0.4 < found.estimate("K_lm").high and found.scale < 1.1
    # and where nobody knows of the shadow, its pixels are outliers
    assert blind.estimate("K_lm").low < 0.4 < blind.estimate("K_lm").high and blind.outliers > 0.4


def test_on_a_flat_plate_under_a_far_lamp_paint_and_light_from_around_are_not_told_apart():
    ball = sphere_sight((20, 20), 17, (41, 41), 1.0)
    ahead = np.broadcast_to([0.0, 0.0, 1.0], (len(ball), 3))
    plate = replace(ball, normals=ahead.copy(), facing=ahead.copy(), points=ball.points * [1.0, 1.0, 0.0])
    light = Light(np.array([0.4, 0.3, 0.8]), 2.0, np.zeros(3), FAR_MM)
    put = problem_on(plate, (light,), Guess(0.4, 0.0, 1e-4), Unknowns(("K_lm",), direction=False, ambient=True))
    found = fit(photographed(put, seed=2))
    assert found.estimate("K_lm").low is None and found.estimate("picture 0 ambient").low is None
    [said] = found.statements
    assert "K_lm" in said and "picture 0 ambient" in said and "apart" in said
    # on a ball, which is dark where the lamp does not reach, they are
    both = fit(photographed(replace(put, photographs=(replace(put.photographs[0], sight=ball),)), seed=2))
    assert both.estimate("K_lm").low < 0.4 < both.estimate("K_lm").high and not both.statements


def test_a_mirror_s_lamp_is_found_as_large_as_it_is_where_the_fit_begins_with_a_larger():
    sight = sphere_sight((60, 58), 50, (121, 121))
    ahead = np.array([0.4, 0.3, 0.8])
    light = Light(ahead, 0.05, np.zeros(3), FAR_MM, 4.0)
    names = ("K_lm", "K_spike", "K_lobe", "sigma_um", "correlation_um")
    put = problem_on(sight, (light,), Guess(0.4, 0.25, 1e-4, 0.02, 2.0), Unknowns(names, radius=True), SEVEN_NODES, noise=0.002)
    seen = photographed(put, seed=0, noise=0.002)
    there = Light(ahead + [0.02, -0.01, 0.0], 0.05, np.zeros(3), FAR_MM, 5.0)
    found = fit(replace(seen, lights=(there,), material=Guess()))
    assert found.estimate("light 0 radius").value == pytest.approx(4.0, abs=0.05)


def test_in_the_rough_limit_only_the_ratio_of_height_and_length_is_said_to_be_known():
    sight = sphere_sight((30, 30), 28, (61, 61))
    light = Light(np.array([0.4, 0.3, 0.8]), 1.0, np.zeros(3), FAR_MM, 0.5)
    problem = photographed(problem_on(sight, (light,), Guess(0.3, 0.0, 0.4, 3.0, 30.0), Unknowns()), 5)
    found = fit(replace(problem, material=Guess()))
    assert found.estimate("sigma_um").low is None and found.estimate("correlation_um").low is None
    assert any("only" in said and "sigma_um" in said and "correlation_um" in said for said in found.statements)
    material = found.problem.material
    assert material.sigma_um / material.correlation_um == pytest.approx(0.1, rel=0.05)


def test_strength_and_irradiance_act_only_as_a_product():
    sight = sphere_sight((30, 30), 28, (61, 61))
    light = Light(np.array([0.4, 0.3, 0.8]), 1.0, np.zeros(3), FAR_MM, 0.5)
    unknowns = Unknowns(("K_lm",), irradiance=True, first_fixed=False)
    found = fit(photographed(problem_on(sight, (light,), Guess(0.6, 0.0, 0.0, 0.0001, 2.0), unknowns), 5))
    assert found.estimate("K_lm").low is None and found.estimate("light 0 irradiance").low is None
    assert found.estimate("light 0 direction a").low is not None
    assert any("K_lm" in said and "irradiance" in said for said in found.statements)


def test_a_matt_sphere_says_nothing_of_the_lamp_s_size():
    sight = sphere_sight((30, 30), 28, (61, 61))
    light = Light(np.array([0.1, 0.1, 0.9]), 1.0, np.zeros(3), FAR_MM, 0.5)
    found = fit(photographed(problem_on(sight, (light,), Guess(0.6, 0.0, 0.0, 0.0001, 2.0), Unknowns(("K_lm",), radius=True)), 5))
    assert found.estimate("light 0 radius").low is None
    assert found.statements == ("the pictures do not determine light 0 radius",)


@pytest.mark.parametrize("degrees", [0.3, 12.0, 89.5])
def test_a_lamp_may_grow_twentyfold_but_never_stand_all_around(degrees):
    light = Light(np.array([0.1, 0.1, 0.9]), 1.0, np.zeros(3), FAR_MM, degrees)
    problem = problem_on(sphere_sight((30, 30), 28, (61, 61)), (light,), Guess(), Unknowns((), direction=False, radius=True))
    (radius,) = problem.parameters()
    grown = degrees * np.exp(radius.high)
    assert min(20 * degrees, 88.9) <= grown < 90.0


def test_a_fit_without_unknowns_or_pixels_says_what_it_lacks():
    sight = sphere_sight((30, 30), 28, (61, 61))
    light = Light(np.array([0.1, 0.1, 0.9]), 1.0, np.zeros(3), FAR_MM, 0.5)
    problem = problem_on(sight, (light,), Guess(), Unknowns())
    with pytest.raises(SceneError, match="nothing is unknown"):
        fit(replace(problem, unknowns=Unknowns((), direction=False)))
    with pytest.raises(SceneError, match="3 pixels cannot determine"):
        fit(replace(problem, photographs=(problem.photographs[0].only(np.arange(3)),)))
    with pytest.raises(SettingError, match="roughness is no number"):
        Unknowns(("roughness",))
    with pytest.raises(SceneError, match="radius is 1"):
        sphere_sight((5, 5), 1, (10, 10))


def test_an_interval_of_what_nothing_determines_is_a_number_still():
    sight = sphere_sight((20, 20), 18, (40, 40))
    problem = problem_on(sight, (Light(np.array([0.0, 0.0, 1.0]), 2.0, np.zeros(3), 1e6),), Guess(), Unknowns())
    [length] = [p for p in problem.parameters() if p.name == "sigma_um"]
    assert in_own_unit(problem, length, 5000.0) > 1e100 and in_own_unit(problem, length, -5000.0) == 0.0
