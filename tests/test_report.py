"""What a report says is what was measured: arrays survive the page, the likeness keeps its distance, the page can be made again."""

import html
import io
import json

import numpy as np
import pytest
from rangecheck_cli.main import exit_status
from report_cases import job_of_a_vase, vase
from test_topology_distance import CUBE_CORNERS, CUBE_FACES

from rangecheck.config import load_settings
from rangecheck.optics import PinholeCamera
from rangecheck.pipeline import likeness as likenesses
from rangecheck.pipeline.likeness import lighter, likeness
from rangecheck.pipeline.page import keep_for_report, page_of
from rangecheck.report import Coverage, Figure, ReportContent, report_html
from rangecheck.report.pack import octahedral, packed, packed_floats, unpacked
from rangecheck.report.sphere import halves, seen_share
from rangecheck.rigid import look_at
from rangecheck.scan import RangeScan
from rangecheck.scan.quality_sphere import counted
from rangecheck.surface import MEASURED, Surface
from rangecheck.surface.coarse import clustered
from rangecheck.surface.distance import SurfaceDistance


@pytest.fixture(scope="module")
def job():
    return job_of_a_vase()


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.uint32])
@pytest.mark.parametrize("shape", [(0, 3), (1, 1), (257, 3)])
def test_what_is_packed_comes_out_as_it_went_in(kind, shape):
    array = np.random.default_rng(1).integers(0, np.iinfo(kind).max, shape, dtype=kind, endpoint=True)
    np.testing.assert_array_equal(unpacked(json.loads(json.dumps(packed(array)))), array)


def test_packed_numbers_lie_within_half_a_step_and_nothing_stays_nothing():
    values = np.random.default_rng(2).normal(700, 40, 1000)
    values[::7] = np.nan
    form = packed_floats(values)
    code = unpacked(form)[:, 0]
    np.testing.assert_array_equal(code == 0, np.isnan(values))
    back = form["low"] + (code[code > 0] - 1.0) * form["step"]
    assert np.abs(back - values[code > 0]).max() <= form["step"] / 2 * (1 + 1e-9)
    assert not unpacked(packed_floats(np.full(5, np.nan))).any()


