"""Scenes: sources give the light that their closed forms say, surroundings shine as described, contradictions are refused."""

import math
from dataclasses import replace

import numba
import numpy as np
import pytest

from rangecheck.analytic import light
from rangecheck.errors import SceneError
from rangecheck.reflectance import GREY_UM, Material
from rangecheck.scene import DARKNESS, Scene, Softbox, Source, constant, gradient, panorama, stripes, studio
from rangecheck.surface import Surface
from rangecheck.surface.surface import join
from rangecheck.transport.reflection import materials_of

PLASTER = Material("white", K_lm=0.9, wavelengths_um=GREY_UM)


def tetrahedron(size_mm=10.0, centre=(0.0, 0.0, 0.0)):
    vertices = size_mm * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float) + centre
    return Surface(vertices, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]))


def test_irradiance_of_a_sphere_is_its_closed_form_above_at_and_below_the_horizon():
    source = Source(np.array([0.0, 0.0, 50.0]), 20.0, np.array([3.0]))
    angles = np.linspace(0.0, math.pi, 200)
    normals = np.stack([np.sin(angles), np.zeros(200), np.cos(angles)], axis=1)
    points = np.zeros((200, 3))
    truth = light.irradiance_of_sphere(3.0, 20.0, 50.0, normals[:, 2])
    assert np.allclose(source.irradiance(points, normals)[:, 0], truth, rtol=1e-12, atol=1e-13)
    assert source.irradiance(points[:1], normals[:1])[0, 0] == pytest.approx(3.0 * math.pi * 0.16, rel=1e-14)


def test_the_horizon_cut_agrees_with_adding_up_the_sphere_piece_by_piece():
    source = Source(np.array([0.0, 0.0, 30.0]), 15.0, np.array([1.0]))
    n = 2000
    cosine = 1 - (np.arange(n) + 0.5) / n * (1 - math.sqrt(0.75))
    turn = (np.arange(n) + 0.5) / n * 2 * math.pi
    sine = np.sqrt(1 - cosine**2)
    for tilt in (70.0, 85.0, 95.0, 110.0):
        a = math.radians(tilt)
        light_in = np.maximum(0.0, cosine[:, None] * math.cos(a) + sine[:, None] * np.cos(turn) * math.sin(a)).mean()
        solid_angle = source.solid_angle(np.zeros((1, 3)))[0]
        there = source.irradiance(np.zeros((1, 3)), np.array([[math.sin(a), 0.0, math.cos(a)]]))[0, 0]
        assert there == pytest.approx(light_in * solid_angle, rel=1e-5, abs=1e-7)


def test_the_exact_solid_angle_departs_from_the_reports_as_the_source_comes_near():
    # 0.25 % at r/d = 0.1, 7 % at 0.5
    source = Source(np.zeros(3), 1.0, np.array([1.0]))
    ratio = source.solid_angle(np.array([[10.0, 0, 0], [2.0, 0, 0]])) / (math.pi / np.array([100.0, 4.0]))
    assert ratio == pytest.approx([1.0025, 1.0718], abs=1e-4)
    assert source.solid_angle(np.array([[1e9, 0, 0]]))[0] == pytest.approx(math.pi * 1e-18, rel=1e-12)


def test_a_point_inside_a_source_is_refused_with_the_numbers():
    source = Source(np.zeros(3), 5.0, np.array([1.0]))
    with pytest.raises(SceneError, match=r"1 points lie inside the source .* radius 5 mm, the nearest 3 mm") as caught:
        source.solid_angle(np.array([[3.0, 0, 0], [8.0, 0, 0]]))
    assert caught.value.inside == 1


@pytest.mark.parametrize("radius", [0.0, -1.0, math.nan, math.inf])
def test_a_source_needs_a_positive_radius(radius):
    with pytest.raises(SceneError, match="radius"):
        Source(np.zeros(3), radius, np.array([1.0]))


@pytest.mark.parametrize("radiance", [[-1.0], [math.nan], [], [[1.0]]])
def test_a_source_needs_a_radiance_that_is_light(radiance):
    with pytest.raises(SceneError, match="radiance"):
        Source(np.zeros(3), 1.0, np.array(radiance))


