"""Registration: scans whose true poses are known find back to them, and what cannot be known is refused."""

from dataclasses import replace

import numpy as np
import pytest
from registration_cases import pebble, plate, ring, shaken, strays_mm

from rangecheck import rigid
from rangecheck.errors import ScanError, SettingError
from rangecheck.kernels import threads
from rangecheck.scan import RangeScan
from rangecheck.scan.readers import read_scans
from rangecheck.scan.registration import register
from rangecheck.scan.registration.freedom import free_motions
from rangecheck.scan.registration.matching import motion_numbers, small_motion
from rangecheck.scan.registration.samples import samples_of


@pytest.fixture(scope="module")
def views() -> list[RangeScan]:
    """Eight views of one object, 45 degrees apart, at their true poses; noise 0.1 mm, samples 1.6 mm apart."""
    return ring(pebble(1))


@pytest.fixture(scope="module")
def strangers() -> list[RangeScan]:
    return ring(pebble(2), 2, name="stranger")


# a thousand matches of 0.1 mm noise determine a pose to some hundredths of a millimetre; half the noise is allowed
WITHIN_MM = 0.05


def test_perturbed_scans_return_to_where_they_were_taken(views):
    moved = shaken(views, mm=5.0, deg=5.0)
    assert np.median(strays_mm(moved, views)[1:]) > 3
    result = register(moved)
    assert result.verdict == "aligned"
    assert strays_mm(result.scans, views).max() < WITHIN_MM
    assert result.residual_mm < 2 * np.hypot(0.1, 0.1)


def test_ridges_that_smoothing_takes_off_do_not_lean_on_the_poses():
    ridged = ring(pebble(1, ridges_mm=2.0), 6, noise_mm=0.02, elevations_deg=(-12.0, 38.0))
    result = register(ridged)
    assert result.verdict == "aligned"
    # a hundredth of the sample spacing for noise, and as much again for what is left of the ridges
    assert strays_mm(result.scans, ridged).max() < 0.02 * 1.6
    assert max(s.pose_error_mm for s in result.states) < 0.1 * 1.6


def test_scans_without_any_poses_are_put_together(views):
    result = register([scan.moved(rigid.identity()) for scan in views], guess="none")
    assert result.verdict == "aligned"
    assert strays_mm(result.scans, views).max() < WITHIN_MM


def test_a_turntable_gives_its_axis_and_its_step(views):
    result = register([scan.moved(views[0].world_from_scan) for scan in views], guess="turntable")
    assert result.verdict == "aligned" and result.turntable is not None
    assert strays_mm(result.scans, views).max() < WITHIN_MM
    assert abs(result.turntable.step_deg) == pytest.approx(45.0, abs=0.05)
    assert abs(result.turntable.direction[1]) == pytest.approx(1.0, abs=1e-5)
    assert np.hypot(*result.turntable.point_mm[[0, 2]]) < WITHIN_MM


def test_a_scan_with_a_wrong_pose_is_found_again_or_refused_but_never_kept(views):
    wrong = list(views)
    wrong[3] = views[3].moved(rigid.about_axis([0, 1, 0], 1.2) @ views[3].world_from_scan)
    kept = register(wrong, rescue=False)
    assert [s.aligned for s in kept.states] == [True] * 3 + [False] + [True] * 4
    assert kept.verdict == "partial" and kept.states[3].reason
    assert np.array_equal(kept.scans[3].world_from_scan, wrong[3].world_from_scan)
    found = register(wrong)
    assert found.verdict == "aligned" and "guess did not hold" in found.states[3].reason
    assert strays_mm(found.scans, views).max() < WITHIN_MM


@pytest.mark.parametrize("guess", ["poses", "none"])
def test_two_different_objects_are_refused(views, strangers, guess):
    result = register([views[0], strangers[0]], guess=guess)
    assert result.verdict == "refused" and not result.aligned
    assert all(state.reason for state in result.states)


def test_a_stranger_among_the_scans_is_left_out(views, strangers):
    result = register([*shaken(views, 3.0, 3.0), strangers[0]])
    assert [s.aligned for s in result.states] == [True] * 8 + [False]
    assert strays_mm(result.scans[:8], views).max() < WITHIN_MM


def test_scans_that_see_opposite_sides_are_refused(views):
    result = register([views[0], views[4]], guess="none")
    assert result.verdict == "refused"


def test_a_plate_slides_and_the_result_says_which_ways():
    one = ring(plate(), 1)[0]
    result = register([one, replace(one, name="again")])
    assert result.verdict == "refused"
    words = " ".join(result.states[0].undetermined)
    assert words.count("sliding along") == 2 and words.count("turning about the axis") == 1
    assert len(result.states[0].undetermined) == 3
    bumpy = ring(plate(bump_mm=4.0), 1)[0]
    assert register([bumpy, replace(bumpy, name="again")]).verdict == "aligned"


