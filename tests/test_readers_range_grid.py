"""Range-grid PLY, `.conf` and NPZ: points are the file's, poses are the model's, and damage is named."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from rangecheck.errors import InputError, UnitMissing
from rangecheck.optics import PinholeCamera, RayGrid
from rangecheck.rigid import about_axis
from rangecheck.scan import RangeScan
from rangecheck.scan.readers import read_scans, write_npz
from rangecheck.scan.readers.ply import read_ply

ROWS, COLUMNS = 40, 50


def fan(seed=0):
    """Vertices (k, 3) and grid (ROWS, COLUMNS) of a scanner whose interlaced rows fan out and whose lens bends them a little."""
    random = np.random.default_rng(seed)
    r, c = np.mgrid[0:ROWS, 0:COLUMNS].astype(float)
    z = 10 * np.cos((c - 25) / 20) * np.cos((r - 20) / 15) + 0.01 * random.normal(size=r.shape)
    y = 0.7 * (20 - r) - z * (0.1 - 0.006 * r) + 2e-4 * (r - 20) ** 2
    x = 0.5 * c - 12 + np.where(r % 2 == 0, -0.125, 0.125)
    valid = (np.hypot(r - 20, c - 25) < 18) & (random.random(r.shape) > 0.05)
    index = np.where(valid, np.cumsum(valid).reshape(r.shape) - 1, -1)
    return np.stack([x, y, z], axis=-1)[valid], index


def ply(vertices, index, kind="ascii", newline="\n", extra=()):
    header = ["ply", f"format {kind} 1.0", "obj_info is_cyberware_data 1"]
    header += [f"obj_info num_cols {index.shape[1]}", f"obj_info num_rows {index.shape[0]}", f"element vertex {len(vertices)}"]
    header += [f"property float {axis}" for axis in "xyz"] + [f"property uchar {name}" for name in extra]
    header += [f"element range_grid {index.size}", "property list uchar int vertex_indices", "end_header"]
    flat = index.ravel()
    if kind == "ascii":
        lines = [" ".join(f"{v:.9g}" for v in vertex) + " 128" * len(extra) for vertex in vertices.astype(np.float32)]
        lines += ["0" if i < 0 else f"1 {i}" for i in flat]
        return newline.join(header + lines + [""]).encode()
    order = "<" if "little" in kind else ">"
    body = b"".join(vertex.astype(f"{order}f4").tobytes() + b"\x80" * len(extra) for vertex in vertices)
    body += b"".join(b"\0" if i < 0 else b"\1" + np.array(i, f"{order}i4").tobytes() for i in flat)
    return newline.join([*header, ""]).encode() + body


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"], ids=["LF", "CRLF"])
def test_points_are_the_files_vertices_in_millimetres(tmp_path, kind, newline):
    vertices, index = fan()
    path = tmp_path / "grid.ply"
    path.write_bytes(ply(vertices, index, kind, newline, ("red", "green", "blue")))
    (scan,) = read_scans(path, "cm")
    assert (scan.valid == (index >= 0)).all()
    told = vertices.astype(np.float32).astype(float) * 10
    rounding = np.spacing(np.float32(np.nanmax(scan.range_mm))) / 2
    assert np.abs(scan.points_mm() - told[index[index >= 0]]).max() <= rounding + 5e-9 * np.abs(told).max(), (
        "float32 range, nine digits of text"
    )
    assert np.allclose(scan.brightness[scan.valid], 128 / 255) and scan.unit == "cm" and scan.name == "grid"


def test_rows_that_run_upwards_are_turned_over(tmp_path):
    vertices, index = fan()
    (tmp_path / "down.ply").write_bytes(ply(vertices, index))
    (tmp_path / "up.ply").write_bytes(ply(vertices, index[::-1]))
    down, up = (read_scans(tmp_path / f"{name}.ply", "mm")[0] for name in ("down", "up"))
    assert (down.valid == up.valid).all() and np.array_equal(down.grid_points_mm, up.grid_points_mm, equal_nan=True)


def test_projecting_a_point_along_its_ray_finds_its_cell_and_range(tmp_path):
    vertices, index = fan()
    (tmp_path / "grid.ply").write_bytes(ply(vertices, index))
    (scan,) = read_scans(tmp_path / "grid.ply", "mm")
    origins, directions = scan.camera.pixel_rays()
    assert np.isfinite(origins).all() and np.isfinite(directions).all()
    rows, columns = np.indices(index.shape)
    for further in (-3.0, 0.0, 3.0):
        ranges = np.nan_to_num(scan.range_mm.astype(float), nan=100.0) + further
        uv, back = scan.camera.project(origins + ranges[..., None] * directions)
        assert np.abs(uv[..., 0] - columns).max() < 1e-3 and np.abs(uv[..., 1] - rows).max() < 1e-3
        assert np.abs(back - ranges).max() < 1e-3


def test_rays_of_empty_cells_stay_between_their_neighbours(tmp_path):
    vertices, index = fan()
    (tmp_path / "grid.ply").write_bytes(ply(vertices, index))
    (scan,) = read_scans(tmp_path / "grid.ply", "mm")
    origins, _ = scan.camera.pixel_rays()
    assert np.allclose(np.diff(origins[..., 0], axis=1), 0.5, atol=1e-4)
    assert (np.diff(origins[..., 1], axis=0) < 0).all() or (np.diff(origins[..., 1], axis=0) > 0).all()
    assert np.allclose(origins[1::2, :, 0] - origins[::2, :, 0], 0.25, atol=1e-4), "interlaced rows keep their offset"


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda b: b[: len(b) // 2], "cut short"),
        (lambda b: b[:200], "no header"),
        (lambda b: b"off" + b[3:], "named like PLY, but it begins"),
        (lambda b: b.replace(b"num_cols 50", b"num_cols 51"), "export it again"),
        (lambda b: b.replace(b"num_rows 40", b"num_rows 99999999"), "at most"),
        (lambda b: b.replace(b"element vertex ", b"element vertex 9999999"), "cut short"),
        (lambda b: b.replace(b"element range_grid 2000", b"element range_grid 1999"), "more numbers than"),
        (lambda b: b.replace(b"\n1 0\n", b"\n1 99999\n"), "names vertex 99999"),
        (lambda b: b.replace(b"\n1 0\n", b"\n2 0 1\n"), "lists 2 vertices"),
        (lambda b: b.replace(b"\n1 0\n", b"\n1 x\n"), r"line \d+ holds b'x'"),
        (lambda b: b.replace(b"format ascii", b"format EBCDIC"), "line 2 of its header"),
        (lambda b: b.replace(b"obj_info num_cols 50\n", b""), "num_cols and num_rows"),
        (lambda b: b.replace(b"property float z\n", b"property float w\n"), "no property z"),
    ],
)
def test_a_damaged_range_grid_is_refused_in_one_line(tmp_path, spoil, message):
    content = spoil(ply(*fan()))
    (tmp_path / "grid.ply").write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_scans(tmp_path / "grid.ply", "m")
    assert "\n" not in str(caught.value)


def test_a_grid_without_vertices_and_a_mesh_are_refused(tmp_path):
    path = tmp_path / "grid.ply"
    path.write_bytes(ply(np.empty((0, 3)), np.full((3, 4), -1)))
    with pytest.raises(InputError, match="every cell of its range grid is empty"):
        read_scans(path, "m")
    path.write_bytes(ply(np.full((12, 3), np.nan), np.arange(12).reshape(3, 4)))
    with pytest.raises(InputError, match="every cell of its range grid is empty"):
        read_scans(path, "m")
    with pytest.raises(UnitMissing):
        read_scans(path)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 2), (3, 1)])
def test_grids_of_one_row_or_column_are_read(tmp_path, shape):
    r, c = np.indices(shape)
    vertices = np.stack([c * 0.5, -r * 0.7, np.zeros(shape)], axis=-1).reshape(-1, 3)
    (tmp_path / "g.ply").write_bytes(ply(vertices, np.arange(r.size).reshape(shape)))
    (scan,) = read_scans(tmp_path / "g.ply", "mm")
    assert np.abs(scan.points_mm() - vertices).max() < 1e-5


def conf(tmp_path, *lines):
    vertices, index = fan()
    (tmp_path / "a.ply").write_bytes(ply(vertices, index))
    (tmp_path / "all.conf").write_text("camera 0 0 -0.7 0 0 0 1\n" + "\r\n".join(lines) + "\n")
    return vertices[index[index >= 0]], tmp_path / "all.conf"


def test_a_conf_turns_against_its_quaternion_and_scales_its_translation(tmp_path):
    vertices, path = conf(tmp_path, "bmesh a.ply 1 2 3 0 0 0 1", "", "bmesh a.ply 0 0 0 0 0 0.5 0.8660254037844386")
    still, turned = read_scans(path, "cm")
    assert np.abs(still.points_mm() - (10 * vertices + [10, 20, 30])).max() < 1e-4
    back = about_axis((0, 0, 1), -np.pi / 3)[:3, :3]
    assert np.abs(turned.points_mm() - 10 * vertices @ back.T).max() < 1e-4
    assert len(read_scans(tmp_path, "cm")) == 2, "a folder is read through its .conf"


@pytest.mark.parametrize(
    "line, message",
    [
        ("bmesh b.ply 0 0 0 0 0 0 1", "b.ply: does not exist"),
        ("bmesh ../a.ply 0 0 0 0 0 0 1", "outside its own folder"),
        ("bmesh a.ply 0 0 0 0 0 0", "line 2 is"),
        ("bmesh a.ply 0 0 0 0 0 0 0", "length 0"),
        ("bmesh a.ply 0 nan 0 0 0 0 1", "not finite"),
        ("bmesh a.ply 0 0 0 0 0 0 one", "line 2"),
        ("tmesh a.ply", "line 2 is"),
        ("# nothing", "places no scan"),
    ],
)
def test_a_wrong_line_of_a_conf_is_named(tmp_path, line, message):
    _, path = conf(tmp_path, line)
    with pytest.raises(InputError, match=message):
        read_scans(path, "m")


def npz_scan():
    random = np.random.default_rng(3)
    directions = random.normal(size=(6, 7, 3)) * 0.05 + [0, 0, 1]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    ranges = random.uniform(90, 110, (6, 7)).astype(np.float32)
    ranges[2, 3] = np.nan
    camera = RayGrid(7, 6, random.normal(size=(6, 7, 3)), directions)
    return RangeScan(ranges, camera, about_axis((1, 2, 3), 1.0), random.random((6, 7)), "ä b", "in", 0.1)


@pytest.mark.parametrize("own_rays", [True, False])
def test_an_archive_gives_back_every_bit(tmp_path, own_rays):
    scan = npz_scan()
    if not own_rays:
        camera = PinholeCamera(7, 6, 10.1, 9.3, 3.3, 2.2, (0.1, 0.2))
        scan = RangeScan(scan.range_mm, camera, scan.world_from_scan, None, "b")
    write_npz(tmp_path / "a.npz", scan)
    (back,) = read_scans(tmp_path / "a.npz")
    assert back.range_mm.tobytes() == scan.range_mm.tobytes()
    assert back.world_from_scan.tobytes() == scan.world_from_scan.tobytes()
    assert back.points_mm().tobytes() == scan.points_mm().tobytes()
    assert (back.name, back.unit, back.noise_mm) == (scan.name, scan.unit, scan.noise_mm)
    assert (back.brightness is None) if scan.brightness is None else (back.brightness == scan.brightness).all()
    write_npz(tmp_path / "b.npz", back)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def archive(tmp_path, **changes):
    """An archive with members replaced (bytes as they are) or, by None, left out."""
    write_npz(tmp_path / "a.npz", npz_scan())
    with zipfile.ZipFile(tmp_path / "a.npz") as source:
        members = {name: source.read(name) for name in source.namelist()}
    with zipfile.ZipFile(tmp_path / "b.npz", "w", zipfile.ZIP_DEFLATED) as target:
        for name in members | {f"{key}.npy": b"" for key in changes}:
            content = changes.get(name.removesuffix(".npy"), members.get(name))
            if content is not None:
                target.writestr(name, content)
    return tmp_path / "b.npz"


def npy(values, pickle=False):
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asanyarray(values), allow_pickle=pickle)
    return stream.getvalue()


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"range_mm": None}, "lacks range_mm"),
        ({"description": None}, "lacks description"),
        ({"surprise": npy(1)}, "holds 'surprise.npy'"),
        ({"schema": npy("rangecheck/scan/7")}, "scans are read from"),
        ({"range_mm": npy(np.ones((6, 7)))}, "float64 of shape"),
        ({"range_mm": npy(np.ones((6, 8), np.float32))}, "does not fit its arrays"),
        ({"range_mm": npy(np.full((6, 7), np.nan, np.float32))}, "holds no distance"),
        ({"range_mm": npy(np.ones((6, 7), np.float32))[:-4]}, "does not fill"),
        ({"range_mm": npy(np.ones((6, 7), np.float32)).replace(b"(6, 7)", b"(6e9,)")}, "damaged"),
        ({"range_mm": npy(np.array([[{}]]), True)}, "damaged"),
        ({"range_mm": b""}, "damaged"),
        ({"description": npy("{}")}, "does not fit"),
        ({"description": npy("[" * 100000)}, "does not fit"),
        ({"description": npy(json.dumps({"name": "a", "unit": "ell", "noise_mm": None, "camera": {}}))}, "does not fit"),
        ({"world_from_scan": npy(np.full((4, 4), np.nan))}, "does not fit"),
    ],
    ids=lambda value: "" if isinstance(value, dict) else value,
)
def test_a_damaged_archive_is_refused(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        read_scans(archive(tmp_path, **changes))


def test_an_archive_that_would_unpack_to_far_more_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as target:
        target.writestr("range_mm.npy", b"\x93NUMPY" + bytes(100))
    content = bytearray((tmp_path / "bomb.npz").read_bytes())
    place = content.rindex(b"PK\x01\x02")
    content[place + 24 : place + 28] = (0x7FFFFFFF).to_bytes(4, "little")
    (tmp_path / "bomb.npz").write_bytes(content)
    with pytest.raises(InputError, match="more than"):
        read_scans(tmp_path / "bomb.npz")


@pytest.mark.real_data
def test_the_bunnys_ten_scans_lie_on_its_merged_mesh(real_data):
    from scipy.spatial import cKDTree

    scans = read_scans(real_data / "stanford_bunny", "m")
    assert len(scans) == 10 and all(30_000 < scan.valid.sum() < 41_000 for scan in scans)
    merged = read_ply(Path(real_data / "stanford_bunny" / "bun_zipper.ply")).need("vertex", "x", "y", "z").columns
    tree = cKDTree(1000.0 * np.stack([merged[axis] for axis in "xyz"], axis=1))
    medians = [float(np.median(tree.query(scan.points_mm()[::7])[0])) for scan in scans]
    assert min(medians) > 0.51 and max(medians) < 0.585, medians
    for scan in scans[:3]:
        uv, ranges = scan.camera.project(scan.grid_points_mm[scan.valid])
        rows, columns = np.nonzero(scan.valid)
        off = np.abs(uv - np.stack([columns, rows], axis=1)).max(axis=1)
        assert np.isnan(off).mean() < 1e-3, "rays cross in hardly any place"
        assert np.nanmax(off) < 1e-3 and np.nanmax(np.abs(ranges - scan.range_mm[scan.valid])) < 1e-4
