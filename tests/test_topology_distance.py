"""Distances to a surface: nearest over all triangles, and the side told from any feature."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rangecheck import kernels
from rangecheck.errors import ArrayError, SurfaceError
from rangecheck.surface import Surface
from rangecheck.surface.distance import SurfaceDistance

CUBE_FACES = np.array(
    [
        [0, 2, 1],
        [0, 3, 2],
        [4, 5, 6],
        [4, 6, 7],
        [0, 1, 5],
        [0, 5, 4],
        [1, 2, 6],
        [1, 6, 5],
        [2, 3, 7],
        [2, 7, 6],
        [3, 0, 4],
        [3, 4, 7],
    ]
)
CUBE_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float)


def cube(side_mm=2.0, centre_mm=(0.0, 0.0, 0.0)):
    return Surface((CUBE_CORNERS - 0.5) * side_mm + np.asarray(centre_mm), CUBE_FACES)


def signed_distance_to_cube(points, side_mm):
    q = np.abs(points) - side_mm / 2
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


def test_signed_distance_to_a_cube_is_its_closed_form_near_faces_edges_and_corners():
    points = np.random.default_rng(1).uniform(-3, 3, (4000, 3))
    distance, _ = SurfaceDistance(cube()).signed_distance_mm(points)
    assert np.abs(distance - signed_distance_to_cube(points, 2.0)).max() < 16 * np.finfo(float).eps * 3


def test_far_from_the_origin_no_digit_is_lost_but_those_of_the_coordinates():
    offset = np.array([4.0e8, -3.0e8, 5.0e6])
    points = np.random.default_rng(2).uniform(-3, 3, (500, 3)) + offset
    distance, _ = SurfaceDistance(cube(2.0, offset)).signed_distance_mm(points)
    assert np.abs(distance - signed_distance_to_cube(points - offset, 2.0)).max() < 4 * np.spacing(4e8)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 400), st.integers(0, 2**31))
def test_no_triangle_of_a_soup_is_nearer_than_the_one_that_was_found(count, seed):
    random = np.random.default_rng(seed)
    soup = Surface(random.normal(size=(3 * count, 3)) * 10.0 ** random.integers(-2, 3), np.arange(3 * count).reshape(-1, 3))
    points = random.normal(size=(40, 3)) * 20
    found = SurfaceDistance(soup).nearest(points)
    each = np.array(
        [SurfaceDistance(soup.with_faces(np.arange(count) == f)).distance_mm(points)[0] for f in range(min(count, 30))]
    )
    assert (found.distance_mm <= each.min(axis=0) * (1 + 1e-12) + 1e-12).all()
    assert np.allclose(np.linalg.norm(points - found.place_mm, axis=1), found.distance_mm, rtol=1e-12, atol=1e-12)
    assert found.face.min() >= 0 and found.face.max() < count


def test_threads_change_no_byte():
    random = np.random.default_rng(3)
    soup = Surface(random.normal(size=(3000, 3)), np.arange(3000).reshape(-1, 3))
    points = random.normal(size=(20000, 3))
    answers = []
    for count in (1, 4):
        with kernels.threads(count):
            answers.append(SurfaceDistance(Surface(soup.vertices, soup.faces)).nearest(points))
    assert all(np.array_equal(a, b) for a, b in zip(*answers))


def test_faces_without_area_are_points_and_lines():
    needle = Surface([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2], [0, 0, 0]])
    distance, _ = SurfaceDistance(needle).distance_mm(np.array([[1.5, 2.0, 0.0], [-3.0, 4.0, 0.0]]))
    assert np.array_equal(distance, [2.0, 5.0])


def test_no_points_no_faces_and_points_that_are_not_numbers():
    assert SurfaceDistance(cube()).distance_mm(np.empty((0, 3)))[0].shape == (0,)
    with pytest.raises(SurfaceError, match="no faces"):
        SurfaceDistance(Surface(np.zeros((3, 3)), np.empty((0, 3))))
    with pytest.raises(ArrayError, match="points_mm has 1 values that are not finite"):
        SurfaceDistance(cube()).distance_mm(np.array([[0, 0, np.nan]]))
