"""Secondary IDs and shadows of scenes whose every chain of reflections can be written down."""

import json

import numpy as np
import pytest

from rangecheck import kernels, rigid
from rangecheck.analytic.reflections import box_corner_chain
from rangecheck.errors import ArrayError
from rangecheck.export.map_files import write_chain, write_shadows, write_value_map
from rangecheck.export.pictures import read_map_png16, read_png
from rangecheck.maps import (
    back_projection_error,
    deviation_seen,
    smooth_normals,
    trace_chain,
    trace_maps,
    trace_shadows,
    values_seen,
)
from rangecheck.maps.shadow import LIT, NOTHING, SHADED, TURNED_AWAY
from rangecheck.optics import PinholeCamera
from rangecheck.raycast import EmbreeCaster
from rangecheck.surface import Surface
from rangecheck.surface.surface import join

SIDE = 100.0


def rectangle(corner, a, b, name):
    """Two triangles, normal along a x b."""
    p = np.array(corner, float)
    vertices = np.stack([p, p + a, p + np.add(a, b), p + b])
    return Surface(vertices, np.array([[0, 1, 2], [0, 2, 3]]), part_names=(name,))


def box_corner():
    """Three mutually facing squares in the planes x = 0, y = 0, z = 0, facing the first octant."""
    x, y, z = SIDE * np.eye(3)
    return join([rectangle((0, 0, 0), y, z, "x wall"), rectangle((0, 0, 0), z, x, "floor"), rectangle((0, 0, 0), x, y, "z wall")])


@pytest.mark.parametrize("eye", [(160.0, 140.0, 170.0), (300.0, 60.0, 90.0)])
def test_every_chain_in_a_box_corner_is_the_analytic_one(eye):
    surface = box_corner()
    camera = PinholeCamera.from_field_of_view(157, 131, 45)
    pose = rigid.look_at(eye, (35, 35, 35))
    maps = trace_maps(surface, camera, pose)
    chain = trace_chain(surface, maps, bounces=3)
    directions = camera.pixel_rays()[1].reshape(-1, 3) @ pose[:3, :3].T
    ids, clearance = box_corner_chain(np.tile(eye, (len(directions), 1)), directions, SIDE, 3)
    away = clearance > 1e-4 * SIDE
    assert away.mean() > 0.95
    found = np.concatenate([maps.part_id[None], chain.part_ids]).reshape(4, -1)
    assert (found[:, away] == ids[:, away]).all()
    # the retroreflector: chains of all three walls exist, and after three different walls the ray leaves
    assert (np.sort(ids[:3], axis=0) == [[1], [2], [3]]).all(axis=0).sum() > 100
    names = {(a, b) for a, b, _ in chain.pairs(maps)}
    assert ("floor", "x wall") in names and ("floor", "floor") not in names


def test_a_ray_that_left_the_scene_never_comes_back():
    surface = box_corner()
    maps = trace_maps(surface, PinholeCamera.from_field_of_view(61, 51, 60), rigid.look_at((160, 140, 170), (35, 35, 35)))
    chain = trace_chain(surface, maps, bounces=4)
    gone = chain.part_ids == 0
    assert (gone[1:] | ~gone[:-1]).all()
    assert (chain.part_ids[:, maps.part_id == 0] == 0).all()
    assert ((chain.faces >= 0) == (chain.part_ids > 0)).all()


def test_a_plane_seen_from_behind_mirrors_towards_the_viewer():
    floor = rectangle((-50, 0, -50), (0, 0, 100), (100, 0, 0), "floor")
    lid = rectangle((-500, -40, -500), (0, 0, 1000), (1000, 0, 0), "lid")
    scene = join([floor, lid])
    maps = trace_maps(scene, PinholeCamera.from_field_of_view(21, 21, 10), rigid.look_at((10, -30, 0), (0, 0, 0)))
    assert (maps.incidence_rad > np.pi / 2).all()
    assert (trace_chain(scene, maps).secondary_id == 2).all()


