"""The whole job, small: what it leaves, what other people's programs say of its STL, and that stopping it loses nothing."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from rangecheck_cli.main import exit_status
from test_meshing_fuse import assert_closed_manifold

from rangecheck.scan.readers import read_scans
from rangecheck.studies.hardness_jobs import small_scans
from rangecheck.surface.distance import SurfaceDistance
from rangecheck.surface.mesh_files import read_mesh

SMALL = ["--size", "96x96", "--frames", "4", "-q"]


@pytest.fixture
def bust_job(readme_job) -> Path:
    """The finished job on the eight sample views."""
    assert readme_job.status == 0
    return readme_job.out


@pytest.fixture(scope="session")
def relief_job(sample_data, tmp_path_factory) -> Path:
    """The finished job on the single frontal view."""
    out = tmp_path_factory.mktemp("job") / "relief"
    assert exit_status(["run", str(sample_data / "frontal"), "--out", str(out), *SMALL]) == 0
    return out


@pytest.mark.parametrize("job", ["bust_job", "relief_job"])
def test_the_job_leaves_what_it_promises(job, request):
    out = request.getfixturevalue(job)
    for name in ("bust.stl", "plaster.mp4", "steel.mp4", "report.html", "run.json", "settings.json"):
        assert (out / name).stat().st_size > 0
    document = json.loads((out / "run.json").read_text())
    assert document["schema"] == "rangecheck/run/1"
    assert document["fit"] and document["stl"]["verdict"]["fit"]
    assert set(document["inputs"]) and all(re.fullmatch("[0-9a-f]{64}", digest) for digest in document["inputs"].values())
    assert document["area_shares"]["measured"] > 0.5 or job == "relief_job"
    assert not list(out.glob("unfinished.json")) and not list(out.rglob("*.part*"))
    page = (out / "report.html").read_text()
    assert "http://" not in page.replace("http://www.w3.org", "") and "https://" not in page
    assert len(page) < 12e6


@pytest.mark.parametrize("job", ["bust_job", "relief_job"])
def test_slicers_and_admesh_find_nothing_wrong(job, request):
    stl = request.getfixturevalue(job) / "bust.stl"
    if shutil.which("admesh") is None or shutil.which("prusa-slicer") is None:
        pytest.skip("admesh and prusa-slicer are not installed: apt-get install admesh prusa-slicer")
    # admesh prints the header's 80 bytes and what lies behind them in its memory
    said = subprocess.run(["admesh", str(stl)], capture_output=True, text=True, errors="replace", check=True).stdout
    disconnected = re.search(r"Total disconnected facets\s*:\s*(\d+)\s+(\d+)", said)
    assert disconnected and disconnected.groups() == ("0", "0")
    said = subprocess.run(["prusa-slicer", "--info", str(stl)], capture_output=True, text=True, check=True).stdout
    assert "manifold = yes" in said


def test_the_fused_bust_is_where_the_true_bust_is(bust_job):
    from rangecheck.analytic.bust import bust_distance_mm

    surface = read_mesh(bust_job / "surface.ply", "mm")
    document = json.loads((bust_job / "run.json").read_text())
    assert document["method"] == "fuse"
    # the base is cut, so what is compared is what the scanner saw
    points = np.concatenate([s.points_mm() for s in read_scans(bust_job_inputs())])[::997]
    distance, _ = SurfaceDistance(surface).distance_mm(points)
    seen = surface.vertices[surface.vertices[:, 1] > surface.bounds_mm[0, 1] + 1.0][::13]
    assert np.median(distance) < 0.2  # one standard deviation of the noise
    assert np.median(np.abs(bust_distance_mm(seen))) < 0.2


def bust_job_inputs() -> Path:
    return Path(__file__).resolve().parent.parent / "sample_data"


def test_a_finished_job_is_not_replaced_without_force(bust_job, sample_data, capsys):
    before = (bust_job / "bust.stl").read_bytes()
    assert exit_status(["run", str(sample_data), "--out", str(bust_job), *SMALL]) == 2
    assert "--force" in capsys.readouterr().err
    assert (bust_job / "bust.stl").read_bytes() == before


def test_a_verdict_that_says_no_holds_the_stl_back(tmp_path):
    strict = ["--set", "checking.max_invented_percent=0.0", "--set", 'light.materials=["plaster"]']
    assert exit_status(["run", str(small_scans(tmp_path)), "--out", str(tmp_path / "out"), *SMALL, *strict]) in (0, 1)
    document = json.loads((tmp_path / "out" / "run.json").read_text())
    assert document["fit"] == (tmp_path / "out" / "bust.stl").exists()


@pytest.fixture(scope="module")
def bunny_job(real_data, tmp_path_factory) -> Path:
    """The finished job on the ten scans of the Stanford bunny."""
    out = tmp_path_factory.mktemp("bunny") / "bunny"
    line = ["run", str(real_data / "stanford_bunny" / "bun.conf"), "--unit", "m", "--out", str(out), *SMALL]
    # what the scans are worth and what steel shows is tested of others; here it is the shape
    assert exit_status([*line, "--set", "scan.quality=false", "--set", 'light.materials=["plaster"]']) == 0
    return out


@pytest.fixture(scope="module")
def published_mm(real_data) -> np.ndarray:
    """(n, 3) the vertices of the published mesh."""
    published = read_mesh(real_data / "stanford_bunny" / "bun_zipper.ply", "m")
    return published.vertices[np.unique(published.faces)]


@pytest.mark.real_data
def test_the_bunny_fused_from_its_ten_scans_agrees_with_its_zippered_mesh(bunny_job, published_mm):
    assert json.loads((bunny_job / "run.json").read_text())["method"] == "fuse"
    surface = read_mesh(bunny_job / "surface.ply", "mm")
    assert_closed_manifold(surface)
    distance = SurfaceDistance(surface).distance_mm(published_mm)[0]
    assert np.median(distance) < 0.03
    assert np.quantile(distance, 0.95) < 0.12


@pytest.mark.real_data
def test_the_real_bunny_becomes_a_solid_close_to_the_published_one(bunny_job, published_mm):
    made = read_mesh(bunny_job / "bust.stl", "mm")
    above = published_mm[:, 1] > made.bounds_mm[0, 1]
    distance, _ = SurfaceDistance(made).distance_mm(published_mm[above])
    assert above.mean() > 0.95
    assert np.median(distance) <= 0.06
    assert np.quantile(distance, 0.95) <= 0.3


@pytest.mark.real_data
def test_the_published_bunny_is_open_with_223_edges(real_data, capsys):
    assert exit_status(["check", str(real_data / "stanford_bunny" / "bun_zipper.ply"), "--unit", "m", "--json", "-q"]) == 1
    document = json.loads(capsys.readouterr().out)
    [found] = [f for f in document["files"][0]["findings"] if f["code"] == "open-edges"]
    assert found["count"] == 223
