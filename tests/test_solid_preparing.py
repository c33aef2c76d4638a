"""From a surface to a part: closing, cutting, socle, hollow backs, orientation, what slicers weld, and other programs' word on the file."""

import json
import shutil
import subprocess
import sys
import weakref

import numpy as np
import pytest
from click.testing import CliRunner
from rangecheck_cli.main import cli, exit_status
from test_check_printing import CUP, turned
from test_solid_repair import BALL, ball
from test_topology import grid, torus
from test_topology_distance import CUBE_CORNERS, CUBE_FACES, cube

from rangecheck.arrays import float32_spacing_mm
from rangecheck.config import load_settings
from rangecheck.errors import NotSolid, SettingError, SurfaceError
from rangecheck.export.meshes import write_mesh
from rangecheck.export.stl import stl_bytes, write_stl
from rangecheck.pipeline.shape import make_solid
from rangecheck.progress import Reporter
from rangecheck.solid import Solid, close_relief, repair
from rangecheck.solid.base import trimmed
from rangecheck.solid.closing import choose_way, close_surface
from rangecheck.solid.engine import cross_section, from_engine, prism
from rangecheck.solid.hollow import hollow
from rangecheck.solid.orientation import advise, judge
from rangecheck.solid.plane_cut import MOST_STEPS, clear_height_mm, cut_by_plane
from rangecheck.solid.printer import printer
from rangecheck.solid.relief_back import hollow_back
from rangecheck.solid.slicer import weld_findings, welded_within
from rangecheck.solid.socle import with_socle
from rangecheck.surface import INVENTED, MEASURED, Surface
from rangecheck.surface.mesh_files import read_mesh
from rangecheck.surface.surface import join

Z = (0.0, 0.0, 1.0)


def dome(n=40):
    """A sheet that faces up: 60 x 60 mm, 10 mm high in the middle."""
    sheet = grid(n, n)
    xy = (sheet.vertices[:, :2] - sheet.vertices[:, :2].min(axis=0)) / np.ptp(sheet.vertices[:, :2], axis=0) * 60 - 30
    z = 10 * np.cos(xy[:, 0] * np.pi / 60) * np.cos(xy[:, 1] * np.pi / 60)
    up = Surface(np.column_stack([xy, z]), sheet.faces)
    return up if up.area_vectors[:, 2].sum() > 0 else Surface(up.vertices, up.faces[:, ::-1])


def test_a_sheet_is_closed_as_a_relief_a_body_by_repair_and_both_say_why():
    as_relief = close_surface(dome(), back_mm=5.0)
    assert as_relief.way == "relief" and as_relief.after.fit and as_relief.moved_mm == 0.0 and "faces one way" in as_relief.reason
    holed = BALL.with_faces(BALL.triangles.mean(axis=1)[:, 2] < 9.0)
    mended = close_surface(holed)
    assert mended.way == "repair" and mended.after.fit and mended.moved_mm == 0.0
    assert ("open-edges", 96, 0) in mended.table()
    assert choose_way(BALL) == ("repair", "it is closed already")
    with pytest.raises(SettingError, match="no way 'glue'"):
        close_surface(BALL, way="glue")


def test_the_leash_shrinks_with_the_part():
    tiny = Surface(BALL.vertices * 1e-3, BALL.faces[:-1])
    assert any("the leash is" in words for words in close_surface(tiny, max_move_mm=0.05).refused)


def test_with_little_memory_a_solid_is_proved_without_manifold3d_and_what_only_that_does_is_refused(monkeypatch):
    monkeypatch.setattr("rangecheck.memory._most_mb", 1.0)
    never_judged = Surface(BALL.vertices, BALL.faces)
    made = make_solid(never_judged, load_settings(None, (), {"solid.base": "none"}), Reporter())
    assert made.solid is not None and "manifold3d" in made.verdict.get("left-out").message
    with pytest.raises(SettingError, match=r"solid.wall_mm, solid.base of .* faces takes about .* MB, and memory_mb leaves 0"):
        make_solid(BALL, load_settings(None, (), {"solid.wall_mm": 2.0}), Reporter())


