"""Every number of the check for printing, of every known solid, against its closed form."""

import numpy as np
import pytest
from test_check_printing import CUP, Z, box, polygon_area, turned
from test_topology import torus
from test_topology_distance import cube

from rangecheck.solid import Solid
from rangecheck.solid.printer import Printer
from rangecheck.solid.printing import check_printing
from rangecheck.solid.thickness import sample_surface, wall_thickness_mm
from rangecheck.surface import Surface
from rangecheck.surface.surface import join

PRINTER = Printer("test", (100.0, 80.0, 120.0), 0.05, 0.05, ((200.0, 1.0), (np.inf, 2.0)), 0.5, 45.0, 1.2, 50.0)


def turned_over(surface):
    return Surface(surface.vertices, surface.faces[:, ::-1])


def _ball():
    latitude = np.linspace(-np.pi / 2, np.pi / 2, 121)
    return turned(np.column_stack([10 * np.cos(latitude), 10 * np.sin(latitude)]), 192)


def _nested():
    """A cube of 20 mm with a cavity of 6 mm off its middle, and in it a cube of 2 mm that floats."""
    return join([cube(20.0), turned_over(cube(6.0, (2, 1, 0))), cube(2.0, (2, 1, 0))])


NESTED = 8000 - 216 + 8
CUP_VOLUME = polygon_area(10) * 20 - polygon_area(8) * 18
#: solid, up, and what is known of it: volume, least wall, islands, held in cups, trapped, overhang beyond 45 degrees off the plate, centre of mass, each
#: with the relative error that its facets make
KNOWN = {
    "sphere": (_ball, Z, 4 / 3 * np.pi * 1e3, 20, 0, 0, 0, 2 * np.pi * 10 * (10 - 10 * np.sqrt(0.5) - 0.05), (0, 0, 0), 0.02),
    "cube": (lambda: cube(20.0), Z, 8000, 20, 0, 0, 0, 0, (0, 0, 0), 1e-9),
    # the quarter of the tube that looks down, but for what lies within a layer of 0.05 mm of the plate; its middle runs along the ring
    "torus": (lambda: torus(240, 160), Z, 6 * np.pi**2, 2, 0, 0, 0, 6 * np.pi * (np.pi / 2 - 2 * np.arccos(0.95)), (0, 0, 0), 0.03),
    # the floating cube begins in mid-air; it and the cavity's ceiling hang over; it takes room from what is trapped
    "nested shells": (_nested, Z, NESTED, 2, 1, 0, 208, 36 + 4, (np.array([2, 1, 0]) * -208 / NESTED), 1e-9),
    "thin fin": (lambda: box(30, 0.6, 20), Z, 360, 0.6, 0, 0, 0, 0, (15, 0.3, 10), 1e-9),
    "cup upside down": (
        lambda: CUP, (0, 0, -1), CUP_VOLUME, 2 * np.cos(np.pi / 96), 0, 0, 0, polygon_area(8),
        (0, 0, (polygon_area(10) * 200 - polygon_area(8) * 18 * 11) / CUP_VOLUME), 1e-9,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", KNOWN)
def test_every_number_of_a_known_solid_is_its_closed_form(name):
    make, up, volume, wall, islands, held, trapped, overhang, centre, error = KNOWN[name]
    solid = Solid.from_surface(make(), severities={"nested-shells": "note"})
    facts = check_printing(solid, PRINTER, up=up).facts
    assert facts["volume_mm3"] == pytest.approx(volume, rel=error)
    assert facts["least_wall_mm"] == pytest.approx(wall, rel=max(error, 1e-5))
    assert (facts["unsupported_minima"], facts["held_mm3"]) == (islands, held)
    assert facts["trapped_mm3"] == pytest.approx(trapped, rel=error)
    assert facts["overhang_area_mm2"] == pytest.approx(overhang, rel=error)
    assert facts["centre_of_mass_mm"] == pytest.approx(centre, abs=1e-6)


def test_the_upright_cup_holds_what_its_inside_measures():
    facts = check_printing(Solid.from_surface(CUP), PRINTER, up=Z).facts
    assert facts["held_mm3"] == pytest.approx(polygon_area(8) * 18, rel=0.02) and facts["trapped_mm3"] == 0


def test_the_wall_of_every_known_shape_is_the_same_all_over():
    for shape, wall, error in ((_ball(), 20, 0.002), (torus(240, 160), 2, 0.002), (cube(20.0), 20, 1e-5)):
        thick = wall_thickness_mm(shape, sample_surface(shape, 0.5))
        assert np.abs(thick / wall - 1).max() < error
