"""Reliefs closed: volumes in closed form, measured faces that do not move, rims and gaps as bad as scans have them."""

import numpy as np
import pytest
from test_topology import grid

from rangecheck.errors import SurfaceError
from rangecheck.solid import check_solid
from rangecheck.solid.relief import close_relief
from rangecheck.surface import INVENTED, MEASURED, Surface
from rangecheck.surface.patches import neighbours_of, refined, smooth_values, turn_diagonals


def height_field(n, m, step_mm, height):
    """A grid of n x m cells seen from +z, with z = height(x, y)."""
    flat = grid(n, m)
    x, y = flat.vertices[:, 0] * step_mm, flat.vertices[:, 1] * step_mm
    return Surface(np.stack([x, y, height(x, y)], axis=1), flat.faces)


def without(surface, hole):
    x, y, _ = surface.triangles.mean(axis=1).T
    return surface.with_faces(~hole(x, y))


def has_all_measured(solid, surface):
    """Whether each triangle of `surface` is there, bit for bit, and measured."""
    rows = {tuple(t) for t in surface.triangles.reshape(-1, 9).tolist()}
    mine = solid.surface.triangles[solid.surface.origin_of_face == MEASURED].reshape(-1, 9).tolist()
    turned = ([t[3:] + t[:3] for t in mine], [t[6:] + t[:6] for t in mine], mine)
    return rows == {tuple(t) for ring in turned for t in ring} & rows and len(mine) == len(rows)


def test_a_flat_sheet_seen_in_parallel_becomes_a_slab_of_its_area_times_the_depth():
    slab = close_relief(height_field(8, 5, 2.0, lambda x, y: 0 * x), back_mm=3.0)
    assert slab.volume_mm3 == pytest.approx(16 * 10 * 3.0, rel=1e-12)
    assert has_all_measured(slab, height_field(8, 5, 2.0, lambda x, y: 0 * x))


def test_seen_from_an_eye_the_skirt_opens_along_the_rays_and_then_runs_straight():
    sheet = height_field(10, 10, 1.0, lambda x, y: 0 * x)
    solid = close_relief(sheet, back_mm=2.0, eye_mm=(5.0, 5.0, 50.0))
    # a frustum over the first tenth of the depth, then a prism of its far end
    first, wide = 0.2, (50.2 / 50.0) * 10
    expected = first * (100 + wide * 10 + wide**2) / 3 + 1.8 * wide**2
    assert solid.volume_mm3 == pytest.approx(expected, rel=1e-9)


def test_holes_are_filled_smoothly_with_faces_marked_invented():
    radius = 200.0
    bowl = height_field(40, 40, 1.0, lambda x, y: np.sqrt(radius**2 - (x - 20) ** 2 - (y - 20) ** 2) - radius)
    holed = without(bowl, lambda x, y: (x - 18) ** 2 + (y - 22) ** 2 < 49)
    solid = close_relief(holed, back_mm=5.0)
    assert has_all_measured(solid, holed)
    filled = solid.surface.part_of_face == solid.surface.part_names.index("filled")
    assert filled.sum() > 100 and (solid.surface.origin_of_face[filled] == INVENTED).all()
    inside = solid.surface.vertices[np.unique(solid.surface.faces[filled])] - [20, 20, -radius]
    # a plate over a cap of curvature 1/200 and width 14 departs from the sphere by less than the cap's own sagitta / 10
    assert np.abs(np.linalg.norm(inside, axis=1) - radius).max() < 0.1 * 7**2 / (2 * radius)


def test_gaps_are_bridged_islands_dropped_and_measured_faces_stay(seed=7):
    random = np.random.default_rng(seed)
    rough = height_field(60, 60, 0.5, lambda x, y: 0.1 * random.normal(size=x.shape) + np.where(y > 15, 8.0, 0.0))
    cut = without(
        rough, lambda x, y: (np.abs(y - 14.75) < 0.6) | ((x < 4) & (y < 4) & ((np.abs(x - 3.4) < 0.4) | (np.abs(y - 3.4) < 0.4)))
    )
    ragged = cut.with_faces(random.random(len(cut.faces)) > 0.05)
    solid = close_relief(ragged, back_mm=4.0)
    assert any("islands" in note for note in solid.notes)
    kept = solid.surface.origin_of_face == MEASURED
    rows = {tuple(t) for t in ragged.triangles.reshape(-1, 9).tolist()}
    mine = solid.surface.triangles[kept]
    assert all(any(tuple(np.roll(t, k, axis=0).ravel()) in rows for k in range(3)) for t in mine)
    assert kept.sum() > 0.95 * len(ragged.faces)
    # both terraces are there
    assert {0, 8} <= set(np.round(mine[:, :, 2].mean(axis=1)).astype(int).tolist())


