"""Derivatives of the light that a surface sends to the camera are those of finite differences, for every number of every kind of source.

What moves while others are held: material (K_lm, K_spike, K_lobe, sigma/lambda, T/lambda), each lamp's direction, place, radius and strength, exposure,
ambient light, the camera's pose. Kinds of lamps: far and small, near, so wide that the horizon cuts it, narrower and wider than what a pixel mirrors.
"""

from dataclasses import replace

import numpy as np
import pytest
from test_recover import EVERYTHING, bumpy_ball, problem_on
from test_transport import ball, floor

from rangecheck import rigid
from rangecheck.optics import OrthographicCamera, PinholeCamera
from rangecheck.recover.lights import ONE_NODE, SEVEN_NODES, Light
from rangecheck.recover.matt_light import BODY_NUMBERS, LAMP_NUMBERS, Surface, shown, slopes
from rangecheck.recover.problem import Guess, Unknowns
from rangecheck.recover.radiance import disc_share
from rangecheck.recover.sight import see, sphere_sight
from rangecheck.reflectance import Material
from rangecheck.scene import Scene

SIGHT = sphere_sight((12, 12), 10, (25, 25), 1.0)
#: direction, distance (ball: radius 10 mm), angular radius in degrees; a pixel of this ball mirrors 6.5 degrees around
LAMPS = {
    "far and small": ([0.3, 0.5, 0.8], 1e6, 0.25),
    "far, wider than a pixel mirrors": ([0.3, 0.5, 0.8], 1e6, 9.0),
    "near": ([0.3, 0.4, 0.8], 40.0, 5.0),
    "near, cut by the horizon": ([0.9, 0.3, 0.1], 60.0, 30.0),
    "wide, from behind": ([0.5, 0.2, -0.6], 60.0, 60.0),
}
#: of each kind of number, in its unit: large where all light hardly changes, small where a mirrored disc's edge passes
STEPS = {
    "strength": 2e-5, "log strength": 2e-5, "length": 2e-5, "direction": 2e-5, "irradiance": 2e-5, "distance": 2e-3, "radius": 1e-4,
    "exposure": 2e-5, "ambient": 2e-5, "pose": 2e-6,
}  # fmt: skip


def differences(value, at, step):
    """Central differences of two steps, free of the step's square (Richardson)."""
    near, wide = ((value(at + n * step) - value(at - n * step)) / (2 * n * step) for n in (1, 2))
    return (4 * near - wide) / 3


@pytest.mark.parametrize("masking", ["none", "smith", "v-groove"])
@pytest.mark.parametrize("lamp", LAMPS)
def test_every_number_s_derivative_is_that_of_finite_differences_under_each_kind_of_lamp(lamp, masking):
    direction, distance, radius = LAMPS[lamp]
    light = Light(np.array(direction), 2.0, np.zeros(3), distance, radius)
    guess = Guess(0.4, 0.3, 0.5, 0.12, 2.5, masking=masking)
    problem = problem_on(SIGHT, (light,), guess, EVERYTHING, ONE_NODE if radius < 1 else SEVEN_NODES)
    parameters = problem.parameters()
    assert {p.kind for p in parameters} == set(STEPS)
    rng = np.random.default_rng(1)
    # poses count from where they are: what is seen moves along straight lines from there
    theta = problem.start() + 0.02 * rng.normal(size=len(parameters)) * [p.unit * (p.kind != "pose") for p in parameters]
    by = problem.predict(theta, 0).slopes
    for k, p in enumerate(parameters):

        def value(at, k=k):
            moved = theta.copy()
            moved[k] = at
            return problem.predict(moved, 0, slopes=False).values

        measured = differences(value, theta[k], STEPS[p.kind] * p.unit)
        # seen from far away nothing changes with the camera's distance
        assert (np.abs(measured).max() > 0.0) == (p.name != "picture 0 shift z"), p.name
        assert np.abs(measured - by[:, k]).max() <= 1e-5 * np.abs(measured).max(), p.name


def test_radiance_has_no_slope_where_a_lamp_does_not_reach():
    light = Light(np.array([0.3, 0.4, 0.8]), 2.0, np.zeros(3), 40.0, 5.0)
    problem = problem_on(SIGHT, (light,), Guess(0.4, 0.3, 0.5, 0.12, 2.5), EVERYTHING)
    dark = replace(problem.photographs[0], lit=np.zeros((len(SIGHT), 1), bool))
    slopes = replace(problem, photographs=(dark,)).predict(problem.start(), 0).slopes
    ambient = [p.kind == "ambient" for p in problem.parameters()]
    assert np.all(slopes[:, ambient] == 1.0) and not slopes[:, np.logical_not(ambient)].any()


