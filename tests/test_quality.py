"""Scan quality: what was seen and what was not is known for scans whose object and poses are known."""

from dataclasses import replace

import numpy as np
import pytest
from registration_cases import CAMERA, pebble, ring

from rangecheck import rigid
from rangecheck.animation import outline_of
from rangecheck.errors import ScanError, SettingError
from rangecheck.maps import trace_maps
from rangecheck.optics import OrthographicCamera, PinholeCamera
from rangecheck.scan import RangeScan
from rangecheck.scan.quality import PROFILES, Profile, assess
from rangecheck.scan.quality_space import Space as SeenSpace
from rangecheck.scan.quality_space import directions, shell_of, views_from
from rangecheck.scan.quality_sphere import counted, in_letters
from rangecheck.scan.readers import read_scans
from rangecheck.scan.simulate import RangeFinder, simulate_scan
from rangecheck.surface import Surface

CELLS = 40


@pytest.fixture(scope="module")
def views() -> list[RangeScan]:
    """Eight views in a level ring: top and bottom are not seen."""
    return ring(pebble(1))


@pytest.fixture(scope="module")
def poles() -> list[RangeScan]:
    """One view from above and one from below."""
    finder = RangeFinder(source_mm=(100.0, 0.0, 0.0), working_distance_mm=600.0, noise_mm=0.1)
    return [
        simulate_scan(
            pebble(1),
            CAMERA,
            rigid.look_at([0, side * 600.0, 0], [0, 0, 0], [0, 0, 1]),
            finder,
            7,
            scan_index=20 + side,
            name=f"pole{side}",
        ).scan
        for side in (1, -1)
    ]


def box_space() -> SeenSpace:
    """A measured ball of 15 cells' radius in empty space, 2 mm cells, whose upper half is unknown instead."""
    grid = np.indices((41, 41, 41)) - 20
    inside = (grid**2).sum(axis=0) <= 15**2
    state = np.where(inside, np.where(grid[1] > 0, 0, 2), 1).astype(np.uint8)
    return SeenSpace(state, np.zeros(3), 2.0)


def test_the_shell_of_a_ball_has_its_area():
    shell = shell_of(box_space())
    # stairs on a sphere are exact only on the whole: a few percent at 15 cells' radius
    assert shell.area_mm2.sum() == pytest.approx(4 * np.pi * 31**2, rel=0.05)
    assert shell.area_mm2[~shell.measured].sum() == pytest.approx(2 * np.pi * 31**2, rel=0.08)


def test_half_a_ball_that_nobody_saw_is_seen_best_from_its_own_side():
    space = box_space()
    shell = shell_of(space)
    ways = directions(200)
    gain, known, seen = views_from(space, shell, ways)
    assert ways[np.argmax(gain)][1] > 0.9 and ways[np.argmax(known)][1] < -0.9
    # a disc's area is what a hemisphere shows from straight above
    assert gain.max() == pytest.approx(np.pi * 31**2, rel=0.15)
    assert seen.mean() > 0.97


@pytest.fixture(scope="module")
def level(views):
    """What the level ring is worth."""
    return assess(views, cells=CELLS, elevation_deg=(-90, 90))


def test_a_level_ring_misses_the_poles_and_the_next_view_is_one_of_them(level, views, poles):
    quality = level
    assert 0.6 < quality.seen < 0.95
    assert {np.sign(round(g.centre_mm[1])) for g in quality.gaps[:2]} == {1, -1}
    assert quality.next_view is not None and abs(quality.next_view.elevation_deg) > 50
    assert any(f.code == "scan-unseen" for f in quality.findings) and "fit" in quality.verdict
    both = assess([*views, *poles], cells=CELLS, elevation_deg=(-90, 90))
    assert both.seen > 0.97 > quality.seen
    assert both.coverage > 0.99 > quality.coverage
    assert not any(f.code == "scan-unseen" for f in both.findings)


def test_the_drawing_of_a_level_ring_shows_its_scans_around_the_middle_and_the_next_view_where_none_has_a_sample(level):
    meaning, *rows, axis = level.drawing
    assert all(said in meaning for said in ("no scan", "so many scans", "where a scan was taken from", "the next view"))
    sphere = [row[5:] for row in rows]
    assert len(sphere) == 9 and {len(row) for row in sphere} == {36} and axis.split() == ["-180", "-90", "0", "+90", "+180"]
    assert [row.count("o") for row in sphere] == [0, 0, 0, 0, 8, 0, 0, 0, 0]
    # every direction of the middle is seen by more than one scan of eight, and most around the poles by none
    assert set(sphere[4]) <= set("o23456")
    assert all(row.count("·") > 18 for row in (sphere[0], sphere[8]))
    assert sum(row.count("N") for row in sphere) == 1
    at = next(k for k, row in enumerate(sphere) if "N" in row)
    assert abs(90 - 20 * (at + 0.5) - level.next_view.elevation_deg) <= 10