def test_a_solid_that_does_not_fit_into_memory_is_refused_in_one_line_before_anything_is_computed(tmp_path, monkeypatch, capsys):
    write_mesh(BALL, tmp_path / "ball.ply")
    monkeypatch.setattr("rangecheck.pipeline.shape.BYTES_A_FACE", 1e9)
    line = ["solid", str(tmp_path / "ball.ply"), "-o", str(tmp_path / "ball.stl"), "--memory-mb", "8000"]
    assert exit_status(line) == 2
    assert "MB to prove, write and read back, and memory_mb leaves" in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "ball.stl").exists()


def test_a_large_mesh_is_cut_face_by_face_and_its_file_does_not_depend_on_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr("rangecheck.solid.base.FACES_OF_ENGINE", 0)
    monkeypatch.setattr("rangecheck.pipeline.shape.FACES_OF_ENGINE", 0)
    write_mesh(BALL, tmp_path / "ball.ply")
    written = []
    for engine_takes, name in ((1.0, "ample"), (1e12, "bounded")):
        monkeypatch.setattr("rangecheck.solid.engine.BYTES_A_FACE", engine_takes)
        line = ["solid", str(tmp_path / "ball.ply"), "-o", str(tmp_path / f"{name}.stl"), "--memory-mb", "20000"]
        assert exit_status(line) == 0
        said = json.loads((tmp_path / f"{name}.stl.json").read_text())
        assert ("left-out" in {f["code"] for f in said["read_back"]["findings"]}) == (name == "bounded")
        written.append((tmp_path / f"{name}.stl").read_bytes())
    assert written[0] == written[1]
    assert "base" in said["areas"]["parts"]


def test_walls_that_there_is_no_memory_to_look_at_are_named_and_the_part_is_written(tmp_path, monkeypatch):
    write_mesh(BALL, tmp_path / "ball.ply")
    monkeypatch.setattr("rangecheck.pipeline.printable.BYTES_OF_WALLS", 1e12)
    line = ["solid", str(tmp_path / "ball.ply"), "-o", str(tmp_path / "b.stl"), "--memory-mb", "20000", "--height-mm", "30"]
    assert exit_status(line) == 0 and (tmp_path / "b.stl").exists()
    said = json.loads((tmp_path / "b.stl.json").read_text())
    assert any(f["code"] == "left-out" and "walls" in f["message"] for f in said["read_back"]["findings"]) and "walls" not in said


def test_what_a_surface_was_before_it_was_cut_is_held_no_longer(monkeypatch):
    def cut(*arguments):
        return trimmed(*arguments[:1], height_mm=0.0)

    given = [Surface(BALL.vertices, BALL.faces)]
    whole = weakref.ref(given[0])
    monkeypatch.setattr("rangecheck.pipeline.shape._cut", cut)
    proving = Solid.from_surface
    alive = []
    monkeypatch.setattr(Solid, "from_surface", lambda *args, **more: alive.append(whole()) or proving(*args, **more))
    made = make_solid(given.pop(), load_settings(None, (), {"solid.base": "none"}), Reporter())
    assert made.solid is not None and alive == [None]


def test_bodies_that_run_into_each_other_are_united_to_their_closed_form():
    apart = 3.0
    both = join([cube(4.0), Surface(cube(4.0).vertices + [apart, 0.5, 0.25], CUBE_FACES)])
    mended = repair(both)
    common = (4 - apart) * 3.5 * 3.75
    assert mended.after.fit and mended.after.facts["volume_mm3"] == pytest.approx(2 * 64 - common)
    assert mended.moved_mm < 1e-9 and any(step.name == "unite-bodies" for step in mended.steps)


@pytest.mark.parametrize("normal", [(0, 1, 0), (1, 2, -2)])
@pytest.mark.parametrize("face_by_face", [False, True])
def test_a_plane_through_the_middle_of_a_ball_leaves_half_of_it_with_a_cap(normal, face_by_face, monkeypatch):
    if face_by_face:
        monkeypatch.setattr("rangecheck.solid.base.FACES_OF_ENGINE", 0)
    half = trimmed(BALL, height_mm=0.0, up=normal, cap="cut")
    assert half.volume_mm3 == pytest.approx(BALL.volume_mm3 / 2, rel=1e-3)
    cap = half.part_of_face == half.part_names.index("cut")
    assert half.face_areas[cap].sum() == pytest.approx(np.pi * 100, rel=0.01)


