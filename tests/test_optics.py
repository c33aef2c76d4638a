"""Cameras, lenses and sensors against the formulas of their makers."""

import math

import numpy as np
import pytest

from rangecheck import kernels
from rangecheck.errors import ArrayError, CameraError, SettingError
from rangecheck.optics import CylindricalCamera, OrthographicCamera, PinholeCamera, Sensor, ThinLens, camera_from_dict
from rangecheck.optics.distortion import distort, fold_radius, undistort
from rangecheck.optics.lens import common_area

MILD = (-0.28, 0.11, 0.0007, -0.0011, -0.02)
RATIONAL = (0.5, -0.2, 0.001, 0.002, 0.05, 0.6, -0.1, 0.02)


def real_camera(folder, side):
    """A calibration of the Alexander bust's structured-light cameras, full resolution."""
    where = folder / "alexander_bust" / f"{side}Cam"
    k = np.loadtxt(where / "cam_matrix.txt")
    return PinholeCamera(4896, 3264, k[0, 0], k[1, 1], k[0, 2], k[1, 2], tuple(np.loadtxt(where / "cam_distortion.txt")))


@pytest.mark.real_data
@pytest.mark.parametrize("side", ["left", "right"])
def test_real_calibrations_distort_and_undistort_to_a_millionth_of_a_pixel(real_data, side):
    camera = real_camera(real_data, side)
    v, u = np.mgrid[0 : camera.height : 60j, 0 : camera.width : 80j]
    _, directions = camera.rays(u, v)
    # the corner beyond which the polynomial folds has no ray, and says so
    known = np.isfinite(directions).all(axis=-1)
    assert known.mean() > 0.93
    for range_mm in (300.0, 1000.0):
        uv, ranges = camera.project(range_mm * directions[known])
        assert np.abs(uv - np.stack([u, v], axis=-1)[known]).max() < 1e-6
        np.testing.assert_allclose(ranges, range_mm)
    assert camera.distortion_px() > 1


@pytest.mark.parametrize("distortion", [MILD, RATIONAL, (0.1,), (0, 0, 0.01, -0.02)])
def test_distortion_is_opencvs(distortion):
    import cv2

    rng = np.random.default_rng(3)
    points = np.concatenate([rng.uniform(-0.6, 0.6, (500, 2)), np.ones((500, 1))], axis=1)
    k = np.array([[800.0, 0, 320], [0, 790, 240], [0, 0, 1]])
    expected = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), k, np.array([*distortion, 0, 0, 0, 0][: max(4, len(distortion))], float)
    )[0][:, 0]
    camera = PinholeCamera(640, 480, 800, 790, 320, 240, distortion)
    np.testing.assert_allclose(camera.project(points)[0], expected, atol=1e-9)


@pytest.mark.parametrize("distortion", [MILD, RATIONAL, (0.9, -0.3), (-0.5,), (0.4, 8.0, -0.002, -0.003, -120.0)])
def test_undistorting_inverts_distorting_up_to_the_fold(distortion):
    edge = min(fold_radius(distortion), 1.5) * 0.995
    angle, radius = np.meshgrid(np.linspace(0, 2 * math.pi, 40), np.linspace(0, edge, 50))
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    again = undistort(*distort(x, y, distortion), distortion)
    # near the fold the inverse's slope grows without bound: an input rounding of 1e-16 is magnified by its reciprocal
    np.testing.assert_allclose(again[0], x, atol=1e-11)
    np.testing.assert_allclose(again[1], y, atol=1e-11)


def test_beyond_the_fold_there_is_no_ray_and_no_picture():
    barrel = (-0.5,)
    fold = fold_radius(barrel)
    assert fold == pytest.approx(math.sqrt(1 / 1.5))
    reach = fold * (1 - 0.5 * fold**2)
    x = np.array([0.999, 1.001]) * reach
    assert np.isfinite(undistort(x, 0 * x, barrel)[0]).tolist() == [True, False]
    assert np.isfinite(distort(np.array([0.99, 1.01]) * fold, np.zeros(2), barrel)[0]).tolist() == [True, False]
    assert fold_radius(()) == fold_radius((0.1, 0.2)) == math.inf
    # without that, a point 63 degrees off the axis would appear in the middle of the picture
    camera = PinholeCamera(640, 480, 500, 500, 320, 240, barrel)
    assert np.isnan(camera.project(np.array([2.0, 0, 1]))[0]).all()
    assert camera.distortion_px() > 1 and PinholeCamera(640, 480, 300, 300, 320, 240, barrel).distortion_px() == math.inf


