"""run --each: many subjects, each a whole job in a folder of its own, one after the other or spread over a cluster.

On a cluster, scans and results are files that every worker must find under the same names, as on a shared disk. A lost worker's subject is
taken up by another where it was left, and the bytes are those of one machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rangecheck.config import Settings
from rangecheck.errors import RangecheckError, SettingError
from rangecheck.pipeline.folder import check_writable, key_of
from rangecheck.pipeline.job import run
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.progress import Reporter


@dataclass(frozen=True)
class Subjects:
    """Everything that determines the jobs; it travels to other machines as it is."""

    scans: tuple[str, ...]
    folders: tuple[str, ...]
    settings: Settings
    unit: str | None
    force: bool


def run_each(
    scans: Sequence[str], out: str, *, settings: Settings, unit: str | None, force: bool, reporter: Reporter, scheduler: str | None = None
) -> Outcome:  # fmt: skip
    """Each of `scans` is a subject of its own; its results go to a folder in `out` that bears its name.

    A subject that is refused does not stop the others; the outcome is fit when all are. Raises SettingError when two bear one name."""
    names = folder_names(scans)
    check_writable(out)
    here = [str(Path(path).resolve()) for path in scans]
    job = Subjects(tuple(here), tuple(str(Path(out).resolve() / name) for name in names), settings, unit, force)
    found: dict[int, dict[str, Any]] = {}
    with reporter.stage("subjects", len(names)):
        for index, result in _made(job, scheduler, reporter):
            found[index] = result
            reporter.advance(len(found))
            reporter.note(f"{names[index]}: {result['said']}")
    rows = [{"name": name, "folder": job.folders[k]} | found[k] for k, name in enumerate(names)]
    fit = sum(bool(row["fit"]) for row in rows)
    return Outcome(
        document("run-each", subjects=rows, fit=fit == len(rows), seconds=reporter.seconds),
        [
            *(f"{row['name']}: {row['said']}" for row in rows),
            f"{fit} of {len(rows)} subjects are fit; each has its report in {out}",
        ],
        fit == len(rows),
    )


def folder_names(scans: Sequence[str]) -> list[str]:
    """The folder of each subject. Raises SettingError when two bear one name."""
    names = [Path(path).resolve().name.split(".")[0] for path in scans]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise SettingError(f"two subjects are called {twice[0]}; results are told apart by the name, so rename one", key=twice[0])
    return names


def _made(job: Subjects, scheduler: str | None, reporter: Reporter) -> Iterator[tuple[int, dict[str, Any]]]:
    if scheduler is None:
        make = subjects_of(job)
        yield from ((index, make(index)) for index in range(len(job.scans)))
        return
    from rangecheck.animation.farm import Farm

    with Farm(scheduler) as farm:
        reporter.note(f"subjects are made at {scheduler} by {farm.threads()} threads")
        key = key_of(scans=job.scans, folders=job.folders, settings=job.settings.determining(), unit=job.unit)
        yield from farm.spread(subjects_of, job, key)(range(len(job.scans)))


def subjects_of(job: Subjects) -> Callable[[int], dict[str, Any]]:
    """The function that does the job of subject k, and says how it ended."""

    def make(index: int) -> dict[str, Any]:
        try:
            done = run(
                [job.scans[index]], job.folders[index], settings=job.settings, unit=job.unit, force=job.force, reporter=Reporter()
            )
        except RangecheckError as error:
            return {"fit": False, "refused": True, "said": f"refused: {error}"}
        return {"fit": bool(done.fit), "refused": False, "said": "fit" if done.fit else "not fit"}

    return make
