"""Hollow solids, simplified solids and deviations: volumes, walls and errors against closed forms."""

import numpy as np
import pytest
from test_check_printing import turned
from test_solid_repair import ball
from test_topology import torus
from test_topology_distance import cube

from rangecheck.errors import SettingError, SurfaceError
from rangecheck.solid import Solid, check_solid
from rangecheck.solid.deviation import band_colours, both_ways, deviation, vertex_deviation_mm
from rangecheck.solid.hollow import hollow
from rangecheck.solid.offset import inner_offset
from rangecheck.solid.printer import printer
from rangecheck.solid.ridges import with_ridges
from rangecheck.solid.room import proved_without_room
from rangecheck.solid.simplify import printable_error_mm, simplify
from rangecheck.solid.thickness import sample_surface, wall_thickness_mm
from rangecheck.surface import INVENTED, MEASURED, Surface
from rangecheck.surface import topology as topo
from rangecheck.surface.distance import SurfaceDistance

Z = (0.0, 0.0, 1.0)
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
turned_cube = Surface(cube(20.0).vertices @ TURN.T, cube(20.0).faces)


@pytest.mark.parametrize("step", [0.7, 1.0])
def test_the_offset_of_a_ball_is_a_ball_and_that_of_a_cube_a_cube(step):
    inner = inner_offset(ball(96, 12.0), 3.0, step)
    assert check_solid(inner).fit
    radius = np.linalg.norm(inner.vertices, axis=1)
    # the facets of the ball lie up to their sagitta inside it; interpolation over a step adds step^2 / 8 r
    assert radius.max() <= 9.0 + step**2 / (8 * 9) and radius.min() >= 9.0 - 12 * (1 - np.cos(np.pi / 48)) - step**2 / 8
    box = inner_offset(cube(10.0), 2.0, step)
    assert box.volume_mm3 == pytest.approx(6.0**3, rel=6 * step**2 / 36) and np.abs(box.vertices).max() <= 3.0 + 1e-9


def test_a_torus_keeps_its_hole_inside_and_what_is_too_thin_has_no_inside():
    inner = inner_offset(torus(120, 80), 0.4, 0.15)
    assert check_solid(inner).facts["genus"] == 1
    assert inner.volume_mm3 == pytest.approx(2 * np.pi**2 * 3 * 0.6**2, rel=0.02)
    assert inner_offset(torus(40, 30), 1.1, 0.2) is None
    with pytest.raises(SurfaceError, match="choose a larger one"):
        inner_offset(cube(), 0.1, 1e-5)


def test_a_hollow_ball_has_its_wall_its_drain_and_is_proved_to_empty():
    solid = Solid.from_surface(ball(96, 15.0))
    made = hollow(solid, wall_mm=2.0, up=Z, drain_mm=4.0)
    assert made.kept == () and len(made.drains) == 1
    assert made.wall.share_within == pytest.approx(1.0) and abs(made.wall.median_mm - 2.0) < 0.05
    cavity = 4 / 3 * np.pi * 13**3
    assert made.cavity_mm3 == pytest.approx(cavity, rel=0.02)
    drain = np.pi * 4.0 * 2.0
    assert made.solid.volume_mm3 == pytest.approx(solid.volume_mm3 - made.cavity_mm3 - drain, abs=0.3 * drain)
    assert made.drains[0].outside_mm[2] < -14 and topo.shells(made.solid.surface)[0] == 1
    # the plug fills the drain but for its clearance
    (plug,) = made.plugs
    assert plug.volume_mm3 == pytest.approx(np.pi * 1.9**2 * 2.0, rel=0.1)


def test_without_drains_the_pocket_is_named_with_its_volume():
    made = hollow(Solid.from_surface(cube(20.0)), wall_mm=3.0, up=Z, drain_mm=0.0)
    assert made.drains == () and len(made.kept) == 1 and made.kept[0].closed
    # a drain would go through the middle of the floor, not through a wall beside it
    assert np.abs(made.kept[0].lowest_mm[:2]).max() < 2
    assert made.kept[0].volume_mm3 == pytest.approx(14.0**3, rel=0.02) and "1 pockets keep" in made.notes[1]


def test_the_wall_seen_from_outside_is_judged_where_the_shape_leaves_room_for_a_cavity():
    wall = hollow(Solid.from_surface(cube(20.0)), wall_mm=3.0, up=Z, drain_mm=0.0, step_mm=0.5).wall
    # on each side of the cube the cavity, a cube of 14 mm, is within 3.15 mm of a square of 14 mm widened by a rim
    rim = np.sqrt(3.15**2 - 3.0**2)
    room = (14**2 + 4 * 14 * rim + np.pi * rim**2) / 20**2
    assert wall.outer_within > 0.99 and wall.full_share == pytest.approx(1 - room, abs=0.03)
    assert wall.full[0][3] == pytest.approx(3 * np.sqrt(3), rel=0.15) and np.abs(wall.full[0][:3]).min() > 8


