"""What is asked wrongly is answered in one line that names the file or the option, the rule, the value and the next step."""

import numpy as np
import pytest
from test_cli import complaint

from rangecheck.export.meshes import write_mesh
from rangecheck.modeler.primitives import sphere
from rangecheck.surface import Surface
from rangecheck.surface.mesh_files import read_mesh


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A ball, a flat cap of it, a text, an empty folder."""
    folder = tmp_path_factory.mktemp("wrong")
    body = sphere(40.0, 2.0)
    ball = Surface(body.vertices, body.faces)
    write_mesh(ball, folder / "ball.ply")
    write_mesh(ball.with_faces(np.arange(40)), folder / "cap.ply")
    (folder / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "note.txt").write_text("hello\n")
    (folder / "empty").mkdir()
    return folder


WRONG = [
    ("run nothere --out o", ("nothere: does not exist; check the name",)),
    ("run note.txt --unit mm --out o", ("note.txt: holds no line of numbers",)),
    ("run empty --out o", ("empty: holds no scans among its 0 files; scans end in",)),
    ("run ball.ply --out o --set turntable.framez=7", ("turntable.framez is unknown; did you mean turntable.frames?",)),
    ("run ball.ply --out o --set scan.profile=bust-100", ("scan.profile is 'bust-100'", "'bust-150'")),
    ("run ball.ply --out o --size 640", ("'640' is not a size; write WIDTHxHEIGHT",)),
    ("render ball.ply --unit mm -o x.png --camera nan,2,3", ("--camera", "'nan,2,3' is not a point; write X,Y,Z")),
    ("render one.obj -o x.png", ("one.obj: the file does not say its unit", "--unit mm")),
    ("render ball.ply --unit mm -o x.bmp", ("x.bmp: must end in .png",)),
    ("solid ball.ply --unit mm -o b.stl --print-up 0,0,0", ("solid.print_up is (0.0, 0.0, 0.0)", "for example [0, 1, 0]")),
    ("solid ball.ply --unit mm -o b.xyz", ("b.xyz: ends in .xyz; a mesh ends in",)),
    ("solid ball.ply --unit mm -o ball.ply --force", ("ball.ply: is read by this command; choose another place",)),
    ("draw ball.ply -o x.svg", ("ball.ply: is no modelled scene", ".toml")),
    ("decode nothere -o d.npz", ("nothere: does not exist; check the name",)),
    ("decode note.txt -o d.npz", ("note.txt: is a file; give the folder",)),
    ("fit note.txt -o f.toml --sphere 1,2", ("--sphere", "'1,2' is not a circle; write COLUMN,ROW,RADIUS in pixels")),
    ("fit picture.png -o f.toml --sphere 9,9,50 --on ball.ply", ("one of --sphere COLUMN,ROW,RADIUS and --on MESH",)),
    ("fit picture.png -o f.toml --sphere 9,9,500 --calibrate chrome", ("radius 500", "16x12; give its outline")),
    ("fit text.png -o f.toml --sphere 9,9,5 --calibrate chrome", ("text.png: is no picture that can be read; JPEG, PNG",)),
    ("fit empty -o f.toml", ("f.toml: must end in .png",)),
    ("simulate ball.ply --unit mm -o s --finder lost_shares=1", ("no 'lost_shares'; did you mean lost_share?",)),
    ("simulate ball.ply --unit mm -o s --finder lost_share", ("--finder takes key=value; got 'lost_share'",)),
    ("simulate ball.ply --unit mm -o s --drift 1,2", ("'1,2' is not a velocity; write X,Y,Z in mm/s",)),
    ("study registraton -o st", ("'registraton'; did you mean registration?",)),
    ("materials -o note.txt", ("note.txt: is a file; the plots need a folder",)),
    ("completion tcsh", ("'tcsh' is not one of 'bash', 'zsh', 'fish'",)),
    ("turntable ball.ply --unit mm -o t.mp4 --material stel", ("stel: is no shipped material; choose one of",)),
    ("turntable ball.ply --unit mm -o t.mp4 --scheduler nonsense --frames 2 --size 16x16", ("'nonsense' is no address", "tcp://HOST:PORT")),
    ("dataset ball.ply --unit mm -o ds --count 1000000000 --dry-run", ("ds: may need", "MB free; make room")),
    ("check note.txt --log note.txt", ("note.txt: is no log of rangecheck; choose another --log",)),
    ("report empty", ("empty: holds no finished job (no run.json); `rangecheck run` makes one",)),
    ("schema configuratoin", ("did you mean configuration?",)),
    ("explain open-edge", ("did you mean open-edges?",)),
    ("init -o note.txt", ("note.txt: must end in .toml",)),
]  # fmt: skip


@pytest.mark.parametrize("asked, said", WRONG, ids=lambda value: value if isinstance(value, str) else "")
def test_a_wrong_wish_is_answered_with_the_rule_the_value_and_the_next_step(asked, said, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    if "picture.png" in asked:
        from rangecheck.export.pictures import write_png

        write_png("picture.png", np.zeros((12, 16), np.uint8))
    if "text.png" in asked:
        (folder / "text.png").write_text("hello\n")
    told = complaint(capsys, *asked.split())
    for part in said:
        assert part in told, told
    assert " 0x" not in told and "Error" not in told


def test_a_surface_that_is_open_is_no_stl_and_is_told_what_makes_one(folder, sample_data, tmp_path, capsys, monkeypatch):
    half = read_mesh(folder / "ball.ply").vertices
    np.savetxt(tmp_path / "half.xyz", half[half[:, 2] > 0.0])
    told = complaint(
        capsys, "mesh", tmp_path / "half.xyz", "--unit", "mm", "--method", "pivot", "-o", tmp_path / "half.stl", "-q"
    )
    assert "boundary edges; write a .ply" in told and "rangecheck solid" in told
    # a single scan's grid is open whatever it shows: nothing is computed first
    monkeypatch.setattr("rangecheck.pipeline.scanning.prepared", lambda *_: pytest.fail("the scan was prepared"))
    for more in ([], ["--method", "grid"]):
        told = complaint(capsys, "mesh", sample_data / "frontal", "-o", tmp_path / "face.stl", "-q", *more)
        assert "is open: nothing behind it was seen; write a .ply" in told and "rangecheck solid" in told
    assert [path.name for path in tmp_path.iterdir()] == ["half.xyz"]


def test_a_focal_point_on_the_surface_has_no_distances(folder, tmp_path, capsys):
    told = complaint(capsys, "maps", folder / "one.obj", "--unit", "mm", "-o", tmp_path / "m", "--camera", "0,0,0")
    assert "the focal point (0.0, 0.0, 0.0) mm" in told and "say another --camera" in told