def test_what_is_hidden_or_turned_away_is_left_out_and_too_much_of_it_refused():
    sheet = height_field(30, 30, 1.0, lambda x, y: 0 * x)
    flap = height_field(3, 3, 1.0, lambda x, y: 0 * x - 5.0)
    both = Surface(
        np.concatenate([sheet.vertices, flap.vertices + [10, 10, 0]]),
        np.concatenate([sheet.faces, flap.faces + len(sheet.vertices)]),
    )
    solid = close_relief(both, back_mm=2.0)
    assert "hidden" in solid.notes[0] and solid.volume_mm3 == pytest.approx(30 * 30 * 2.0)
    with pytest.raises(SurfaceError, match="no face of the surface faces the eye"):
        close_relief(sheet, back_mm=2.0, eye_mm=(15, 15, -100.0))
    with pytest.raises(SurfaceError, match="lies behind the eye"):
        close_relief(height_field(30, 30, 1.0, lambda x, y: x), back_mm=2.0, eye_mm=(0, 0, 1.0))


def test_a_closed_body_is_no_relief():
    from test_topology_distance import cube

    with pytest.raises(SurfaceError, match="faces all ways"):
        close_relief(cube(), back_mm=1.0)


def test_nothing_and_no_depth_are_refused():
    with pytest.raises(SurfaceError, match="no faces"):
        close_relief(Surface(np.zeros((0, 3)), np.empty((0, 3), np.int32)), back_mm=1.0)
    with pytest.raises(SurfaceError, match="back_mm is 0"):
        close_relief(height_field(2, 2, 1.0, lambda x, y: 0 * x), back_mm=0.0)


def test_after_turning_no_two_opposite_angles_exceed_180_degrees():
    random = np.random.default_rng(3)
    ring = np.sort(random.uniform(0, 2 * np.pi, 80))
    points = np.stack([np.cos(ring), 0.6 * np.sin(ring)], axis=1)
    faces = np.array([[0, i, i + 1] for i in range(1, 79)], np.int32)
    across = neighbours_of(faces, 80)
    assert turn_diagonals(points, faces, across, np.zeros(len(faces), bool)) > 10
    assert np.array_equal(across, neighbours_of(faces, 80))
    corners = points[faces]
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    assert (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] > 0).all()
    for f in range(len(faces)):
        for s in range(3):
            if across[f, s] >= 0:
                angle = 0.0
                for h in (3 * f + s, across[f, s]):
                    a, b, c = (points[faces[h // 3, (h % 3 + k) % 3]] for k in range(3))
                    angle += np.arccos(np.dot(a - c, b - c) / np.linalg.norm(a - c) / np.linalg.norm(b - c))
                assert angle <= np.pi + 1e-8


def test_a_refined_patch_keeps_its_rim_and_has_edges_of_its_rims_length():
    turn = np.arange(60) * 2 * np.pi / 60
    points, faces = refined(
        np.stack([np.cos(turn), np.sin(turn)], axis=1), np.array([[0, i, i + 1] for i in range(1, 59)], np.int32)
    )
    assert (neighbours_of(faces, len(points)) < 0).sum() == 60
    length = np.linalg.norm(points[faces] - points[np.roll(faces, 1, axis=1)], axis=2)
    assert np.median(length) == pytest.approx(2 * np.pi / 60, rel=0.5)
    area = 0.5 * np.sin(2 * np.pi / 60) * 60
    a, b, c = (points[faces[:, k]] for k in range(3))
    assert 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum() == pytest.approx(area, rel=1e-12)


def test_a_plate_over_a_plane_and_a_membrane_over_a_plane_are_that_plane():
    sheet = height_field(12, 12, 1.0, lambda x, y: 0.3 * x - 0.2 * y)
    inner = (np.abs(sheet.vertices[:, :2] - 6) < 3).all(axis=1)
    spoiled = sheet.vertices[:, 2:] * 1.0
    spoiled[inner] = 99.0
    smooth = smooth_values(sheet.vertices[:, :2], spoiled, inner, sheet.faces)
    assert np.abs(smooth - sheet.vertices[:, 2:]).max() < 1e-9


@pytest.mark.real_data
def test_a_real_scan_with_holes_is_closed_as_seen_from_its_front(real_data):
    from rangecheck.surface.mesh_files import read_mesh

    bunny = read_mesh(real_data / "stanford_bunny" / "bun_zipper.ply", "m")
    front = bunny.with_faces((bunny.face_normals[:, 2] > 0.3) & (bunny.triangles[:, :, 2].mean(axis=1) > 10.0))
    solid = close_relief(front, back_mm=5.0, eye_mm=(-15.0, 100.0, 600.0))
    assert check_solid(solid.surface).fit