def test_folded_normals_point_where_they_pointed():
    n = np.random.default_rng(3).normal(size=(500, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    xy = octahedral(n) / 2047.5 - 1
    z = 1 - np.abs(xy).sum(axis=1)
    xy -= np.where(xy >= 0, 1, -1) * np.clip(-z, 0, None)[:, None]
    back = np.column_stack([xy, z])
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    # half a step of 1/2047.5 in each coordinate, stretched by at most 3 where the octahedron is farthest from the sphere
    assert np.arccos(np.clip((back * n).sum(axis=1), -1, 1)).max() < 3 / 2047.5


def test_joined_vertices_move_no_farther_than_their_cell():
    surface = vase()
    coarse = clustered(surface, 6.0)
    assert 0 < len(coarse.faces) < len(surface.faces)
    assert SurfaceDistance(coarse).distance_mm(surface.vertices)[0].max() <= 6.0 * np.sqrt(3)


@pytest.mark.parametrize("closed", [True, False])
def test_a_likeness_has_few_faces_and_says_how_far_off_it_is(closed, monkeypatch):
    monkeypatch.setattr(likenesses, "MOST_FACES", 1500)
    surface = vase() if closed else vase().with_faces(np.arange(40, len(vase().faces)))
    light = likeness(surface, surface, [], None)
    assert len(light.surface.faces) <= 1500 < len(surface.faces)
    away = SurfaceDistance(light.surface).distance_mm(surface.vertices)[0]
    assert light.off_mm == away.max() and light.off_99_mm <= light.off_mm < 0.1 * surface.extent_mm
    assert np.isnan(light.deviation_mm).all() and np.isnan(light.error_mm).all()


def test_a_small_surface_is_its_own_likeness():
    assert lighter(vase()).faces is vase().faces or len(lighter(vase()).faces) == len(vase().faces)


def test_deviation_is_what_the_scans_say_against_the_surface():
    """A sheet scanned from straight ahead, 0.3 mm nearer to the scanner than the sheet that is shown."""
    camera = PinholeCamera.from_field_of_view(60, 60, 30.0)
    pose = look_at((0.0, 0.0, 200.0), (0.0, 0.0, 0.0))
    _, directions = camera.rays(*np.meshgrid(np.arange(60.0), np.arange(60.0)))
    scan = RangeScan(199.7 * np.linalg.norm(directions, axis=-1) / np.abs(directions[..., 2]), camera, pose)
    sheet = Surface(
        np.array([[-80.0, -80, 0], [80, -80, 0], [80, 80, 0], [-80, 80, 0]]), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    )
    found = likeness(sheet, sheet, [scan], None)
    np.testing.assert_allclose(found.deviation_mm, 0.3, atol=1e-4)


def test_directions_are_counted_from_the_middle_of_the_bust_not_of_the_relief_that_it_was_made_of(tmp_path):
    """Readings of a relief may pass close to their own middle, from where they lie in few directions."""
    camera = PinholeCamera.from_field_of_view(60, 60, 30.0)
    _, directions = camera.rays(*np.meshgrid(np.arange(60.0), np.arange(60.0)))
    scan = RangeScan(
        200.0 / np.abs(directions[..., 2] / np.linalg.norm(directions, axis=-1)), camera, look_at((0, 0, 200.0), (0, 0, 0))
    )
    block = Surface(CUBE_CORNERS * (100.0, 100.0, 80.0) - (50.0, 50.0, 80.0), CUBE_FACES)
    sheet = block.with_faces(np.flatnonzero((block.triangles[..., 2] == 0.0).all(axis=1)))
    settings = load_settings("quick", (), {"picture.width": 32, "picture.height": 32})
    keep_for_report(tmp_path, block, sheet, [scan], None, settings, front_deg=0.0)
    with np.load(tmp_path / "likeness.npz") as kept:
        counts = kept["coverage"]
    rows, columns = counts.shape
    ahead = np.r_[-columns // 9 : columns // 9]
    assert (counts[rows // 3 : 2 * rows // 3, ahead] == 1).all()


def test_one_scan_from_the_front_covers_the_front():
    camera = PinholeCamera.from_field_of_view(60, 60, 30.0)
    scan = RangeScan(np.full((60, 60), 200.0), camera, look_at((0.0, 0.0, 250.0), (0.0, 0.0, 0.0)))
    counts = counted([scan.points_mm()] * 2, np.zeros(3))
    columns = counts.shape[1]
    assert counts.max() == 2
    assert not counts[:, columns // 4 : 3 * columns // 4].any()


def test_the_coverage_sphere_weighs_by_solid_angle():
    counts = np.zeros((36, 72), np.uint16)
    counts[:18] = 1
    assert seen_share(counts) == pytest.approx(0.5)
    front, back = halves(Coverage(counts, [("a", 0.0, 0.0), ("b", 180.0, 30.0)], (90.0, 0.0), "from the side"))
    assert [m.name for m in front.marks] == ["a", "next view"] and [m.name for m in back.marks] == ["b", "next view"]
    assert (front.marks[0].x, front.marks[0].y) == (0.0, 0.0)
    # +x is to the right from the front and to the left from behind
    assert front.marks[1].x == pytest.approx(1.0) and back.marks[1].x == pytest.approx(-1.0)


def test_a_report_of_little_is_still_a_report():
    page = html.unescape(report_html(ReportContent("nothing", False, "Nothing was made.", ["<b>no scans</b> & nothing else"])))
    assert "Not fit." in page and "<b>no scans</b> & nothing else" in page
    assert "default-src 'none'" in page and "data.library" in page and '"library"' not in page


def test_the_page_can_be_made_again_from_the_folder_of_the_job(job, tmp_path, capsys):
    first = (job / "report.html").read_text()
    assert exit_status(["report", str(job), "-q"]) == 0
    # only the time that the page itself took is not yet known to the first
    assert abs(len((job / "report.html").read_text()) - len(first)) < 400
    study = tmp_path / "study"
    study.mkdir()
    chart = {"slug": "time", "title": "Error against time", "kind": "line"}
    (study / "rays.json").write_text(json.dumps({"schema": "rangecheck/study/1", "title": "Rays", "charts": [chart]}))
    (study / "rays-time.svg").write_bytes(b'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1 1"/>')
    assert exit_status(["report", str(job), "--study", str(study), "-q"]) == 0
    assert "Error against time" in (job / "report.html").read_text()
    assert exit_status(["report", str(study), "-q"]) == 2
    assert exit_status(["report", str(job), "--study", str(job / "frames"), "-q"]) == 2
    assert "holds no charts" in capsys.readouterr().err


def test_shares_of_the_surface_say_of_which_surface(job):
    """What is judged leaves base and back aside, which nobody measures; what is counted does not: the two are not to be mixed up."""
    said = page_of(job, json.loads((job / "run.json").read_text())).reasons
    assert any("of the surface, base and back left aside, was never measured; 0 % is allowed" in reason for reason in said)
    assert any(reason.startswith("of the whole surface, with base and back, ") for reason in said)


def test_the_likeness_on_disk_is_the_bust_of_the_job(job):
    with np.load(io.BytesIO((job / "likeness.npz").read_bytes()), allow_pickle=False) as kept:
        light = Surface(kept["vertices_mm"].astype(float), kept["faces"], origin_of_face=kept["origin_of_face"])
        deviation, error, coverage_counts = kept["deviation_mm"], kept["error_mm"], kept["coverage"]
    document = json.loads((job / "run.json").read_text())
    assert light.volume_mm3 == pytest.approx(document["verdict"]["facts"]["volume_mm3"], rel=1e-3)
    assert light.share_of_area(MEASURED) == pytest.approx(document["area_shares"]["measured"], abs=0.01)
    assert np.nanmedian(np.abs(deviation)) < 0.2  # one standard deviation of the simulated noise
    assert np.isfinite(error).any() and coverage_counts.max() >= 1


def test_what_the_scans_lack_stands_in_the_table_with_places_and_what_mends_it(job):
    content = json.loads((job / "run.json").read_text())
    remarks = content["quality"]["findings"]
    unseen = next(f for f in remarks if f["code"] == "scan-unseen")
    assert len(unseen["places_mm"]) == min(20, content["quality"]["gaps"])
    rows = {f.code: f for f in page_of(job, content).findings}
    assert {f["code"] for f in remarks} <= set(rows)
    np.testing.assert_array_equal(rows["scan-unseen"].places_mm, unseen["places_mm"])
    assert "next view" in rows["scan-unseen"].mend
    # a bust that was scaled is elsewhere than its scans
    content["settings"]["solid"]["height_mm"] = 50.0
    moved = {f.code: f for f in page_of(job, content).findings}["scan-unseen"]
    assert not len(moved.places_mm) and moved.where == "all scans"


def test_focal_points_stand_in_the_order_of_their_azimuths(job):
    labels = [float(m.label.removesuffix("°")) for m in page_of(job, json.loads((job / "run.json").read_text())).distance_maps]
    assert labels == sorted(labels) and len(labels) > 12


def test_large_pictures_become_lighter():
    from rangecheck.export.pictures import png_bytes
    from rangecheck.report import Scan

    noise = np.random.default_rng(4).integers(0, 255, (900, 1200, 3), dtype=np.uint8)
    content = ReportContent("t", True, "v", [], scans=[Scan("s", [], [Figure("Contours", "", png_bytes(noise), "noise")])])
    page = report_html(content)
    assert "data:image/webp" in page and len(page) < len(png_bytes(noise))


def test_what_could_not_be_told_is_said_to_be_unknown(job, tmp_path):
    """A cloud has no grid, and numbers that are not numbers are null in JSON."""
    content = json.loads((job / "run.json").read_text())
    content["scans"][0] = {"name": "cloud", "camera": None, "unit": "mm", "valid": 1234, "valid_share": 1.0}
    content["quality"] |= {"expected_error_mm": None, "spacing_mm": None, "next_view": None}
    page = page_of(tmp_path, content)
    assert page.model is None and page.coverage is None and not page.distance_maps and not page.turntables
    assert "1,234" in page.scans[0].facts[0][1]
    assert ("Expected error", "unknown") in page.worth
    assert "1,234, a cloud" in report_html(page)