def test_points_behind_the_camera_and_nan_are_not_seen():
    camera = PinholeCamera(640, 480, 500, 500, 320, 240, MILD)
    for point in ([0, 0, -1], [0, 0, 0], [np.nan, 0, 1]):
        assert np.isnan(camera.project(np.array(point, float))[0]).all()


@pytest.mark.parametrize(
    "camera",
    [
        PinholeCamera(64, 48, 50, 51, 31, 22, MILD),
        OrthographicCamera(64, 48, 0.7, 30.0, 20.0),
        CylindricalCamera(64, 48, 150.0, 0.09, 2.0, 20.0, 0.3),
        CylindricalCamera(64, 48, 150.0, -0.09, 2.0, 20.0, 0.3),
    ],
)
def test_projecting_a_point_on_a_ray_returns_to_its_pixel(camera):
    origins, directions = camera.pixel_rays()
    assert np.allclose(np.linalg.norm(directions, axis=-1), 1)
    for range_mm in (1.0, 90.0):
        uv, ranges = camera.project(origins + range_mm * directions)
        v, u = np.mgrid[0:48, 0:64]
        np.testing.assert_allclose(uv, np.stack([u, v], axis=-1), atol=1e-9)
        np.testing.assert_allclose(ranges, range_mm, atol=1e-10)
    assert camera_from_dict(camera.to_dict()) == camera


CAMERA = PinholeCamera.from_field_of_view(101, 101, 20)


@pytest.mark.parametrize("depth_mm", [400.0, 700.0, 1500.0])
def test_the_disc_of_confusion_has_the_thin_lens_radius(depth_mm):
    lens = ThinLens(CAMERA, aperture_mm=30.0, focus_mm=600.0)
    # a point source at depth z: the ray through each lens point that also meets the source reaches one pixel
    points = lens.lens_points_mm(4000)
    source = np.array([3.0, -2.0, depth_mm])
    at_focus = points + (source[:2] - points) * (lens.focus_mm / depth_mm)
    uv = at_focus / lens.focus_mm * CAMERA.fx
    spread = uv - uv.mean(axis=0)
    # second moment of a disc: R^2 / 2
    radius = math.sqrt(2 * (spread**2).sum(axis=1).mean())
    assert 2 * radius == pytest.approx(float(lens.circle_of_confusion_px(np.array(depth_mm))), rel=0.002)
    # the image-space form of the same law: A' = A |s' - s| / s
    s, s_focus = (1 / (1 / lens.focal_length_mm - 1 / z) for z in (depth_mm, lens.focus_mm))
    assert 2 * radius * lens.pixel_mm == pytest.approx(30.0 * abs(s - s_focus) / s, rel=0.002)


def test_a_traced_bundle_spreads_a_small_ball_over_the_disc_of_confusion():
    lens = ThinLens(CAMERA, aperture_mm=40.0, focus_mm=600.0)
    centre, ball_mm = np.array([0.0, 0.0, 1000.0]), 1.5
    v, u = np.mgrid[20:81, 20:81]
    origins, directions, passes = lens.bundle(u.ravel(), v.ravel(), lens.lens_points_mm(600))
    along = ((centre - origins) * directions).sum(axis=-1)
    miss = np.linalg.norm(origins + along[..., None] * directions - centre, axis=-1)
    share = ((miss < ball_mm) & passes).mean(axis=1)
    offset2 = ((u.ravel() - 50) ** 2 + (v.ravel() - 50) ** 2).astype(float)
    measured2 = 2 * (share * offset2).sum() / share.sum()
    # the ball's own disc adds its second moment
    ball_px = CAMERA.fx * ball_mm / 1000
    radius = math.sqrt(measured2 - ball_px**2)
    assert 2 * radius == pytest.approx(float(lens.circle_of_confusion_px(np.array(1000.0))), rel=0.02)