def test_a_ball_turns_three_ways_and_an_egg_one():
    import trimesh

    points = np.asarray(trimesh.creation.icosphere(subdivisions=3).vertices)
    seen = points[points[:, 2] > 0.2]
    assert len(free_motions(60 * seen, seen, 0.0)) == 3
    axes = np.array([1.0, 1.0, 2.0])
    normals = seen / axes
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    (only,) = free_motions(60 * seen * axes, normals, 0.0)
    assert only.startswith("turning about the axis (0.00, 0.00, 1.00) through (0, 0")


def test_same_seed_same_bytes_on_any_number_of_threads(views):
    moved = [scan.moved(rigid.identity()) for scan in views[:4]]
    with threads(1):
        one = register(moved, guess="none", seed=3)
    with threads(3):
        three = register(moved, guess="none", seed=3)
    assert [s.world_from_scan.tobytes() for s in one.scans] == [s.world_from_scan.tobytes() for s in three.scans]
    assert one.lines == three.lines


def test_noise_is_read_from_the_scan_itself():
    for noise in (0.05, 0.2):
        scan = ring(pebble(1), 1, noise_mm=noise)[0]
        # the simulated noise grows as 1 / cos of the angle of incidence: its median over the views is 1.1 to 1.4 times the nominal
        assert noise < samples_of(scan).noise_mm < 1.6 * noise


def test_a_small_motion_and_its_numbers_are_inverse():
    rng = np.random.default_rng(4)
    centre = np.array([10.0, -20.0, 400.0])
    for _ in range(20):
        numbers = rng.normal(size=6)
        assert np.allclose(motion_numbers(small_motion(numbers, centre, 50.0), centre, 50.0), numbers, atol=1e-9)


def test_one_scan_needs_no_alignment(views):
    result = register(views[:1])
    assert result.verdict == "aligned" and result.lines == ["view0: one scan, nothing to align"]


def test_bad_input_is_refused_with_the_next_step(views):
    with pytest.raises(ScanError, match="no scans"):
        register([])
    with pytest.raises(ScanError, match="name each scan differently"):
        register([views[0], views[0]])
    with pytest.raises(SettingError, match="poses, turntable or none"):
        register(views[:2], guess="luck")  # type: ignore[arg-type]
    with pytest.raises(SettingError, match="least_overlap is 2"):
        register(views[:2], least_overlap=2.0)
    empty = replace(views[1], range_mm=np.full_like(views[1].range_mm, np.nan))
    with pytest.raises(ScanError, match="0 of"):
        register([views[0], empty])
    rng = np.random.default_rng(0)
    noise = replace(views[1], range_mm=rng.uniform(100, 900, views[1].range_mm.shape).astype(np.float32))
    assert register([views[0], noise]).verdict == "refused"


def test_far_from_the_origin_costs_nothing(views):
    away = rigid.identity()
    away[:3, 3] = [4.5e8, -5.1e9, 2e5]
    moved = [scan.moved(away @ scan.world_from_scan) for scan in shaken(views[:3], 3.0, 3.0)]
    result = register(moved)
    assert result.verdict == "aligned"
    # a double at 5e9 mm counts in steps of 1e-6 mm
    truth = [scan.moved(away @ scan.world_from_scan) for scan in views[:3]]
    assert strays_mm(result.scans, truth).max() < WITHIN_MM


@pytest.mark.real_data
def test_the_bunny_returns_after_five_millimetres_and_five_degrees(real_data):
    truth = read_scans(real_data / "stanford_bunny" / "bun.conf", unit="m")
    result = register(shaken(truth, 5.0, 5.0, seed=1), enough_points=9_000)
    assert result.verdict == "aligned"
    assert np.median(strays_mm(result.scans, truth)) < 0.3


@pytest.mark.real_data
def test_the_bunny_is_put_together_without_poses(real_data):
    truth = read_scans(real_data / "stanford_bunny" / "bun.conf", unit="m")[:4]
    result = register([scan.moved(rigid.identity()) for scan in truth], guess="none", enough_points=15_000)
    assert result.verdict == "aligned"
    assert np.median(strays_mm(result.scans, truth)) < 0.3


def test_a_pose_says_how_well_it_is_known():
    truth = ring(pebble(1), noise_mm=0.4)
    result = register(shaken(truth, 3.0, 3.0))
    strays = strays_mm(result.scans, truth)[1:]
    expected = np.array([state.pose_error_mm for state in result.states])[1:]
    assert result.states[0].pose_error_mm == 0
    # the mean of squares over seven poses of six numbers each, one standard deviation: within a factor of two either way
    assert 0.5 < np.sqrt(np.mean((strays / expected) ** 2)) < 2.0
    strict = register(shaken(truth, 3.0, 3.0), most_pose_error_mm=0.5 * float(expected.max()), rescue=False)
    assert strict.verdict != "aligned" and any("determine its pose only to" in state.reason for state in strict.states)
