"""The report in a real browser: it works as it says, is usable without a mouse, and asks nothing of the network."""

import base64
import json
import re
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import Page, browser, chromium
from rangecheck_cli.main import exit_status
from report_cases import job_of_a_vase

from rangecheck.maps import trace_maps
from rangecheck.optics import PinholeCamera
from rangecheck.report import ReportContent, Turntable, write_report
from rangecheck.rigid import look_at
from rangecheck.surface.mesh_files import read_mesh

pytestmark = pytest.mark.skipif(chromium() is None, reason="Chromium is not installed: apt-get install chromium")
READY = "!data.model || document.getElementById('view').dataset.ready"


@pytest.fixture(scope="module")
def job() -> Path:
    return job_of_a_vase()


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def page(tab, job) -> Page:
    tab.complaints.clear()
    tab.open(job / "report.html")
    tab.until(READY)
    return tab


def seen(page: Page) -> np.ndarray:
    """(h, w, 4) what the 3-D view shows."""
    page.settle()
    uri = page.run("document.getElementById('view').toDataURL()")
    return cv2.imdecode(np.frombuffer(base64.b64decode(uri.split(",")[1]), np.uint8), cv2.IMREAD_UNCHANGED)


def pose(page: Page) -> dict:
    page.settle()
    return json.loads(page.run("document.getElementById('view').dataset.pose"))


def choose(page: Page, name: str, value: str) -> None:
    page.run(f"document.querySelector('input[name={name}][value=\"{value}\"]').click()")


def test_it_opens_without_a_complaint_and_without_a_request(page):
    page.settle()
    assert page.complaints == []
    assert {address.partition(":")[0] for address in page.requests} <= {"file", "data", "blob"}
    assert page.run("document.querySelector('h1').innerText").endswith("Findings.")


def test_the_bust_is_drawn_and_each_colouring_is_another_picture(page):
    plain = seen(page)
    drawn = plain[..., 3] > 0
    assert 0.1 < drawn.mean() < 0.9
    assert plain[drawn].std() > 5
    pictures = [plain]
    for colour in page.run("[...document.querySelectorAll('input[name=colour]')].map((b) => b.value)")[1:]:
        choose(page, "colour", colour)
        pictures.append(seen(page))
    assert len(pictures) >= 5
    assert all((a != b).any() for k, a in enumerate(pictures) for b in pictures[:k])


def test_slider_turntables_and_view_turn_together(page):
    before = page.run("[...document.querySelectorAll('img.turned')].map((i) => i.src)")
    assert len(before) >= 2
    page.run("const s = document.getElementById('angle'); s.value = 90; s.dispatchEvent(new Event('input'))")
    page.run("document.getElementById('view').focus()")
    page.press("ArrowRight")
    assert pose(page)["azimuth"] == 100
    assert page.run("document.getElementById('angle').value") == "100"
    after = page.run("[...document.querySelectorAll('img.turned')].map((i) => i.src)")
    assert all(a != b for a, b in zip(before, after))
    page.press("Home")
    page.until("JSON.parse(document.getElementById('view').dataset.pose).azimuth === 0")


def test_dragging_turns_and_the_keys_zoom(page):
    x, y = page.run(
        "(() => { const b = document.getElementById('view').getBoundingClientRect(); return [b.x + b.width / 2, b.y + 200]; })()"
    )
    before = pose(page)
    page.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, button="left", buttons=1, clickCount=1)
    page.call("Input.dispatchMouseEvent", type="mouseMoved", x=x - 80, y=y, button="left", buttons=1)
    page.call("Input.dispatchMouseEvent", type="mouseReleased", x=x - 80, y=y, button="left", clickCount=1)
    turned = pose(page)
    assert turned["azimuth"] > before["azimuth"]
    page.press("+")
    assert pose(page)["distance"] < turned["distance"]


def test_a_section_cuts_the_bust_where_it_says(page):
    whole = seen(page)
    choose(page, "section", "2")
    cut = seen(page)
    assert (cut != whole).any()
    low, high = page.run("[data.model.low[2], data.model.high[2]]")
    shown = float(page.run("document.getElementById('cut-at').textContent").replace("−", "-").removesuffix(" mm"))
    assert shown == pytest.approx((low + high) / 2, abs=0.06)
    # the cut is one flat colour
    _, counts = np.unique(cut[cut[..., 3] == 255][:, :3], axis=0, return_counts=True)
    assert counts.max() > 0.3 * counts.sum()


def test_a_click_on_a_finding_takes_the_view_there(page):
    before = pose(page)
    place = page.run("data.findings[0].places[0]")
    page.run("document.querySelector('tbody button.show').click()")
    page.until(f"JSON.parse(document.getElementById('view').dataset.pose).distance < {0.5 * before['distance']}")
    np.testing.assert_allclose(pose(page)["target"], place, atol=1e-6)
    assert page.run("document.activeElement.id") == "view"


