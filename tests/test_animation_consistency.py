"""What an animation shows of a surface, measured: planted noise comes back as planted, a planted dent where it was planted."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from test_maps import ball

from rangecheck import kernels, rigid
from rangecheck.animation import faces_seen, measure_consistency, orbit_around, outline_of, verdict_for
from rangecheck.animation.measured_normals import lit_picture, normals_in_shading, normals_in_waves
from rangecheck.animation.orbit import Orbit
from rangecheck.animation.standing_out import FALSE_PLACES, look_at_places, look_of, normals_around, spots
from rangecheck.errors import SurfaceError
from rangecheck.maps import trace_maps
from rangecheck.optics import PinholeCamera, Sensor
from rangecheck.pipeline.consistency import standing_in_frames
from rangecheck.reflectance import load_material
from rangecheck.scan import RangeScan
from rangecheck.scene import Scene, studio
from rangecheck.surface import Surface
from rangecheck.transport import Settings, Tracer

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


def sheet(height_of, step=0.5, half=40.0):
    """A surface of heights over a square, as a scan of it would be, with noise of half a micrometre."""
    x, y = np.meshgrid(*2 * [np.arange(-half, half + step / 2, step)])
    z = height_of(x, y) + 5e-4 * np.random.default_rng(0).normal(size=x.shape)
    corner = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]))
    return Surface(np.stack([x, y, z], -1).reshape(-1, 3), np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]))


def cap(x, y, radius=80.0):
    return np.sqrt(radius**2 - x**2 - y**2) - radius


def hollow(x, y, depth_mm, half_width_mm=1.0):
    return -depth_mm * np.exp(-0.5 * (x**2 + y**2) / half_width_mm**2)


CAMERA = PinholeCamera.from_field_of_view(170, 170, 11.5)
SENSOR = Sensor(full_well=20_000.0, read_noise=10.0, response="srgb")
POSES = [rigid.look_at((400 * np.sin(a), 40, 400 * np.cos(a)), (0, 0, 0)) for a in np.radians(range(-40, 41, 20))]
TURNED = [rigid.look_at((400 * np.sin(a), 40, 400 * np.cos(a)), (0, 0, 0)) for a in np.radians(range(-60, 61, 10))]
MIRRORED, MATT = (Settings(each=4, spike=m, lobe=m, diffuse=False, depth=1, backdrop=False) for m in (True, False))


def in_waves(surface, poses=POSES):
    return normals_in_waves(Scene(surface, (load_material("steel"),), smooth=True), CAMERA, poses, MIRRORED, SENSOR)


def in_shading(surface, moving=True):
    pictures = []
    for k, pose in enumerate(TURNED):
        front = -pose[:3, 2] if moving else (0.0, 0.0, 1.0)
        scene = studio(surface, load_material("plaster"), "dark", front=front, smooth=True).grey()
        pictures.append(lit_picture(Tracer(scene), CAMERA, pose, MATT, SENSOR, seed=k))
    return normals_in_shading(surface, CAMERA, pictures, normals_around(surface, 2.0))


@pytest.mark.parametrize("measure", [in_waves, in_shading])
def test_normals_are_measured_in_pictures_to_within_the_noise_that_is_told(measure):
    found = measure(sheet(cap))
    true = found.points_mm + [0, 0, 80.0]
    off = found.normals - true / np.linalg.norm(true, axis=1, keepdims=True)
    assert len(found.normals) > 10_000 and np.degrees(np.median(found.noise_rad)) < 2.0
    # what is common to all around is form, and no noise
    near = cKDTree(found.points_mm).query(found.points_mm, 40)[1]
    noise = np.sqrt(0.5 * ((off - off[near].mean(axis=1)) ** 2).sum(axis=1))
    # the mesh's own half micrometre leans its normals by a twentieth of a degree
    told = np.sqrt(np.median(found.noise_rad) ** 2 + (5e-4 / 0.5) ** 2)
    assert 0.5 * told < np.median(noise) / 0.83 < 2 * told


def test_lights_that_never_move_over_a_matt_surface_tell_one_slope_and_no_normal():
    assert len(in_shading(sheet(cap), moving=False).normals) == 0


@pytest.mark.parametrize("depth_mm", [0.0, 0.025, 0.1, 0.4, -0.1])
def test_a_dent_or_bump_shallow_or_deep_is_found_in_waves_with_its_depth_and_a_sound_cap_shows_nothing(depth_mm):
    looks = look_at_places(in_waves(sheet(lambda x, y: cap(x, y) + hollow(x, y, depth_mm))), (1.0,))
    assert np.isfinite(looks[0].threshold)
    found = spots(looks)
    assert len(found) == (depth_mm != 0)
    for spot in found:
        assert np.hypot(*spot.centre_mm[:2]) < 1.0 and spot.ratio > 1.2 * spot.asked and spot.by_chance < FALSE_PLACES
        # pixels of half a millimetre and lines between vertices blur it
        assert 0.6 * abs(depth_mm) < spot.depth_mm * np.sign(depth_mm) < abs(depth_mm)


def test_a_dent_in_a_fold_is_found_along_it_and_a_fold_is_no_dent():
    def folded(x, y):
        return cap(x, y) - 1.5 * np.exp(-0.5 * ((x - 1.0) / 1.5) ** 2)

    assert spots(look_at_places(in_waves(sheet(folded)), (1.0,))) == []
    (found,) = spots(look_at_places(in_waves(sheet(lambda x, y: folded(x, y) + hollow(x, y, 0.1))), (1.0,)))
    assert np.hypot(*found.centre_mm[:2]) < 1.0


def test_a_dent_is_found_in_plaster_whose_lights_stand_still_while_it_turns():
    (found,) = spots(look_at_places(in_shading(sheet(lambda x, y: cap(x, y) + hollow(x, y, 0.2))), (1.0,)))
    assert np.hypot(*found.centre_mm[:2]) < 1.0


def test_a_dent_is_found_in_the_frames_of_a_plaster_turntable_alone():
    scene = studio(sheet(lambda x, y: cap(x, y) + hollow(x, y, 0.2)), load_material("plaster"), "dark", smooth=True).grey()
    orbit = Orbit((0.0, 0.0, 0.0), 400.0, elevation_deg=6.0, frames=13, swing_deg=60.0)
    exposure = 0.5
    sensor = replace(SENSOR, electrons_per_unit=exposure * SENSOR.full_well)

    def frame(index):
        turned = scene.lights_moved(orbit.world_from_turned(index))
        light = Tracer(turned).render(CAMERA, orbit.world_from_camera(index), MATT, seed=index).radiance[..., 0]
        return sensor.expose(light.astype(float), frame=index)

    told = standing_in_frames(scene, CAMERA, orbit, frame, exposure, sensor)
    (found,) = told.spots
    assert np.hypot(*found.centre_mm[:2]) < 1.0 and 0.1 < found.depth_mm < 0.2
    assert told.shown == "frames" and told.pictures == told.views == 13 and told.noise_deg < 2.0
    assert told.lines()[0].startswith("13 frames tell slopes to") and "a dent at" in told.lines()[1]

    # pixels wider than what is looked for tell of no place, and no frame is looked at
    coarse = standing_in_frames(scene, PinholeCamera.from_field_of_view(20, 20, 11.5), orbit, None, exposure, sensor)
    assert coarse.spots == () and "not told; pixels of" in coarse.lines()[0]


def test_places_are_the_same_bytes_on_any_number_of_threads():
    found = []
    for count in (1, 3):
        with kernels.threads(count):
            (look,) = look_at_places(in_waves(sheet(cap, half=12.0), POSES[:2]), (1.0,))
            found.append(look.points_mm.tobytes() + look.ratios.tobytes())
    assert found[0] == found[1]


def test_of_places_whose_number_falls_exponentially_as_many_stand_out_as_are_expected():
    rng = np.random.default_rng(0)
    points = 1e3 * rng.normal(size=(1000, 3))

    def named(ratios_of, surfaces=200):
        return sum(len(spots([look_of(1.0, points, ratios_of())])) for _ in range(surfaces))

    # 200 surfaces of 0.05 expected places each are 10
    assert 3 <= named(lambda: rng.exponential(0.3, 1000)) <= 30

    # defects do not hide themselves: three of them, each far beyond all others
    def spoilt():
        return np.r_[10.0, 10.0, 10.0, rng.exponential(0.3, 997)]

    assert 600 <= named(spoilt) <= 630
    few = look_of(1.0, points[:5], np.full(5, 3.0))
    assert few.threshold == np.inf and spots([few]) == []
    # a hollow that does not explain most of what is left is none, however rare
    assert named(lambda: np.r_[1.5, rng.exponential(0.01, 999)], 1) == 0
