"""What happens to scans before they become a surface: poses proved or refused, filters that say what they took, worth measured."""

import json

import numpy as np
import pytest
from rangecheck_cli.main import exit_status
from registration_cases import pebble, plate, ring, shaken

from rangecheck import rigid
from rangecheck.config import load_settings
from rangecheck.errors import PosesRefused
from rangecheck.pipeline.preparing import prepared
from rangecheck.pipeline.together import sentence_of, verdicts_of
from rangecheck.progress import Reporter
from rangecheck.scan.point_cloud import PointCloud
from rangecheck.scan.readers import write_scans
from rangecheck.scan.registration import check_poses
from rangecheck.solid.findings import Verdict, finding


@pytest.fixture(scope="module")
def views():
    return ring(pebble(1), 6)


def ready(scans, *assignments, quality=False):
    reporter = Reporter()
    return prepared(scans, load_settings(assignments=assignments), reporter, quality=quality), reporter.notes


def test_true_poses_are_left_alone_and_the_pairs_say_so(views):
    given = check_poses(views)
    assert given.agreeing and not given.contradicted and not given.missing
    made, notes = ready(views)
    assert made.registration["verdict"] == "given"
    assert all(np.array_equal(a.world_from_scan, b.world_from_scan) for a, b in zip(made.scans, views))
    assert any("agree at the poses given" in note for note in notes)


def test_poses_that_the_scans_contradict_are_mended_and_it_is_said(views):
    made, notes = ready(shaken(views, 4.0, 3.0))
    assert made.registration["verdict"] == "aligned" and made.registration["guess"] == "poses"
    assert not check_poses(made.grids).contradicted
    assert any("disagree at the poses given" in note for note in notes)


def test_taken_as_given_they_stay_wrong(views):
    off = shaken(views, 4.0, 3.0)
    made, _ = ready(off, "scan.registration=off")
    assert made.registration is None
    assert all(np.array_equal(a.world_from_scan, b.world_from_scan) for a, b in zip(made.scans, off))


def test_scans_that_cannot_belong_together_are_refused_with_status_1(tmp_path, capsys):
    strangers = [ring(pebble(1), 1, name="one")[0], ring(plate(4.0), 1, name="two")[0]]
    same = [scan.moved(rigid.identity()) for scan in strangers]
    assert check_poses(same).missing
    with pytest.raises(PosesRefused, match="register off"):
        ready(same)
    manifest = write_scans(tmp_path / "scans", same, step_mm=0.02)
    for command in (["mesh", str(manifest), "-o", str(tmp_path / "m.ply")], ["check", str(manifest)]):
        assert exit_status([*command, "--json", "-q"]) == 1
        document = json.loads(capsys.readouterr().out)
        assert document["fit"] is False
    assert not (tmp_path / "m.ply").exists()


def test_filters_say_what_they_removed_and_noise_is_told(views):
    ranges = views[0].range_mm.copy()
    row, column = (int(v) for v in np.argwhere(views[0].valid)[len(ranges)])
    ranges[row, column] -= 60
    from dataclasses import replace

    spoiled = replace(views[0], range_mm=ranges, noise_mm=None)
    made, notes = ready([spoiled], 'scan.filters=["isolated","flying"]')
    assert len(made.filtered) == 2 and all("view0" in said for said in made.filtered)
    assert made.grids[0].valid.sum() < spoiled.valid.sum()
    assert made.grids[0].noise_mm == pytest.approx(0.1, rel=0.3)
    assert any("noise told" in note for note in notes)


def test_worth_is_measured_with_the_next_view(views):
    made, _ = ready(views[:3], quality=True)
    worth = made.quality
    assert worth["verdict"] == "unfit" and worth["next_view"] is not None
    assert worth["never_seen"] > 0.2 and len(worth["views"]) == 3
    assert any(line.startswith("next view") for line in made.quality_lines)


def test_clouds_pass_as_they_are(views):
    cloud = PointCloud(views[0].points_mm())
    made, _ = ready([cloud], quality=True)
    assert made.scans == [cloud] and made.quality is None


def test_one_sentence_says_all_verdicts_the_worst_first():
    solid = Verdict((), {"volume_mm3": 1000.0})
    scans = {
        "verdict": "unfit",
        "profile": {"name": "bust-150"},
        "findings": [{"severity": "error", "text": "half was never seen"}],
    }
    likeness = {"fit": True, "verdict": "accurate enough for a bust: its noise is within"}
    rows = verdicts_of(solid, scans, likeness)
    assert [row["word"] for row in rows] == ["unfit", "accurate enough", "fit"]
    assert sentence_of(rows).startswith("scans for bust-150: unfit; ") and "half was never seen" in sentence_of(rows)
    assert [row["about"] for row in verdicts_of(solid, None, likeness)] == ["likeness where it was seen", "solid"]


def test_a_solid_held_back_for_its_scans_is_still_called_a_solid():
    held = Verdict((finding("too-much-invented", 3, "40 % was never measured"),), {"volume_mm3": 1000.0})
    assert not held.fit and held.sentence() == "solid, but not fit: 40 % was never measured"
    open_too = Verdict((*held.findings, finding("open-edges", 3, "it is open")), {})
    assert open_too.sentence().startswith("not solid: ")
