"""Maps against closed forms: what a camera sees of a sphere is geometry, not opinion."""

import math

import numpy as np
import pytest

from rangecheck import kernels, rigid
from rangecheck.errors import InputError, SceneError
from rangecheck.export.legend import NOTHING
from rangecheck.export.map_files import read_maps_npz, write_maps, write_maps_npz
from rangecheck.export.mapped import coloured_normals
from rangecheck.export.pictures import read_map_png16, read_png
from rangecheck.maps import back_projection_error, trace_maps, winding_number
from rangecheck.maps.proof import point_triangle_mm
from rangecheck.optics import CylindricalCamera, OrthographicCamera, PinholeCamera
from rangecheck.raycast import BruteCaster
from rangecheck.surface import Surface


def ball(radius_mm=50.0, centre_mm=(0.0, 0.0, 0.0), subdivisions=4):
    """An icosphere: every vertex lies on the sphere, every face sags inside it."""
    golden = (1 + math.sqrt(5)) / 2
    corners = np.array([(0, a, b) for a in (-1, 1) for b in (-golden, golden)])
    vertices = np.concatenate([corners, corners[:, [2, 0, 1]], corners[:, [1, 2, 0]]])
    from scipy.spatial import ConvexHull

    faces = ConvexHull(vertices).simplices
    for _ in range(subdivisions):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, index = np.unique(edges, axis=0, return_inverse=True)
        middle = index.reshape(-1, 3) + len(vertices)
        vertices = np.concatenate([vertices, vertices[edges].mean(axis=1)])
        a, b, c = faces.T
        ab, bc, ca = middle.T
        faces = np.concatenate([np.stack(f, axis=1) for f in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    outward = np.einsum(
        "ij,ij->i", np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))), vertices[faces[:, 0]]
    )
    faces = np.where((outward > 0)[:, None], faces, faces[:, ::-1])
    return Surface(radius_mm * vertices + centre_mm, faces, part_names=("ball",))


def sag_mm(surface, radius_mm, centre_mm=(0.0, 0.0, 0.0)):
    """How far the faces lie inside the sphere at most."""
    return radius_mm - np.linalg.norm(surface.triangles.mean(axis=1) - centre_mm, axis=1).min()


CAMERA = PinholeCamera.from_field_of_view(121, 91, 40)
FOCAL_POINTS = [(0.0, 0.0, 200.0), (150.0, 90.0, -120.0), (0.0, 5000.0, 0.0)]


@pytest.mark.parametrize("focal_point_mm", FOCAL_POINTS)
def test_distance_and_depth_of_a_ball_are_those_of_the_sphere_within_the_sag_of_its_facets(focal_point_mm):
    surface = ball()
    pose = rigid.look_at(focal_point_mm, (0, 0, 0))
    camera = PinholeCamera.from_field_of_view(121, 91, math.degrees(3 * 50 / np.linalg.norm(focal_point_mm)))
    maps = trace_maps(surface, camera, pose)
    _, directions = camera.pixel_rays()
    to_centre = np.linalg.norm(focal_point_mm)
    along = directions @ (rigid.inverse(pose)[:3, :3] @ -np.array(focal_point_mm))
    off2 = to_centre**2 - along**2
    # a ray that passes the sphere steeply enough must hit; the facets lie at most `sag` inside, seen under the angle of incidence
    cosine = np.sqrt(np.maximum(1 - off2 / 50**2, 0))
    surely = cosine > 0.3
    truth = along - np.sqrt(np.maximum(50**2 - off2, 0))
    error = maps.distance_mm - truth
    assert maps.hit[surely].all()
    assert not maps.hit[off2 > 50**2].any()
    bound = sag_mm(surface, 50) / cosine[surely] * 1.2
    assert (error[surely] > -1e-9 * to_centre).all() and (error[surely] < bound).all()
    np.testing.assert_allclose(maps.depth_mm, maps.distance_mm * directions[..., 2], rtol=1e-12)
    np.testing.assert_allclose(
        np.cos(maps.incidence_rad[surely]), cosine[surely], atol=2 * math.sqrt(2 * sag_mm(surface, 50) / 50) / 0.3
    )


