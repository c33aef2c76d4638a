"""Mesh files of every kind come to the same surface, and what is wrong with a file is said in one line."""

import struct
import sys
import tracemalloc
import zipfile

import numpy as np
import pytest
from test_topology_distance import CUBE_CORNERS, CUBE_FACES, cube

from rangecheck.errors import DependencyMissing, InputError, UnitMissing
from rangecheck.export.meshes import write_mesh
from rangecheck.surface import Surface
from rangecheck.surface import topology as topo
from rangecheck.surface.mesh_files import open_mesh, read_mesh
from rangecheck.surface.weld import weld_exactly

QUADS = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]


def binary_stl(triangles, header=b"made by hand"):
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *np.asarray(t, float).ravel(), 0) for t in triangles)
    return header.ljust(80) + struct.pack("<I", len(triangles)) + rows


def ascii_stl(triangles):
    lines = ["solid by hand"]
    for t in triangles:
        lines += [
            "facet normal 0 0 0",
            " outer loop",
            *(f"  vertex {x!r} {y!r} {z!r}" for x, y, z in t.tolist()),
            " endloop",
            "endfacet",
        ]
    return "\n".join([*lines, "endsolid by hand"]).encode()


def ascii_ply(faces, header_end="\n"):
    head = ["ply", "format ascii 1.0", "comment corners", "element vertex 8", "property float x", "property float y", "property float z",
            "property uchar red", f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]  # fmt: skip
    rows = [f"{x} {y} {z} 7" for x, y, z in CUBE_CORNERS.tolist()] + [" ".join(map(str, [len(f), *f])) for f in faces]
    return header_end.join(head + rows).encode() + header_end.encode()


def binary_ply(order, faces):
    name = {"<": "little", ">": "big"}[order]
    head = (
        f"ply\nformat binary_{name}_endian 1.0\nelement vertex 8\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar uint vertex_index\nproperty short label\nend_header\n"
    )
    body = CUBE_CORNERS.astype(order + "f8").tobytes()
    return head.encode() + body + b"".join(struct.pack(f"{order}B{len(f)}Ih", len(f), *f, 3) for f in faces)


def obj(faces):
    rows = [f"v {x} {y} {z} 1.0" for x, y, z in CUBE_CORNERS.tolist()]
    return "\n".join(
        ["mtllib ../../etc/passwd", *rows, "vt 0 0", *("f " + " ".join(f"{i + 1}/1/1" for i in f) for f in faces)]
    ).encode()


def off(faces):
    rows = [f"{x} {y} {z}" for x, y, z in CUBE_CORNERS.tolist()] + [" ".join(map(str, [len(f), *f])) for f in faces]
    return "\n".join(["OFF", "# corners", f"8 {len(faces)} 0", *rows]).encode()


TRIANGLES = CUBE_CORNERS[CUBE_FACES]
CUBES = {
    "binary.stl": binary_stl(TRIANGLES),
    "solid_binary.stl": binary_stl(TRIANGLES, b"solid facet says it is ASCII"),
    "ascii.STL": ascii_stl(TRIANGLES),
    "upper.stl": ascii_stl(TRIANGLES).upper(),
    "triangles.ply": ascii_ply(CUBE_FACES.tolist()),
    "crlf.ply": ascii_ply(CUBE_FACES.tolist(), "\r\n"),
    "quads.ply": ascii_ply(QUADS),
    "little.ply": binary_ply("<", CUBE_FACES.tolist()),
    "big.ply": binary_ply(">", CUBE_FACES.tolist()),
    "big_quads.ply": binary_ply(">", QUADS),
    "cube.obj": obj(QUADS),
    "relative.obj": obj([[i - 8 - 1 for i in f] for f in QUADS]),
    "cube.off": off(QUADS),
}


@pytest.mark.parametrize("name", CUBES)
def test_every_kind_of_file_gives_the_same_cube(tmp_path, name):
    (tmp_path / name).write_bytes(CUBES[name])
    read = read_mesh(tmp_path / name, "cm")
    assert len(read.vertices) == 8 and len(read.faces) == 12 and topo.is_closed(read)
    assert read.volume_mm3 == pytest.approx(1000.0)
    with pytest.raises(UnitMissing, match="--unit mm, cm, m, um or in"):
        read_mesh(tmp_path / name)


def test_our_own_ply_says_its_unit_and_keeps_its_labels(tmp_path):
    box = cube(2.0)
    origin, part = (np.arange(12) % 3).astype(np.uint8), (np.arange(12) % 2).astype(np.int32)
    error = np.linspace(0.1, 0.8, 8)
    write_mesh(Surface(box.vertices, box.faces, part, origin, ('a "first"', "base"), error, part == 1), tmp_path / "box.ply")
    found = open_mesh(tmp_path / "box.ply")
    assert found.unit == "mm" and found.surface.part_names == ('a "first"', "base")
    np.testing.assert_array_equal(found.surface.origin_of_face, origin)
    np.testing.assert_array_equal(found.surface.part_of_face, part)
    np.testing.assert_array_equal(found.surface.refined_of_face, part == 1)
    np.testing.assert_allclose(found.surface.vertex_error_mm, error, rtol=1e-6)
    # a unit that is asked for goes first; labels that contradict their legend are none
    assert open_mesh(tmp_path / "box.ply", "cm").surface.volume_mm3 == pytest.approx(8000)
    content = (tmp_path / "box.ply").read_bytes()
    (tmp_path / "one.ply").write_bytes(content.replace(b'comment part 1 "base"\n', b""))
    assert read_mesh(tmp_path / "one.ply").part_names == ("one",)


