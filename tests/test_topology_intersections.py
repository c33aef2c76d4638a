"""Where surfaces run through themselves: signs against rational arithmetic, meetings against clipping, known solids."""

from fractions import Fraction
from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_topology_distance import cube

from rangecheck import kernels
from rangecheck.surface import Surface
from rangecheck.surface.intersections import APART, CROSSING, OVERLAP, TOUCHING, meeting, self_intersections
from rangecheck.surface.predicates import side_of_line, side_of_plane
from rangecheck.surface.surface import join
from rangecheck.surface.tree import blocks_of


def exact(points):
    return [tuple(Fraction(float(x)) for x in p) for p in points]


def minus(p, q):
    return tuple(a - b for a, b in zip(p, q))


def dot(p, q):
    return sum(a * b for a, b in zip(p, q))


def cross(p, q):
    return (p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0])


def sign(x):
    return (x > 0) - (x < 0)


def exact_side_of_plane(a, b, c, d):
    return sign(dot(cross(minus(b, a), minus(c, a)), minus(d, a)))


def part_within(polygon, normal, t):
    """What of a convex polygon lies within triangle t of the same plane, by clipping at its edges."""
    for i in range(3):
        inward = cross(normal, minus(t[(i + 1) % 3], t[i]))
        heights = [dot(inward, minus(p, t[i])) for p in polygon]
        kept = []
        for k, p in enumerate(polygon):
            q, h, g = polygon[k - 1], heights[k], heights[k - 1]
            if sign(h) * sign(g) < 0:
                kept.append(tuple(b + (a - b) * g / (g - h) for a, b in zip(p, q)))
            if h >= 0:
                kept.append(p)
        polygon = kept
    return polygon


def cut_interval(t, heights, along):
    """Where the plane that t's corners have these heights over meets t, as positions along the common line."""
    places = [dot(along, p) for p, h in zip(t, heights) if h == 0]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        if sign(heights[i]) * sign(heights[j]) < 0:
            s = heights[i] / (heights[i] - heights[j])
            places.append(dot(along, t[i]) * (1 - s) + dot(along, t[j]) * s)
    return (min(places), max(places)) if places else None


def exact_meeting(t, u):
    """The same answer as `meeting`, in rational arithmetic, by clipping in the common plane or along the common line."""
    t, u = exact(t), exact(u)
    n1, n2 = cross(minus(t[1], t[0]), minus(t[2], t[0])), cross(minus(u[1], u[0]), minus(u[2], u[0]))
    common = len(set(t) & set(u))
    h_u, h_t = [dot(n1, minus(p, t[0])) for p in u], [dot(n2, minus(p, u[0])) for p in t]
    if all(h == 0 for h in h_u):
        rest = part_within(list(u), n1, t)
        corners = list(dict.fromkeys(rest))
        area = any(cross(minus(a, corners[0]), minus(b, corners[0])) != (0, 0, 0) for a in corners for b in corners)
        return OVERLAP if area else TOUCHING if rest and not common else APART
    along = cross(n1, n2)
    one, two = cut_interval(t, h_t, along), cut_interval(u, h_u, along)
    if common == 2 or along == (0, 0, 0) or one is None or two is None:
        return APART
    low, high = max(one[0], two[0]), min(one[1], two[1])
    if low < high or (low == high and not common and (one[0] == one[1] or two[0] == two[1])):
        # a point strictly inside the other's segment counts like a segment: the faces touch there
        through = all(min(h) < 0 < max(h) for h in (h_u, h_t))
        if low < high:
            return CROSSING if through else TOUCHING
    return TOUCHING if low <= high and not common else APART


def has_area(t):
    t = exact(t)
    return cross(minus(t[1], t[0]), minus(t[2], t[0])) != (0, 0, 0)


corner = st.tuples(*[st.integers(-2, 2)] * 3)


@settings(max_examples=500, deadline=None)
@given(st.tuples(corner, corner, corner), st.tuples(corner, corner, corner))
def test_any_two_triangles_meet_as_rational_arithmetic_says(t, u):
    if has_area(t) and has_area(u):
        a, b = (tuple(tuple(float(x) for x in p) for p in triangle) for triangle in (t, u))
        assert meeting(a, b) == exact_meeting(t, u)


def test_the_answer_knows_no_order_of_corners_or_faces():
    random = np.random.default_rng(4)
    for _ in range(60):
        t, u = random.integers(-2, 3, (2, 3, 3)).astype(float)
        if has_area(t) and has_area(u):
            a, b = [tuple(map(tuple, x)) for x in (t, u)]
            answers = {meeting(x, y) for p in permutations(a) for q in permutations(b) for x, y in ((p, q), (q, p))}
            assert len(answers) == 1


@settings(max_examples=150, deadline=None)
@given(st.lists(st.integers(-(2**31), 2**31), min_size=12, max_size=12), st.integers(-3, 3), st.integers(-3, 3), st.floats(0, 1))
def test_sides_are_exact_on_a_grid_of_two_to_the_32_steps_however_close_to_the_plane(numbers, i, j, w):
    a, b, c, d = np.array(numbers, float).reshape(4, 3)
    near = np.round(a + w * (b - a) + (1 - w) * (c - a)) + [i, j, 0]
    for p in (d, near):
        assert side_of_plane(tuple(a), tuple(b), tuple(c), tuple(p)) == exact_side_of_plane(*exact((a, b, c, p)))
        (ax, ay, _), (bx, by, _), (px, py, _) = exact((a, b, p))
        turn = sign((bx - ax) * (py - ay) - (by - ay) * (px - ax))
        assert side_of_line(a[0], a[1], b[0], b[1], p[0], p[1]) == turn


