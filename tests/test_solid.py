"""A solid is what passed every check; known solids, planted defects, cuts with closed forms."""

import numpy as np
import pytest
from test_topology import grid, torus
from test_topology_distance import CUBE_CORNERS, CUBE_FACES, cube

from rangecheck.errors import NotSolid, SettingError, SurfaceError
from rangecheck.files import read_json, write_json
from rangecheck.solid import Solid, check_solid, explain, untangle
from rangecheck.solid.base import choose_base_height, cut_flat
from rangecheck.solid.findings import SEVERITIES, catalogue
from rangecheck.surface import INVENTED, MEASURED, Surface
from rangecheck.surface.surface import join


def turned_over(surface):
    return Surface(surface.vertices, surface.faces[:, ::-1])


def test_cube_and_torus_are_solids_of_their_volume_and_genus():
    box = Solid.from_surface(cube(3.0, (1e5, 0, 0)))
    assert box.volume_mm3 == pytest.approx(27.0, rel=1e-9)
    assert box.verdict.findings == () and box.verdict.facts["genus"] == 0
    ring = Solid.from_surface(torus(400, 300))
    assert ring.verdict.facts["genus"] == 1
    # a tube of inscribed polygons: the area of the 300-gon times the length of the 400-gon's path, to second order
    exact = 2 * np.pi**2 * 3.0
    assert ring.volume_mm3 == pytest.approx(exact, rel=2 * np.pi**2 * (1 / 300**2 + 1 / 400**2))


def test_a_solid_cannot_be_claimed():
    with pytest.raises(NotSolid, match="cannot be claimed"):
        Solid(cube(), check_solid(cube()))


DEFECTS = {
    "open-edges": lambda: Surface(CUBE_CORNERS, CUBE_FACES[:-1]),
    "inside-out": lambda: turned_over(cube()),
    "inconsistent-winding": lambda: Surface(CUBE_CORNERS, np.concatenate([CUBE_FACES[:-1], CUBE_FACES[-1:, ::-1]])),
    "nested-shells": lambda: join([cube(4.0), cube(1.0)]),
    "duplicate-faces": lambda: Surface(CUBE_CORNERS, np.concatenate([CUBE_FACES, CUBE_FACES[:1]])),
    "degenerate-faces": lambda: Surface(CUBE_CORNERS, np.concatenate([CUBE_FACES, [[0, 0, 1]]])),
    "self-intersections": lambda: join([cube(), cube(2.0, (0.7, 0.6, 0.5))]),
    "overlapping-faces": lambda: join([cube(), cube(2.0, (2.0, 0.3, 0.4))]),
    "no-volume": lambda: Surface(np.zeros((0, 3)), np.empty((0, 3), np.int32)),
}


@pytest.mark.parametrize("code", DEFECTS)
def test_each_defect_is_named_with_its_place_and_keeps_the_surface_from_being_solid(code):
    spoiled = DEFECTS[code]()
    found = check_solid(spoiled).get(code)
    assert found.severity == "error" and found.count >= 1 and found.why and found.mend
    if len(spoiled.faces):
        low, high = spoiled.bounds_mm
        assert len(found.places_mm) and (found.places_mm >= low - 1e-9).all() and (found.places_mm <= high + 1e-9).all()
    with pytest.raises(NotSolid) as refusal:
        Solid.from_surface(spoiled)
    assert any(f.code == code for f in refusal.value.findings)


def test_a_cavity_is_no_defect_and_its_volume_is_taken_away():
    hollow = Solid.from_surface(join([cube(4.0), turned_over(cube(2.0))]))
    assert hollow.volume_mm3 == pytest.approx(64 - 8)
    assert [s["role"] for s in hollow.verdict.facts["shell_roles"]] == ["body", "cavity"]
    island = Solid.from_surface(join([cube(4.0), turned_over(cube(2.0)), cube(1.0)]))
    assert [s["role"] for s in island.verdict.facts["shell_roles"]] == ["body", "cavity", "body"]
    assert island.verdict.get("several-bodies").count == 2