def test_a_step_that_lies_in_the_cutting_plane_goes_and_what_stands_on_it_keeps_part_and_origin():
    # an L: 4 wide at the bottom, 1 wide above y = 1
    ring = np.array([[0, 0], [4, 0], [4, 1], [1, 1], [1, 3], [0, 3]], float)
    step = from_engine(prism(cross_section([ring], 0.0), 0.0, 2.0), [], "stair", MEASURED)
    left = Solid.from_surface(cut_by_plane(step, np.array([0.0, 1.0, 0.0]), 1.0, "base"))
    moved = MOST_STEPS * float32_spacing_mm(4.0)
    assert 2 * 2 - 2 * moved <= left.volume_mm3 <= 2 * 2
    cap = left.surface.part_of_face == left.surface.part_names.index("base")
    assert left.surface.face_areas[cap].sum() == pytest.approx(2.0) and left.surface.face_normals[cap][:, 1].max() < -1 + 1e-12
    assert (left.surface.origin_of_face[cap] == INVENTED).all() and (left.surface.origin_of_face[~cap] == MEASURED).all()
    with pytest.raises(NotSolid, match="not closed where the plane cuts it"):
        cut_by_plane(step.with_faces(np.arange(len(step.faces)) != 0), np.array([0.3, 0.9, 0.3]), 2.0, "base")


def test_a_plane_keeps_clear_of_vertices_near_it():
    assert clear_height_mm(np.array([0.0, 5.0]), 2.0, 1e-3) == 2.0
    near = np.array([0.0, 2.0 - 4e-3, 2.0, 2.0 + 1e-3, 5.0])
    assert clear_height_mm(near, 2.0, 1e-3) == pytest.approx(2.0 + 33e-3)
    crowded = 2.0 + np.arange(-100, 3000) * 1e-3
    assert np.abs(crowded - clear_height_mm(crowded, 2.0, 1e-3)).min() == pytest.approx(0.5e-3)


def test_a_socle_carries_the_bust_and_a_nameplate_only_where_asked():
    cut = trimmed(ball(48, 40.0), height_mm=-20.0)
    plain = Solid.from_surface(with_socle(cut))
    assert plain.volume_mm3 > cut.volume_mm3 and "nameplate" not in plain.surface.part_names
    low = plain.surface.vertices[:, 1].min()
    standing = np.ptp(plain.surface.vertices[plain.surface.vertices[:, 1] < low + 1e-9], axis=0)
    # wider than what stood before, by a plinth on both sides
    assert (standing[[0, 2]] > 2 * np.sqrt(40**2 - 20**2) * 1.15).all()
    assert (plain.surface.origin_of_face[plain.surface.part_of_face == plain.surface.part_names.index("socle")] == INVENTED).all()
    named = Solid.from_surface(with_socle(cut, nameplate="ADA"))
    assert "nameplate" in named.surface.part_names and named.volume_mm3 > plain.volume_mm3
    with pytest.raises(SurfaceError, match="does not stand flat"):
        with_socle(ball(48, 40.0))


def test_a_hollow_back_leaves_a_front_of_even_wall_that_holds_nothing_lying_down():
    relief = close_relief(dome(), back_mm=6.0)
    made = Solid.from_surface(hollow_back(relief.surface, wall_mm=2.0))
    assert made.volume_mm3 < 0.75 * relief.volume_mm3
    top = made.surface.vertices[np.abs(made.surface.vertices[:, :2]).max(axis=1) < 1.0]
    assert np.ptp(top[:, 2]) == pytest.approx(2.0, abs=0.15)
    with pytest.raises(SurfaceError, match="closed with a back plane"):
        hollow_back(BALL, wall_mm=1.0)


def test_advice_prefers_the_cup_that_neither_holds_resin_nor_hangs_over():
    profile = printer("prusa-sl1s")
    upright, over = judge(CUP, profile, Z, Z), judge(CUP, profile, (0, 0, -1), Z)
    assert upright.held_mm3 == pytest.approx(np.pi * 64 * 18, rel=0.05) and over.held_mm3 == 0.0
    assert upright.islands == 0 and over.islands == 0 and over.tilt_deg == pytest.approx(180)
    # upside down the cup's inner floor is a ceiling
    assert over.overhang_mm2 == pytest.approx(np.pi * 64, rel=0.01)
    shelf = turned([(0, 0), (3, 0), (3, 10), (8, 9), (8, 12), (0, 12)])
    assert judge(shelf, profile, Z, Z, 0.1).islands == 1
    found = advise(CUP, profile, up=Z, step_mm=0.5)
    assert found[0].fits and all(f.fits for f in found) and found[0].to_dict()["islands"] <= upright.islands