def test_one_cube_meets_itself_nowhere_two_far_ones_neither():
    assert len(self_intersections(cube()).pairs) == 0
    assert len(self_intersections(join([cube(), cube(2.0, (5.0, 0, 0))])).pairs) == 0


def test_two_cubes_that_interpenetrate_cross_and_cubes_face_to_face_overlap():
    crossed = self_intersections(join([cube(), cube(2.0, (0.7, 0.6, 0.5))]))
    assert len(crossed.of_kind(CROSSING)) > 0 and len(crossed.of_kind(OVERLAP)) == 0
    stacked = self_intersections(join([cube(), cube(2.0, (2.0, 0.3, 0.4))]))
    assert len(stacked.of_kind(OVERLAP)) == 4 and len(stacked.of_kind(CROSSING)) == 0
    assert set(self_intersections(join([cube(), cube(2.0, (2.0, 2.0, 2.0))])).kind) <= {TOUCHING}


def test_a_face_laid_twice_overlaps_itself_and_a_flap_folded_flat_overlaps_its_neighbour():
    corners = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0.5, 0.5, 0], [2, 2, 0]], float)
    assert self_intersections(Surface(corners, [[0, 1, 2], [2, 0, 1]])).kind.tolist() == [OVERLAP]
    assert self_intersections(Surface(corners, [[0, 1, 2], [1, 0, 3]])).kind.tolist() == [OVERLAP]
    assert len(self_intersections(Surface(corners, [[0, 1, 2], [2, 1, 4]])).pairs) == 0


def test_unwelded_corners_count_as_shared_by_their_coordinates():
    whole = cube()
    soup = Surface(whole.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3))
    assert len(self_intersections(soup).pairs) == 0


def test_every_pair_of_a_soup_is_found_whatever_the_threads():
    random = np.random.default_rng(5)
    soup = (random.normal(size=(120, 1, 3)) + 0.6 * random.normal(size=(120, 3, 3))).astype(np.float32).astype(float)
    expected = [
        (i, j)
        for i in range(120)
        for j in range(i + 1, 120)
        if meeting(tuple(map(tuple, soup[i])), tuple(map(tuple, soup[j]))) != APART
    ]
    for count in (1, 3):
        with kernels.threads(count):
            found = self_intersections(Surface(soup.reshape(-1, 3), np.arange(360).reshape(-1, 3)))
        assert [tuple(p) for p in found.pairs.tolist()] == expected


def soup(n=900, seed=3):
    """Triangles of several sizes anywhere on a grid of whole numbers, a quarter in one plane, so that many touch and overlap."""
    random = np.random.default_rng(seed)
    corners = random.uniform(-30, 30, (n, 1, 3)) + random.normal(0, random.choice([1.0, 2.0, 6.0], (n, 1, 1)), (n, 3, 3))
    corners[: n // 4, :, 2] = 0.0
    return Surface(np.round(corners).reshape(-1, 3), np.arange(3 * n).reshape(-1, 3))


def test_faces_that_have_a_point_in_common_come_together_in_some_block():
    scattered = soup()
    blocks = list(blocks_of(scattered.vertices, scattered.faces, 60))
    assert len(blocks) > 6 and max(map(len, blocks)) < len(scattered.faces)
    together = {pair for block in blocks for pair in combinations(sorted(block.tolist()), 2)}
    corners = scattered.triangles
    low, high = corners.min(axis=1), corners.max(axis=1)
    near = {(i, j) for i, j in combinations(range(len(low)), 2) if (low[i] <= high[j]).all() and (low[j] <= high[i]).all()}
    assert len(near) > 1000 and near <= together


def test_block_by_block_the_same_faces_meet(monkeypatch):
    far = Surface(soup().vertices + (1e4, 0.25, 0.0), soup().faces)
    whole = self_intersections(far)
    monkeypatch.setattr("rangecheck.surface.intersections.FACES_OF_BLOCK", 50)
    parted = self_intersections(far)
    assert len(whole.pairs) > 100 and {CROSSING, TOUCHING, OVERLAP} <= set(whole.kind.tolist())
    assert np.array_equal(whole.pairs, parted.pairs) and np.array_equal(whole.kind, parted.kind)


def test_a_fan_that_no_plane_parts_is_one_block():
    turn = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    rim = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(200)])
    fan = Surface(
        np.vstack([np.zeros((1, 3)), rim, -rim]), np.column_stack([np.arange(1, 201), np.arange(201, 401), np.zeros(200, int)])
    )
    assert [len(block) for block in blocks_of(fan.vertices, fan.faces, 10)] == [200]


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_faces_cannot_meet(count):
    assert len(self_intersections(Surface(np.eye(3), np.arange(3 * count).reshape(-1, 3))).pairs) == 0
