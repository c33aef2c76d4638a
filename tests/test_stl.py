"""What the STL says is what was proved: bytes, float32, and the refusal of what rounding spoils."""

import struct

import numpy as np
import pytest
from test_topology import grid, torus
from test_topology_distance import CUBE_CORNERS, CUBE_FACES, cube

from rangecheck.errors import NotSolid, OutputError
from rangecheck.export.meshes import write_mesh
from rangecheck.export.stl import as_float32, write_stl
from rangecheck.rigid import move_points
from rangecheck.solid import Solid
from rangecheck.solid.rounding import collapse_flat_faces
from rangecheck.surface import Surface
from rangecheck.surface import topology as topo
from rangecheck.surface.mesh_files import open_mesh, read_mesh
from rangecheck.surface.standing import file_from_scans, lowered_in


def test_a_written_solid_is_read_back_with_its_volume_and_the_same_bytes_each_time(tmp_path):
    ring = Solid.from_surface(torus(40, 30))
    exported = write_stl(ring, tmp_path / "a.stl")
    write_stl(ring, tmp_path / "b.stl")
    content = (tmp_path / "a.stl").read_bytes()
    assert content == (tmp_path / "b.stl").read_bytes()
    # what prints the head as text finds its end
    assert b"\0" in content[:80]
    assert len(content) == 84 + 50 * exported.faces == 84 + 50 * struct.unpack("<I", content[80:84])[0]
    back = read_mesh(tmp_path / "a.stl", "mm")
    assert back.volume_mm3 == pytest.approx(ring.volume_mm3, rel=1e-6)
    assert exported.verdict.fit and 0 < exported.moved_mm <= np.spacing(np.float32(4.0)) / 2


def test_normals_in_the_file_point_outwards(tmp_path):
    write_stl(Solid.from_surface(cube(2.0)), tmp_path / "c.stl")
    rows = np.frombuffer((tmp_path / "c.stl").read_bytes()[84:], np.dtype([("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")]))
    assert (np.einsum("ij,ij->i", rows["n"], rows["c"].mean(axis=1)) > 0.9).all()


@pytest.mark.parametrize("name", ["a.stl", "text.stl", "a.3mf"])
def test_a_part_stands_on_its_base_for_slicers_and_is_read_in_its_own_frame_here(tmp_path, name):
    import trimesh

    # y up, and the front towards +z, as in the frame of scans; lengths that float32 says exactly
    lying = Solid.from_surface(Surface(CUBE_CORNERS * [2.0, 5.0, 1.5] + [7.0, -20.25, 3.0], CUBE_FACES))
    written = write_mesh(lying, tmp_path / name, stand=True, ascii=name == "text.stl")
    (x0, y0, z0), (x1, y1, z1) = lying.surface.bounds_mm
    seen = trimesh.load_mesh(tmp_path / name).bounds
    np.testing.assert_array_equal(seen, [[x0, -z1, 0.0], [x1, -z0, y1 - y0]])
    back = read_mesh(tmp_path / name, "mm")
    np.testing.assert_array_equal(back.bounds_mm, lying.surface.bounds_mm)
    assert back.volume_mm3 == pytest.approx(lying.volume_mm3)
    motion = file_from_scans(written.lowered_mm)
    corners = move_points(motion, lying.surface.vertices)
    np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], seen)


def test_the_head_of_a_standing_file_holds_every_digit_of_how_far_it_was_lowered(tmp_path):
    far = -1.2345678901234567e-05
    write_stl(Solid.from_surface(Surface(CUBE_CORNERS * 0.5 + [0.0, far, 0.0], CUBE_FACES)), tmp_path / "a.stl", stand=True)
    head = (tmp_path / "a.stl").read_bytes()[:80]
    assert lowered_in(head) == pytest.approx(far, abs=1e-15) and not head.startswith(b"solid")
    assert lowered_in(b"solid written by somebody else, z up, lowered by 3") is None


