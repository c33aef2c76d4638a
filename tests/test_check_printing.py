"""What a printer will make of known solids: every number against its closed form."""

import numpy as np
import pytest
from test_topology import torus
from test_topology_distance import CUBE_CORNERS, CUBE_FACES, cube

from rangecheck.errors import InputError, SettingError, SurfaceError
from rangecheck.solid import Solid
from rangecheck.solid.drainage import pockets
from rangecheck.solid.printer import Printer, printer, printer_names
from rangecheck.solid.printing import centre_of_mass, check_printing, convex_hull, round_above, smallest_footprint
from rangecheck.solid.slices import cells_of, section_areas_mm2
from rangecheck.solid.thickness import gap_mm, sample_surface, wall_thickness_mm
from rangecheck.surface import Surface
from rangecheck.surface.surface import join

Z = (0.0, 0.0, 1.0)
SIDES = 96


def turned(rings, sides=SIDES):
    """A solid of revolution about z from a closed outline of (radius, z), radius 0 allowed at its ends; faces outward for outlines that
    run counter-clockwise in (radius, z)."""
    outline = np.asarray(rings, float)
    turn = np.arange(sides) * 2 * np.pi / sides
    vertices = np.stack(
        [np.outer(np.cos(turn), outline[:, 0]), np.outer(np.sin(turn), outline[:, 0]), np.tile(outline[:, 1], (sides, 1))], -1
    )
    n, faces = len(outline), []
    for i in range(sides):
        for j in range(n):
            a, b = i * n + j, i * n + (j + 1) % n
            c, d = (i + 1) % sides * n + (j + 1) % n, (i + 1) % sides * n + j
            faces += [[a, d, c], [a, c, b]]
    flat = vertices.reshape(-1, 3)
    _, first, number = np.unique(np.round(flat, 9), axis=0, return_index=True, return_inverse=True)
    welded = number.reshape(-1)[np.array(faces)]
    keep = (welded[:, 0] != welded[:, 1]) & (welded[:, 1] != welded[:, 2]) & (welded[:, 2] != welded[:, 0])
    return Surface(flat[first], welded[keep])


def polygon_area(radius, sides=SIDES):
    return 0.5 * sides * radius**2 * np.sin(2 * np.pi / sides)


CUP = turned([(0, 0), (10, 0), (10, 20), (8, 20), (8, 2), (0, 2)])


@pytest.fixture
def any_printer():
    return Printer("test", (100.0, 80.0, 120.0), 0.05, 0.05, ((200.0, 1.0), (np.inf, 2.0)), 0.5, 45.0, 1.2, 50.0)


def box(x, y, z, place=(0.0, 0.0, 0.0)):
    return Surface(CUBE_CORNERS * [x, y, z] + np.asarray(place), CUBE_FACES)


def test_a_cube_fits_stands_and_weighs_what_it_must(any_printer):
    said = check_printing(Solid.from_surface(box(20, 20, 20, (3, 4, 0))), any_printer, up=Z)
    assert said.findings == ()
    facts = said.facts
    assert facts["contact_area_mm2"] == pytest.approx(400) and facts["tipping_margin_mm"] == pytest.approx(10)
    assert facts["centre_of_mass_mm"] == pytest.approx([13, 14, 10]) and facts["least_wall_mm"] == pytest.approx(20, rel=1e-6)
    assert facts["mass_g"] == pytest.approx(8 * 1.2) and facts["cost"] == pytest.approx(8e-3 * 50)
    assert facts["layers"] == 400 and facts["peak_section_mm2"] == pytest.approx(400)


def test_what_is_too_large_is_told_at_what_size_it_would_fit(any_printer):
    said = check_printing(Solid.from_surface(box(90, 90, 30)), any_printer, up=Z)
    assert said.get("does-not-fit").measured["fits_at"] == pytest.approx(80 / 90)
    diagonal = Surface(box(95, 20, 5).vertices @ np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]]), CUBE_FACES)
    assert not check_printing(Solid.from_surface(diagonal), any_printer, up=Z).has("does-not-fit")