def test_what_is_not_hit_is_nan_zero_and_minus_one():
    maps = trace_maps(ball(), CAMERA, rigid.look_at((0, 0, 200), (0, 0, 0)))
    nothing = ~maps.hit
    assert 0.2 < nothing.mean() < 0.9
    for values in (maps.distance_mm, maps.depth_mm, maps.normals, maps.incidence_rad):
        assert np.isnan(values[nothing]).all() and np.isfinite(values[maps.hit]).all()
    assert (maps.part_id[nothing] == 0).all() and (maps.part_id[maps.hit] == 1).all()
    assert (maps.face[nothing] == -1).all()


@pytest.mark.parametrize("offset_mm", [0.0, 1e6])
@pytest.mark.parametrize("far", [1.2, 30.0, 1000.0])
def test_pixels_sent_back_by_distance_and_by_depth_lie_on_the_surface(far, offset_mm):
    centre = np.array([offset_mm, -offset_mm, 0.5 * offset_mm])
    surface = ball(50, centre)
    camera = PinholeCamera.from_field_of_view(101, 101, 2 * math.degrees(math.asin(1 / (1.2 * far))))
    maps = trace_maps(surface, camera, rigid.look_at(centre + far * 50 * np.array([0.6, 0.48, 0.64]), centre))
    proof = back_projection_error(surface, maps)
    assert proof.pixels == maps.hit.sum() > 1000
    assert proof.holds, proof


def test_a_wrong_distance_is_found_by_back_projection():
    surface = ball()
    maps = trace_maps(surface, CAMERA, rigid.look_at((0, 0, 200), (0, 0, 0)))
    row, column = np.argwhere(maps.hit)[500]
    maps.distance_mm[row, column] += 0.01
    proof = back_projection_error(surface, maps)
    assert not proof.holds and 0.005 < proof.distance_max_mm <= 0.0101


@pytest.mark.parametrize(
    "camera",
    [
        PinholeCamera.from_field_of_view(41, 31, 40),
        PinholeCamera(37, 31, 40, 42, 19, 14, (-0.2, 0.05, 0.001, -0.002, 0.01)),
        OrthographicCamera(34, 34, 3.1, 16.5, 16.5),
        CylindricalCamera(40, 30, 180.0, 2 * math.pi / 40, 3.0, 14.5),
    ],
)
def test_embree_and_the_oracle_see_the_same_map(camera):
    surface = ball(subdivisions=1)
    pose = rigid.identity() if camera.model == "cylindrical" else rigid.look_at((40, 60, 150), (3, 2, 1))
    fast = trace_maps(surface, camera, pose)
    slow = trace_maps(surface, camera, pose, BruteCaster(surface.vertices, surface.faces))
    assert (fast.hit == slow.hit).all() and fast.hit.sum() > 300
    # on an edge between two faces either may be named; the distance must agree all the same, and the point lie on both
    np.testing.assert_allclose(fast.distance_mm, slow.distance_mm, atol=1e-6 * surface.extent_mm)
    other = fast.face != slow.face
    both = fast.points_mm()[other], surface.triangles[slow.face[other]]
    assert (point_triangle_mm(*both) <= 1e-6 * surface.extent_mm).all()
    assert back_projection_error(surface, fast).holds


def test_pixels_without_a_ray_see_nothing_and_do_not_disturb_their_neighbours():
    surface = ball(subdivisions=1)
    folding = PinholeCamera(41, 31, 30, 30, 20, 15, (-0.9,))
    _, directions = folding.pixel_rays()
    lost = np.isnan(directions).any(axis=-1)
    assert 0.1 < lost.mean() < 0.9
    pose = rigid.look_at((0, 0, 70), (0, 0, 0))
    maps = trace_maps(surface, folding, pose)
    assert not maps.hit[lost].any()
    slow = trace_maps(surface, folding, pose, BruteCaster(surface.vertices, surface.faces))
    np.testing.assert_allclose(maps.distance_mm, slow.distance_mm, atol=1e-6 * surface.extent_mm)


def test_a_focal_point_inside_the_solid_is_refused_and_one_in_its_cavity_is_not():
    outer, inner = ball(50), ball(30)
    hollow = Surface(
        np.concatenate([outer.vertices, inner.vertices]),
        np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)]),
    )
    assert winding_number(hollow, np.array([[0.0, 0, 0], [40, 0, 0], [60, 0, 0]])) == pytest.approx([0, 1, 0], abs=1e-9)
    with pytest.raises(SceneError, match=r"\(40, 0, 0\) mm is inside the solid") as refused:
        trace_maps(hollow, CAMERA, rigid.look_at((40, 0, 0), (90, 0, 0)))
    assert refused.value.measured["winding_number"] == pytest.approx(1)
    cavity = trace_maps(hollow, CAMERA, rigid.look_at((0, 0, 0), (0, 0, 1)))
    assert cavity.hit.all() and cavity.distance_mm.max() < 30.001
    assert trace_maps(hollow, CAMERA, rigid.look_at((40, 0, 0), (90, 0, 0)), allow_inside=True).hit.all()