def test_smooth_normals_of_a_fine_mesh_mirror_as_the_true_surface_does():
    from test_maps import ball

    radius = 30.0
    sphere = ball(radius, (0, radius, 0), subdivisions=5)
    floor = rectangle((-400, 0, -400), (0, 0, 800), (800, 0, 0), "plane")
    scene = join([sphere, floor])
    camera = PinholeCamera.from_field_of_view(121, 121, 30)
    eye = np.array([0.0, 90.0, 220.0])
    pose = rigid.look_at(eye, (0, radius, 0))
    maps = trace_maps(scene, camera, pose)
    chain = trace_chain(scene, maps, normals=smooth_normals(scene))
    directions = camera.pixel_rays()[1] @ pose[:3, :3].T
    # the ball: exact reflection about its radius, then the plane where the ray goes down far enough
    along = ((np.array([0, radius, 0]) - eye) * directions).sum(-1)
    off2 = ((np.array([0, radius, 0]) - eye) ** 2).sum() - along**2
    on_ball = off2 < (0.97 * radius) ** 2
    point = eye + (along - np.sqrt(np.where(on_ball, radius**2 - off2, 0)))[..., None] * directions
    normal = (point - [0, radius, 0]) / radius
    mirrored = directions - 2 * (directions * normal).sum(-1, keepdims=True) * normal
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(mirrored[..., 1] < 0, -point[..., 1] / mirrored[..., 1], np.inf)
    landing = np.abs(point + np.where(np.isfinite(reach), reach, 0)[..., None] * mirrored)[..., [0, 2]].max(-1)
    sure = on_ball & (np.abs(mirrored[..., 1]) > 0.02) & ((np.abs(landing - 400) > 20) | ~np.isfinite(reach))
    expected = np.where(np.isfinite(reach) & (landing < 400), 2, 0)
    assert sure.sum() > 1000
    assert (chain.secondary_id[sure] == expected[sure]).all()
    assert set(np.unique(chain.secondary_id[maps.part_id == 2])) == {0, 1}


def test_chains_are_the_same_on_any_number_of_threads():
    surface = box_corner()
    maps = trace_maps(surface, PinholeCamera.from_field_of_view(301, 203, 45), rigid.look_at((160, 140, 170), (35, 35, 35)))
    found = []
    for count in (1, 3):
        with kernels.threads(count):
            found.append(trace_chain(surface, maps, bounces=2).part_ids.tobytes())
    assert found[0] == found[1]


def test_wrong_questions_are_refused():
    surface = box_corner()
    maps = trace_maps(surface, PinholeCamera.from_field_of_view(21, 21, 45), rigid.look_at((160, 140, 170), (35, 35, 35)))
    with pytest.raises(ArrayError, match="bounces is 0"):
        trace_chain(surface, maps, bounces=0)
    other = rectangle((0, 0, 0), (1, 0, 0), (0, 1, 0), "a")
    for question in (trace_chain, back_projection_error, lambda s, m: trace_shadows(s, m, [[0, 1, 0, 0]])):
        with pytest.raises(ArrayError, match="the surface has 2; maps, caster and surface must belong together"):
            question(other, maps)
    with pytest.raises(ArrayError, match="must belong together"):
        trace_maps(other, maps.camera, maps.world_from_camera, EmbreeCaster(surface.vertices, surface.faces), allow_inside=True)
    with pytest.raises(ArrayError, match=r"points \(x, y, z, 1\) or directions"):
        trace_shadows(surface, maps, [[0, 0, 0, 0]])
    with pytest.raises(ArrayError, match="values has 5 entries"):
        values_seen(surface, maps, np.zeros(5))


def test_a_plate_throws_its_shadow_where_the_source_says():
    floor = rectangle((-100, 0, -100), (0, 0, 200), (200, 0, 0), "floor")
    plate = rectangle((-10, 50, -10), (0, 0, 20), (20, 0, 0), "plate")
    scene = join([floor, plate])
    camera = PinholeCamera.from_field_of_view(201, 201, 40)
    maps = trace_maps(scene, camera, rigid.look_at((0, 400, 1), (0, 0, 0), up=(0, 0, -1)))
    lamps = np.array([[0, 100, 0, 1], [1, 1, 0, 0], [0, -1, 0, 0], [0, 20, 0, 1]], float)
    shadows = trace_shadows(scene, maps, lamps)
    points = maps.points_mm()
    on_floor = maps.part_id == 1
    x, z = points[..., 0], points[..., 2]
    # the point source at twice the plate's height doubles it; the slanted sun shifts it by its height
    for k, (shift, size) in enumerate([(0.0, 20.0), (-50.0, 10.0)]):
        border = np.abs(np.maximum(np.abs(x - shift), np.abs(z)) - size)
        dark = (np.abs(x - shift) < size) & (np.abs(z) < size)
        sure = on_floor & (border > 0.01)
        assert (shadows.state[k][sure & dark] == SHADED).all() and (shadows.state[k][sure & ~dark] == LIT).all()
        assert (shadows.shaded_by[k][sure & dark] == 2).all()
    assert (shadows.state[2][maps.hit] == TURNED_AWAY).all()
    # a lamp under the plate lights the floor and not the plate's top
    assert (shadows.state[3][on_floor] == LIT).all() and (shadows.state[3][maps.part_id == 2] == TURNED_AWAY).all()
    assert (shadows.state[:, ~maps.hit] == NOTHING).all()
    seen = shadows.sources_seen
    assert ((seen & 1) > 0).sum() == shadows.lit[0].sum() and ((seen >> 3 & 1) > 0).sum() == shadows.lit[3].sum()