def test_only_a_solid_is_written_unless_an_open_file_is_forced(tmp_path):
    with pytest.raises(NotSolid, match="only a Solid"):
        write_stl(grid(2, 2), tmp_path / "open.stl")
    assert not (tmp_path / "open.stl").exists()
    exported = write_stl(grid(2, 2), tmp_path / "open.stl", force_open=True)
    assert exported.verdict.has("open-edges") and len(topo.boundary_edges(open_mesh(tmp_path / "open.stl", "mm").surface)) == 8


def test_a_solid_that_float32_cannot_say_is_refused_and_leaves_no_file(tmp_path):
    # steps of float32 at 2e7 mm are 2 mm: a wall of 0.5 mm closes to a sheet
    thin = Solid.from_surface(Surface(CUBE_CORNERS * [5.0, 5.0, 0.5] + 2e7, CUBE_FACES))
    with pytest.raises(NotSolid, match="read back as float32"):
        write_stl(thin, tmp_path / "thin.stl")
    assert list(tmp_path.iterdir()) == []


def test_faces_that_rounding_flattens_are_collapsed_and_the_rest_stays_closed(tmp_path):
    # two vertices nearer to each other than float32 can tell, and one that falls onto its face's longest edge
    fine = Surface(CUBE_CORNERS + 4096.0, CUBE_FACES)
    corners = np.concatenate([fine.vertices, [fine.vertices[0] + [0.5, 1e-6, 0]]])
    faces = [f for f in CUBE_FACES.tolist() if f not in ([0, 2, 1], [0, 1, 5])]
    split = Surface(corners, np.array([*faces, [8, 1, 5], [0, 8, 5], [0, 2, 8], [8, 2, 1]]))
    assert topo.is_closed(split)
    rounded, _ = as_float32(split)
    assert len(topo.degenerate_faces(rounded)) == 0 or topo.is_closed(collapse_flat_faces(rounded))
    written = write_stl(Solid.from_surface(split), tmp_path / "fine.stl")
    assert written.verdict.fit


def test_existing_files_and_folders_are_respected(tmp_path):
    solid = Solid.from_surface(cube())
    write_stl(solid, tmp_path / "x.stl")
    with pytest.raises(OutputError, match="exists already"):
        write_stl(solid, tmp_path / "x.stl", force=False)
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="is a folder"):
        write_stl(solid, tmp_path / "folder")


@pytest.mark.parametrize("suffix", ["ply", "obj", "off", "glb", "3mf"])
def test_every_mesh_format_is_read_back_as_the_same_closed_surface(tmp_path, suffix):
    ring = torus(20, 12)
    parts = (ring.triangles.mean(axis=1)[:, 0] > 0).astype(np.int32)
    ring = Surface(
        ring.vertices, ring.faces, parts, (2 * parts).astype(np.uint8), ("left", 'right "half"'), np.full(len(ring.vertices), 0.1)
    )
    path = tmp_path / f"ring.{suffix}"
    write_mesh(ring, path)
    first = path.read_bytes()
    write_mesh(ring, path)
    assert path.read_bytes() == first
    back = read_mesh(path, None if suffix in ("glb", "3mf") else "mm")
    assert topo.is_closed(back) and back.volume_mm3 == pytest.approx(ring.volume_mm3, rel=1e-12 if suffix != "glb" else 1e-5)
    assert len(back.vertices) == len(ring.vertices)


def test_a_mesh_of_unknown_ending_is_refused(tmp_path):
    with pytest.raises(OutputError, match="a mesh ends in"):
        write_mesh(cube(), tmp_path / "x.step")


@pytest.mark.parametrize("suffix", ["ply", "glb", "3mf"])
def test_a_solid_in_any_format_is_read_back_and_judged(tmp_path, suffix):
    write_mesh(Solid.from_surface(torus(24, 16)), tmp_path / f"ring.{suffix}")
    thin = Solid.from_surface(Surface(CUBE_CORNERS * [5.0, 5.0, 0.5] + 2e7, CUBE_FACES))
    if suffix == "glb":
        with pytest.raises(NotSolid, match="read back"):
            write_mesh(thin, tmp_path / "thin.glb")
        assert not (tmp_path / "thin.glb").exists()
    else:
        write_mesh(thin, tmp_path / f"thin.{suffix}")