def test_sheets_nearer_than_a_slicer_welds_are_told():
    gap = 1e-4
    plates = join([Surface(CUBE_CORNERS, CUBE_FACES), Surface(CUBE_CORNERS + [0, 0, 1 + gap], CUBE_FACES)])
    (said,) = weld_findings(plates, 2 * gap)
    assert said.code == "weld-sensitive" and "joins 4 vertices" in said.message
    assert weld_findings(plates, gap / 2) == [] and welded_within(plates, gap / 2) is plates


def test_a_planted_closed_pocket_is_found_with_its_volume_to_two_per_cent():
    inner = ball(48, 6.0)
    shell = join([ball(48, 10.0), Surface(inner.vertices, inner.faces[:, ::-1])])
    # the wall of 4 mm is thinner than two of 2.5: no cavity of its own, so the planted one is all there is to find
    from rangecheck.solid.drainage import pockets

    (pocket,) = pockets(shell, Z)
    assert pocket.closed and pocket.volume_mm3 == pytest.approx(4 / 3 * np.pi * 6**3, rel=0.02)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """STL files of parts of every kind that the project makes, and the hollowed one among them."""
    folder = tmp_path_factory.mktemp("written")
    made = hollow(Solid.from_surface(ball(64, 15.0)), wall_mm=2.5, up=(0, 1, 0))
    parts = {
        "ring": Solid.from_surface(torus(60, 40)),
        "hollow": made.solid,
        "plug": made.plugs[0],
        "socle": Solid.from_surface(with_socle(trimmed(ball(48, 20.0), height_mm=-10.0), nameplate="A")),
        "relief": close_relief(dome(), back_mm=6.0),
        "filled": Solid.from_surface(repair(BALL.with_faces(BALL.triangles.mean(axis=1)[:, 2] < 9.0)).surface),
    }
    for name, part in parts.items():
        write_stl(part, folder / f"{name}.stl")
    write_stl(parts["ring"], folder / "ring_ascii.stl", ascii=True)
    return folder


def test_ascii_says_what_binary_says(written):
    one, other = read_mesh(written / "ring.stl", "mm"), read_mesh(written / "ring_ascii.stl", "mm")
    assert np.array_equal(one.vertices, other.vertices) and np.array_equal(one.faces, other.faces)
    assert stl_bytes(cube(), ascii=True).startswith(b"solid")


def needs(program):
    return pytest.mark.skipif(shutil.which(program) is None, reason=f"{program} is not installed")


def said_by(*command):
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@needs("prusa-slicer")
def test_prusa_slicer_calls_every_stl_manifold_and_slices_the_hollow_one(written, tmp_path):
    for path in sorted(written.glob("*.stl")):
        assert "manifold = yes" in said_by("prusa-slicer", "--info", path), path.name
    said_by("prusa-slicer", "--export-sla", "--printer-technology", "SLA", "-o", tmp_path / "hollow.sl1", written / "hollow.stl")
    assert (tmp_path / "hollow.sl1").stat().st_size > 10_000


@needs("admesh")
def test_admesh_finds_no_disconnected_edge_in_any_stl(written):
    for path in sorted(written.glob("*.stl")):
        (line,) = (row for row in said_by("admesh", path).splitlines() if row.startswith("Total disconnected facets"))
        assert line.split(":")[1].split() == ["0", "0"], path.name


@pytest.mark.engines
def test_meshlab_finds_no_boundary_and_no_non_manifold_edge_in_any_stl(written):
    code = (
        "import sys, json, pymeshlab\n"
        "for path in sys.argv[1:]:\n"
        "    m = pymeshlab.MeshSet(verbose=False); m.load_new_mesh(path); m.meshing_remove_duplicate_vertices()\n"
        "    f = m.get_topological_measures(); print(json.dumps([int(f[k]) for k in ('boundary_edges', 'non_two_manifold_edges', 'non_two_manifold_vertices')]))\n"
    )
    paths = sorted(written.glob("*.stl"))
    rows = [json.loads(row) for row in said_by(sys.executable, "-c", code, *paths).splitlines() if row.startswith("[")]
    assert rows == [[0, 0, 0]] * len(paths)