def test_a_source_can_be_asked_for_by_the_irradiance_that_it_gives():
    source = Source.giving([2.0, 4.0], at_mm=[1, 2, 3], centre_mm=[1, 2, 503], angular_radius_deg=3.0)
    assert source.irradiance(np.array([[1.0, 2, 3]]), np.array([[0.0, 0, 1]]))[0] == pytest.approx([2.0, 4.0], rel=1e-12)


def test_surroundings_shine_as_they_say():
    along = np.array([[0, 1, 0], [0, -1, 0], [1, 0, 0], [0, 0, -1]], float)
    assert constant(0.5).radiance(along)[:, 0] == pytest.approx([0.5] * 4)
    assert gradient(0.1, 0.9).radiance(along)[:, 0] == pytest.approx([0.9, 0.1, 0.5, 0.5])
    banded = stripes(0.0, 1.0, period_deg=20.0, softness=0.0)
    polar = np.radians([2.0, 7.0, 12.0, 18.0, 27.0, 33.0, 173.0])
    level = banded.radiance(np.stack([np.sin(polar), np.cos(polar), 0 * polar], axis=1))[:, 0]
    assert level == pytest.approx([0, 1, 1, 0, 1, 1, 1])


def test_stripes_cover_the_sphere_half_dark_half_bright_by_angle():
    polar = (np.arange(36000) + 0.5) / 36000 * math.pi
    along = np.stack([np.sin(polar), np.cos(polar), 0 * polar], axis=1)
    for softness in (0.0, 0.3, 1.0):
        assert stripes(0.0, 1.0, 15.0, softness=softness).radiance(along).mean() == pytest.approx(0.5, abs=1e-4)


def test_a_softbox_adds_its_light_within_its_edges_only():
    room = constant(0.1).with_boxes(Softbox(np.array([0, 0, 1.0]), 20.0, 10.0, np.array([2.0]), softness=0.0))
    degrees = np.radians([[0, 0], [9.9, 0], [10.1, 0], [0, 4.9], [0, 5.1], [180, 0]])
    along = np.stack([np.sin(degrees[:, 0]), np.sin(degrees[:, 1]), np.cos(degrees[:, 0]) * np.cos(degrees[:, 1])], axis=1)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    assert room.radiance(along)[:, 0] == pytest.approx([2.1, 2.1, 0.1, 2.1, 0.1, 0.1])
    assert room.brightest()[0] >= 2.1


def test_a_panorama_is_read_between_its_samples_and_around_its_seam():
    rows, columns = np.mgrid[0:64, 0:128]
    polar, azimuth = (rows + 0.5) / 64 * math.pi, ((columns + 0.5) / 128 - 0.5) * 2 * math.pi
    # ahead is -z, right is +x
    directions = np.stack([np.sin(polar) * np.sin(azimuth), np.cos(polar), -np.sin(polar) * np.cos(azimuth)], axis=-1)
    picture = 1.0 + directions @ np.array([0.3, 0.2, 0.5])
    world = panorama(np.repeat(picture[..., None], 3, axis=2))
    assert np.allclose(world.radiance(directions)[..., 1], picture, atol=2e-6)
    rng = np.random.default_rng(0)
    other = rng.normal(size=(500, 3))
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    # bilinear between samples 2.8 degrees apart: an eighth of the squared step times the second derivative, and half a step at the poles
    step = math.pi / 64
    assert np.abs(world.radiance(other)[:, 0] - (1.0 + other @ np.array([0.3, 0.2, 0.5]))).max() < 0.7 * step / 2


def test_a_scene_refuses_what_contradicts_itself():
    surface = tetrahedron()
    with pytest.raises(SceneError, match="no material"):
        Scene(surface, ())
    with pytest.raises(SceneError, match="reaches into the surface"):
        Scene(surface, (PLASTER,), sources=(Source(np.zeros(3), 8.0, np.array([1.0])),))
    with pytest.raises(SceneError, match="reaches into the surface"):
        Scene(surface, (PLASTER,), sources=(Source(np.array([0, 0, 20.0]), 11.0, np.array([1.0])),))
    with pytest.raises(SceneError, match="3 radiances and the materials 1 wavelengths"):
        Scene(surface, (PLASTER,), sources=(Source(np.array([0, 0, 99.0]), 1.0, np.ones(3)),))
    with pytest.raises(SceneError, match="different wavelengths"):
        Scene(surface, (PLASTER, Material("red", K_lm=0.5)))
    with pytest.raises(SceneError, match="there are 1 materials"):
        Scene(surface, (PLASTER,), material_of_part=(1,))
    # small enough to stay within the tetrahedron, whose faces are 10/sqrt(3) from its middle
    Scene(surface, (PLASTER,), sources=(Source(np.zeros(3), 5.7, np.array([1.0])),))