def test_all_rays_of_a_pixel_meet_in_the_plane_of_focus_and_the_middle_one_is_the_pinholes():
    lens = ThinLens(CAMERA, aperture_mm=20.0, focus_mm=500.0)
    points = np.concatenate([[[0.0, 0.0]], lens.lens_points_mm(50)])
    origins, directions, passes = lens.bundle(np.array([3.0, 70.0]), np.array([90.0, 10.0]), points)
    meeting = origins + directions * ((500.0 - origins[..., 2]) / directions[..., 2])[..., None]
    np.testing.assert_allclose(meeting, meeting[:, :1].repeat(51, axis=1), atol=1e-10)
    np.testing.assert_allclose(directions[:, 0], CAMERA.rays(np.array([3.0, 70.0]), np.array([90.0, 10.0]))[1], atol=1e-15)
    assert passes.all()


def test_only_pixels_within_reach_of_blur_are_marked_for_it():
    lens = ThinLens(CAMERA, aperture_mm=20.0, focus_mm=600.0)
    depth = np.full((101, 101), 600.0)
    assert not lens.defocused_pixels(depth).any()
    depth[50, 50] = 900.0
    reach = float(lens.circle_of_confusion_px(np.array(900.0))) / 2
    v, u = np.mgrid[0:101, 0:101] - 50
    marked = lens.defocused_pixels(depth)
    assert marked[np.hypot(u, v) <= reach].all()
    assert not marked[np.hypot(u, v) > 2 * reach + 2].any()
    assert not lens.defocused_pixels(np.full((9, 9), np.nan)).any()


@pytest.mark.parametrize("degrees", [0.0, 15.0, 35.0])
def test_image_irradiance_falls_with_the_fourth_power_of_the_cosine(degrees):
    # (15) from first principles: radiance 1 over the exit pupil, seen from a sensor point at the field angle
    lens = ThinLens(PinholeCamera.from_field_of_view(901, 3, 80), aperture_mm=0.5, focus_mm=1e9, focal_length_mm=50.0)
    points = lens.lens_points_mm(20000)
    sensor = np.array([50.0 * math.tan(math.radians(degrees)), 0.0, 50.0])
    to_sensor = sensor - np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    distance2 = (to_sensor**2).sum(axis=1)
    area = math.pi * (lens.aperture_mm / 2) ** 2
    irradiance = area * (to_sensor[:, 2] ** 2 / distance2**2).mean()
    column = round(450 + lens.camera.fx * math.tan(math.radians(degrees)))
    exact = lens.irradiance_factor()[1, column]
    tangent = (column - 450) / lens.camera.fx
    at_column = irradiance * (math.cos(math.atan(tangent)) / math.cos(math.radians(degrees))) ** 4
    assert exact == pytest.approx(at_column, rel=1e-4)


def test_a_rim_cuts_oblique_bundles_by_the_area_that_two_circles_share():
    lens = ThinLens(PinholeCamera.from_field_of_view(200, 200, 90), 20.0, 500.0, rim_mm=30.0, rim_distance_mm=25.0)
    u, v = np.array([99.5, 150.0, 199.0, 199.0]), np.array([99.5, 99.5, 99.5, 199.0])
    _, through, _ = lens.bundle(u, v, np.zeros((1, 2)))
    tangent = np.hypot(through[:, 0, 0], through[:, 0, 1]) / through[:, 0, 2]
    _, _, passes = lens.bundle(u, v, lens.lens_points_mm(40000))
    # rays of one pixel converge, so seen from the focus plane the rim's shift is the tangent's to within rim_distance / focus
    assert passes.mean(axis=1) == pytest.approx(lens.rim_share(tangent), abs=25 / 500)
    assert lens.rim_share(np.array([0.0, 1.0]))[0] == 1.0
    far = ThinLens(lens.camera, 20.0, 5e7, rim_mm=30.0, rim_distance_mm=25.0)
    assert far.bundle(u, v, far.lens_points_mm(40000))[2].mean(axis=1) == pytest.approx(far.rim_share(tangent), abs=1e-3)
    assert common_area(1, 1, np.array([0.0, 1.0, 2.0])) == pytest.approx([math.pi, 2 * math.pi / 3 - math.sqrt(3) / 2, 0])


@pytest.mark.parametrize("wrong", [{"aperture_mm": -1}, {"focus_mm": 40.0}, {"focal_length_mm": math.nan}, {"rim_mm": 5.0}])
def test_an_impossible_lens_is_refused(wrong):
    with pytest.raises(CameraError):
        ThinLens(**{"camera": CAMERA, "aperture_mm": 10.0, "focus_mm": 500.0} | wrong)


