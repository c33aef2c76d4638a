"""Repair on a leash: planted damage comes back to the solid it was, what cannot be mended is left and said."""

import numpy as np
import pytest
from test_topology import grid, torus
from test_topology_distance import CUBE_CORNERS, CUBE_FACES, cube

from rangecheck.errors import SettingError
from rangecheck.solid import Solid, check_solid, repair
from rangecheck.solid.holes import fill_holes, least_area_triangles
from rangecheck.solid.sheets import part_sheets, turn_faces
from rangecheck.surface import INVENTED, Surface
from rangecheck.surface import topology as topo
from rangecheck.surface.mesh_files import read_mesh
from rangecheck.surface.surface import join


def ball(n=48, radius=10.0):
    """A sphere of n x n/2 cells with poles, vertices on it."""
    u, v = np.arange(n) * 2 * np.pi / n, np.linspace(0, np.pi, n // 2 + 1)[1:-1]
    rings = np.stack(
        [np.outer(np.sin(v), np.cos(u)), np.outer(np.sin(v), np.sin(u)), np.outer(np.cos(v), np.ones(n))], -1
    ).reshape(-1, 3)
    m = len(v)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(m - 1), np.arange(n), indexing="ij"))
    a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + (j + 1) % n, i * n + (j + 1) % n
    k = np.arange(n)
    top = np.stack([np.full(n, m * n), k, (k + 1) % n], 1)
    low = np.stack([np.full(n, m * n + 1), (m - 1) * n + (k + 1) % n, (m - 1) * n + k], 1)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1), top, low])
    return Surface(radius * np.concatenate([rings, [[0, 0, 1], [0, 0, -1]]]), faces)


BALL = ball()


def test_the_ball_itself_needs_nothing():
    same = repair(BALL)
    assert same.surface is BALL and same.steps == () and same.after.fit


def test_a_hole_in_a_ball_is_filled_along_the_ball():
    direction = np.array([0.6, 0.0, 0.8])
    middle = BALL.triangles.mean(axis=1) / 10
    holed = BALL.with_faces(middle @ direction < np.cos(0.45))
    mended = repair(holed)
    assert mended.after.fit and mended.moved_mm == 0.0 and mended.vanished == 0.0
    solid = Solid.from_surface(mended.surface)
    filled = solid.surface.origin_of_face == INVENTED
    radius = np.linalg.norm(solid.surface.vertices[np.unique(solid.surface.faces[filled])], axis=1)
    sagitta = 10 * (1 - np.cos(0.45))
    # a flat patch would be off by the sagitta; the plate follows the ball to a sixth of it
    assert np.abs(radius - 10).max() < sagitta / 6
    assert solid.volume_mm3 == pytest.approx(BALL.volume_mm3, rel=0.005)


def test_a_sawn_off_ball_is_closed_flat():
    cut = BALL.with_faces(BALL.triangles[:, :, 2].min(axis=1) > -1e-9)
    mended = repair(cut)
    filled = mended.surface.origin_of_face == INVENTED
    assert mended.after.fit and np.abs(mended.surface.vertices[mended.surface.faces[filled]][..., 2]).max() < 1e-9
    assert mended.after.facts["volume_mm3"] == pytest.approx(BALL.volume_mm3 / 2, rel=1e-9)


def test_holes_longer_than_allowed_stay_and_are_named():
    cut = BALL.with_faces(BALL.triangles[:, :, 2].min(axis=1) > -1e-9)
    left = repair(cut, longest_hole_mm=30.0)
    assert not left.after.fit and "longer than 30 mm" in left.refused[0]
    assert np.array_equal(left.surface.faces, cut.faces)


def test_a_sheet_is_not_closed_over_itself():
    flat = fill_holes(grid(6, 6))
    assert flat.filled == 0 and flat.surface.faces.shape == grid(6, 6).faces.shape and "run through" in flat.left[0]


def test_turned_faces_shells_and_cavities_are_set_right():
    random = np.random.default_rng(1)
    inner = cube(1.0)
    nested = join([BALL, Surface(inner.vertices, inner.faces[:, ::-1]), torus()])
    nested = Surface(nested.vertices + 0.0, nested.faces)
    apart = join([BALL, Surface(inner.vertices, inner.faces[:, ::-1])])
    faces = apart.faces.copy()
    flip = random.random(len(faces)) < 0.3
    faces[flip] = faces[flip][:, ::-1]
    turned = turn_faces(Surface(apart.vertices, faces))
    assert turned.surface.volume_mm3 == pytest.approx(BALL.volume_mm3 - 1.0)
    over = turn_faces(Surface(apart.vertices, apart.faces[:, ::-1]))
    assert over.shells == 2 and over.faces == 0 and over.surface.volume_mm3 == pytest.approx(BALL.volume_mm3 - 1.0)
    assert len(nested.faces) > len(apart.faces)


