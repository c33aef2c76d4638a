"""What an animation shows of a surface, measured: planted noise comes back as planted, a planted dent where it was planted."""

import numpy as np
import pytest
from test_maps import ball

from rangecheck import kernels, rigid
from rangecheck.animation import faces_seen, measure_consistency, orbit_around, outline_of, verdict_for
from rangecheck.animation.standing_out import FALSE_PLACES, look_at_places, look_of, spots
from rangecheck.errors import SurfaceError
from rangecheck.maps import trace_maps
from rangecheck.optics import PinholeCamera, Sensor
from rangecheck.reflectance import load_material
from rangecheck.scan import RangeScan
from rangecheck.scene import studio
from rangecheck.surface import Surface
from rangecheck.transport import Settings

BALL = ball(50.0, subdivisions=5)


def roughened(surface, slope_deg, seed=0):
    """The surface with independent heights at its vertices, scaled until the facets' slopes depart by `slope_deg` RMS."""
    heights = np.random.default_rng(seed).normal(size=len(surface.vertices))[:, None] * surface.vertex_normals
    scale = 1e-3
    for _ in range(12):
        rough = Surface(surface.vertices + scale * heights, surface.faces)
        cosine = np.clip((rough.face_normals * surface.face_normals).sum(axis=1), -1, 1)
        scale *= np.radians(slope_deg) / np.sqrt(np.average(np.arccos(cosine) ** 2, weights=surface.face_areas))
    return rough


@pytest.mark.parametrize("planted_deg", [0.2, 0.5, 1.0, 2.0])
def test_planted_slope_noise_is_measured_within_fifteen_percent(planted_deg):
    rough = roughened(BALL, planted_deg)
    found = measure_consistency(rough)
    assert found.slope_noise_deg == pytest.approx(planted_deg, rel=0.15)
    assert found.slope_rms_deg == pytest.approx(planted_deg, rel=0.15)
    assert found.highlight_jump_deg == 2 * found.slope_noise_deg
    assert found.places == ()


def test_height_noise_is_that_planted_at_the_vertices():
    rough = roughened(BALL, 1.0)
    planted = np.linalg.norm(rough.vertices, axis=1) - 50
    assert measure_consistency(rough).height_noise_mm == pytest.approx(planted.std(), rel=0.05)


@pytest.mark.parametrize("depth_mm", [0.4, -0.4])
def test_a_dent_or_bump_stands_out_at_its_place(depth_mm):
    rough = roughened(BALL, 0.3)
    middle = 50 * np.array([0.48, 0.6, 0.64])
    away = np.linalg.norm(rough.vertices - middle, axis=1)
    dented = Surface(rough.vertices * (1 - depth_mm / 50 * np.exp(-((away / 2.5) ** 2)))[:, None], rough.faces)
    found = measure_consistency(dented)
    assert measure_consistency(rough).places == ()
    place = found.places[0]
    assert np.linalg.norm(np.subtract(place.centre_mm, middle)) < 2.5 and place.size_mm < 15 and place.peak_deg > 2
    # everything flagged is at the dent
    assert all(np.linalg.norm(np.subtract(p.centre_mm, middle)) < 8 for p in found.places)


def test_an_edge_of_the_shape_is_not_noise():
    import trimesh

    cube = trimesh.creation.box((60, 60, 60)).subdivide().subdivide().subdivide().subdivide()
    found = measure_consistency(Surface(cube.vertices, cube.faces))
    assert found.slope_noise_deg < 1e-6 and found.slope_rms_deg < 1e-6 and found.places == ()


def test_only_what_the_animation_showed_is_judged():
    camera = PinholeCamera.from_field_of_view(150, 150, 25)
    orbit = orbit_around(BALL, camera, frames=4, elevation_deg=40)
    rough_below = roughened(BALL, 2.0)
    mixed = Surface(np.where((BALL.vertices[:, 1] < -20)[:, None], rough_below.vertices, BALL.vertices), BALL.faces)
    seen = faces_seen((trace_maps(mixed, camera, orbit.world_from_camera(i)) for i in range(4)), len(mixed.faces))
    from_above = seen * (mixed.triangles[:, :, 1].min(axis=1) > -20)
    assert (seen > 0).sum() > 0.5 * len(seen)
    assert measure_consistency(mixed, from_above).slope_noise_deg < 0.2 < measure_consistency(mixed).slope_rms_deg
    with pytest.raises(SurfaceError, match="0 facets were seen"):
        measure_consistency(mixed, np.zeros(len(mixed.faces)))


def test_the_measure_is_the_same_bytes_on_any_number_of_threads():
    rough = roughened(BALL, 0.5)
    found = []
    for count in (1, 3):
        with kernels.threads(count):
            found.append(measure_consistency(rough).residual_deg.tobytes())
    assert found[0] == found[1]


