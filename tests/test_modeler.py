"""Modelled scenes: facets near the true surface, faces that keep their numbers, mirrors that obey the true normals."""

import math

import numpy as np
import pytest

from rangecheck import rigid
from rangecheck.analytic import shapes
from rangecheck.analytic.reflections import away_from_borders, ball_on_mirror_ids
from rangecheck.errors import InputError, RangecheckError, SceneError
from rangecheck.files import presets_folder
from rangecheck.maps import back_projection_error, trace_chain, trace_maps, trace_shadows
from rangecheck.modeler import model_from_dict, read_model
from rangecheck.optics import PinholeCamera

BOX = {"name": "box", "shape": "box", "size_mm": [60, 40, 50]}
SHAPES = {
    "sphere": ({"shape": "sphere", "radius_mm": 30}, shapes.Sphere(30)),
    "plane": ({"shape": "plane", "size_mm": [100, 80]}, shapes.Plane(100)),
    "box": ({"shape": "box", "size_mm": [60, 40, 50]}, shapes.Box(60, 40, 50)),
    "cylinder": ({"shape": "cylinder", "radius_mm": 20, "height_mm": 50}, shapes.Cylinder(20, 50)),
    "cone": ({"shape": "cone", "radius_mm": 25, "height_mm": 60}, shapes.Cone(25, 60)),
    "torus": ({"shape": "torus", "major_mm": 30, "minor_mm": 10}, shapes.Torus(30, 10)),
}
FOCAL_POINTS = [(0.0, 60.0, 160.0), (120.0, -90.0, 70.0), (-2000.0, 1500.0, -1000.0)]


def scene(*bodies, **more):
    return model_from_dict({"tolerance_mm": 0.05, "body": [{"name": f"b{k}"} | dict(b) for k, b in enumerate(bodies)]} | more)


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("focal_point_mm", FOCAL_POINTS)
def test_distance_maps_of_simple_solids_agree_with_closed_form_within_the_tessellation_bound(name, focal_point_mm):
    row, truth = SHAPES[name]
    motion = rigid.about_axis((0, 0, 1), math.radians(30)) @ rigid.about_axis((0, 1, 0), math.radians(20)) @ rigid.about_axis(
        (1, 0, 0), math.radians(10)
    )  # fmt: skip
    motion[:3, 3] = 5, -3, 8
    model = scene({"name": "a", "at_mm": [5, -3, 8], "turn_deg": [10, 20, 30]} | row)
    camera = PinholeCamera.from_field_of_view(121, 121, 2 * math.degrees(math.atan(70 / np.linalg.norm(focal_point_mm))))
    pose = rigid.look_at(focal_point_mm, motion[:3, 3])
    maps = trace_maps(model.surface, camera, pose)
    tolerance = model.tolerance_mm + 1e-9 * np.linalg.norm(focal_point_mm)
    to_shape = rigid.inverse(motion)
    points = rigid.move_points(to_shape, maps.points_mm()[maps.hit])
    # every hit lies within the bound of the true surface, whatever the angle
    assert np.abs(truth.signed_distance(points)).max() <= tolerance
    assert len(points) > 1000
    eye = rigid.move_points(to_shape, np.array(focal_point_mm))
    directions = camera.pixel_rays()[1] @ pose[:3, :3].T @ to_shape[:3, :3].T
    exact = truth.first_hit(eye, directions)
    obliquity = np.abs(np.cos(maps.incidence_rad))
    steep = maps.hit & np.isfinite(exact) & (obliquity > 0.3)
    if name == "plane":
        met = eye + np.where(np.isfinite(exact), exact, 0)[..., None] * directions
        exact = np.where((np.abs(met[..., 0]) <= 50) & (np.abs(met[..., 2]) <= 40), exact, np.inf)
        steep &= np.isfinite(exact)
    # along a ray the bound grows with the obliquity; a ray that meets another face than the true one is at an edge
    error = np.abs(maps.distance_mm - exact)[steep]
    assert (error <= 1.2 * tolerance / obliquity[steep] + 1e-9).mean() > 0.999
    assert steep.sum() > 500
    # where they disagree about a hit, the ray passes the surface within the bound
    border = maps.hit != np.isfinite(exact)
    assert border.mean() < 0.02


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("tolerance_mm", [1.0, 0.1, 0.01])
def test_facets_stay_within_the_tolerance_and_are_not_far_finer_than_it_asks(name, tolerance_mm):
    row, truth = SHAPES[name]
    model = scene(row, tolerance_mm=tolerance_mm)
    surface = model.surface
    weights = np.random.default_rng(0).dirichlet((1, 1, 1), 20)
    points = np.einsum("sk,fkj->fsj", weights, surface.triangles).reshape(-1, 3)
    measured = max(np.abs(truth.signed_distance(points)).max(), model.tessellation_error_mm())
    assert measured <= tolerance_mm * (1 + 1e-9)
    if name in ("sphere", "cylinder", "torus"):
        assert model.tessellation_error_mm() > 0.4 * tolerance_mm
    if name != "plane":
        assert surface.volume_mm3 == pytest.approx(truth.volume, abs=truth.area * tolerance_mm)
        assert surface.volume_mm3 > 0