def test_a_moebius_strip_is_left_as_it_is():
    n = 20
    turn = np.arange(n) * 2 * np.pi / n
    edge = [
        np.stack([(3 + s * np.cos(turn / 2)) * np.cos(turn), (3 + s * np.cos(turn / 2)) * np.sin(turn), s * np.sin(turn / 2)], 1)
        for s in (1, -1)
    ]
    faces = []
    for i in range(n):
        a, b = i, i + n
        c, d = (i + 1 + n, i + 1) if i < n - 1 else (0, n)
        faces += [[a, b, c], [a, c, d]]
    strip = Surface(np.concatenate(edge), faces)
    assert np.array_equal(turn_faces(strip).surface.faces, strip.faces)


def test_cubes_that_share_an_edge_or_a_corner_are_parted_by_a_hair():
    for shift in ([1, 1, 0], [1, 1, 1]):
        both = np.concatenate([CUBE_CORNERS, CUBE_CORNERS + shift])
        corners, number = np.unique(both, axis=0, return_inverse=True)
        welded = Surface(corners, number[np.concatenate([CUBE_FACES, CUBE_FACES + 8])])
        parted = part_sheets(welded, max_move_mm=0.01)
        assert parted.doubled == 3 - sum(shift) + 1 and topo.shells(parted.surface)[0] == 2
        mended = repair(welded, max_move_mm=0.01)
        assert mended.after.fit and 0 < mended.moved_mm < 0.01
        assert mended.after.facts["volume_mm3"] == pytest.approx(2.0, rel=1e-4)
        assert not repair(welded, max_move_mm=0.0).after.fit


def test_seams_apart_by_less_than_the_leash_are_welded_and_wider_ones_are_not():
    soup = cube(10.0)
    corners = soup.vertices.copy()
    seam = np.concatenate([corners, corners[6:7] + [0.01, 0, 0]])
    faces = soup.faces.copy()
    at = np.argwhere(faces == 6)[:2]
    faces[tuple(at.T)] = 8
    split = Surface(seam, faces)
    assert not check_solid(split).fit
    mended = repair(split, max_move_mm=0.05)
    assert mended.after.fit and mended.moved_mm <= 0.005 + 1e-12 and any(s.name == "weld-rims" for s in mended.steps)


def test_crumbs_and_doubles_go_and_what_went_is_counted():
    crumb = cube(0.05, (30, 0, 0))
    spoiled = join([BALL, crumb])
    spoiled = Surface(spoiled.vertices, np.concatenate([spoiled.faces, spoiled.faces[:2], [[3, 3, 4]]]))
    mended = repair(spoiled)
    assert mended.after.fit and {s.name for s in mended.steps} >= {"drop-crumbs", "drop-doubles"}
    assert mended.vanished < 1e-4 + 2 / len(BALL.faces)
    assert ("shells", 3, 1) in mended.table()
    assert not any(s.name == "drop-crumbs" for s in repair(spoiled, max_vanished=0.0).steps)


def test_a_leash_must_be_a_length():
    with pytest.raises(SettingError, match="a length and a share are needed"):
        repair(cube(), max_move_mm=float("nan"))


def test_least_area_triangles_beat_every_other_triangulation():
    def areas(ring):
        n = len(ring)
        if n < 3:
            return [0.0]
        found = []
        for j in range(1, n - 1):
            own = 0.5 * np.linalg.norm(np.cross(ring[j] - ring[0], ring[-1] - ring[0]))
            found += [own + x + y for x in areas(ring[: j + 1]) for y in areas(ring[j:])]
        return found

    ring = np.random.default_rng(6).normal(size=(8, 3))
    faces = least_area_triangles(ring)
    a, b, c = (ring[faces[:, k]] for k in range(3))
    every = areas(ring)
    assert len(every) == 132
    assert 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() == pytest.approx(min(every))
    assert least_area_triangles(np.zeros((500, 3))) is None


@pytest.mark.real_data
@pytest.mark.parametrize(("name", "unit"), [("busts/Laurana50k.ply", "mm"), ("stanford_bunny/bun_zipper.ply", "m")])
def test_open_scans_become_solids_that_moved_no_farther_than_the_leash(real_data, name, unit):
    mended = repair(read_mesh(real_data / name, unit), max_move_mm=0.05)
    assert mended.after.fit and mended.moved_mm <= 0.05 and mended.vanished < 0.01
    assert Solid.from_surface(mended.surface).volume_mm3 > 0


@pytest.mark.real_data
def test_many_small_holes_are_mended_but_the_sheet_is_never_emptied(real_data):
    sheet = read_mesh(real_data / "dirty" / "meshlab" / "many_small_holes.ply", "mm")
    mended = repair(sheet)
    assert len(mended.surface.faces) >= len(sheet.faces) and mended.vanished < 1e-9
    assert len(topo.boundary_loops(mended.surface)) == 1 and mended.refused
