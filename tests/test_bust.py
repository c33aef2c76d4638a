"""The sample bust is one smooth closed surface, known to rounding, with the proportions of a head."""

import numpy as np
import pytest

from rangecheck.analytic import bust
from rangecheck.analytic.bust import bust_distance_mm, bust_first_hit, bust_normals, bust_signed_distance
from rangecheck.errors import ArrayError
from rangecheck.kernels import threads


@pytest.fixture(scope="module")
def rays():
    """Rays from a sphere of 600 mm around the bust to points inside its box, and where they first meet it."""
    random = np.random.Generator(np.random.Philox(key=5))
    origins = random.normal(size=(6000, 3))
    origins = 600 * origins / np.linalg.norm(origins, axis=1, keepdims=True) + [0, 150, 0]
    targets = random.uniform([-60, 0, -40], [60, 300, 40], (6000, 3))
    directions = targets - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins, directions, bust_first_hit(origins, directions)


@pytest.fixture(scope="module")
def on_surface(rays):
    origins, directions, distance = rays
    hit = np.isfinite(distance)
    return origins[hit] + distance[hit, None] * directions[hit]


def test_rays_end_on_the_zero_set(on_surface):
    # the root finder stops when the function is below 1e-10 or the bracket shorter than 1e-9 mm; slopes stay below 8
    assert np.abs(bust_signed_distance(on_surface)).max() < 8e-9 / 0.1


def test_rays_find_the_first_crossing_that_a_fine_march_finds(rays):
    origins, directions, distance = rays
    step = 0.25
    along = np.arange(380.0, 820.0, step)
    for i in range(150):
        inside = bust_signed_distance(origins[i] + along[:, None] * directions[i]) < 0
        first = along[np.argmax(inside)] if inside.any() else np.inf
        assert first == distance[i] or 0 <= first - distance[i] <= step


def test_hits_face_the_ray(rays):
    origins, directions, distance = rays
    hit = np.isfinite(distance)
    normals = bust_normals(origins[hit] + distance[hit, None] * directions[hit])
    assert (normals * directions[hit]).sum(axis=1).max() < 1e-3


def test_the_distance_of_a_shifted_point_is_the_shift(on_surface):
    normals = bust_normals(on_surface)
    for shift in (-0.1, 0.05, 0.2):
        distance = bust_distance_mm(on_surface + shift * normals)
        # but for grooves narrower than the shift, where another wall is nearer: then the answer is smaller
        assert np.quantile(np.abs(distance - shift), 0.99) < 1e-6
        assert (np.abs(distance) > abs(shift) + 1e-6).mean() < 1e-3
        assert (np.sign(distance) == np.sign(shift)).mean() > 0.999


def test_points_far_from_the_surface_are_told_so():
    far = bust_distance_mm(np.array([[0.0, 500.0, 0.0], [0.0, 312.0, 0.0], [0.0, 240.0, 0.0]]))
    assert np.isinf(far[0]) or far[0] > 190
    assert 10 < far[1] < 20
    assert far[2] < -20


def test_the_first_order_distance_is_right_to_second_order(on_surface):
    normals = bust_normals(on_surface)
    coarse, fine = (np.median(np.abs(bust_signed_distance(on_surface + s * normals) - s)) for s in (0.2, 0.02))
    assert fine < coarse / 50


def test_the_function_has_no_jumps():
    random = np.random.Generator(np.random.Philox(key=6))
    points = random.uniform([-110, -5, -75], [110, 305, 85], (60000, 3))
    near = points[np.abs(bust_signed_distance(points)) < 4.0]
    direction = random.normal(size=near.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    change = np.abs(bust._values(near + 1e-6 * direction) - bust._values(near))
    assert change.max() < 20 * 1e-6


def test_it_stands_on_a_flat_base_and_is_300_mm_tall():
    down = bust_first_hit(np.array([[x, 400.0, 2.0] for x in (-12.0, 0.0, 12.0)]), np.array([[0.0, -1.0, 0.0]] * 3))
    assert 294 < 400 - down.min() < 306
    up = bust_first_hit(np.array([[x, -50.0, -14.0] for x in (-40.0, 0.0, 40.0)]), np.array([[0.0, 1.0, 0.0]] * 3))
    np.testing.assert_allclose(up, 50.0, atol=1e-8)


def test_the_base_is_inside_and_the_sky_outside():
    signs = bust_signed_distance(np.array([[0.0, 5.0, -14.0], [0.0, 240.0, 0.0], [0.0, 330.0, 0.0], [0.0, -3.0, -14.0]]))
    assert (np.sign(signs) == [-1, -1, 1, 1]).all()


def test_the_same_bytes_on_any_number_of_threads(rays):
    origins, directions, _distance = rays
    origins, directions = np.tile(origins, (4, 1)), np.tile(directions, (4, 1))
    with threads(1):
        alone = bust_first_hit(origins, directions)
    with threads(3):
        assert bust_first_hit(origins, directions).tobytes() == alone.tobytes()


def test_compiled_and_interpreted_agree(on_surface, tmp_path):
    import os
    import subprocess
    import sys

    points = on_surface[::150] + 0.3
    np.save(tmp_path / "points.npy", points)
    np.save(tmp_path / "heights.npy", bust.height_map())
    program = (
        "import sys, numpy as np\n"
        "from rangecheck.analytic.bust_form import bust_function\n"
        "points, heights = (np.load(f'{sys.argv[1]}/{name}.npy') for name in ('points', 'heights'))\n"
        "np.save(f'{sys.argv[1]}/values.npy', [bust_function(*p, heights) for p in points])\n"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], env=os.environ | {"NUMBA_DISABLE_JIT": "1"}, check=True)
    np.testing.assert_allclose(np.load(tmp_path / "values.npy"), bust._values(points), rtol=1e-12, atol=1e-12)


def test_rays_that_pass_by_miss(rays):
    origins, directions, _ = rays
    assert np.isinf(bust_first_hit(origins, -directions)).all()
    assert np.isinf(bust_first_hit(origins, directions, 100.0)).all()
    assert len(bust_first_hit(np.empty((0, 3)), np.empty((0, 3)))) == 0


def test_points_that_are_not_finite_are_refused():
    with pytest.raises(ArrayError, match="points_mm"):
        bust_distance_mm(np.array([[0.0, np.nan, 0.0]]))