def test_smooth_normals_are_the_vertices_and_flat_ones_the_faces():
    surface = tetrahedron()
    flat = Scene(surface, (PLASTER,)).corner_normals
    assert np.allclose(flat, np.repeat(surface.face_normals[:, None], 3, axis=1), atol=1e-6)
    smooth = Scene(surface, (PLASTER,), smooth=True).corner_normals
    assert np.allclose(smooth, surface.vertices[surface.faces] / (10 * math.sqrt(3)), atol=1e-6)


def test_corners_that_no_vertex_speaks_for_have_the_normal_of_their_face():
    flat, smooth = tetrahedron(), tetrahedron(20.0, centre=(50, 0, 0))
    surface = join([replace(flat, part_names=("flat",)), replace(smooth, part_names=("smooth",))])
    known = surface.vertex_normals.copy()
    known[4] = 0.0  # of the smooth one
    scene = Scene(surface, (PLASTER,), smooth_of_part=(False, True), vertex_normals=known)
    for face, corners in enumerate(scene.corner_normals):
        for vertex, normal in zip(surface.faces[face], corners):
            own = face < 4 or vertex == 4
            assert np.allclose(normal, surface.face_normals[face] if own else known[vertex], atol=1e-6)


def test_the_normals_of_a_smooth_surface_are_kept_once_a_vertex():
    surface = tetrahedron()
    normals, rows = Scene(surface, (PLASTER,), smooth=True).shading_normals
    assert len(normals) == len(surface.vertices) and np.shares_memory(rows, surface.faces)


@pytest.mark.parametrize("kind", ["plaster", "steel", "stripes", "dark"])
@pytest.mark.parametrize("offset_mm", [0.0, 5e5])
def test_a_studio_fits_any_object_and_turns_with_it(kind, offset_mm):
    surface = tetrahedron(35.0, centre=(offset_mm, 0, 0))
    scene = studio(surface, PLASTER, kind, front=(1, 0, 0), up=(0, 0, 1))
    turned = studio(surface, PLASTER, kind)
    assert len(scene.sources) == len(turned.sources)
    for source, other in zip(scene.sources, turned.sources):
        away, beyond = source.centre_mm - [offset_mm, 0, 0], other.centre_mm - [offset_mm, 0, 0]
        # front x -> z, up z -> y, right y -> x
        assert np.allclose(away[[1, 2, 0]], beyond, rtol=1e-9, atol=1e-6)
        assert np.linalg.norm(away) > surface.extent_mm
    if kind == "dark":
        assert scene.surroundings is DARKNESS


def test_a_studio_says_what_it_knows():
    with pytest.raises(SceneError, match="plaster, steel, stripes, dark"):
        studio(tetrahedron(), PLASTER, "stell")
    with pytest.raises(SceneError, match="point the same way"):
        studio(tetrahedron(), PLASTER, "steel", front=(0, 1, 0))


def test_whatever_a_scene_is_made_of_its_stages_are_compiled_once():
    """A kernel is compiled for each type of its arguments, and an array that may be written is of another type than one that may not."""
    metal = Material("metal", K_s=0.6, sigma_um=0.02, correlation_um=3.0, wavelengths_um=GREY_UM)
    assert len({numba.typeof(materials_of(some)) for some in ([PLASTER], [metal], [PLASTER, metal])}) == 1
    around = (DARKNESS, constant(0.3), gradient(0.1, 0.5), stripes(0.0, 1.0, 20.0), panorama(np.ones((4, 8, 1))))
    assert len({numba.typeof(some.arrays(channels)) for some in around for channels in (1, 3)}) == 1