@pytest.mark.parametrize("name", SHAPES)
def test_normals_are_the_true_surfaces_and_not_the_facets(name):
    row, truth = SHAPES[name]
    model = scene(row)
    surface = model.surface
    # on the facets the true normal is that of the nearest true point: exact, except at edges where two faces meet
    at = surface.triangles.mean(axis=1)
    normals = model.normals_at(at, np.arange(len(surface.faces)))
    np.testing.assert_allclose(normals, truth.normal(at), atol=1e-9)
    corners = model.corner_normals
    np.testing.assert_allclose(np.linalg.norm(corners, axis=2), 1.0)
    assert (np.einsum("fkj,fj->fk", corners, surface.face_normals) > 0.5).all()
    if name in ("sphere", "torus"):
        np.testing.assert_allclose(corners, truth.normal(surface.triangles), atol=1e-9)


def bored(at_mm, radius_mm=10):
    hole = {"name": "hole", "shape": "cylinder", "radius_mm": radius_mm, "height_mm": 100, "at_mm": at_mm}
    return {"name": "block", "shape": "difference", "of": [BOX, hole]}


def test_faces_keep_their_numbers_whatever_the_boolean_leaves_of_them():
    ball = {"name": "ball", "shape": "sphere", "radius_mm": 5, "at_mm": [0, 60, 0]}
    through, beside = scene(bored([0, 0, 0]), ball), scene(bored([200, 0, 0]), ball)
    assert through.surface.part_names == beside.surface.part_names
    names = through.surface.part_names
    assert names[:3] == ("block/box/right", "block/box/left", "block/box/top") and names[-1] == "ball/surface"
    assert {"block/hole/side", "block/hole/top"} <= set(names)
    present = {names[k] for k in np.unique(through.surface.part_of_face)}
    # the hole's ends are outside the block and leave no facet, but their numbers stay
    assert "block/hole/side" in present and "block/hole/top" not in present
    for model in (through, beside):
        for k, name in enumerate(names):
            corners = model.surface.triangles[model.surface.part_of_face == k].reshape(-1, 3)
            assert np.abs(model.true_faces[k].distance_mm(corners)).max(initial=0) < 1e-9, name


def test_volumes_of_booleans_are_those_of_the_closed_forms():
    hole = math.pi * 100 * 40
    cut = scene(bored([0, 0, 0]), tolerance_mm=0.001).surface
    assert cut.volume_mm3 == pytest.approx(60 * 40 * 50 - hole, abs=0.001 * 2 * math.pi * 10 * 40)
    two = [{"name": n, "shape": "sphere", "radius_mm": 10, "at_mm": [x, 0, 0]} for n, x in (("a", 0), ("b", 10))]
    lens = math.pi * (4 * 10 + 10) * (2 * 10 - 10) ** 2 / 12
    both = scene({"shape": "union", "of": two}, tolerance_mm=0.005).surface
    common = scene({"shape": "intersection", "of": two}, tolerance_mm=0.005).surface
    whole = 4 / 3 * math.pi * 1000
    assert common.volume_mm3 == pytest.approx(lens, abs=0.005 * common.area_mm2)
    assert both.volume_mm3 == pytest.approx(2 * whole - lens, abs=0.005 * both.area_mm2)
    below = scene({"shape": "intersection", "of": [two[0], {"name": "half", "shape": "plane", "size_mm": [100, 100]}]}).surface
    assert below.volume_mm3 == pytest.approx(whole / 2, abs=0.05 * below.area_mm2)