@pytest.mark.parametrize(("kind", "volume_mm3"), [("glb", 8e9), ("3mf", 8.0)])
def test_glb_is_in_metres_and_3mf_says_its_unit(tmp_path, kind, volume_mm3):
    import trimesh

    pytest.importorskip("lxml", reason="trimesh reads and writes 3MF with lxml")
    trimesh.Trimesh(cube().vertices, cube().faces, process=False).export(tmp_path / f"c.{kind}")
    read = open_mesh(tmp_path / f"c.{kind}")
    assert read.surface.volume_mm3 == pytest.approx(volume_mm3, rel=1e-6) and topo.is_closed(read.surface)


@pytest.mark.parametrize("lacking", ["networkx", "lxml"])
def test_what_reading_3mf_lacks_is_named(tmp_path, monkeypatch, lacking):
    path = three_mf(tmp_path / "one.3mf", TETRAHEDRON, '<item objectid="1"/>')
    monkeypatch.setitem(sys.modules, lacking, None)
    with pytest.raises(DependencyMissing, match=rf"^{lacking} is needed for reading 3MF .*rangecheck\[formats\]"):
        read_mesh(path)


def test_what_is_odd_is_said(tmp_path):
    path = tmp_path / "odd.stl"
    path.write_bytes(binary_stl(TRIANGLES, b"solid") + b"attached")
    notes = " ".join(open_mesh(path, "mm").notes)
    assert "8 bytes follow the last of the 12 faces" in notes and "is binary" in notes and "36 corners were welded to 8" in notes


def test_zero_and_minus_zero_are_one_point_and_neighbours_are_not():
    points = np.array([[0.0, 1, 2], [-0.0, 1, 2], [np.nextafter(np.float32(0), np.float32(1)), 1, 2]], np.float32)
    first, number = weld_exactly(points)
    assert first.tolist() == [0, 2] and number.tolist() == [0, 0, 1]


def test_welding_agrees_with_sorting():
    points = np.random.default_rng(2).integers(-3, 4, (5000, 3)).astype(np.float64)
    first, number = weld_exactly(points)
    assert np.array_equal(points[first][number], points)
    assert len(first) == len(np.unique(points, axis=0)) and (np.diff(first) > 0).all()


