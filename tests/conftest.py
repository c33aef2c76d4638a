"""Shared fixtures; where the real scans are; which tests share a process."""

import contextlib
import io
import os
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import hypothesis
import pytest

# as the command has it: two workers' threads would wait for each other over small matrices
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

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


@dataclass(frozen=True)
class Command:
    """A command of README and what stands below it there."""

    arguments: tuple[str, ...]
    said: str


def readme_commands() -> list[Command]:
    """Every command in README, in order."""
    blocks = re.findall(r"^```console\n(.*?)^```(?:\n\n```text\n(.*?)^```)?", (ROOT / "README.md").read_text(), re.S | re.M)
    found = []
    for block, said in blocks:
        lines = [line[2:] for line in block.splitlines() if line.startswith("$ ")]
        for line in lines:
            program, *arguments = shlex.split(line)
            assert program == "rangecheck"
            found.append(Command(tuple(arguments), said if line == block.splitlines()[-1][2:] else ""))
    return found


@dataclass(frozen=True)
class Job:
    """README's first command, done: the whole job on the eight sample views. `folder` is where it was done, `out` what it made."""

    folder: Path
    out: Path
    status: int
    told: str


@pytest.fixture(scope="session")
def readme_job(tmp_path_factory) -> Job:
    """README's first command, which is the whole job: minutes of work that the tests of README and of the job share."""
    from rangecheck_cli.main import exit_status

    folder = tmp_path_factory.mktemp("job") / "bust, eight views"
    folder.mkdir()
    for name in ("sample_data", "configs"):
        (folder / name).symlink_to(ROOT / name)
    first = readme_commands()[0].arguments
    assert first[:2] == ("run", "sample_data")
    told = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
        status = exit_status([*first])
    return Job(folder, folder / first[first.index("--out") + 1], status, told.getvalue())


#: files whose tests take longest, or share what takes long, first: where they began last, one process would end alone
LONGEST = (
    ("test_readme", "test_run"), ("test_animation_consistency",), ("test_registration",), ("test_hardness",), ("test_transport_plan",),
    ("test_report", "test_report_browser"), ("test_packaging",), ("test_decode",),
)  # fmt: skip


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of one file, and of files that share a job, go to one process; the longest begin first."""
    ranks = {name: (rank, " and ".join(names)) for rank, names in enumerate(LONGEST) for name in names}
    for item in items:
        name = item.path.stem
        item.add_marker(pytest.mark.xdist_group(ranks[name][1] if name in ranks else str(item.path)))
    items.sort(key=lambda item: ranks.get(item.path.stem, (len(LONGEST), ""))[0])


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