def test_normals_of_a_bore_point_into_it():
    model = scene(bored([0, 0, 0]))
    side = np.flatnonzero(model.surface.part_of_face == model.surface.part_names.index("block/hole/side"))
    at = model.surface.triangles[side].mean(axis=1)
    normals = model.normals_at(at, side)
    np.testing.assert_allclose(normals, -at * [1, 0, 1] / np.linalg.norm(at * [1, 0, 1], axis=1)[:, None], atol=1e-9)


def test_outlines_of_lines_and_arcs_enclose_the_volume_of_their_closed_form():
    # a rectangle with one corner rounded by a quarter circle, given both ways round
    outline = [[0, 0], [30, 0], [30, 10, math.tan(math.pi / 8)], [20, 20], [0, 20]]
    for points in (outline, [[0, 0], [0, 20], [20, 20, -math.tan(math.pi / 8)], [30, 10], [30, 0]]):
        model = scene({"shape": "extruded", "outline_mm": points, "depth_mm": 10}, tolerance_mm=0.01)
        assert model.surface.volume_mm3 == pytest.approx((600 - 100 + math.pi * 25) * 10, abs=0.01 * 160 * math.pi / 2)
        assert model.tessellation_error_mm() <= 0.01
    # turned about the axis: a cylinder with a rounded shoulder (Pappus)
    model = scene(
        {"shape": "revolved", "outline_mm": outline, "faces": ["foot", "side", "shoulder", "top", "axis"]}, tolerance_mm=0.01
    )
    corner = (1 - math.pi / 4) * 100
    # centroid of what the rounding removes, from the square's corner: r (10 - 3 pi) / (12 - 3 pi)
    inward = 10 * (1 - (10 - 3 * math.pi) / (12 - 3 * math.pi)) - 10
    exact = math.pi * 900 * 20 - 2 * math.pi * (30 + inward) * corner
    assert model.surface.volume_mm3 == pytest.approx(exact, abs=0.01 * model.surface.area_mm2)
    assert model.surface.part_names == ("b0/foot", "b0/side", "b0/shoulder", "b0/top")
    assert [f.kind for f in model.true_faces] == ["plane", "cylinder", "torus", "plane"]
    assert model.tessellation_error_mm() <= 0.01


def test_every_pixel_of_a_ball_over_a_plane_mirrors_what_the_closed_form_says():
    radius, half = 30.0, 150.0
    model = scene(
        {"name": "ball", "shape": "sphere", "radius_mm": radius, "at_mm": [0, radius, 0]},
        {"name": "plane", "shape": "plane", "size_mm": [2 * half, 2 * half]},
        tolerance_mm=0.002,
    )
    camera = PinholeCamera.from_field_of_view(161, 141, 35)
    eye = np.array([60.0, 120.0, 260.0])
    pose = rigid.look_at(eye, (0, 20, 0))
    maps = trace_maps(model.surface, camera, pose)
    chain = trace_chain(model.surface, maps, normals=model.normals_at)
    expected = np.stack(ball_on_mirror_ids(eye, camera.pixel_rays()[1] @ pose[:3, :3].T, radius, half))
    alike = away_from_borders(expected)
    assert alike.mean() > 0.9
    assert (maps.part_id[alike] == expected[0][alike]).all()
    assert (chain.secondary_id[alike] == expected[1][alike]).all()
    assert {(1, 0), (1, 2), (2, 0), (2, 1)} <= set(map(tuple, expected[:, alike].T))