def test_where_a_cube_leaves_no_room_is_proved_to_a_hundredth_of_a_millimetre():
    # on a side of 20 mm the deep places are a square of 14 mm, 3 mm below: within 3.15 mm of it lies what is within a rim around it
    rim = np.sqrt(3.15**2 - 3.0**2)
    flat = np.random.default_rng(5).uniform(-10, 10, (600, 2))
    beyond = np.hypot(*np.maximum(np.abs(flat) - 7, 0).T) - rim
    proved = proved_without_room(SurfaceDistance(turned_cube), np.column_stack([flat, np.full(600, 10.0)]) @ TURN.T, 3.0, 3.15)
    assert not proved[beyond <= 0].any() and proved[beyond > 0.01].all()


@pytest.mark.parametrize(("thick", "limited"), [(5.9, True), (6.05, False), (6.2, False), (7.0, False)])
def test_a_plate_thinner_than_two_walls_has_no_room_and_a_thicker_one_has(thick, limited):
    plate = SurfaceDistance(Surface(cube(1.0).vertices * [40, 40, thick], cube(1.0).faces))
    places = np.column_stack([np.random.default_rng(6).uniform(-10, 10, (50, 2)), np.full(50, thick / 2)])
    assert (proved_without_room(plate, places, 3.0, 3.15) == limited).all()


def test_ridges_are_drawn_out_to_where_the_sides_at_depth_meet():
    outside = SurfaceDistance(turned_cube)
    cut = inner_offset(turned_cube, 3.0, 0.9)
    whole = with_ridges(cut, outside, 3.0, 0.9)
    assert check_solid(whole).fit
    assert 14**3 - cut.volume_mm3 > 20 and 0 <= 14**3 - whole.volume_mm3 < 1
    assert np.abs(whole.vertices @ TURN).max() <= 7 + 1e-9 and len(whole.faces) < 2 * len(cut.faces)


def test_the_wall_of_a_ridged_body_is_as_asked_over_99_percent_seen_from_either_side():
    # a star of three bars: ridges, grooves and corners, none along the grid
    import manifold3d

    star = manifold3d.Manifold.batch_boolean(
        [manifold3d.Manifold.cube((30, 9, 9), True).rotate((20, 10 + 70 * k, 35 * k)) for k in range(3)], manifold3d.OpType.Add
    )
    mesh = star.to_mesh64()
    body = Surface(mesh.vert_properties[:, :3], mesh.tri_verts.astype(int))
    wall = hollow(body, wall_mm=2.0, up=Z, drain_mm=0.0).wall
    assert wall.share_within > 0.99 and wall.outer_within > 0.99 and wall.least_mm > 2 - 0.15
    assert 0.2 < wall.full_share < 0.6 and wall.full


def test_a_sharp_edge_is_thin_only_as_an_edge_and_a_blade_is_thin_all_over():
    # a blade 10 mm long that rises from nothing to 1 mm
    corners = [[0, 0, 0], [10, 0, -0.5], [10, 0, 0.5], [0, 8, 0], [10, 8, -0.5], [10, 8, 0.5]]
    faces = [[0, 1, 2], [3, 5, 4], [0, 3, 4], [0, 4, 1], [0, 2, 5], [0, 5, 3], [1, 4, 5], [1, 5, 2]]
    blade = Surface(corners, faces)
    samples = sample_surface(blade, 0.1)
    assert wall_thickness_mm(blade, samples).min() < 0.01
    thick = wall_thickness_mm(blade, samples, edge_mm=0.5)
    assert 0.04 < thick.min() < 0.06 and (thick < 0.5).mean() > 0.3


def test_the_tip_of_a_spike_is_no_wall_though_its_sides_share_no_corner():
    # a cone of 12 facets, 0.4 mm thin near its tip, whose sides are cut into rings, and a plate on a stalk that is as thin all over
    spike = turned([(0, 0), (5, 0), *((0.2 * r, 20 - r) for r in (0.8, 0.6, 0.4, 0.2)), (0, 20)], 12)
    samples = sample_surface(spike, 0.05)
    assert wall_thickness_mm(spike, samples).min() < 0.1
    assert wall_thickness_mm(spike, samples, edge_mm=0.5).min() > 0.15
    plate = turned([(0, 0), (5, 0), (5, 0.1), (0, 0.1)], 48)
    samples = sample_surface(plate, 0.2)
    thin = wall_thickness_mm(plate, samples, edge_mm=0.5) < 0.11
    # all but a rim of half a millimetre
    assert samples.area_mm2[thin].sum() == pytest.approx(2 * np.pi * 4.5**2, rel=0.02)