def test_the_drawing_has_the_front_in_the_middle_and_what_lies_towards_x_on_its_right():
    counts = counted([np.array([[0.0, 0.0, 5.0]]), np.array([[5.0, 0.0, 0.0], [0.0, 0.0, 5.0]])], np.zeros(3), (9, 36))
    middle = in_letters(counts, [], None)[4]
    assert middle == "  +0 " + 18 * "·" + "2" + 8 * "·" + "1" + 8 * "·"


def test_the_view_that_is_missing_is_the_one_proposed(views, poles):
    front = assess([views[7], views[0], views[1], *poles], cells=CELLS)
    assert front.next_view is not None
    # the back is at 180 degrees; it must be looked at from there, give or take what helps to align the scan
    assert np.cos(np.radians(front.next_view.azimuth_deg - 180)) > 0.5
    assert 0 < front.next_view.overlap < 1


def test_noise_and_spacing_are_what_the_scans_were_made_with(views):
    quality = assess(views, cells=CELLS)
    pixel_mm = 2 * np.tan(np.radians(11)) * 545 / 150
    for view in quality.views:
        assert 0.1 < view.noise_mm < 0.16
        assert pixel_mm < view.spacing_mm < 1.6 * pixel_mm
        assert 0.02 < view.grazing < 0.4 and abs(view.elevation_deg) < 2
        assert view.overlap > 0.9
    # two looks at every place average the noise of one, but their obliquity differs
    assert 0.4 < quality.error_mm / 0.1 < 1.0
    azimuths = np.array([v.azimuth_deg for v in quality.views])
    assert np.allclose(np.mod(np.diff(azimuths), 360), 45, atol=3)


def test_looking_twice_divides_the_noise_by_the_root_of_two(views):
    finder = RangeFinder(source_mm=(100.0, 0.0, 0.0), working_distance_mm=600.0, noise_mm=0.1)
    again = simulate_scan(pebble(1), CAMERA, views[0].world_from_scan, finder, 7, scan_index=99, name="again").scan
    once, twice = assess(views[:1], cells=CELLS), assess([views[0], again], cells=CELLS)
    assert twice.error_mm == pytest.approx(once.error_mm / np.sqrt(2), rel=0.05)


def test_a_scan_out_of_place_shows_in_its_overlap(views):
    wrong = [*views[:4], views[4].moved(rigid.about_axis([0, 0, 1], 0.5) @ views[4].world_from_scan)]
    quality = assess(wrong, cells=CELLS)
    assert [f.scan for f in quality.findings if f.code == "scan-overlap"] == ["view4"]


def test_what_a_single_scan_cannot_see_is_a_reservation_and_not_a_fault(views):
    alone = assess(views[:1], cells=CELLS)
    unseen = next(f for f in alone.findings if f.code == "scan-unseen")
    assert unseen.severity == "warning" and unseen.value > 0.2
    assert next(f for f in assess(views[:2], cells=CELLS).findings if f.code == "scan-unseen").severity == "error"


def test_the_profile_decides_the_verdict(views, poles):
    everything = [*views, *poles]
    easy = Profile(
        "easy", height_mm=20.0, layer_mm=0.1, most_spacing_mm=0.5, most_error_mm=0.1, most_grazing=0.5, least_overlap=0.1
    )
    assert assess(everything, cells=CELLS, profile=easy).verdict == "fit"
    hard = replace(easy, name="hard", most_spacing_mm=0.01)
    result = assess(everything, cells=CELLS, profile=hard)
    assert result.verdict == "unfit" and result.lines[0].startswith("unfit for hard")
    assert all(f.text for f in result.findings)


def test_bad_input_is_refused_with_the_next_step(views):
    with pytest.raises(ScanError, match="no scans"):
        assess([])
    with pytest.raises(SettingError, match="bust-150"):
        assess(views, profile="statue")
    with pytest.raises(SettingError, match="which way"):
        assess(views, up=(0, 0, 0))
    with pytest.raises(SettingError, match="within -90 to 90"):
        assess(views, elevation_deg=(10, -10))
    with pytest.raises(SettingError, match="cells is 2"):
        assess(views, cells=2)


