"""Labels by every method, in every closing, on scans with a masked region: invented is exactly what lies farther from every sample than stated."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from test_meshing_fuse import CAMERA, scans_around

from rangecheck.analytic.shapes import Sphere
from rangecheck.scan import RangeScan
from rangecheck.surface import INTERPOLATED, INVENTED, MEASURED
from rangecheck.surface.meshing import mesh_scans

MEASURED_MM, INTERPOLATED_MM = 2.5, 4.0


@pytest.fixture(scope="module")
def masked():
    """Three views of a ball of 50 mm radius, with a window of about 25 mm that none of them saw."""
    scans = scans_around(Sphere(50.0), sigma=0.1)[:3]
    hidden = scans[0].points_mm()[np.argmin(scans[0].range_mm[scans[0].valid])]
    made = []
    for scan in scans:
        away = np.linalg.norm(
            scan.grid_points_mm @ scan.world_from_scan[:3, :3].T + scan.world_from_scan[:3, 3] - hidden, axis=-1
        )
        ranges = np.where(away < 12.0, np.float32(np.nan), scan.range_mm)
        made.append(RangeScan(ranges, CAMERA, scan.world_from_scan, noise_mm=0.1))
    return made


@pytest.mark.engines
@pytest.mark.parametrize("closing", ["open", "half", "closed"])
@pytest.mark.parametrize("method", ["auto", "grid", "fuse", "poisson", "pivot"])
def test_invented_is_exactly_what_lies_farther_than_stated_from_any_sample(masked, method, closing):
    scans = masked[:1] if method == "grid" else masked
    surface = mesh_scans(
        scans, method, measured_mm=MEASURED_MM, interpolated_mm=INTERPOLATED_MM, closing=closing, largest_hole_mm=30.0
    )
    distance, _ = cKDTree(np.concatenate([s.points_mm() for s in scans])).query(surface.triangles.mean(axis=1))
    invented = surface.origin_of_face == INVENTED
    if method == "grid":  # one sheet over the samples themselves: nothing is made up, whatever is asked
        assert not invented.any() and (surface.origin_of_face == MEASURED).all()
        return
    # a face's middle is rounded in another order here than there
    clear = (np.abs(distance - INTERPOLATED_MM) > 1e-9) & (np.abs(distance - MEASURED_MM) > 1e-9)
    assert (invented == (distance > INTERPOLATED_MM))[clear].all()
    assert ((surface.origin_of_face == INTERPOLATED) == ((distance > MEASURED_MM) & (distance <= INTERPOLATED_MM)))[clear].all()
    if closing == "open":
        assert not invented.any()
    elif closing == "closed" and method != "pivot":  # pivoting ends where its ball finds no sample
        assert invented.any()