def test_a_leaning_box_falls_over_and_a_ball_has_nothing_to_stand_on(any_printer):
    lean = box(10, 10, 30)
    leaning = Surface(lean.vertices + np.outer(lean.vertices[:, 2], [1.0, 0, 0]), lean.faces)
    said = check_printing(Solid.from_surface(leaning), any_printer, up=Z)
    # the centre of a prism sheared by s lies s h/2 from the middle of its base
    assert said.get("does-not-stand").severity == "warning"
    assert said.facts["tipping_margin_mm"] == pytest.approx(-(15 - 5))
    latitude = np.linspace(-np.pi / 2, np.pi / 2, 41)
    ball = turned(np.column_stack([10 * np.cos(latitude), 10 * np.sin(latitude)]))
    said = check_printing(Solid.from_surface(ball), any_printer, up=Z)
    assert said.has("base-not-flat")
    # the cap below 45 degrees has area 2 pi r^2 (1 - cos 45); facets blur its edge by one ring
    cap = 2 * np.pi * 100 * (1 - np.sqrt(0.5))
    assert said.facts["overhang_area_mm2"] == pytest.approx(cap, abs=2 * np.pi * 100 * np.sqrt(0.5) * np.pi / 40)


def test_a_fin_is_as_thin_as_it_is_and_its_area_is_known(any_printer):
    fin = box(30, 0.6, 20)
    said = check_printing(Solid.from_surface(fin), any_printer, up=Z)
    thin = said.get("thin-walls")
    assert thin.measured["least_mm"] == pytest.approx(0.6, rel=1e-5)
    assert thin.measured["area_mm2"] == pytest.approx(2 * 30 * 20, rel=1e-9)


def test_walls_of_a_hollow_ball_measure_the_difference_of_radii():
    latitude = np.linspace(-np.pi / 2, np.pi / 2, 61)
    ring = np.column_stack([np.cos(latitude), np.sin(latitude)])
    inner = turned(8 * ring, 120)
    shell = join([turned(10 * ring, 120), Surface(inner.vertices, inner.faces[:, ::-1])])
    samples = sample_surface(shell, 1.0)
    assert samples.area_mm2.sum() == pytest.approx(shell.area_mm2)
    wall = wall_thickness_mm(shell, samples)
    # facets shorten each radius by at most its sagitta
    assert np.abs(wall - 2).max() < 10 * (1 - np.cos(np.pi / 60)) * 2
    hollow = np.linalg.norm(samples.places_mm, axis=1) < 9
    gap = gap_mm(shell, samples)
    assert np.isinf(gap[~hollow]).all() and gap[hollow].max() < 16.1 and gap[hollow].min() > 15.5


def test_two_plates_nearer_than_a_pixel_are_named(any_printer):
    plates = join([box(20, 20, 5), box(20, 20, 5, (0, 0, 5.02))])
    assert check_printing(Solid.from_surface(plates), any_printer, up=Z).has("near-sheets")
    assert not check_printing(Solid.from_surface(join([box(20, 20, 5), box(20, 20, 5, (0, 0, 6.0))])), any_printer, up=Z).has(
        "near-sheets"
    )


def test_a_cup_holds_its_volume_upright_none_upside_down_and_half_or_less_on_its_side():
    inner = polygon_area(8) * 18
    (held,) = pockets(CUP, Z, step_mm=0.2)
    # cells miscount the wall by at most half a cell over its area, and on average by far less
    assert held.volume_mm3 == pytest.approx(inner, rel=0.005)
    assert held.depth_mm == pytest.approx(18, abs=0.4) and not held.closed and held.lowest_mm[2] == pytest.approx(2, abs=0.2)
    assert pockets(CUP, (0, 0, -1), step_mm=0.4) == []
    assert pockets(CUP, (1, 0, 0), step_mm=0.4) == []
    (tilted,) = pockets(CUP, (1, 0, 1), step_mm=0.2)
    # the surface of the liquid passes through the lowest point of the brim at 45 degrees: half the cylinder of height 2 r is left of it
    assert tilted.volume_mm3 == pytest.approx(polygon_area(8) * (18 - 8), rel=0.01)


def test_a_planted_pocket_is_found_and_measured(any_printer):
    inner = cube(4.0, (5, 5, 6))
    hollow = Solid.from_surface(join([box(10, 10, 12), Surface(inner.vertices, inner.faces[:, ::-1])]))
    said = check_printing(hollow, any_printer, up=Z)
    assert said.get("trapped-volume").severity == "error" and said.facts["trapped_mm3"] == pytest.approx(64)
    assert said.get("trapped-volume").places_mm[0] == pytest.approx([5, 5, 6], abs=1)
    (pocket,) = pockets(hollow.surface, Z)
    assert pocket.closed and pocket.volume_mm3 == pytest.approx(64, rel=0.02)