def test_two_chambers_get_two_drains():
    # a dumb-bell: two boxes joined by a bar that is thinner than two walls
    import manifold3d

    bell = (
        manifold3d.Manifold.cube((16, 16, 16))
        + manifold3d.Manifold.cube((20, 3, 3)).translate((10, 6, 6))
        + manifold3d.Manifold.cube((16, 16, 16)).translate((24, 0, 0))
    )
    mesh = bell.to_mesh64()
    made = hollow(Solid.from_surface(Surface(mesh.vert_properties[:, :3], mesh.tri_verts.astype(int))), wall_mm=2.0, up=Z)
    assert len(made.drains) == 2 and made.kept == () and len(made.plugs) == 2


def test_labels_survive_hollowing():
    outer = ball(48, 12.0)
    origin = np.where(outer.triangles.mean(axis=1)[:, 2] > 0, MEASURED, INVENTED).astype(np.uint8)
    made = hollow(
        Solid.from_surface(Surface(outer.vertices, outer.faces, origin_of_face=origin)), wall_mm=2.0, up=Z
    ).solid.surface
    assert set(made.part_names) == {"surface", "cavity", "drain"}
    cavity = made.part_of_face == made.part_names.index("cavity")
    assert (made.origin_of_face[cavity] == INVENTED).all()
    assert made.face_areas[made.origin_of_face == MEASURED].sum() == pytest.approx(outer.area_mm2 / 2, rel=0.03)


def test_a_wall_that_leaves_no_room_is_refused():
    with pytest.raises(SurfaceError, match="nothing lies 5 mm deep"):
        hollow(Solid.from_surface(cube(8.0)), wall_mm=5.0)
    with pytest.raises(SettingError, match="lengths are needed"):
        hollow(Solid.from_surface(cube(8.0)), wall_mm=-1.0)


@pytest.mark.parametrize("error", [0.02, 0.1])
def test_simplification_keeps_its_promise_both_ways_and_keeps_labels_apart(error):
    outer = ball(96, 20.0)
    origin = np.where(outer.triangles.mean(axis=1)[:, 0] > 0, MEASURED, INVENTED).astype(np.uint8)
    solid = Solid.from_surface(Surface(outer.vertices, outer.faces, origin_of_face=origin))
    less = simplify(solid, error_mm=error)
    assert less.error_mm <= error and less.faces_after < less.faces_before * 0.9
    there, back = both_ways(solid.surface, less.solid.surface, spacing_mm=1.0)
    assert max(np.abs(there.distance_mm).max(), np.abs(back.distance_mm).max()) <= error * 1.5
    half = less.solid.surface.face_areas[less.solid.surface.origin_of_face == MEASURED].sum()
    assert half == pytest.approx(outer.area_mm2 / 2, rel=0.01)


def test_a_cube_needs_twelve_faces_and_the_printers_error_is_less_than_it_can_show():
    inner = inner_offset(cube(10.0), 2.0, 0.5)
    few = simplify(Solid.from_surface(inner), error_mm=0.3)
    assert few.faces_after < few.faces_before / 10
    assert printable_error_mm(printer("prusa-sl1s")) == pytest.approx(0.0125)
    with pytest.raises(SettingError, match="a positive length"):
        simplify(Solid.from_surface(cube()), error_mm=0.0)


def test_deviation_of_concentric_balls_is_the_difference_of_their_radii_with_its_sign():
    small, large = ball(96, 10.0), ball(96, 10.5)
    inwards, outwards = both_ways(small, large, spacing_mm=0.7)
    sagitta = 10.5 * (1 - np.cos(np.pi / 96) ** 2)
    for d, sign in ((inwards, -1), (outwards, 1)):
        numbers = d.statistics(0.4)["all"]
        assert numbers["mean_mm"] == pytest.approx(sign * 0.5, abs=sagitta) and numbers["share_within"] == 0.0
        assert numbers["rms_mm"] == pytest.approx(0.5, abs=sagitta)
    assert outwards.histogram(np.array([0.0, 0.45, 0.55])).tolist() == pytest.approx([0, 0, 1, 0])
    assert vertex_deviation_mm(large, small) == pytest.approx(0.5, abs=sagitta)


def test_deviation_is_split_by_origin():
    sheet = cube(10.0)
    origin = np.where(sheet.face_normals[:, 2] > 0.5, INVENTED, MEASURED).astype(np.uint8)
    raised = Surface(sheet.vertices * [1, 1, 1.2], sheet.faces, origin_of_face=origin)
    numbers = deviation(raised, sheet, spacing_mm=1.0).statistics(0.1)
    assert numbers["invented"]["mean_mm"] == pytest.approx(1.0) and numbers["invented"]["share_within"] == 0
    assert numbers["measured"]["area_mm2"] + numbers["invented"]["area_mm2"] == pytest.approx(raised.area_mm2)


def test_bands_are_white_within_and_red_or_blue_beyond():
    colours = band_colours(np.array([0.0, 1.0, -1.0, 5.0]), 1.0)
    assert colours[0].tolist() == [1, 1, 1] and colours[1, 0] > colours[1, 2] and colours[2, 2] > colours[2, 0]
    assert np.array_equal(colours[1], colours[3]) and ((colours >= 0) & (colours <= 1)).all()