def test_the_terminator_of_a_facetted_ball_is_the_great_circle():
    model = scene({"shape": "sphere", "radius_mm": 30}, tolerance_mm=0.2)
    camera = PinholeCamera.from_field_of_view(161, 161, 20)
    maps = trace_maps(model.surface, camera, rigid.look_at((0, 0, 260), (0, 0, 0)))
    sun = np.array([[1.0, 0.3, 0.2, 0.0]])
    points = maps.points_mm()[maps.hit]
    height = points @ sun[0, :3] / np.linalg.norm(sun) / 30

    def wrong(**how):
        lit = trace_shadows(model.surface, maps, sun, **how).lit[0][maps.hit]
        return (lit != (height > 0)).mean()

    # a lifted point behind the terminator by the angle acos(r / (r + lift)) still sees the sun only if its normal does
    assert wrong(normals=model.normals_at, lift_mm=2 * model.tolerance_mm) < 1e-4
    assert wrong() > 0.01


def test_the_tolerance_defaults_to_a_tenth_of_a_pixel_of_the_scenes_camera():
    camera = {"width": 200, "height": 200, "field_of_view_deg": 30, "eye_mm": [0, 0, 230], "target_mm": [0, 0, 0]}
    model = model_from_dict({"camera": camera, "body": [{"name": "a", "shape": "sphere", "radius_mm": 30}]})
    assert model.tolerance_mm == pytest.approx(0.1 * 200 / model.camera.fx, rel=0.01)
    assert model_from_dict({"body": [BOX]}).tolerance_mm == pytest.approx(1e-4 * math.hypot(60, 40, 50))


def test_a_mesh_file_can_take_part_in_booleans(tmp_path):
    import trimesh

    trimesh.creation.icosphere(subdivisions=3, radius=20).export(tmp_path / "ball.ply")
    mesh = {"name": "scan", "shape": "mesh", "file": "ball.ply", "unit": "mm", "at_mm": [0, 20, 0]}
    model = model_from_dict({"body": [{"name": "cut", "shape": "difference", "of": [BOX, mesh]}]}, tmp_path)
    assert set(np.unique(model.surface.part_of_face)) >= {2, 6}
    assert model.surface.part_names[6] == "cut/scan/surface"
    normals = model.corner_normals[model.surface.part_of_face == 6]
    corners = model.surface.triangles[model.surface.part_of_face == 6]
    inward = -(corners - [0, 20, 0]) / 20
    assert (np.einsum("fkj,fkj->fk", normals, inward) > 0.97).all()
    for file in ("../ball.ply", str(tmp_path / "ball.ply"), 3):
        with pytest.raises(SceneError, match="inside the scene file's folder"):
            model_from_dict({"body": [mesh | {"file": file}]}, tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        model_from_dict({"body": [mesh | {"file": "none.ply"}]}, tmp_path)


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ({}, "no .*body"),
        ({"body": []}, "no .*body"),
        ({"body": [BOX], "bodi": 1}, "did you mean body"),
        ({"body": [BOX | {"shape": "sphear"}]}, "did you mean sphere"),
        ({"body": [BOX | {"size": 3}]}, "did you mean size_mm"),
        ({"body": [BOX | {"size_mm": [1, 2]}]}, "3 lengths"),
        ({"body": [BOX | {"size_mm": [1, 2, -3]}]}, "positive number"),
        ({"body": [BOX | {"size_mm": [1, 2, math.nan]}]}, "positive number"),
        ({"body": [BOX | {"at_mm": [1, 2]}]}, "three numbers"),
        ({"body": [BOX | {"name": "a/b"}]}, "needs a name"),
        ({"body": [BOX, BOX]}, "given twice"),
        ({"body": [BOX, BOX | {"name": "other", "at_mm": [10, 0, 0]}]}, "overlap by 1e.05 mm3"),
        ({"body": [{"name": "s", "shape": "sphere"}]}, "needs radius_mm"),
        ({"body": [{"name": "t", "shape": "torus", "major_mm": 3, "minor_mm": 4}]}, "needs a hole"),
        ({"body": [{"name": "u", "shape": "union", "of": [BOX]}]}, "at least two"),
        ({"body": [{"name": "u", "shape": "intersection", "of": [BOX, BOX | {"name": "c", "at_mm": [99, 0, 0]}]}]}, "is empty"),
        ({"body": [{"name": "r", "shape": "revolved", "outline_mm": [[0, 0], [5, 0]]}]}, "no area"),
        ({"body": [{"name": "r", "shape": "revolved", "outline_mm": [[-1, 0], [5, 0], [5, 5]]}]}, "radius 0 or more"),
        ({"body": [{"name": "r", "shape": "extruded", "outline_mm": "x", "depth_mm": 1}]}, "list of points"),
        ({"body": [{"name": "r", "shape": "extruded", "outline_mm": [[0, 0], [0, 0], [1, 1]], "depth_mm": 1}]}, "are the same"),
        ({"body": [{"name": "s", "shape": "sphere", "radius_mm": 1e6}], "tolerance_mm": 1e-6}, "larger tolerance"),
        ({"body": [BOX], "camera": {"width": 10}}, "camera lacks"),
        ({"body": [BOX], "source": [{"at_mm": [0, 0, 0]}]}, "source 1 lacks"),
        (
            {"body": [{"name": "c", "shape": "cylinder", "radius_mm": 1e8, "height_mm": 1}], "tolerance_mm": 1e-5},
            "larger tolerance",
        ),
        ({"body": [BOX | {"shape": [1]}]}, "shape is"),
        ({"body": [{"name": "r", "shape": "revolved", "outline_mm": [[0, 0], [1e300, 0], [5, 5]]}]}, "list of points"),
        ({"body": "x"}, "no .*body"),
        ({"body": [3]}, "a body is a table"),
    ],
)
def test_a_scene_that_contradicts_itself_is_refused_with_the_rule(document, words):
    with pytest.raises(SceneError, match=words):
        model_from_dict(document)