def test_a_shelf_begins_in_mid_air_once(any_printer):
    table = turned([(0, 0), (3, 0), (3, 10), (8, 9), (8, 12), (0, 12)])
    said = check_printing(Solid.from_surface(table), any_printer, up=Z)
    assert said.get("unsupported-minima").count == 1
    assert said.get("unsupported-minima").places_mm[0][2] == pytest.approx(9)
    assert check_printing(Solid.from_surface(CUP), any_printer, up=Z).facts["unsupported_minima"] == 0


@pytest.mark.parametrize("island", [True, False])
def test_a_tip_that_leans_far_is_told_from_a_pit_by_its_section(island):
    # just above the tip the section is a unit square, aside of it; the faces end so unevenly that together they look the other way
    heights = np.array([3.0, 1.0, 1.0, 3.0])
    section = np.array([[1, -0.5], [2, -0.5], [2, 0.5], [1, 0.5]])
    cone = np.concatenate([[[0, 0, 0]], np.column_stack([section * heights[:, None], heights])])
    faces = np.array([[0, 1 + (k + 1) % 4, 1 + k] for k in range(4)])
    tip = Surface(cone, faces if island else faces[:, ::-1])
    assert round_above(tip, tip.vertices, np.arange(5) == 0)[0] == pytest.approx(1.0 if island else -1.0)
    assert ((tip.area_vectors @ [0, 0, -1.0]).sum() > 0) != island


def test_a_groove_is_no_gap_at_its_bottom_and_a_slit_is_one(any_printer):
    def wedge(width, low):
        import manifold3d

        cut = manifold3d.Manifold.hull_points(
            [(x, y, z) for y in (-1, 21) for x, z in ((10 - width, 21), (10 + width, 21), (10 + low, 5), (10 - low, 5))]
        )
        mesh = (manifold3d.Manifold.cube((20, 20, 20)) - cut).to_mesh64()
        return Solid.from_surface(Surface(mesh.vert_properties[:, :3], mesh.tri_verts.astype(int)))

    # a slit 0.04 mm wide all the way down, and a groove that is as narrow only in its last third of a millimetre
    assert check_printing(wedge(0.02, 0.02), any_printer, up=Z).has("near-sheets")
    assert not check_printing(wedge(1.2, 0.0), any_printer, up=Z).has("near-sheets")


def test_sections_of_a_torus_are_annuli():
    ring = torus(600, 600)
    heights = np.array([-0.9, -0.3, 0.0, 0.5])
    outer, inner = 3 + np.sqrt(1 - heights**2), 3 - np.sqrt(1 - heights**2)
    exact = np.pi * (outer**2 - inner**2)
    # both circles are inscribed polygons: relative loss (pi/n)^2 each way, at most doubled by the difference of squares
    assert section_areas_mm2(ring, heights, Z) == pytest.approx(exact, rel=8 * (np.pi / 600) ** 2 * 9 / 2)


def test_cells_count_the_volume_and_the_centre_of_mass_is_that_of_the_body():
    ring = torus(120, 80)
    cells = cells_of(ring, 0.05, Z)
    assert cells.solid.sum() * 0.05**3 == pytest.approx(ring.volume_mm3, rel=0.002)
    cone = turned([(0, 0), (6, 0), (0, 12)], 200)
    assert centre_of_mass(cone) == pytest.approx([0, 0, 3], abs=1e-9)
    with pytest.raises(SurfaceError, match="choose a larger step"):
        cells_of(ring, 1e-5, Z)


def test_hull_and_smallest_rectangle():
    random = np.random.default_rng(1)
    inside = random.uniform(-1, 1, (5000, 2)) * [4, 1]
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    corners = np.array([[-4, -1], [4, -1], [4, 1], [-4, 1]]) @ turn
    hull = convex_hull(np.concatenate([inside @ turn, corners]))
    assert sorted(map(tuple, np.round(hull, 9))) == sorted(map(tuple, np.round(corners, 9)))
    assert smallest_footprint(np.concatenate([inside @ turn, corners]))[:2] == pytest.approx((8, 2))


def test_shipped_printers_load_and_wrong_ones_are_refused(tmp_path):
    for name in printer_names():
        assert printer(name).build_mm[0] > 50 and printer(name).least_wall_mm(1000) >= printer(name).least_wall_mm(10)
    with pytest.raises(SettingError, match="no printer is called"):
        printer("teapot")
    with pytest.raises(InputError, match="does not exist"):
        printer(tmp_path / "x.toml")
    (tmp_path / "x.toml").write_text("name = 'x'\n")
    with pytest.raises(SettingError, match="missing or unknown"):
        printer(tmp_path / "x.toml")