def test_a_click_anywhere_in_a_row_goes_to_its_finding(page):
    before = pose(page)
    index = page.run("[...document.querySelectorAll('tbody tr')].findIndex((row) => row.classList.contains('placed'))")
    place = page.run(f"data.findings[{index}].places[0]")
    page.run("document.querySelector('tr.placed td:last-child').click()")
    page.until(f"JSON.parse(document.getElementById('view').dataset.pose).distance < {0.5 * before['distance']}")
    np.testing.assert_allclose(pose(page)["target"], place, atol=1e-6)


def test_the_ringed_places_of_the_turntable_are_shown_one_after_the_other(page):
    places = page.run("data.findings.at(-1).places")
    assert page.run("data.findings.at(-1).code") == "stands out" and len(places) > 1
    for place in places[:2]:
        page.run("document.querySelector('.ringed button.show').click()")
        page.until(f"JSON.parse(document.getElementById('view').dataset.pose).target[0] === {place[0]}")
        np.testing.assert_allclose(pose(page)["target"], place, atol=1e-6)


def test_paper_shows_what_the_screen_folds(page):
    assert page.run("document.querySelectorAll('details:not([open])').length") > 1
    page.run("dispatchEvent(new Event('beforeprint'))")
    assert page.run("document.querySelectorAll('details:not([open])').length") == 0
    page.run("dispatchEvent(new Event('afterprint'))")
    assert page.run("document.querySelectorAll('details:not([open])').length") > 1
    assert len(page.call("Page.printToPDF")["data"]) > 10_000


def test_the_report_is_printed_on_few_pages_and_nothing_else_is_changed(job, capsys):
    assert exit_status(["report", str(job), "-q"]) == 0
    before = (job / "report.html").read_bytes()
    assert exit_status(["report", str(job), "--pdf", "-q"]) == 0
    assert (job / "report.html").read_bytes() == before
    pages = re.findall(rb"/Type\s*/Page\b", (job / "report.pdf").read_bytes())
    assert 3 <= len(pages) <= 8