def run(*arguments):
    return CliRunner().invoke(cli, [str(a) for a in arguments], standalone_mode=False)


def test_the_command_closes_cuts_scales_thins_hollows_and_says_how(tmp_path):
    open_ball = ball(48, 20.0).with_faces(np.flatnonzero(ball(48, 20.0).triangles.mean(axis=1)[:, 2] < 18.5))
    write_mesh(open_ball, tmp_path / "open.ply")
    out = tmp_path / "part.stl"
    done = run(
        "solid", tmp_path / "open.ply", "--unit", "mm", "-o", out, "--height-mm", "40", "--cut", "1,0,0,-15", "--simplify-mm", "auto",
        "--printer", "prusa-sl1s", "--wall-mm", "3", "--orient", "-q",
    )  # fmt: skip
    assert done.exception is None, done.exception
    assert "Original" in done.output and "proved to drain" in done.output and "which way up" in done.output
    said = json.loads((tmp_path / "part.stl.json").read_text())
    assert said["schema"] == "rangecheck/solid/1" and said["hollow"]["kept"] == [] and said["repair"]["moved_mm"] == 0.0
    assert (
        said["inputs"]["open.ply"]
        and said["areas"]["parts"]["filled"]["invented"] > 0
        and said["simplified"]["error_mm"] <= 0.0125
    )
    assert said["read_back"]["fit"] and len(said["plugs"]) == len(said["hollow"]["drains"]) >= 1
    back = read_mesh(out, "mm")
    assert np.ptp(back.vertices[:, 1]) == pytest.approx(40, abs=1e-3)
    again = run("solid", tmp_path / "open.ply", "--unit", "mm", "-o", out)
    assert "exists already" in str(again.exception)


def test_what_is_no_solid_is_written_only_when_forced_and_severities_can_be_overridden(tmp_path):
    sheet = Surface(grid(6, 6).vertices * [1.0, 1.0, 0.0], grid(6, 6).faces)
    write_mesh(sheet, tmp_path / "flat.ply")
    refused = run("solid", tmp_path / "flat.ply", "--unit", "mm", "-o", tmp_path / "flat.stl", "--close", "repair", "-q")
    assert refused.return_value == 1 and "nothing was written" in refused.output and not (tmp_path / "flat.stl").exists()
    forced = run(
        "solid", tmp_path / "flat.ply", "--unit", "mm", "-o", tmp_path / "flat.stl", "--close", "repair", "--force-open", "-q"
    )
    assert forced.return_value == 1 and (tmp_path / "flat.stl").exists()
    other = run("solid", tmp_path / "flat.ply", "--unit", "mm", "-o", tmp_path / "flat.3mf", "--force-open", "-q")
    assert "--force-open is for" in str(other.exception) and not (tmp_path / "flat.3mf").exists()
    crumbs = join([cube(10.0), cube(0.5, (20, 0, 0))])
    write_mesh(crumbs, tmp_path / "crumbs.ply")
    check = ("check", tmp_path / "crumbs.ply", "--unit", "mm", "-q")
    assert run(*check).return_value == 0
    assert run(*check, "--set", "checking.severities.noise-shells=error").return_value == 1
    for suffix in ("3mf", "glb", "ply"):
        assert (
            run(
                "solid", tmp_path / "crumbs.ply", "--unit", "mm", "-o", tmp_path / f"one.{suffix}", "--base", "none", "-q"
            ).return_value
            == 0
        )
        assert read_mesh(tmp_path / f"one.{suffix}", None if suffix != "ply" else "mm").volume_mm3 == pytest.approx(
            1000.125, rel=1e-5
        )


def test_studies_of_checking_and_repair_answer_at_their_smallest():
    from rangecheck.studies.checking import bumpy_torus
    from rangecheck.studies.repair import _error_at

    ring = bumpy_torus(2000)
    assert Solid.from_surface(ring).verdict.facts["genus"] == 1 and abs(len(ring.faces) - 2000) < 100
    assert _error_at("hole", "rangecheck", 24, 10.0) < 1.0 and _error_at("doubled", "rangecheck", 24, 0.5) < 1e-9
    assert _error_at("overlap", "manifold3d", 24, 10.0) < 1e-6
