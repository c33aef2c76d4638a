"""A range scan as triangles between neighbouring cells."""

import math

import numpy as np
import pytest

from rangecheck.errors import ScanError, SettingError, SurfaceError
from rangecheck.optics import PinholeCamera
from rangecheck.scan import RangeScan
from rangecheck.surface import MEASURED
from rangecheck.surface.meshing import grid_mesh
from rangecheck.surface.topology import boundary_edges, non_manifold_edges

CAMERA = PinholeCamera.from_field_of_view(48, 36, 30.0)


def plane_scan(depth_mm: float = 500.0, tilt: float = 0.0, **keywords) -> RangeScan:
    """A plane z = depth + tilt x, exactly."""
    _, d = CAMERA.pixel_rays()
    return RangeScan(depth_mm / (d[..., 2] - tilt * d[..., 0]), CAMERA, **keywords)


def test_a_flat_wall_becomes_one_sheet_that_faces_the_camera():
    surface = grid_mesh(plane_scan())
    assert len(surface.faces) == 2 * 47 * 35
    assert len(surface.vertices) == 48 * 36
    assert (surface.face_normals[:, 2] < -0.999).all()
    assert (surface.origin_of_face == MEASURED).all()
    assert len(boundary_edges(surface)) == 2 * (47 + 35)
    assert len(non_manifold_edges(surface)) == 0


def test_two_walls_are_not_joined_by_a_rubber_sheet():
    scan = plane_scan()
    ranges = scan.range_mm.copy()
    ranges[:, 24:] *= 1.4
    surface = grid_mesh(RangeScan(ranges, CAMERA))
    assert len(surface.faces) == 2 * (23 + 23) * 35
    across = np.abs(np.diff(surface.vertices[surface.faces][:, [0, 1, 2, 0], 2], axis=1)).max()
    assert across < 1.0


@pytest.mark.parametrize("angle_deg", [20.0, 50.0, 70.0])
def test_an_edge_is_cut_exactly_when_it_leans_beyond_the_stated_angle(angle_deg):
    # on the axis of the view the lean of a tilted plane's steepest edges is the plane's own
    tilt = math.tan(math.radians(angle_deg))
    small = PinholeCamera.from_field_of_view(9, 9, 0.5)
    _, d = small.pixel_rays()
    scan = RangeScan(500.0 / (d[..., 2] - tilt * d[..., 0]), small)
    assert len(grid_mesh(scan, max_angle_deg=angle_deg + 1.5).faces) == 2 * 8 * 8
    with pytest.raises(SurfaceError, match="no three neighbouring samples"):
        grid_mesh(scan, max_angle_deg=angle_deg - 1.5)


def test_noise_wider_than_the_spacing_does_not_tear_the_sheet():
    rng = np.random.default_rng(3)
    clean = plane_scan().range_mm
    spacing = 500.0 / CAMERA.fx
    noisy = clean + rng.normal(0, 2 * spacing, clean.shape)
    torn = grid_mesh(RangeScan(noisy, CAMERA), max_angle_deg=70)
    whole = grid_mesh(RangeScan(noisy, CAMERA, noise_mm=2 * spacing), max_angle_deg=70)
    assert len(torn.faces) < 0.9 * len(whole.faces)
    assert len(whole.faces) >= 0.999 * 2 * 47 * 35


def test_each_square_is_cut_along_its_shorter_diagonal():
    scan = plane_scan(tilt=0.0)
    ranges = scan.range_mm.copy()
    ranges[10, 10] += 2.0
    surface = grid_mesh(RangeScan(ranges, CAMERA))
    peak = 10 * 48 + 10
    corners = surface.vertices.reshape(36, 48, 3)
    for row, col in ((9, 9), (9, 10), (10, 9), (10, 10)):
        square = corners[row : row + 2, col : col + 2]
        falling = np.linalg.norm(square[0, 0] - square[1, 1])
        rising = np.linalg.norm(square[0, 1] - square[1, 0])
        number = row * 48 + col
        ends = {number, number + 49} if falling <= rising else {number + 1, number + 48}
        assert sum(ends <= set(face) for face in surface.faces.tolist()) == 2
    assert peak in surface.faces


def test_cells_where_nothing_returned_are_never_points():
    scan = plane_scan()
    ranges = scan.range_mm.copy()
    ranges[5:9, 7:30] = np.nan
    surface = grid_mesh(RangeScan(ranges, CAMERA))
    assert np.isfinite(surface.vertices).all()
    assert len(surface.vertices) == 48 * 36 - 4 * 23


def test_the_error_of_a_vertex_is_the_stated_noise_or_else_what_the_scan_shows():
    assert grid_mesh(plane_scan(noise_mm=0.3)).vertex_error_mm == pytest.approx(0.3)
    camera = PinholeCamera.from_field_of_view(160, 120, 4.0)
    _, d = camera.pixel_rays()
    rng = np.random.default_rng(5)
    ranges = 500.0 / (d[..., 2] - 0.5 * d[..., 0]) + rng.normal(0, 0.01, d.shape[:2])
    surface = grid_mesh(RangeScan(ranges, camera))
    expected = 0.01 * math.cos(math.atan(0.5))
    # the mask's values are correlated over 3.8 cells; |normal| has a relative spread of 0.76; float32 ranges add 1e-5
    tolerance = 3 * 0.76 / math.sqrt(158 * 118 / 3.8)
    assert np.median(surface.vertex_error_mm) == pytest.approx(expected, rel=tolerance + 0.02)


def test_the_pose_moves_the_surface_and_keeps_it_facing_the_camera():
    from rangecheck import rigid

    pose = rigid.look_at((300.0, 200.0, -100.0), (0.0, 0.0, 0.0))
    surface = grid_mesh(plane_scan(world_from_scan=pose))
    towards = pose[:3, 3] - surface.triangles.mean(axis=1)
    assert ((surface.face_normals * towards).sum(axis=1) > 0).all()


def test_a_mirrored_grid_of_rays_still_faces_the_camera():
    from rangecheck.optics import RayGrid

    origins, directions = CAMERA.pixel_rays()
    mirrored = RayGrid(48, 36, origins[:, ::-1].copy(), directions[:, ::-1].copy())
    surface = grid_mesh(RangeScan(plane_scan().range_mm[:, ::-1].copy(), mirrored))
    assert (surface.face_normals[:, 2] < -0.999).all()


def test_what_cannot_be_meshed_is_refused_with_the_reason():
    with pytest.raises(SettingError, match="between 0 and 90"):
        grid_mesh(plane_scan(), max_angle_deg=90)
    with pytest.raises(ScanError, match="0 of 1728 cells"):
        grid_mesh(RangeScan(np.full((36, 48), np.nan), CAMERA))
    lonely = np.full((36, 48), np.nan)
    lonely[::5, ::5] = 500.0
    with pytest.raises(SurfaceError, match="poisson or pivot"):
        grid_mesh(RangeScan(lonely, CAMERA))