def test_crumbs_are_warned_of():
    assert check_solid(join([cube(10.0), cube(0.5, (20, 0, 0))])).get("noise-shells").severity == "warning"


def test_severity_can_be_overridden_but_no_word_makes_an_open_surface_solid():
    sheet = grid(2, 2)
    assert check_solid(sheet, severities={"open-edges": "note", "no-volume": "note"}).fit
    with pytest.raises(NotSolid):
        Solid.from_surface(sheet)


def test_verdicts_are_json(tmp_path):
    for make in DEFECTS.values():
        write_json(tmp_path / "v.json", check_solid(make()).to_dict())
        assert read_json(tmp_path / "v.json")["fit"] is False


def test_every_code_explains_itself_and_a_misspelt_one_names_the_nearest():
    for code, text in catalogue().items():
        assert text == explain(code) and text.severity in SEVERITIES and text.why and text.mend and text.title
    with pytest.raises(SettingError, match="did you mean open-edges"):
        explain("open-edge")


def test_a_cut_torus_has_half_its_volume_and_keeps_the_origin_of_its_faces():
    ring = torus(60, 40)
    measured = Surface(ring.vertices, ring.faces, origin_of_face=np.full(len(ring.faces), MEASURED, np.uint8))
    solid = Solid.from_surface(measured)
    half = cut_flat(solid, height_mm=0.0, up=(0, 1, 0))
    assert half.volume_mm3 == pytest.approx(solid.volume_mm3 / 2, rel=1e-12)
    cap = half.surface.part_of_face == half.surface.part_names.index("base")
    assert (half.surface.origin_of_face[cap] == INVENTED).all() and (half.surface.origin_of_face[~cap] == MEASURED).all()
    assert np.abs(half.surface.vertices[half.surface.faces[cap]][..., 1]).max() < 1e-12
    # what the plane does not touch has not moved by a bit
    above = solid.surface.vertices[solid.surface.vertices[:, 1] > 1e-9]
    assert {tuple(v) for v in above} <= {tuple(v) for v in half.surface.vertices}


def test_a_plane_that_misses_is_refused_with_the_heights_between():
    with pytest.raises(SurfaceError, match=r"reaches from -1.000 to 1.000 mm"):
        cut_flat(Solid.from_surface(cube()), height_mm=5.0)


def test_the_base_is_cut_where_measured_surface_begins():
    ring = torus(200, 80)
    lying = Surface(ring.vertices[:, [0, 2, 1]], ring.faces[:, ::-1])
    middle = lying.triangles.mean(axis=1)[:, 1]
    origin = np.where(middle < -0.6, INVENTED, MEASURED).astype(np.uint8)
    solid = Solid.from_surface(Surface(lying.vertices, lying.faces, origin_of_face=origin))
    chosen = choose_base_height(solid)
    # within one level and one ring of faces of where invention ends
    assert chosen.height_mm + 2.0 / 200 >= -0.6 and chosen.height_mm < -0.6 + 2.0 / 200 + np.sin(2 * np.pi / 80)
    assert "invented" in chosen.reason
    assert "only makes it flat" in choose_base_height(Solid.from_surface(cube())).reason


def test_a_fold_comes_loose_within_its_leash_or_stays_as_it_was():
    sheet = torus(60, 40)
    vertices = sheet.vertices.copy()
    neighbour = vertices[1]
    vertices[0] += 2.2 * (neighbour - vertices[0]) + 0.02 * vertices[0] / np.linalg.norm(vertices[0])
    folded = Surface(vertices, sheet.faces)
    loose = untangle(folded, max_move_mm=0.5)
    assert loose.before > 0 and loose.after == 0 and 0 < loose.moved_mm <= 0.5 * (1 + 1e-12)
    assert np.linalg.norm(loose.surface.vertices - vertices, axis=1).max() == loose.moved_mm
    tied = untangle(folded, max_move_mm=1e-6)
    assert tied.before == tied.after and np.array_equal(tied.surface.vertices, vertices)
    assert untangle(sheet, max_move_mm=1.0).surface is sheet