def test_a_flat_picture_without_background_is_measured_too():
    camera = OrthographicCamera(40, 30, 1.0, 19.5, 14.5)
    rows, columns = np.indices((30, 40))
    scan = RangeScan((100 + 3 * np.sin(rows / 5) + 2 * np.cos(columns / 7)).astype(np.float32), camera)
    quality = assess([scan], cells=20, up=(0, -1, 0))
    assert quality.views[0].spacing_mm == pytest.approx(1.0, rel=0.15)
    assert np.isnan(quality.views[0].overlap) and not any(f.code == "scan-overlap" for f in quality.findings)


def test_every_profile_is_named_by_its_key():
    assert all(name == profile.name for name, profile in PROFILES.items())


@pytest.mark.real_data
def test_the_bunny_was_seen_but_for_its_base(real_data):
    quality = assess(read_scans(real_data / "stanford_bunny" / "bun.conf", unit="m"), cells=48)
    assert quality.seen > 0.95 and quality.coverage > 0.98
    # its base is at 33 mm; bun_zipper has its holes there
    assert quality.gaps[0].centre_mm[1] < 45


def test_a_stray_patch_that_the_surface_left_out_is_missing_but_no_part_of_the_outline():
    ball = _ball()
    camera, pose = PinholeCamera.from_field_of_view(160, 160, 40), rigid.look_at((0, 0, 240), (0, 0, 0))
    distance = trace_maps(ball, camera, pose).distance_mm
    distance[2:5, 2:6] = 300.0
    found = outline_of(ball, RangeScan(distance.astype(np.float32), camera, pose))
    assert found.worst_px == 0 and found.missing_share == pytest.approx(12 / np.isfinite(distance).sum())


def _ball() -> Surface:
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=4, radius=50.0)
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces).astype(np.int32))


def test_the_proposed_view_adds_more_than_nearly_all_others_when_each_is_tried():
    """From the front alone: each of some directions is simulated, and what it adds is counted in readings far from all that are there."""
    from scipy.spatial import cKDTree

    finder = RangeFinder(source_mm=(100.0, 0.0, 0.0), working_distance_mm=600.0, noise_mm=0.1)
    subject = pebble(1)

    def shot(direction):
        up = (0, 1, 0) if abs(direction[1]) < 0.99 else (0, 0, 1)
        pose = rigid.look_at(600.0 * np.asarray(direction), (0, 0, 0), up)
        return simulate_scan(subject, CAMERA, pose, finder, 7).scan

    front = [shot([np.sin(a), 0.0, np.cos(a)]) for a in np.radians([-45.0, 0.0, 45.0])]
    quality = assess(front, cells=CELLS)
    known = cKDTree(np.concatenate([scan.points_mm() for scan in front]))

    def worth(direction):
        apart = known.query(shot(direction).points_mm())[0]
        new, overlap = (apart > 3 * quality.spacing_mm).sum(), (apart <= 3 * quality.spacing_mm).mean()
        return new * min(1.0, overlap / 0.25)  # what could not be aligned adds nothing

    ways = directions(60)
    others = np.array([worth(way) for way in ways[np.degrees(np.arcsin(ways[:, 1])) > -30]])
    assert quality.next_view is not None
    proposed = worth(quality.next_view.direction)
    assert proposed > 0.8 * others.max() and (others > proposed).mean() < 0.15


def test_an_object_of_unlikely_size_puts_its_unit_in_doubt(views):
    small = [replace(scan, range_mm=scan.range_mm / 1000, world_from_scan=scaled(scan.world_from_scan)) for scan in views[:3]]
    assert any(f.code == "scan-size" for f in assess(small, cells=CELLS).findings)
    assert not any(f.code == "scan-size" for f in assess(views[:3], cells=CELLS).findings)


def test_every_finding_of_scans_is_explained():
    import re
    from pathlib import Path

    import rangecheck.scan.quality as quality
    from rangecheck.solid.findings import catalogue

    codes = set(re.findall(r'"(scan-[a-z]+)"', Path(quality.__file__).read_text()))
    assert len(codes) >= 8 and codes <= set(catalogue())


def scaled(pose):
    smaller = pose.copy()
    smaller[:3, 3] /= 1000
    return smaller