BROKEN = {
    "nothing.stl": (b"", "is empty"),
    "short.stl": (b"abc", "too short for STL"),
    "none.stl": (binary_stl([]), "holds no faces"),
    "headless.stl": (b"solid x\nendsolid x\n", "holds no faces"),
    "cut.stl": (binary_stl(TRIANGLES)[:-20], "header counts 12 faces, its 664 bytes have room for 11"),
    "lies.stl": (b"x" * 80 + b"\xff\xff\xff\xff" + b"y" * 50, "header counts 4294967295 faces"),
    "nan.stl": (binary_stl([[[0, 0, 0], [1, 0, 0], [np.nan, 1, 0]]]), "1 faces have corners that are not finite numbers, the first in face 0"),
    "cut_ascii.stl": (ascii_stl(TRIANGLES)[:-300], "cut off or damaged"),
    "comma.stl": (ascii_stl(TRIANGLES).replace(b"1.0", b"1,0"), "a comma stands where a point is due"),
    "cut.ply": (binary_ply("<", QUADS)[:-9], "ends within its 6 face elements"),
    "cut_ascii.ply": (ascii_ply(QUADS)[:-9], "ends within its 6 face elements"),
    "endless.ply": (b"ply\nformat ascii 1.0\nelement vertex 3\n", "header does not end"),
    "huge.ply": (b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\nproperty float x\nproperty float y\nproperty float z\n"
                 b"element face 1\nproperty list uchar int vertex_indices\nend_header\n", "ends within its 999999999999 vertex"),
    "word.ply": (b"ply\nformat ascii 1.0\nelement vertex three\nend_header\n", "is not PLY"),
    "cloud.ply": (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n",
                  "points without faces"),
    "scan.ply": (b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nelement range_grid 0\nproperty list uchar int i\nend_header\n",
                 "a range scan, not a mesh"),
    "index.ply": (ascii_ply([[0, 1, 99]]), "faces name vertices 0 to 99, and it has 8"),
    "bad.obj": (b"v 0 0 zero\n", "line 1 is not OBJ"),
    "index.obj": (b"v 0 0 0\nf 1 2 3\n", "name vertices 0 to 2"),
    "bad.off": (b"OFF\n3 1 0\n0 0 0\n", "the file is cut off"),
    "bad.glb": (b"glTF\x02\x00\x00\x00", "cannot be read as GLB"),
    "bad.3mf": (b"PK\x03\x04", "cannot be read as 3MF"),
    "picture.png": (b"\x89PNG", "mesh files end in stl, ply"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_refused_in_one_line_that_names_it(tmp_path, name):
    content, words = BROKEN[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as refusal:
        read_mesh(tmp_path / name, "mm")
    assert words in str(refusal.value) and name in str(refusal.value) and "\n" not in str(refusal.value)


def test_coordinates_beyond_reckoning_are_refused(tmp_path):
    write_mesh(cube(2.0), tmp_path / "box.ply")
    read = (tmp_path / "box.ply").read_bytes()
    far = read.replace(np.array([1.0]).tobytes(), np.array([1e200]).tobytes())
    (tmp_path / "far.ply").write_bytes(far)
    with pytest.raises(InputError, match=r"coordinates up to 1e\+200 mm, beyond"):
        read_mesh(tmp_path / "far.ply")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_mesh(tmp_path / "missing.stl", "mm")


@pytest.mark.real_data
def test_the_zippered_bunny_is_as_open_as_it_is_known_to_be(real_data):
    bunny = read_mesh(real_data / "stanford_bunny" / "bun_zipper.ply", "m")
    assert len(topo.boundary_edges(bunny)) == 223 and len(topo.boundary_loops(bunny)) == 5
    assert len(topo.unreferenced_vertices(bunny)) == 1113
    assert 150 < np.ptp(bunny.vertices, axis=0).max() < 160


def test_a_3mf_that_unpacks_to_many_times_its_size_is_refused_before_it_is_unpacked(tmp_path):
    path = tmp_path / "bomb.3mf"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("3D/3dmodel.model", "w") as model:
        for _ in range(40):
            model.write(b'<vertex x="0" y="0" z="0"/>' * (1 << 15))
    tracemalloc.start()
    with pytest.raises(InputError, match=r"unpacks from \d+ to 35389440 bytes, more than 60 times"):
        read_mesh(path)
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()


def three_mf(path, objects: str, items: str):
    """A 3MF with these objects and items."""
    kinds = '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types"/>'
    core = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
    model = f'<model unit="millimeter" xmlns="{core}"><resources>{objects}</resources><build>{items}</build></model>'
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("[Content_Types].xml", kinds)
        archive.writestr("3D/3dmodel.model", model)
    return path


TETRAHEDRON = (
    '<object id="1" type="model"><mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="6" y="0" z="0"/><vertex x="0" y="6" z="0"/>'
    '<vertex x="0" y="0" z="6"/></vertices><triangles><triangle v1="0" v2="2" v3="1"/><triangle v1="0" v2="1" v3="3"/>'
    '<triangle v1="0" v2="3" v3="2"/><triangle v1="1" v2="2" v3="3"/></triangles></mesh></object>'
)


def test_parts_of_parts_of_a_3mf_are_placed_each_time_and_mirrored_ones_still_face_outward(tmp_path):
    mirrored = '<component objectid="1" transform="-1 0 0 0 1 0 0 0 1 -20 0 0"/>'
    pair = f'<object id="2"><components><component objectid="1"/>{mirrored}</components></object>'
    moved = '<item objectid="2" transform="1 0 0 0 1 0 0 0 1 0 50 0"/>'
    surface = read_mesh(three_mf(tmp_path / "four.3mf", TETRAHEDRON + pair, f'<item objectid="2"/>{moved}'))
    assert len(surface.faces) == 16
    assert surface.volume_mm3 == pytest.approx(4 * 36.0)


@pytest.mark.parametrize("last", ["1", "29"])
def test_a_3mf_whose_parts_hold_each_other_too_often_or_in_a_circle_is_refused(tmp_path, last):
    twice = "".join(
        f'<object id="{k}"><components>{f"""<component objectid="{last if k == 2 else k - 1}"/>""" * 2}</components></object>'
        for k in range(2, 30)
    )
    with pytest.raises(InputError, match="places its parts more than"):
        read_mesh(three_mf(tmp_path / "deep.3mf", TETRAHEDRON + twice, '<item objectid="29"/>'))


def test_a_3mf_whose_members_are_damaged_is_refused(tmp_path):
    path = three_mf(tmp_path / "good.3mf", TETRAHEDRON, '<item objectid="1"/>')
    content = path.read_bytes()
    member, listed = content.rindex(b"PK\x03\x04"), content.rindex(b"PK\x01\x02")
    for at in (member, member + 60, listed + 6):  # the member's header, what it packs, and the version needed to read it
        path.write_bytes(content[:at] + b"\xff\xff" + content[at + 2 :])
        with pytest.raises(InputError, match="cannot be read as 3MF"):
            read_mesh(path)