def test_broken_files_are_refused(tmp_path):
    for content in (b"[[body", b"\xff\xfe", b"a = " + b"[" * 5000):
        (tmp_path / "s.toml").write_bytes(content)
        with pytest.raises(RangecheckError):
            read_model(tmp_path / "s.toml")


def test_the_shipped_scene_builds_proves_itself_and_shows_interreflection():
    model = read_model(presets_folder() / "scenes" / "workshop.toml")
    assert model.tessellation_error_mm() <= model.tolerance_mm
    assert set(model.material_of_part) == {"plaster", "steel"} and len(model.lamps) == 2
    maps = trace_maps(model.surface, model.camera, model.world_from_camera)
    assert back_projection_error(model.surface, maps).holds
    pairs = {(a, b) for a, b, _ in trace_chain(model.surface, maps, normals=model.normals_at).pairs(maps)}
    assert {("ball/surface", "table/top"), ("table/top", "ball/surface"), ("block/slot/bottom", "block/slot/left")} <= pairs
    # a plane face never mirrors itself
    planes = {name for name, true in zip(model.surface.part_names, model.true_faces) if true.kind == "plane"}
    assert not any(a == b and a in planes for a, b in pairs)


def test_a_picture_of_a_scene_is_as_large_as_asked_and_shows_what_its_own_camera_shows():
    from rangecheck.config import load_settings
    from rangecheck.pipeline.subject import Subject
    from rangecheck.pipeline.views import view_of

    model = read_model(presets_folder() / "scenes" / "bored_block.toml")
    subject = Subject("block", model.surface, model=model)
    own, pose = view_of(subject, load_settings(), None)
    assert own == model.camera and np.array_equal(pose, model.world_from_camera)
    asked, same = view_of(subject, load_settings(None, ["picture.width=96", "picture.height=72"]), None)
    assert (asked.width, asked.height) == (96, 72) and np.array_equal(same, pose)
    assert asked.width / asked.fx == pytest.approx(own.width / own.fx)
