"""Options that mean the same everywhere, and how results and progress are shown.

Messages go to stderr, results to stdout; with --json stdout holds one JSON document and nothing else.
"""

from __future__ import annotations

import functools
import json
import math
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rangecheck import progress
from rangecheck.progress import Reporter

from .completing import among, assignments, shipped
from .memory import bound_memory

if TYPE_CHECKING:
    from rangecheck.pipeline import Outcome

UNITS = ("mm", "cm", "m", "um", "in")


class Size(click.ParamType):
    """WxH in pixels."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        try:
            width, height = (int(part) for part in value.lower().split("x"))
        except ValueError:
            self.fail(f"{value!r} is not a size; write WIDTHxHEIGHT in pixels, for example 640x480", param, ctx)
        return width, height


class Point(click.ParamType):
    """Three finite numbers, `said` to be a point in millimetres unless something else."""

    name = "X,Y,Z"

    def __init__(self, said: str = "a point; write X,Y,Z in millimetres, for example 0,150,900") -> None:
        self.said = said

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        try:
            x, y, z = (float(part) for part in value.split(","))
        except ValueError:
            x = y = z = math.nan
        if not all(map(math.isfinite, (x, y, z))):
            self.fail(f"{value!r} is not {self.said}", param, ctx)
        return x, y, z


_OPTIONS: dict[str, Callable[..., Any]] = {
    "unit": click.option("--unit", type=click.Choice(UNITS), help="Unit of length of inputs that do not say theirs."),
    "out": click.option("--out", "out", type=click.Path(), required=True, metavar="DIR", help="Folder for the results."),
    "out_file": click.option(
        "-o", "--output", "out", type=click.Path(), required=True, metavar="FILE", help="Where to write the result."
    ),
    "out_dir": click.option(
        "-o", "--out", "out", type=click.Path(), required=True, metavar="DIR", help="Folder for the results."
    ),
    "size": click.option("--size", type=Size(), help="Picture size in pixels, WIDTHxHEIGHT."),
    "frames": click.option("--frames", type=click.IntRange(1), help="Frames of one full turn."),
    "frames_dir": click.option("--frames-dir", type=click.Path(), metavar="DIR", help="Where frames are kept between runs."),
    "material": click.option(
        "--material",
        metavar="NAME",
        shell_complete=shipped("materials"),
        help="A material of configs/materials, or a material file.",
    ),
    "tolerance": click.option(
        "--tolerance",
        metavar="P%",
        callback=lambda c, p, v: _percent(v),
        help="Allowed error of light, per cent of the frame's mean.",
    ),
    "threads": click.option(
        "--threads", type=click.IntRange(0), help="Threads to use; results do not depend on it. 0: all cores."
    ),
    "seed": click.option("--seed", type=click.IntRange(0), help="Seed of every random number."),
    "config": click.option(
        "--config",
        metavar="FILE",
        shell_complete=shipped("jobs"),
        help="Settings: a TOML file or a preset (quick, normal, fine).",
    ),
    "preset": click.option(
        "--preset",
        type=click.Choice(["quick", "normal", "fine"]),
        help="Settings to start from; --config and --set go over them.",
    ),
    "set": click.option(
        "--set",
        "assignments",
        multiple=True,
        metavar="KEY=VALUE",
        shell_complete=among(assignments),
        help="One setting, for example turntable.frames=72.",
    ),
    "register": click.option(
        "--register",
        type=click.Choice(["auto", "off", "poses", "turntable", "all"]),
        help="Poses of the scans. auto: moved only where the scans contradict them; off: taken as given; poses: refined; "
        "turntable: taken in order around one axis; all: nothing is known.",
    ),
    "filter": click.option(
        "--filter",
        "filters",
        multiple=True,
        type=click.Choice(["flying", "isolated", "oblique", "smooth"]),
        help="Filter the scans first; may be given several times, in order.",
    ),
    "refine": click.option(
        "--refine", is_flag=True, help="Refine heights, within their noise, by the shading of linear brightness."
    ),
    "memory": click.option(
        "--memory-mb",
        type=click.FloatRange(256),
        help="Most memory to take, in MB, with all that is started; over the setting memory_mb. What needs more ends and says so.",
    ),
    "json": click.option("--json", "as_json", is_flag=True, help="Print one JSON document on stdout and nothing else."),
    "log": click.option(
        "--log", type=click.Path(dir_okay=False), metavar="FILE", help="Append what is done, with the time, to FILE."
    ),
    "dry_run": click.option(
        "--dry-run", is_flag=True, help="Check inputs, settings, encoder, cluster and room on the disk; compute nothing."
    ),
    "explain": click.option(
        "--explain", is_flag=True, help="Say of each finding what it means, why it matters and what mends it."
    ),
    "force": click.option("--force", is_flag=True, help="Replace existing results."),
}


def _percent(text: str | None) -> float | None:
    if text is None:
        return None
    try:
        return float(text.rstrip("%"))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not a percentage; write for example 0.5%") from None


def common(*names: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add the named options, and always --json, --threads, --memory-mb, --log, -v and -q."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def command(
            *args: Any, verbose: int, quiet: bool, threads: int | None, memory_mb: float | None, as_json: bool, log: str | None,
            explain: bool = False, **kwargs: Any,
        ) -> int:  # fmt: skip
            if memory_mb:
                click.get_current_context().call_on_close(bound_memory(memory_mb))
            if threads:
                from rangecheck import kernels

                kernels.set_threads(threads)
            _keep_inputs(kwargs)
            reporter = ConsoleReporter(-1 if quiet else verbose, Log(log) if log else None)
            try:
                outcome: Outcome = function(*args, reporter=reporter, **kwargs)
                if explain:
                    from rangecheck.pipeline.inspect import explained

                    outcome = explained(outcome)
                for line in outcome.lines:
                    reporter.remember(line)
            except BaseException as error:
                reporter.remember(f"{type(error).__name__}: {error}")
                raise
            finally:
                reporter.close()
            return show(outcome, as_json)

        command = click.option("-q", "--quiet", is_flag=True, help="No progress, no notes.")(command)
        command = click.option("-v", "--verbose", count=True, help="More about what is done.")(command)
        for name in reversed(("json", "threads", "memory", "log")):
            command = _OPTIONS[name](command)
        for name in reversed(names):
            command = _OPTIONS[name](command)
        return command

    return decorate


#: options and arguments that name what is written, by their names in Python
_WRITTEN = ("out", "frames_dir")


def _keep_inputs(given: dict[str, Any]) -> None:
    """Raises OutputError where a command would write over what it reads, --force or not."""
    written = [Path(given[name]) for name in _WRITTEN if given.get(name)]
    for output in filter(Path.exists, written):
        for name, value in given.items():
            for one in value if isinstance(value, tuple) else (value,):
                if name not in _WRITTEN and isinstance(one, str) and one and len(one) < 4096 and "\0" not in one:
                    with suppress(OSError):
                        if output.samefile(one):
                            from rangecheck.errors import OutputError

                            raise OutputError(output, "is read by this command; choose another place for what it writes")


def show(outcome: Outcome, as_json: bool) -> int:
    """Print an outcome; exit status 0 when what was inspected is fit, else 1."""
    if as_json:
        click.echo(json.dumps(outcome.document, indent=1, allow_nan=False, ensure_ascii=False))
    else:
        for line in outcome.lines:
            click.echo(line)
    return 0 if outcome.fit else 1


#: how each line of a log begins
_LOGGED = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z ")


class Log:
    """Lines with the time (UTC), appended to a file. Raises OutputError at once when it cannot be written, or holds something else than a log."""

    def __init__(self, path: str) -> None:
        from rangecheck.errors import OutputError

        try:
            with suppress(FileNotFoundError), Path(path).open("rb") as before:
                first = before.readline(100)
                if first and not _LOGGED.match(first):
                    raise OutputError(path, "is no log of rangecheck; choose another --log")
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            self._file = Path(path).open("a", encoding="utf-8")  # noqa: SIM115 - closed by the reporter
        except OSError as error:
            raise OutputError(path, f"cannot be written ({error.strerror}); choose another --log") from None
        self.write(" ".join(sys.argv[1:]))

    def write(self, text: str) -> None:
        """One line, on the disk when this returns."""
        self._file.write(f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%S.%f}"[:-3] + f"Z {text}\n")
        self._file.flush()

    def close(self) -> None:
        """Write no more."""
        self._file.close()


class ConsoleReporter(Reporter):
    """Progress on stderr: a live bar on a terminal, one plain line a stage elsewhere. With a log, everything goes there too."""

    def __init__(self, verbosity: int, log: Log | None = None) -> None:
        super().__init__()
        self.verbosity = verbosity
        self._log = log
        progress.on_first_compile = lambda: self._say("compiling kernels for this machine: only the first start takes this long")
        self._bar: Any = None
        self._task: Any = None
        if verbosity >= 0 and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import (
                BarColumn,
                MofNCompleteColumn,
                Progress,
                ProgressColumn,
                Task,
                TextColumn,
                TimeElapsedColumn,
                TimeRemainingColumn,
            )
            from rich.text import Text

            class Rate(ProgressColumn):
                """Steps a second, of stages that have some."""

                def render(self, task: Task) -> Text:
                    speed = task.finished_speed or task.speed
                    return Text("" if speed is None or (task.total or 0) < 2 else f"{speed:.3g}/s")

            self._bar = Progress(
                TextColumn("{task.description:<28}"),
                BarColumn(bar_width=30),
                MofNCompleteColumn(),
                Rate(),
                TimeElapsedColumn(),
                TimeRemainingColumn(),
                console=Console(stderr=True),
                transient=False,
            )
            self._bar.start()

    def note(self, text: str) -> None:
        super().note(text)
        self._say(text)

    def remember(self, text: str) -> None:
        """Into the log, where there is one."""
        if self._log is not None:
            self._log.write(text)

    def _say(self, text: str) -> None:
        self.remember(text)
        if self.verbosity < 0:
            return
        if self._bar is not None:
            self._bar.console.print(text, highlight=False, markup=False)
        else:
            click.echo(text, err=True)

    def begin(self, name: str, total: int) -> None:
        self.remember(f"{name} ...")
        if self._bar is not None:
            self._task = self._bar.add_task(name, total=total or 1)

    def advance(self, done: int) -> None:
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done)

    def end(self, name: str, seconds: float) -> None:
        self.remember(f"{name}: {seconds:.1f} s")
        if self._bar is not None and self._task is not None:
            total = self._bar.tasks[self._task].total
            self._bar.update(self._task, completed=total)
            self._task = None
        elif self.verbosity >= 0:
            click.echo(f"{name}: {seconds:.1f} s", err=True)

    def close(self) -> None:
        """Leave the terminal as it was, and the log whole."""
        progress.on_first_compile = None
        if self._log is not None:
            self._log.close()
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


def settings_from(config: str | None, assignments: tuple[str, ...], preset: str | None = None, **overrides: Any) -> Any:
    """Resolved settings; dunder names in `overrides` stand for dots (turntable__frames)."""
    from rangecheck.config import load_settings

    settings = load_settings(config, assignments, {key.replace("__", "."): value for key, value in overrides.items()}, preset)
    given = click.get_current_context().params
    if settings.memory_mb is not None and not given.get("memory_mb"):
        click.get_current_context().call_on_close(bound_memory(settings.memory_mb))
    if settings.threads and not given.get("threads"):
        from rangecheck import kernels

        kernels.set_threads(settings.threads)
    return settings
