"""Closed forms of the shapes agree with each other, with integration, and with marching."""

import math

import numpy as np
import pytest

from rangecheck.analytic.shapes import Box, Cone, Cylinder, Plane, Sphere, Torus
from rangecheck.errors import ArrayError

SHAPES = [Sphere(20.0), Box(30.0, 20.0, 44.0), Cylinder(14.0, 30.0), Cone(15.0, 40.0), Torus(20.0, 7.0)]
NAMES = [type(shape).__name__ for shape in SHAPES]


def rays(n, distance, seed=1):
    random = np.random.Generator(np.random.Philox(key=seed))
    origins = random.normal(size=(n, 3))
    origins *= distance / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = random.uniform(-30, 30, (n, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("shape", SHAPES, ids=NAMES)
@pytest.mark.parametrize("distance", [60.0, 1e5])
def test_first_hits_lie_on_the_surface_and_nothing_before_them(shape, distance):
    origins, directions = rays(4000, distance)
    hit = shape.first_hit(origins, directions)
    found = np.isfinite(hit)
    assert 0.1 < found.mean() < 0.9
    points = origins[found] + hit[found, None] * directions[found]
    rounding = 64 * np.spacing(distance + 60.0)
    assert np.abs(shape.signed_distance(points)).max() < rounding
    # march in front of each hit, and along each miss
    centre = -(origins * directions).sum(axis=1)
    start = np.maximum(centre - 60, 0.0)
    end = np.where(found, hit, centre + 60)
    for share in np.linspace(0.0, 1.0, 200):
        here = origins + (start + share * (end - start))[:, None] * directions
        assert (shape.signed_distance(here) > -rounding).all()


@pytest.mark.parametrize("shape", SHAPES, ids=NAMES)
def test_a_ray_from_inside_leaves_and_one_that_starts_on_the_surface_does_not_meet_itself(shape):
    origins, directions = rays(2000, 60.0, seed=2)
    hit = shape.first_hit(origins, directions)
    found = np.isfinite(hit)
    points = origins[found] + hit[found, None] * directions[found]
    normals = shape.normal(points)
    away = shape.first_hit(points + 1e-9 * normals, normals)
    if not isinstance(shape, Torus):
        assert np.isinf(away).all()
    inside = points - 1e-3 * normals
    steep = -(normals * directions[found]).sum(axis=1) > 0.1
    through = shape.first_hit(inside[steep], directions[found][steep])
    assert np.isfinite(through).all()
    leaving = inside[steep] + through[:, None] * directions[found][steep]
    assert np.abs(shape.signed_distance(leaving)).max() < 1e-11 * 60


@pytest.mark.parametrize("shape", SHAPES, ids=NAMES)
def test_normals_are_the_slope_of_the_distance(shape):
    origins, directions = rays(2000, 60.0, seed=3)
    hit = shape.first_hit(origins, directions)
    found = np.isfinite(hit)
    points = origins[found] + hit[found, None] * directions[found]
    step = 1e-5
    slope = np.stack(
        [(shape.signed_distance(points + step * e) - shape.signed_distance(points - step * e)) / (2 * step) for e in np.eye(3)],
        axis=-1,
    )
    smooth = np.abs(np.linalg.norm(slope, axis=1) - 1) < 1e-6  # not across an edge
    assert smooth.mean() > 0.99
    np.testing.assert_allclose(shape.normal(points)[smooth], slope[smooth], atol=1e-7)


@pytest.mark.parametrize("shape", SHAPES, ids=NAMES)
def test_volume_and_area_agree_with_counting_points(shape):
    # Crofton: the mean number of crossings of random lines through a ball of radius R is 2 area / (4 pi R^2);
    # volume by points in the box. Five standard errors.
    n, half = 60000, 25.0 * np.ones(3)
    random = np.random.Generator(np.random.Philox(key=4))
    if isinstance(shape, Cone):
        half = np.array([25.0, 45.0, 25.0])
    if isinstance(shape, Torus):
        half = np.array([28.0, 8.0, 28.0])
    inside = shape.signed_distance(random.uniform(-half, half, (n, 3))) < 0
    box = 8 * half.prod()
    share = shape.volume / box
    assert abs(inside.mean() - share) < 5 * math.sqrt(share * (1 - share) / n)

    radius, lines = (44.0 if isinstance(shape, Cone) else 30.0), 40000
    ends = random.normal(size=(2, lines, 3))
    ends *= radius / np.linalg.norm(ends, axis=-1, keepdims=True)
    origins, directions = ends[0], ends[1] - ends[0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    crossings = np.zeros(lines)
    live = np.ones(lines, bool)
    for _ in range(4):
        hit = shape.first_hit(origins, directions)
        live = np.isfinite(hit)
        crossings += live
        origins = np.where(
            live[:, None], origins + np.where(live, hit + 1e-7, 0.0)[:, None] * directions, 1e3 * directions + origins
        )
    expected = shape.area / (2.0 * math.pi * radius**2)
    assert abs(crossings.mean() - expected) < 5 * crossings.std() / math.sqrt(lines)


def test_area_is_the_growth_of_volume_under_a_thin_coat():
    e = 1e-6
    for thin, thick in (
        (Sphere(20.0), Sphere(20.0 + e)),
        (Torus(20.0, 7.0), Torus(20.0, 7.0 + e)),
        (Box(30.0, 20.0, 44.0), Box(30.0 + 2 * e, 20.0 + 2 * e, 44.0 + 2 * e)),
        (Cylinder(14.0, 30.0), Cylinder(14.0 + e, 30.0 + 2 * e)),
        # a cone's faces move by e when its base moves by e and its apex by e (slant / radius)
        (Cone(15.0, 40.0), Cone(15.0 * (1 + e * (1 + math.hypot(15, 40) / 15) / 40), 40.0 + e * (1 + math.hypot(15, 40) / 15))),
    ):
        assert (thick.volume - thin.volume) / e == pytest.approx(thin.area, rel=1e-5)


def test_plane_is_met_from_either_side_and_not_by_parallels():
    plane = Plane()
    origins = np.array([[0.0, 3.0, 0.0], [0.0, -3.0, 0.0], [0.0, 3.0, 0.0], [0.0, 3.0, 0.0]])
    directions = np.array([[0.0, -1.0, 0.0], [0.6, 0.8, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(plane.first_hit(origins, directions), [3.0, 3.75, np.inf, np.inf])


def test_axes_and_symmetry_planes_are_no_special_case():
    np.testing.assert_allclose(Torus(20.0, 7.0).first_hit(np.array([[50.0, 0, 0]]), np.array([[-1.0, 0, 0]])), 23.0)
    assert np.isinf(Torus(20.0, 7.0).first_hit(np.array([[0.0, 50, 0]]), np.array([[0.0, -1, 0]])))
    np.testing.assert_allclose(Torus(20.0, 7.0).first_hit(np.array([[20.0, 50, 0]]), np.array([[0.0, -1, 0]])), 43.0)
    np.testing.assert_allclose(Cylinder(5.0, 8.0).first_hit(np.array([[0.0, 50, 0]]), np.array([[0.0, -1, 0]])), 46.0)
    np.testing.assert_allclose(Cone(5.0, 8.0).first_hit(np.array([[0.0, -50, 0]]), np.array([[0.0, 1, 0]])), 42.0)
    np.testing.assert_allclose(Box(2.0, 4.0, 6.0).first_hit(np.array([[0.5, 50, 0]]), np.array([[0.0, -1, 0]])), 48.0)
    assert np.isinf(Box(2.0, 4.0, 6.0).first_hit(np.array([[1.5, 50, 0]]), np.array([[0.0, -1, 0]])))


def test_shapes_without_size_are_refused():
    with pytest.raises(ArrayError, match="radius"):
        Sphere(0.0)
    with pytest.raises(ArrayError, match="minor < major"):
        Torus(3.0, 4.0)