def test_an_outline_fits_its_own_scan_and_not_a_shrunken_surface():
    camera = PinholeCamera.from_field_of_view(160, 160, 40)
    pose = rigid.look_at((0, 0, 240), (0, 0, 0))
    distance = trace_maps(BALL, camera, pose).distance_mm
    distance[75:80, 75:80] = np.nan
    scan = RangeScan(distance.astype(np.float32), camera, pose)
    own = outline_of(BALL, scan)
    assert own.missing_share == own.extra_share == own.worst_px == 0
    small, true, large = (camera.fx * r / np.sqrt(240**2 - r**2) for r in (45, 50, 55))
    # the outlines are circles on the picture's axis; a ring of half a pixel is what counting cells can be wrong by
    ring = 1 / true
    shrunk = outline_of(Surface(0.9 * BALL.vertices, BALL.faces), scan)
    assert shrunk.missing_share == pytest.approx(1 - (small / true) ** 2, abs=ring)
    assert shrunk.extra_share == 0 and shrunk.worst_px == pytest.approx(true - small, abs=1.0)
    grown = outline_of(Surface(1.1 * BALL.vertices, BALL.faces), scan)
    assert grown.missing_share == 0 and grown.extra_share == pytest.approx((large / true) ** 2 - 1, abs=ring)


def test_the_verdict_depends_on_the_size_of_the_bust_and_on_the_printer():
    found = measure_consistency(roughened(BALL, 1.0))
    small, huge = (verdict_for(found, 100, height, 0.05, 0.05) for height in (100, 1000))
    assert small.fit and not huge.fit
    assert small.sentence.startswith("accurate enough for a bust of 100 mm") and "not accurate enough" in huge.sentence
    with pytest.raises(SurfaceError, match="layer_mm is 0"):
        verdict_for(found, 100, 100, 0, 0.05)


def cap(dent_mm, radius=80.0, step=0.5, half=40.0):
    """The top of a ball as a scan of it would be, with noise of half a micrometre, and a dent 2 mm wide in its middle."""
    x, y = np.meshgrid(*2 * [np.arange(-half, half + step / 2, step)])
    noise = 5e-4 * np.random.default_rng(0).normal(size=x.shape)
    z = np.sqrt(radius**2 - x**2 - y**2) - radius + noise - dent_mm * np.exp(-0.5 * (x**2 + y**2))
    corner = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]))
    return Surface(np.stack([x, y, z], -1).reshape(-1, 3), np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]))


def test_a_dent_shallow_or_deep_stands_out_of_its_own_turntable_and_a_sound_cap_shows_nothing():
    camera = PinholeCamera.from_field_of_view(170, 170, 11.5)
    sensor, settings = Sensor(full_well=20_000.0, read_noise=10.0), Settings(each=4, depth=1, diffuse=False, backdrop=False)
    poses = [rigid.look_at((400 * np.sin(a), 40, 400 * np.cos(a)), (0, 0, 0)) for a in np.radians([-30, -15, 0, 15, 30])]
    for dent_mm in (0.0, 0.025, 0.1, 0.4):
        scene = studio(cap(dent_mm), load_material("steel"), "stripes", smooth=True).grey()
        looks = look_at_places(scene, camera, poses, settings, sensor, half_widths_mm=(1.0,))
        assert np.isfinite(looks[0].threshold)
        found = spots(looks)
        assert len(found) == (dent_mm > 0)
        for spot in found:
            assert np.hypot(*spot.centre_mm[:2]) < 2.0
            assert spot.ratio > 1.2 * spot.asked and spot.by_chance < FALSE_PLACES / 3


def test_of_places_whose_number_falls_as_a_power_as_many_stand_out_as_are_expected():
    rng = np.random.default_rng(0)
    points = 1e3 * rng.normal(size=(1000, 3))

    def named(ratios_of, surfaces=200):
        return sum(len(spots([look_of(1.0, points, ratios_of())])) for _ in range(surfaces))

    # 200 surfaces of 0.05 expected places each are 10; a power law of places beyond 1, as one in thirteen is
    beyond = rng.random((200, 1000)) < 1 / 13
    law = iter(np.where(beyond, np.exp(0.2 * rng.exponential(size=beyond.shape)), 0.5))
    assert 3 <= named(lambda: next(law)) <= 30
    # defects do not hide themselves: three of them, each ten times what is around it
    with_defects = iter(np.where(beyond, np.exp(0.2 * rng.exponential(size=beyond.shape)), 0.5))

    def spoilt():
        ratios = next(with_defects)
        ratios[:3] = 10.0
        return ratios

    assert 600 <= named(spoilt) <= 630
    few = look_of(1.0, points[:5], np.full(5, 3.0))
    assert few.threshold == np.inf and spots([few]) == []
