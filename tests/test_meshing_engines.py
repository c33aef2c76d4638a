"""Poisson and ball pivoting by outside engines, the choice of a method, and how far surfaces are closed."""

import numpy as np
import pytest
from test_meshing_fuse import CAMERA, ROUND, scan_of, scans_around

from rangecheck import rigid
from rangecheck.analytic.shapes import Sphere
from rangecheck.errors import DependencyMissing, ScanError, SettingError, SurfaceError
from rangecheck.optics import RayGrid
from rangecheck.scan import RangeScan
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.surface import INTERPOLATED, INVENTED, MEASURED, Surface
from rangecheck.surface.meshing import choose_method, engine_tasks, fuse, mesh_scans, pivot, poisson
from rangecheck.surface.meshing.engines import Engine
from rangecheck.surface.meshing.openings import opened, patch_extents
from rangecheck.surface.meshing.oriented import oriented_points
from rangecheck.surface.topology import boundary_edges, non_manifold_edges, non_manifold_vertices


def radial_error(surface: Surface) -> np.ndarray:
    return np.linalg.norm(surface.vertices, axis=1) - 50.0


@pytest.mark.engines
@pytest.mark.parametrize("engine", ["open3d", "pymeshlab"])
def test_poisson_closes_a_sphere_and_labels_it_by_distance(engine):
    scans = scans_around(Sphere(50.0), ROUND[:4], sigma=0.1)
    surface = poisson(scans, engine=engine, measured_mm=3.0, interpolated_mm=8.0)
    assert surface.volume_mm3 > 0
    measured = np.unique(surface.faces[surface.origin_of_face == MEASURED])
    assert np.sqrt((radial_error(surface)[measured] ** 2).mean()) < 0.1
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(np.concatenate([s.points_mm() for s in scans])).query(surface.triangles.mean(axis=1))
    expected = np.where(distance <= 3.0, MEASURED, np.where(distance <= 8.0, INTERPOLATED, INVENTED))
    assert (surface.origin_of_face == expected).all()
    assert surface.vertex_error_mm is not None


@pytest.mark.engines
def test_poisson_gives_the_same_bytes_twice():
    scans = scans_around(Sphere(50.0), ROUND[:3], sigma=0.1)
    one, two = poisson(scans, voxel_mm=3.0), poisson(scans, voxel_mm=3.0)
    assert one.vertices.tobytes() == two.vertices.tobytes() and one.faces.tobytes() == two.faces.tobytes()


@pytest.mark.engines
def test_pivoting_joins_samples_and_leaves_a_manifold():
    scans = scans_around(Sphere(50.0), ROUND[:4], sigma=0.02)
    surface = pivot(scans)
    assert len(surface.faces) > 1000
    assert len(non_manifold_edges(surface)) == 0 and len(non_manifold_vertices(surface)) == 0
    assert np.sqrt((radial_error(surface) ** 2).mean()) < 0.05
    assert ((surface.face_normals * surface.triangles.mean(axis=1)).sum(axis=1) > 0).mean() > 0.999


@pytest.mark.engines
def test_normals_look_at_the_scanner_and_lonely_samples_get_none():
    scan = scan_of(Sphere(50.0), rigid.look_at((0.0, 0.0, 300.0), (0.0, 0.0, 0.0)))
    with Engine("open3d") as open3d:
        points, normals = oriented_points([scan], open3d)
    assert ((normals * points).sum(axis=1) > 0).all()
    line = PointCloud(np.stack([np.linspace(0, 1, 40), np.zeros(40), np.zeros(40)], axis=1), name="wire")
    with Engine("open3d") as open3d, pytest.raises(ScanError, match="span a plane"):
        oriented_points([line], open3d)


@pytest.mark.engines
def test_a_cloud_without_viewpoints_is_oriented_outward():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(3000, 3))
    points *= 50.0 / np.linalg.norm(points, axis=1, keepdims=True)
    surface = mesh_scans([PointCloud(points)])
    assert surface.volume_mm3 == pytest.approx(4 / 3 * np.pi * 50**3, rel=0.02)


def test_the_method_follows_from_what_the_scans_are_and_says_why():
    one, two = scans_around(Sphere(50.0), ROUND[:2])
    assert choose_method([one]) == ("grid", "a single scan is its own grid of neighbours, and nothing behind it was seen")
    assert choose_method([one, two])[0] == "fuse"
    cloud = PointCloud(one.points_mm(), name="cloud.xyz")
    name, reason = choose_method([one, cloud])
    assert name == "poisson" and "cloud.xyz" in reason
    origins, directions = CAMERA.pixel_rays()
    wild = RayGrid(96, 96, origins + np.random.default_rng(1).normal(0, 30, origins.shape), directions[::-1, ::-1].copy())
    name, reason = choose_method([one, RangeScan(one.range_mm, wild)])
    assert name == "poisson" and "free space" in reason
    with pytest.raises(ScanError, match="no scans"):
        choose_method([])