def test_values_on_vertices_are_interpolated_and_values_on_faces_are_kept():
    surface = box_corner()
    maps = trace_maps(surface, PinholeCamera.from_field_of_view(61, 51, 45), rigid.look_at((160, 140, 170), (35, 35, 35)))
    linear = surface.vertices @ [1.0, -2.0, 3.0] + 7
    seen = values_seen(surface, maps, linear)
    np.testing.assert_allclose(seen[maps.hit], maps.points_mm()[maps.hit] @ [1.0, -2.0, 3.0] + 7, atol=1e-9)
    assert np.isnan(seen[~maps.hit]).all()
    faces = values_seen(surface, maps, np.arange(6.0))
    assert (faces[maps.hit] == maps.face[maps.hit]).all()


def test_deviation_from_a_displaced_sphere_is_the_distance_to_its_centre_less_its_radius():
    import trimesh

    radius, shift = 40.0, np.array([0.6, -0.3, 0.8])
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    here, there = Surface(sphere.vertices, sphere.faces), Surface(sphere.vertices + shift, sphere.faces)
    maps = trace_maps(here, PinholeCamera.from_field_of_view(81, 61, 25), rigid.look_at((60, 90, 220), (0, 0, 0)))
    seen = deviation_seen(maps, there)
    truth = np.linalg.norm(maps.points_mm()[maps.hit] - shift, axis=1) - radius
    # the other sphere's facets sag inside it: the distance is larger by up to that
    sag = radius - np.linalg.norm(here.triangles.mean(axis=1), axis=1).min()
    over = seen.distance_mm[maps.hit] - truth
    assert seen.faced == seen.seen == maps.hit.sum()
    assert over.min() > -1e-9 * radius and over.max() < 1.001 * sag < 0.02 * np.linalg.norm(shift)
    # towards the shift the shifted one lies outside, away from it inside
    assert seen.statistics()["lowest_mm"] < -0.9 and seen.statistics()["highest_mm"] > 0.5


def test_what_an_open_surface_does_not_face_has_no_deviation():
    floor, patch = (rectangle((-w, y, -w), (0, 0, 2 * w), (2 * w, 0, 0), "plate") for w, y in ((50, 0.0), (20, -0.5)))
    maps = trace_maps(
        floor,
        PinholeCamera.from_field_of_view(41, 41, 20),
        rigid.look_at((0, 300, 1), (0, 0, 0), up=(0, 0, -1)),
        allow_inside=True,
    )
    seen = deviation_seen(maps, patch)
    x, _, z = np.moveaxis(maps.points_mm(), -1, 0)
    faced = np.maximum(np.abs(x), np.abs(z)) < 20
    np.testing.assert_allclose(seen.distance_mm[faced], 0.5, atol=1e-4)
    assert np.isnan(seen.distance_mm[~faced]).all() and 0 < seen.faced == faced.sum() < seen.seen
    nothing = deviation_seen(maps, Surface(patch.vertices + (500, 0, 0), patch.faces))
    assert nothing.faced == 0 and np.isnan(nothing.statistics()["rms_mm"])


def test_chains_shadows_and_values_become_files(tmp_path):
    surface = box_corner()
    maps = trace_maps(surface, PinholeCamera.from_field_of_view(61, 51, 45), rigid.look_at((160, 140, 170), (35, 35, 35)))
    chain = trace_chain(surface, maps, bounces=2)
    write_chain(tmp_path, maps, chain)
    for k in (0, 1):
        assert (read_png(tmp_path / f"secondary_id_{k + 1}_16bit.png") == chain.part_ids[k]).all()
    with np.load(tmp_path / "chain.npz") as found:
        assert (found["faces"] == chain.faces).all()
    table = json.loads((tmp_path / "reflections.json").read_text())
    assert sum(row["pixels"] for row in table["pairs"]) == maps.hit.sum()
    shadows = trace_shadows(surface, maps, np.array([[50, 60, 70, 1], [0, 1, 0, 0]], float))
    assert len(write_shadows(tmp_path, shadows, ["lamp", "sky"])) == 3
    height = values_seen(surface, maps, surface.vertices[:, 1] - 30)
    write_value_map(tmp_path, "height", height, "Height", "mm", signed=True)
    values, scale = read_map_png16(tmp_path / "height_16bit.png")
    assert np.nanmax(np.abs(values - height)) <= 0.5001 * scale["step"]
    # zero is the middle of the colours, as light as they get
    picture = read_png(tmp_path / "height.png")
    assert picture.shape[1] > 600
