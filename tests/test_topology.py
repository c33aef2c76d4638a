"""Topology by its laws: Euler's number, loops that close, culprits that are named, whatever the order of faces."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_topology_distance import CUBE_CORNERS, CUBE_FACES, cube

from rangecheck.surface import Surface
from rangecheck.surface import topology as topo
from rangecheck.surface.edges import every_edge_passed_both_ways
from rangecheck.surface.surface import join


def torus(n=12, m=8, major=3.0, minor=1.0):
    u, v = np.meshgrid(np.arange(n) * 2 * np.pi / n, np.arange(m) * 2 * np.pi / m, indexing="ij")
    ring = major + minor * np.cos(v)
    corners = np.stack([ring * np.cos(u), ring * np.sin(u), minor * np.sin(v)], axis=-1).reshape(-1, 3)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    a, b, c, d = i * m + j, (i + 1) % n * m + j, (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m
    return Surface(corners, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def grid(n, m):
    u, v = np.meshgrid(np.arange(n + 1.0), np.arange(m + 1.0), indexing="ij")
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    a, b, c, d = i * (m + 1) + j, (i + 1) * (m + 1) + j, (i + 1) * (m + 1) + j + 1, i * (m + 1) + j + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return Surface(np.stack([u, v, 0 * u], axis=-1).reshape(-1, 3), faces)


CULPRITS = (
    topo.boundary_edges,
    topo.non_manifold_edges,
    topo.non_manifold_vertices,
    topo.inconsistent_edges,
    topo.duplicate_faces,
    topo.degenerate_faces,
    topo.unreferenced_vertices,
)


@pytest.mark.parametrize(("solid", "euler"), [(cube(), 2), (torus(), 0)])
def test_closed_solids_have_no_culprits_and_their_euler_number(solid, euler):
    assert [len(find(solid)) for find in CULPRITS] == [0] * len(CULPRITS)
    assert topo.is_closed(solid) and topo.boundary_loops(solid) == []
    assert topo.euler_numbers(solid).tolist() == [euler]


def test_two_shells_and_a_disc_each_have_their_own_euler_number():
    together = join([torus(), cube(1.0, (20, 0, 0)), grid(3, 3)])
    assert topo.shells(together)[0] == 3
    assert topo.euler_numbers(together).tolist() == [0, 2, 1]


def test_the_rim_of_a_grid_is_one_loop_in_the_direction_of_its_faces():
    sheet = grid(5, 3)
    (rim,) = topo.boundary_loops(sheet)
    assert len(rim) == len(topo.boundary_edges(sheet)) == 16
    assert topo.loop_lengths_mm(sheet, [rim]) == pytest.approx([16.0])
    x, y = sheet.vertices[rim, 0], sheet.vertices[rim, 1]
    assert 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() == pytest.approx(15.0)


def test_two_holes_that_touch_in_a_vertex_stay_two_loops():
    sheet = grid(6, 6)
    centre = sheet.triangles.mean(axis=1)
    hole = ((centre[:, :2] > 1) & (centre[:, :2] < 3)).all(1) | ((centre[:, :2] > 3) & (centre[:, :2] < 5)).all(1)
    holed = sheet.with_faces(~hole)
    assert [len(r) for r in topo.boundary_loops(holed)] == [24, 8, 8]
    assert len(topo.non_manifold_vertices(holed)) == 1
    assert topo.euler_numbers(holed).tolist() == [-1 + 1 - 1 + 1]


def test_one_turned_face_is_seen_at_its_three_edges():
    faces = CUBE_FACES.copy()
    faces[4] = faces[4, ::-1]
    turned = Surface(CUBE_CORNERS, faces)
    assert len(topo.inconsistent_edges(turned)) == 3
    assert not topo.is_closed(turned)


def test_cubes_that_share_an_edge_or_a_corner_are_not_manifold_there():
    at_edge = Surface(np.concatenate([CUBE_CORNERS, CUBE_CORNERS + [1, 1, 0]]), np.concatenate([CUBE_FACES, CUBE_FACES + 8]))
    _, where = np.unique(at_edge.vertices, axis=0, return_inverse=True)
    welded = Surface(np.unique(at_edge.vertices, axis=0), where[at_edge.faces])
    assert len(topo.non_manifold_edges(welded)) == 1 and topo.shells(welded)[0] == 1
    corners = np.concatenate([CUBE_CORNERS, CUBE_CORNERS + 1])
    _, where = np.unique(corners, axis=0, return_inverse=True)
    at_corner = Surface(np.unique(corners, axis=0), where[np.concatenate([CUBE_FACES, CUBE_FACES + 8])])
    assert len(topo.non_manifold_vertices(at_corner)) == 1 and topo.shells(at_corner)[0] == 2
    assert topo.euler_numbers(at_corner).tolist() == [2, 2]


def test_doubled_flat_and_idle_things_are_named():
    corners = np.concatenate([CUBE_CORNERS, [[9, 9, 9], [0.5, 0, 0]]])
    spoiled = Surface(corners, np.concatenate([CUBE_FACES, [[1, 2, 0], [3, 3, 4], [0, 9, 1]]]))
    assert topo.duplicate_faces(spoiled).tolist() == [12]
    assert topo.degenerate_faces(spoiled).tolist() == [13, 14]
    assert topo.unreferenced_vertices(spoiled).tolist() == [8]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 60))
def test_any_heap_of_faces_has_culprits_that_do_not_depend_on_the_order_of_faces(seed, count):
    random = np.random.default_rng(seed)
    heap = Surface(random.normal(size=(12, 3)), random.integers(0, 12, (count, 3)))
    order = random.permutation(count)
    mixed = Surface(heap.vertices, heap.faces[order])
    for find in CULPRITS[:4]:
        assert np.array_equal(np.sort(find(heap), axis=0), np.sort(find(mixed), axis=0))
    assert topo.shells(heap)[0] == topo.shells(mixed)[0]
    kept = np.flatnonzero([len(set(f)) == 3 for f in heap.faces.tolist()])
    ends = np.sort(heap.faces[kept][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, uses = np.unique(ends, axis=0, return_counts=True)
    assert np.array_equal(topo.edge_table(heap).ends, edges) and np.array_equal(topo.edge_table(heap).uses, uses)
    assert sum(len(r) for r in topo.boundary_loops(heap)) == (uses == 1).sum()


def test_no_faces_at_all():
    nothing = Surface(np.zeros((2, 3)), np.empty((0, 3), np.int32))
    assert [len(find(nothing)) for find in CULPRITS] == [0, 0, 0, 0, 0, 0, 2]
    assert topo.shells(nothing)[0] == 0 and len(topo.euler_numbers(nothing)) == 0 and not topo.is_closed(nothing)


def test_edges_are_passed_both_ways_wherever_a_surface_has_no_rim_and_no_turned_face():
    faces = np.asarray(CUBE_FACES, np.int32)
    assert every_edge_passed_both_ways(faces, 8)
    assert every_edge_passed_both_ways(np.concatenate([faces, faces, [[3, 3, 5], [2, 2, 2]]]).astype(np.int32), 8)
    assert not every_edge_passed_both_ways(faces[:-1], 8)
    turned = faces.copy()
    turned[4] = turned[4, ::-1]
    assert not every_edge_passed_both_ways(turned, 8)


def test_noise_adds_wrinkles_to_an_area_and_little_to_it_without_them():
    x, y = np.meshgrid(np.arange(40.0), np.arange(40.0))
    cell = np.arange(39 * 40).reshape(39, 40)[:, :39].ravel()
    faces = np.concatenate([np.stack([cell, cell + 1, cell + 41], 1), np.stack([cell, cell + 41, cell + 40], 1)]).astype(np.int32)
    rough = np.random.default_rng(4).normal(0.0, 0.5, x.shape)
    flat, noisy = (Surface(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces) for z in (np.zeros_like(x), rough))
    true = 39.0 * 39.0
    assert flat.areas_without_wrinkles().sum() == pytest.approx(true)
    assert noisy.area_mm2 > 1.2 * true
    assert noisy.areas_without_wrinkles().sum() - true < 0.35 * (noisy.area_mm2 - true)
