"""Files judged whole: the collection of broken meshes, other programs' opinions, and why they differ."""

import numpy as np
import pytest
from test_topology import torus
from test_topology_distance import CUBE_CORNERS, CUBE_FACES, cube

from rangecheck import memory
from rangecheck.errors import InputError
from rangecheck.export.meshes import write_mesh
from rangecheck.export.stl import write_stl
from rangecheck.files import write_json
from rangecheck.solid import Solid, judges
from rangecheck.solid.check_file import check_mesh_file
from rangecheck.solid.opinions import TOO_LITTLE, disagreements, second_opinions
from rangecheck.solid.printer import printer
from rangecheck.solid.shape import shape_findings
from rangecheck.surface import Surface
from rangecheck.surface.mesh_files import open_mesh, read_mesh

#: file: boundary edges, non-manifold vertices, shells, faces that cross, findings that are errors; as trimesh and MeshLab agree
DIRTY = {
    "admesh_block/basic.stl": (0, 0, 1, 0, set()),
    "admesh_block/exact-bad.stl": (4, 0, 1, 0, {"open-edges"}),
    "admesh_block/fill-holes-bad.stl": (3, 0, 1, 0, {"open-edges"}),
    "admesh_block/fill-holes-good.stl": (0, 0, 1, 0, {"inconsistent-winding"}),
    "admesh_block/merge.stl": (0, 0, 2, 0, set()),
    "admesh_block/nearby-bad.stl": (4, 0, 1, 0, {"open-edges"}),
    "admesh_block/normal-directions-bad.stl": (0, 0, 1, 0, {"inconsistent-winding"}),
    "admesh_block/normal-directions-good.stl": (0, 0, 1, 0, {"inside-out"}),
    "admesh_block/remove-unconnected-bad.stl": (3, 0, 3, 0, {"open-edges"}),
    "meshlab/T.ply": (0, 0, 1, 0, set()),
    "meshlab/greek_helmet.obj": (424, 0, 7, 230, {"open-edges", "self-intersections"}),
    "meshlab/many_small_holes.ply": (556, 6, 1, 0, {"open-edges", "non-manifold-vertices"}),
    "meshlab/non_manif_hole.ply": (119, 5, 1, 0, {"open-edges", "non-manifold-vertices"}),
    "trimesh/busted.STL": (0, 0, 1, 0, set()),
    "trimesh/featuretype.STL": (576, 0, 1, 0, {"open-edges"}),
    "trimesh/multibody.stl": (0, 0, 2, 0, {"inconsistent-winding"}),
    "trimesh/not_convex.obj": (0, 0, 1, 0, {"non-manifold-edges", "overlapping-faces"}),
    "trimesh/shared.STL": (0, 0, 1, 0, {"non-manifold-edges"}),
    "trimesh/soup.stl": (300, 0, 100, 99, {"open-edges", "self-intersections"}),
}
EMPTY = ["empty.ply", *(f"emptyIO/{n}" for n in ("ply_empty_ascii.ply", "ply_empty_bin.ply", "ply_empty_header.ply", "stl_empty_ascii.stl",
                                                  "stl_empty_bin.stl"))]  # fmt: skip


@pytest.mark.real_data
@pytest.mark.parametrize("name", DIRTY)
def test_broken_meshes_are_judged_as_two_other_programs_measured_them(real_data, name):
    edges, vertices, shells, crossing, errors = DIRTY[name]
    said = check_mesh_file(real_data / "dirty" / name, "mm").verdict
    counts = {f.code: f.count for f in said.findings}
    assert (counts.get("open-edges", 0), counts.get("non-manifold-vertices", 0), said.facts["shells"]) == (
        edges,
        vertices,
        shells,
    )
    assert (said.get("self-intersections").measured["faces_involved"] if said.has("self-intersections") else 0) == crossing
    assert {f.code for f in said.errors} == errors


@pytest.mark.real_data
@pytest.mark.parametrize("name", EMPTY)
def test_empty_and_headless_files_are_refused_in_one_line(real_data, name):
    with pytest.raises(InputError, match=r"^[^\n]*export it again$"):
        check_mesh_file(real_data / "dirty" / "trimesh" / name, "mm")


@pytest.mark.real_data
@pytest.mark.engines
def test_programs_that_disagree_are_explained_by_their_merge_rule_and_by_winding(real_data):
    feature = check_mesh_file(real_data / "dirty" / "trimesh" / "featuretype.STL", "mm", opinions=True)
    by_name = {o.program: o for o in feature.opinions}
    assert by_name["trimesh"].closed and not by_name["MeshLab"].closed and by_name["MeshLab"].facts["boundary_edges"] == 576
    assert (
        "merge rule" in feature.verdict.get("opinions-differ").message
        and "closes 576 edges" in feature.verdict.get("opinions-differ").message
    )
    # walls end 2.7e-16 mm below the base they stand on: they touch it, and MeshLab's test takes that for crossing
    crossing = [f for f in feature.verdict.findings if f.code == "opinions-differ" and f.measured["program"] == "MeshLab"]
    assert len(crossing) == 1 and len(crossing[0].places_mm)
    named = by_name["MeshLab"].facts["self_intersecting_faces"]
    assert f"MeshLab says {named} faces run through others, rangecheck 0: {named} of those it names touch" in crossing[0].message
    assert "self_intersecting_faces" not in by_name["trimesh"].facts and feature.verdict.has("touching-faces")
    turned = check_mesh_file(real_data / "dirty" / "admesh_block" / "normal-directions-bad.stl", "mm", opinions=True)
    assert "winding: 3 edges" in turned.verdict.get("opinions-differ").message
    assert {o.program: o.closed for o in turned.opinions}["manifold3d"] is False