def test_an_orthographic_camera_that_starts_inside_is_refused():
    with pytest.raises(SceneError, match="inside the solid"):
        trace_maps(ball(), OrthographicCamera(50, 50, 2.0, 24.5, 24.5), rigid.look_at((0, 0, 10), (0, 0, 0)))


def test_an_empty_surface_is_refused():
    with pytest.raises(SceneError, match="no faces"):
        trace_maps(Surface(np.zeros((3, 3)), np.empty((0, 3), np.int32)), CAMERA, np.eye(4))


def test_maps_are_the_same_bytes_on_any_number_of_threads():
    surface, pose = ball(), rigid.look_at((0, 80, 200), (0, 0, 0))
    camera = PinholeCamera.from_field_of_view(301, 203, 40)
    found = []
    for count in (1, 2, 5):
        with kernels.threads(count):
            found.append(trace_maps(surface, camera, pose))
    for name in ("distance_mm", "depth_mm", "normals", "incidence_rad", "part_id", "face"):
        assert len({getattr(maps, name).tobytes() for maps in found}) == 1


def test_a_point_is_as_far_from_a_triangle_as_from_its_plane_edge_or_corner():
    triangle = np.array([[[0.0, 0, 0], [4, 0, 0], [0, 3, 0]]])
    points = {(1, 1, 2): 2, (2, -1, 0): 1, (-3, -4, 0): 5, (4, 3, 0): 12 / 5, (5, 0, 1): math.sqrt(2)}
    for point, distance in points.items():
        assert point_triangle_mm(np.array([point], float), triangle)[0] == pytest.approx(distance)
    needle = np.array([[[0.0, 0, 0], [4, 0, 0], [2, 0, 0]]])
    assert point_triangle_mm(np.array([[2.0, 0, 3]]), needle)[0] == pytest.approx(3)


def test_maps_come_back_from_their_files(tmp_path):
    surface = ball()
    maps = trace_maps(surface, CAMERA, rigid.look_at((0, 0, 200), (0, 0, 0)))
    paths = write_maps(tmp_path, maps, stem="front_")
    assert {p.name for p in paths} >= {"front_maps.npz", "front_distance.png", "front_distance_16bit.png", "front_contours.png"}
    assert all(p.stat().st_size > 0 for p in paths)
    again = read_maps_npz(tmp_path / "front_maps.npz")
    assert again.camera == maps.camera and again.part_names == ("ball",)
    assert (again.face == maps.face).all() and back_projection_error(surface, again).holds
    values, scale = read_map_png16(tmp_path / "front_distance_16bit.png")
    assert scale["unit"] == "mm" and scale["quantity"] == "distance"
    assert np.nanmax(np.abs(values - maps.distance_mm)) <= 0.5001 * scale["step"]
    assert (np.isnan(values) == ~maps.hit).all()
    assert (read_png(tmp_path / "front_part_id_16bit.png") == maps.part_id).all()
    normals, scale = read_map_png16(tmp_path / "front_normals_16bit.png")
    assert scale["quantity"] == "normal" and (np.isnan(normals).all(axis=2) == ~maps.hit).all()
    assert np.nanmax(np.abs(normals - maps.normals)) <= 0.5001 * scale["step"]
    write_maps_npz(tmp_path / "again.npz", maps)
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "front_maps.npz").read_bytes()


def test_the_picture_of_normals_has_the_colour_of_each_axis_and_nothing_where_nothing_is():
    normals = np.full((1, 4, 3), np.nan)
    normals[0, :3] = np.eye(3)
    shown = {tuple(colour) for colour in coloured_normals(normals, "Normals", picture_px=400).reshape(-1, 3).tolist()}
    assert {(255, 128, 128), (128, 255, 128), (128, 128, 255), NOTHING} <= shown


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", b"plain text"])
def test_a_file_without_maps_is_refused_in_one_line(tmp_path, content):
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(InputError, match="does not hold maps"):
        read_maps_npz(tmp_path / "x.npz")
    with pytest.raises(InputError, match="does not exist"):
        read_maps_npz(tmp_path / "none.npz")