@pytest.mark.parametrize("mean", [0.3, 4.0, 9.9, 10.1, 40.0, 3000.0])
def test_photons_are_counted_by_poissons_law(mean):
    from scipy.stats import chi2, poisson

    sensor = Sensor(electrons_per_unit=1.0, full_well=1e9, read_noise=0.0)
    counts = sensor.electrons(np.full(200_000, mean), seed=5)
    assert (counts == np.rint(counts)).all()
    # classes of at least 50 expected counts each
    edges = np.unique(poisson.ppf(np.linspace(0.002, 0.998, 40), mean))
    observed = np.bincount(np.searchsorted(edges, counts), minlength=len(edges) + 1)
    cumulative = np.concatenate([[0], poisson.cdf(edges, mean), [1]])
    expected = len(counts) * np.diff(cumulative)
    statistic = ((observed - expected)[expected > 50] ** 2 / expected[expected > 50]).sum()
    assert chi2.sf(statistic, (expected > 50).sum() - 1) > 1e-4


def test_noise_has_the_variance_of_shot_and_read_noise_together():
    sensor = Sensor(electrons_per_unit=1.0, full_well=1e6, read_noise=7.0, bits=0)
    n = 200_000
    for mean in (200.0, 5000.0):
        counts = sensor.electrons(np.full(n, mean), seed=1)
        # standard error of a variance estimate: sqrt(2 / n); five of them
        assert counts.var() == pytest.approx(mean + 49, rel=5 * math.sqrt(2 / n))
        assert counts.mean() == pytest.approx(mean, abs=5 * math.sqrt((mean + 49) / n))
        neighbours = np.corrcoef(counts[:-1], counts[1:])[0, 1]
        assert abs(neighbours) < 5 / math.sqrt(n)


def test_noise_belongs_to_seed_frame_and_pixel_whatever_the_threads():
    light = np.random.default_rng(0).uniform(0, 2, (300, 400))
    sensor = Sensor()
    one = sensor.expose(light, seed=7, frame=3)
    with kernels.threads(1):
        assert (sensor.expose(light, seed=7, frame=3) == one).all()
    other_frame, other_seed = sensor.expose(light, seed=7, frame=4), sensor.expose(light, seed=8, frame=3)
    assert (other_frame != one).mean() > 0.3 and (other_seed != one).mean() > 0.3
    brighter = light.copy()
    brighter[0, 0] = 1.9
    changed = sensor.expose(brighter, seed=7, frame=3) != one
    assert changed.sum() <= 1


@pytest.mark.parametrize("response", ["linear", "srgb", "gamma", (0.0, 0.5, 0.8, 1.0)])
@pytest.mark.parametrize("bits", [0, 8, 12, 16])
def test_linearising_a_picture_undoes_response_and_quantisation(response, bits):
    sensor = Sensor(electrons_per_unit=1e12, full_well=1e12, read_noise=0.0, bits=bits, response=response)
    light = np.linspace(0.001, 1.0, 1000)
    picture = sensor.expose(light)
    assert picture.dtype == {0: np.float64, 8: np.uint8, 12: np.uint16, 16: np.uint16}[bits]
    # at 1e12 electrons shot noise is 1e-6; half a number of the converter, through the response's least slope
    half = 0.5 / (2**bits - 1) if bits else 0.0
    slope = {"linear": 1.0, "srgb": 0.41, "gamma": 0.45}.get(response if isinstance(response, str) else "", 0.6)
    assert np.abs(sensor.linearise(picture) - light).max() <= half / slope + 2e-5


def test_a_full_well_saturates_and_darkness_is_dark():
    sensor = Sensor(electrons_per_unit=1e6, full_well=2e4, read_noise=3.0)
    assert (sensor.expose(np.full((8, 8), 1.0)) >= 254).all()
    assert (sensor.expose(np.full((8, 8), np.nan)) <= 1).all()
    assert (sensor.expose(np.zeros((8, 8)), exposure_time=0.0) <= 1).all()


@pytest.mark.parametrize(
    "wrong", [{"bits": 17}, {"full_well": 0.0}, {"read_noise": math.nan}, {"response": "film"}, {"response": (0.0, 0.7, 0.5)}]
)
def test_an_impossible_sensor_is_refused(wrong):
    with pytest.raises(SettingError):
        Sensor(**wrong)
    with pytest.raises(ArrayError, match="negative or infinite"):
        Sensor().expose(np.array([-1.0]))