def test_without_a_browser_printing_says_in_one_line_how_else(job, capsys, monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert exit_status(["report", str(job), "--pdf", "-q"]) == 2
    said = capsys.readouterr().err
    assert "apt-get install chromium" in said and len(said.splitlines()) == 1


def test_the_value_under_the_cursor_is_the_measured_distance(page, job):
    with np.load(job / "maps" / "azimuth_0" / "maps.npz", allow_pickle=False) as found:
        distance = found["distance_mm"]
    step = page.run("data.maps[0].distance.step")
    page.run("document.getElementById('map').scrollIntoView({block: 'center', behavior: 'instant'})")
    page.settle()
    left, top, width, height = page.run(
        "(() => { const b = document.getElementById('map').getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; })()"
    )
    scale = min(width / distance.shape[1], height / distance.shape[0])
    left, top = left + (width - scale * distance.shape[1]) / 2, top + (height - scale * distance.shape[0]) / 2
    rows, columns = np.nonzero(np.isfinite(distance))
    for k in np.linspace(0, len(rows) - 1, 5).astype(int):
        v, u = rows[k], columns[k]
        page.point_at(left + (u + 0.5) * scale, top + (v + 0.5) * scale)
        page.until(f"document.getElementById('map').dataset.pixel === '{u},{v}'")
        shown = float(page.run("document.getElementById('map-value').textContent").removesuffix(" mm"))
        assert shown == pytest.approx(distance[v, u], abs=0.005 + step / 2 + 1e-6)
    page.point_at(left + 0.5 * scale, top + 0.5 * scale)
    page.until("document.getElementById('map-value').textContent === 'nothing'")


def test_a_pixel_of_the_map_is_a_place_on_the_bust(page):
    """Enter marks the place in the 3-D view: it lies on the surface that the view shows."""
    page.run("document.getElementById('map').focus()")
    page.press("ArrowLeft")
    page.press("Enter")
    page.until(
        "JSON.parse(document.getElementById('view').dataset.pose).distance < 0.5 * 1e9 && document.activeElement.id === 'view'"
    )
    target = np.array(pose(page)["target"])
    low, high = (np.array(page.run(f"data.model.{end}")) for end in ("low", "high"))
    assert (target >= low - 0.1).all() and (target <= high + 0.1).all()


def test_focal_points_are_changed_by_the_keys(page):
    page.run("document.querySelector('input[name=focal]').focus()")
    page.press("ArrowRight")
    page.until("document.getElementById('map').dataset.map === '1'")


def test_from_a_focal_point_of_the_readers_choice_the_page_measures_what_a_distance_map_holds(page, job):
    surface = read_mesh(job / "surface.ply", "mm")
    middle = surface.bounds_mm.mean(axis=0)
    page.until("!document.getElementById('anywhere').hidden")
    width, height, intrinsics = page.run("(({ width, height, intrinsics }) => [width, height, intrinsics])(data.maps[0])")
    camera = PinholeCamera(width, height, *intrinsics)
    page.run("document.getElementById('map').focus()")
    page.press("ArrowLeft")
    for azimuth, elevation, distance in ((33.0, 21.5, 300.0), (-120.0, -80.0, 260.0), (200.0, 7.0, 900.0)):
        chosen = {"azimuth": azimuth, "elevation": elevation, "distance": distance}
        page.run(
            f"for (const [name, x] of Object.entries({json.dumps(chosen)})) document.getElementById(`focal-${{name}}`).value = x; 0"
        )
        page.run("document.getElementById('focal-azimuth').dispatchEvent(new Event('input'))")
        assert page.run("document.getElementById('map').dataset.map") == "other"
        a, e = np.radians((azimuth, elevation))
        eye = middle + distance * np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        pose = look_at(eye, middle)
        maps = trace_maps(surface, camera, pose)
        true = maps.distance_mm
        asked = f"offers.distances({json.dumps(pose.tolist())}, {json.dumps(intrinsics)}, {width}, {height}).values"
        found = np.array(page.run(f"Array.from({asked}, (x) => (Number.isNaN(x) ? -1 : x))")).reshape(height, width)
        seen = found >= 0
        assert (seen != np.isfinite(true)).sum() <= 0.02 * seen.sum()  # a ray along a silhouette meets it or not by a rounding
        both = seen & np.isfinite(true)
        assert both.sum() > 50
        # a vertex is kept to half a step, and an edge drawn to the 16th of a pixel that OpenGL asks for: across the face that is as much, along a ray that grazes it more
        off, step = np.abs(found - true)[both], page.run("data.model.step")
        across = off * np.cos(maps.incidence_rad[both])
        assert np.median(off) < step and np.quantile(across, 0.99) < step + distance / intrinsics[0] / 16
        u, v = map(int, page.run("document.getElementById('map').dataset.pixel").split(","))
        shown = page.run("document.getElementById('map-value').textContent")
        assert shown == ("nothing" if found[v, u] < 0 else f"{found[v, u]:.2f} mm")


def test_a_focal_point_inside_the_bust_or_out_of_bounds_is_said_to_be_so(page):
    page.until("!document.getElementById('anywhere').hidden")
    for distance, said in (("2", "inside the bust"), ("0", "1 to 100000"), ("", "1 to 100000"), ("300", "")):
        page.run(f"document.getElementById('focal-distance').value = '{distance}'; 0")
        page.run("document.getElementById('focal-distance').dispatchEvent(new Event('input'))")
        assert said in page.run("document.getElementById('focal-status').textContent")
    page.run("document.getElementById('focal-view').click()")
    eye = json.loads(page.run("document.getElementById('view').dataset.pose"))
    assert float(page.run("document.getElementById('focal-distance').value")) == pytest.approx(eye["distance"], abs=0.06)


@pytest.mark.parametrize("width, scheme", [(1280, "light"), (400, "dark")])
def test_nobody_is_shut_out(tab, job, width, scheme):
    axe = (resources.files("axe_core_python") / "axe.min.js").read_text("utf-8")
    tab.open(job / "report.html", width=width, scheme=scheme)
    tab.until(READY)
    assert tab.run("document.documentElement.scrollWidth") <= width
    tab.run("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    tab.run(axe + "; 0")
    found = json.loads(
        tab.run("axe.run().then((r) => JSON.stringify(r.violations.map((v) => [v.impact, v.id, v.nodes[0].html])))")
    )
    assert [v for v in found if v[0] in ("serious", "critical")] == []


def test_without_webgl_the_rest_still_works(tab, job):
    script = tab.call(
        "Page.addScriptToEvaluateOnNewDocument",
        source="const get = HTMLCanvasElement.prototype.getContext;"
        "HTMLCanvasElement.prototype.getContext = function (kind, ...rest) { return kind === '2d' ? get.call(this, kind, ...rest) : null; }",
    )
    try:
        tab.open(job / "report.html")
        tab.until("document.getElementById('view-status').textContent.includes('WebGL')")
        tab.until("document.getElementById('map').dataset.map === '0'")
        assert tab.run("document.getElementById('view-frame').hidden")
    finally:
        tab.call("Page.removeScriptToEvaluateOnNewDocument", identifier=script["identifier"])


def test_a_turntable_that_starts_elsewhere_shows_the_frame_of_the_azimuth(tab, tmp_path):
    frames = []
    for k in range(4):
        frames.append(tmp_path / f"{k}.png")
        cv2.imwrite(str(frames[-1]), np.full((8, 8, 3), 60 * k, np.uint8))
    tables = [Turntable("plaster", frames, start_deg=90.0)]
    write_report(ReportContent("turned", True, "Only frames.", [], turntables=tables), tmp_path / "report.html")
    tab.open(tmp_path / "report.html")
    for azimuth, frame in ((90, 0), (180, 1), (0, 3)):
        tab.run(
            f"document.getElementById('angle').value = {azimuth}; document.getElementById('angle').dispatchEvent(new Event('input'))"
        )
        assert tab.run(f"document.querySelector('img.turned').src === data.tables[0].frames[{frame}]")
