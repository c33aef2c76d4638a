"""Shared fixtures; where the real scans are."""

import os
from pathlib import Path

import hypothesis
import pytest

# how long an example takes says something of the machine, not of the code
hypothesis.settings.register_profile("any machine", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow])
hypothesis.settings.load_profile("any machine")

ROOT = Path(__file__).resolve().parent.parent


def real_data_folder() -> Path | None:
    """The folder of real scans (RANGECHECK_DATA, else ../shared/data), or None where it is absent."""
    folder = Path(os.environ.get("RANGECHECK_DATA", ROOT.parent / "shared" / "data"))
    return folder if (folder / "README.md").is_file() else None


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real scans; skips the test, with the reason, where it is absent."""
    folder = real_data_folder()
    if folder is None:
        pytest.skip("no real scans here: set RANGECHECK_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def sample_data() -> Path:
    """The scans that the project made itself."""
    return ROOT / "sample_data"


@pytest.fixture(scope="session", autouse=True)
def documents_keep_their_schemas():
    """Every JSON document that any test has made, for a program or for the disk, is as its published schema says."""
    import schemas_kept

    from rangecheck import files
    from rangecheck.pipeline.outcome import Outcome

    made, written = Outcome.__init__, files.write_bytes

    def outcome(self, document, *more, **others):
        schemas_kept.require(document)
        made(self, document, *more, **others)

    def write_bytes(path, content, **others):
        schemas_kept.require_text(path, content)
        written(path, content, **others)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Outcome, "__init__", outcome)
        patch.setattr(files, "write_bytes", write_bytes)  # as write_json calls it
        yield


_real_data_passed = 0


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    global _real_data_passed
    if report.when == "call" and report.passed and "real_data" in report.keywords:
        _real_data_passed += 1


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Where real scans are expected, a run that tested fewer than it should has failed."""
    if hasattr(session.config, "workerinput"):
        return  # one of several test processes: the one that gathers their reports counts
    expected = int(os.environ.get("RANGECHECK_EXPECT_REAL_DATA", "0"))
    if _real_data_passed < expected and session.exitstatus == pytest.ExitCode.OK:
        print(f"\n{_real_data_passed} tests with real data passed; {expected} were expected")
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