@pytest.mark.engines
def test_of_a_sound_solid_all_programs_say_the_same(tmp_path):
    write_stl(Solid.from_surface(torus(30, 20)), tmp_path / "ring.stl")
    surface = read_mesh(tmp_path / "ring.stl", "mm")
    opinions = second_opinions(tmp_path / "ring.stl", surface)
    assert [o.closed for o in opinions] == [True] * 4 and disagreements(surface, opinions, 1.0) == []
    assert opinions[2].facts["self_intersecting_faces"] == 0 and opinions[3].facts["genus"] == 1
    # by their own readers, or given the file's records with equal corners welded: they say the same
    records = open_mesh(tmp_path / "ring.stl", "mm").file_vertices
    assert [o.facts for o in second_opinions(tmp_path / "ring.stl", surface, records=records)] == [o.facts for o in opinions]


@pytest.mark.engines
def test_a_program_that_cannot_read_the_file_has_no_opinion(tmp_path):
    (tmp_path / "x.stl").write_bytes(b"nothing of the kind")
    opinions = second_opinions(tmp_path / "x.stl", cube())
    assert opinions[1].closed is None and opinions[2].closed is None and opinions[2].error
    assert {found.code for found in disagreements(cube(), opinions, 1.0)} == {"no-opinion"}


def test_a_solid_file_is_judged_for_printing_too_and_all_of_it_is_json(tmp_path):
    write_mesh(cube(20.0), tmp_path / "c.ply")
    said = check_mesh_file(tmp_path / "c.ply", "mm", printer=printer("prusa-sl1s"), up=(0, 0, 1)).verdict
    assert said.fit and said.facts["printing"]["contact_area_mm2"] == pytest.approx(400)
    write_json(tmp_path / "c.json", said.to_dict())


def test_with_little_memory_a_check_finds_the_same_and_says_what_it_left_out(tmp_path, monkeypatch):
    write_mesh(torus(24, 16), tmp_path / "torus.ply")
    whole = check_mesh_file(tmp_path / "torus.ply").verdict
    monkeypatch.setattr("rangecheck.memory._most_mb", 1.0)
    bounded = check_mesh_file(tmp_path / "torus.ply", printer=printer("prusa-sl1s")).verdict
    left = bounded.get("left-out")
    assert left.severity == "note" and "manifold3d and printing" in left.message and bounded.fit
    assert [f for f in bounded.findings if f is not left] == list(whole.findings)
    assert bounded.facts == dict(whole.facts) | {"engine_asked": False}


def test_programs_that_do_not_fit_into_memory_say_so_and_others_are_heard(tmp_path, monkeypatch):
    write_mesh(torus(24, 16), tmp_path / "torus.ply")
    monkeypatch.setattr("rangecheck.memory._most_mb", memory.held_mb() + 30.0)
    assert {opinion.error for opinion in second_opinions(tmp_path / "torus.ply", torus(24, 16))[1:]} == {TOO_LITTLE}
    monkeypatch.setattr("rangecheck.memory._most_mb", memory.held_mb() + 8000.0)
    assert [opinion.closed for opinion in second_opinions(tmp_path / "torus.ply", torus(24, 16))] == [True] * 4


def test_folds_slivers_and_short_edges_are_named():
    wedge = Surface([[0, 0, 0], [1, 0, 0], [0.5, 2, 0.05], [0.5, 2, -0.05]], [[0, 1, 2], [1, 0, 3], [2, 3, 0], [3, 2, 1]])
    assert [f.code for f in shape_findings(wedge)] == ["folded-edges"]
    needle = Surface(CUBE_CORNERS * [1000.0, 1.0, 1.0], CUBE_FACES)
    assert {f.code: f.count for f in shape_findings(needle)} == {"sliver-faces": 8}
    far = cube(1.0, (1e6, 0, 0))
    assert {f.code for f in shape_findings(far)} == {"short-edges"} or np.spacing(np.float32(1e6)) * 8 < 1.0
    assert [f.code for f in shape_findings(cube(1.0, (4e6, 0, 0)))] == ["short-edges"]


def test_a_program_that_crashes_over_a_mesh_is_a_finding_and_the_check_goes_on(tmp_path, monkeypatch):
    script = tmp_path / "crashing.py"
    script.write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
    monkeypatch.setattr(judges, "__file__", str(script))
    path = tmp_path / "torus.ply"
    write_mesh(torus(24, 16), path)
    found = [one for one in check_mesh_file(path, opinions=True).verdict.findings if one.code == "no-opinion"]
    assert len(found) == 3 and all("SIGSEGV" in one.message and one.severity == "note" for one in found)