@pytest.mark.parametrize(
    "source, pixel, apart", [(0.1, 0.2, 0.25), (0.2, 0.1, 0.25), (0.1, 0.3, 0.15), (0.3, 0.1, 0.15), (0.2, 0.2, 0.1)]
)
def test_the_share_that_a_lamp_s_disc_covers_of_a_pixel_s_changes_as_its_derivatives_say(source, pixel, apart):
    at = np.array([apart, source, pixel])
    slopes = disc_share(*at)[1:]
    for k in range(3):
        measured = differences(lambda t, k=k: disc_share(*np.where(np.arange(3) == k, t, at))[0], at[k], 1e-5)
        assert abs(measured - slopes[k]) < 1e-8


@pytest.mark.parametrize("lamp", ["far and small", "far, wider than a pixel mirrors", "near", "wide, from behind"])
def test_a_mirrored_lamp_s_picture_changes_with_the_pose_as_its_derivative_says(lamp):
    scene = Scene(bumpy_ball(), (Material("grey", K_lm=0.5, wavelengths_um=(0.555,)),), smooth=True)
    camera, pose = PinholeCamera.from_field_of_view(40, 40, 12.0), rigid.look_at((100, 80, 500.0), (0, 0, 0))
    direction, distance, radius = LAMPS[lamp]
    # the ball is five times as large as the other
    light = Light(np.array(direction), 2.0, np.zeros(3), 5.0 * distance, radius)
    guess, unknowns = Guess(0.4, 0.3, 0.3, 0.1, 3.0), Unknowns((), direction=False, pose=True)
    start = see(scene, camera, pose)
    slopes = problem_on(start, (light,), guess, unknowns).predict(np.zeros(6), 0).slopes
    for k in range(6):
        faces = [start.spread(start.face.astype(float))]

        def value(step, k=k, faces=faces):
            moved = pose.copy()
            if k < 3:
                moved[:3, :3] = rigid.about_axis(np.eye(3)[k], step)[:3, :3] @ pose[:3, :3]
            else:
                moved[k - 3, 3] += step
            sight = see(scene, camera, moved)
            faces.append(sight.spread(sight.face.astype(float)))
            return sight.spread(problem_on(sight, (light,), guess, unknowns).predict(np.zeros(6), 0, slopes=False).values)

        measured = differences(value, 0.0, 2e-6 if k < 3 else 6e-4)
        same = np.all([face == faces[0] for face in faces], axis=0)
        mine = start.spread(slopes[:, k])
        assert same.sum() > 0.9 * len(start)
        assert np.abs(measured - mine)[same].max() < 1e-5 * np.abs(mine[same]).max()


def test_a_flat_plate_mirrors_parallel_rays_in_parallel_wherever_the_camera_stands():
    scene = Scene(floor(), (Material("grey", K_lm=0.5, wavelengths_um=(0.555,)),))
    sight = see(scene, OrthographicCamera(20, 20, 10.0, 9.5, 9.5), rigid.look_at((30.0, 300.0, 40.0), (0.0, 0.0, 0.0)))
    assert len(sight) > 100 and 0.0 <= sight.footprints.max() < 1e-5
    assert np.isfinite(sight.footprints_by_pose).all() and np.abs(sight.footprints_by_pose).max() < 1e-4


def test_of_a_pixel_without_neighbours_no_footprint_is_known_nor_how_it_moves():
    scene = Scene(ball(1, 0.5), (Material("grey", K_lm=0.5, wavelengths_um=(0.555,)),))
    sight = see(scene, PinholeCamera.from_field_of_view(5, 5, 10.0), rigid.look_at((0.0, 0.0, 100.0), (0.0, 0.0, 0.0)))
    assert len(sight) == 1 and sight.footprints[0] == 0.0 and not sight.footprints_by_pose.any()


@pytest.mark.parametrize("sideways", [False, True], ids=["in front", "at the rim"])
def test_a_matt_ball_s_derivatives_are_those_of_finite_differences(sideways):
    numbers = np.array([0.05, -0.03, -0.4, 0.12, -0.08, 0.06])
    direction = np.array([0.9, 0.43, 0.1]) if sideways else np.array([0.3, 0.2, 0.9])
    if sideways:
        numbers[:2] = 0.1
    body = np.array([0.3, 0.04, np.log(0.35)])
    at = np.concatenate([numbers, body])
    assert len(at) == LAMP_NUMBERS + BODY_NUMBERS

    def value(all_numbers):
        slope, gloss, width = all_numbers[LAMP_NUMBERS:]
        surface = Surface(slope, gloss, np.exp(width))
        lit = direction / np.linalg.norm(direction)
        return np.array(shown(SIGHT.normals, SIGHT.views, lit, all_numbers[:LAMP_NUMBERS], surface))

    by = np.array(slopes(SIGHT.normals, SIGHT.views, direction / np.linalg.norm(direction), numbers, Surface(0.3, 0.04, 0.35)))
    for k in range(len(at)):
        measured = differences(lambda t, k=k: value(np.where(np.arange(len(at)) == k, t, at)), at[k], 1e-5)
        # a pixel at which one of the model's maxima changes sides has two slopes; on this ball there is none
        assert np.abs(measured - by[:, :, k]).max() < 1e-5 * np.abs(measured).max(), k
