"""Many subjects: each its own job in its own folder, and one that is refused stops no other."""

import pytest
from rangecheck_cli.main import exit_status

from rangecheck.errors import InputError
from rangecheck.pipeline import many
from rangecheck.pipeline.outcome import Outcome


@pytest.fixture
def jobs(monkeypatch):
    """Stands in for the job itself; remembers what it was asked for."""
    asked = []

    def run(scans, out, *, settings, unit, force, reporter):
        asked.append((scans, out))
        if "spoilt" in scans[0]:
            raise InputError(scans[0], "holds no scan")
        return Outcome({}, [], "crooked" not in scans[0])

    monkeypatch.setattr(many, "run", run)
    return asked


def test_each_subject_gets_its_own_folder_and_the_worst_decides(jobs, tmp_path, capsys):
    scans = [str(tmp_path / name) for name in ("ann", "spoilt bob", "crooked cy", "dee.conf")]
    assert exit_status(["run", *scans, "--each", "--out", str(tmp_path / "out"), "-q"]) == 1
    said = capsys.readouterr().out
    assert [out.rsplit("/", 1)[1] for _, out in jobs] == ["ann", "spoilt bob", "crooked cy", "dee"]
    assert "ann: fit\n" in said and "crooked cy: not fit" in said and "2 of 4 subjects are fit" in said
    assert "spoilt bob: refused" in said and "holds no scan" in said
    assert exit_status(["run", scans[0], "--each", "--out", str(tmp_path / "alone"), "-q"]) == 0


def test_two_subjects_of_one_name_are_refused_before_any_work(jobs, tmp_path, capsys):
    assert exit_status(["run", str(tmp_path / "a/ann"), str(tmp_path / "b/ann"), "--each", "--out", str(tmp_path / "out")]) == 2
    assert "two subjects are called ann" in capsys.readouterr().err and not jobs