def test_settings_of_other_methods_are_left_aside_and_unknown_ones_refused():
    scans = scans_around(Sphere(50.0), ROUND[:1])
    assert len(mesh_scans(scans, "grid", voxel_mm=2.0, max_angle_deg=70.0).faces) > 0
    with pytest.raises(SettingError, match="auto, grid, fuse, poisson, pivot"):
        mesh_scans(scans, "marching")
    with pytest.raises(SettingError, match="no such setting"):
        mesh_scans(scans, "fuse", colour="red")
    with pytest.raises(ScanError, match="one range scan"):
        mesh_scans(scans * 2, "grid")


def test_half_closing_keeps_small_patches_and_open_keeps_none():
    scans = scans_around(Sphere(50.0), ROUND[:5], sigma=0.05)
    ranges = scans[0].range_mm.copy()
    ranges[40:52, 40:52] = np.nan
    scans[0] = RangeScan(ranges, CAMERA, scans[0].world_from_scan)
    # interpolated_mm so small that the masked window (14 mm) and the unseen south (60 mm) are both invented
    whole = fuse(scans, measured_mm=2.0, interpolated_mm=2.5)
    sizes = np.unique(patch_extents(whole)[1])
    assert (sizes > 12).any() and (sizes > 40).any()
    half = opened(whole, "half", 30.0)
    assert patch_extents(half)[1].max() <= 30.0 < patch_extents(whole)[1].max()
    fully = opened(whole, "open")
    assert not (fully.origin_of_face == INVENTED).any()
    for surface in (half, fully):
        assert len(boundary_edges(surface)) > 0
        assert len(non_manifold_vertices(surface)) == 0
    with pytest.raises(SettingError, match="say up to which size"):
        opened(whole, "half")


@pytest.mark.engines
@pytest.mark.parametrize("method", [poisson, pivot])
def test_nothing_is_refused_with_the_reason_by_every_method(method):
    with pytest.raises(ScanError, match="no scans"):
        method([])
    with pytest.raises(ScanError, match="samples"):
        method([PointCloud(np.zeros((5, 3)))])


#: an engine that ends by SIGSEGV over its first `crashes` questions, counted in a file beside it
CRASHES = """
import os, runpy, signal, sys
from pathlib import Path
count = Path(__file__).with_suffix(".count")
done = int(count.read_text()) if count.exists() else 0
count.write_text(str(done + 1))
if done < {crashes}:
    sys.stdin.readline()
    os.kill(os.getpid(), signal.SIGSEGV)
runpy.run_path({tasks!r}, run_name="__main__")
"""


def crashing(times: int, folder, monkeypatch) -> None:
    script = folder / "crashing.py"
    script.write_text(CRASHES.format(crashes=times, tasks=engine_tasks.__file__))
    monkeypatch.setattr(engine_tasks, "__file__", str(script))


@pytest.mark.engines
def test_an_engine_that_crashes_once_is_asked_again_and_answers_the_same(tmp_path, monkeypatch):
    points = np.random.default_rng(1).normal(size=(200, 3))
    with Engine("open3d") as open3d:
        undisturbed = open3d.ask("covariances", points=points, neighbours=8)["covariances"]
    crashing(1, tmp_path, monkeypatch)
    with Engine("open3d") as open3d:
        assert open3d.ask("covariances", points=points, neighbours=8)["covariances"].tobytes() == undisturbed.tobytes()
        assert open3d.ask("covariances", points=points, neighbours=8)["covariances"].tobytes() == undisturbed.tobytes()


def test_an_engine_that_always_crashes_is_an_error_that_names_the_signal_and_the_way_round_it(tmp_path, monkeypatch):
    crashing(9, tmp_path, monkeypatch)
    with Engine("open3d") as open3d, pytest.raises(SurfaceError, match=r"open3d ended 2 times .* SIGSEGV; .*pymeshlab"):
        open3d.ask("covariances", points=np.eye(3), neighbours=2)


def test_an_absent_engine_is_named_with_the_line_that_mends_it(tmp_path, monkeypatch):
    script = tmp_path / "absent.py"
    script.write_text(
        f"import runpy, sys\nsys.modules['open3d'] = None\nrunpy.run_path({engine_tasks.__file__!r}, run_name='__main__')\n"
    )
    monkeypatch.setattr(engine_tasks, "__file__", str(script))
    with Engine("open3d") as open3d, pytest.raises(DependencyMissing, match=r"open3d .*pip install"):
        open3d.ask("covariances", points=np.eye(3), neighbours=2)
