"""Entry point: finds the command, maps errors to exit statuses.

Exit status: 0 done and fit; 1 done, and what was inspected is not fit; 2 wrong usage or unreadable input; 130 interrupted.
A command's module is imported only when the command is called, so that `rangecheck --help` stays quick.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any, NoReturn

import click

from .memory import OUT_OF_MEMORY

#: command -> (module, one line for --help); a test keeps the lines equal to the commands' own
COMMANDS = {
    "run": "Do the whole job: mesh, check, close, render, measure, export STL, report.",
    "check": "Check range scans or mesh files; verdict, findings with places, numbers.",
    "mesh": "Turn scans into one surface and say by which method and why.",
    "solid": "Close, repair, base, hollow and simplify a mesh so that it can be built; export it.",
    "render": "Make one picture of a mesh, scan or scene.",
    "maps": "Distance, depth, normals and surface IDs from any focal point.",
    "turntable": "Frames and video of an orbit; resumes where it was stopped.",
    "dataset": "Many pictures with their truth over sampled parameters, for vision research.",
    "simulate": "Make the scans that a range finder would have measured of a mesh.",
    "fit": "Recover material and lamps from photographs of a known shape.",
    "decode": "Turn structured-light pictures into a range scan.",
    "draw": "Line drawing of a modelled scene, hidden lines removed.",
    "sample": "Make the sample scans again, byte for byte.",
    "study": "Chart speed against accuracy, and find where methods break.",
    "materials": "List materials, plot their lobes, print their energy table.",
    "explain": "Say what a finding means, why it matters and what mends it.",
    "init": "Write a settings file with every setting, its default, range and meaning.",
    "schema": "Print the JSON Schema of a document, or of the settings.",
    "completion": "Print the script that lets a shell complete commands and options.",
    "report": "Make the report of a finished job again, with the charts of studies.",
    "doctor": "Say what is installed, what is missing, and the line that mends it.",
}

#: commands that go on, when they are given again, from where they were stopped
RESUMED = ("run", "turntable", "dataset")


class Commands(click.Group):
    """Finds commands in modules of the same name."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f".{cmd_name}_command", __package__)
        command: click.Command = module.command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            import difflib

            near = difflib.get_close_matches(args[0], COMMANDS, n=1)
            hint = f"; did you mean {near[0]}?" if near else "; rangecheck --help lists them"
            raise click.UsageError(f"there is no command {args[0]!r}{hint}", ctx)
        return super().resolve_command(ctx, args)


@click.group(
    cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110}, no_args_is_help=True
)
@click.version_option(package_name="rangecheck", prog_name="rangecheck")
def cli() -> None:
    """Range scans of a head or sculpture in; a checked, physically rendered bust and its STL out.

    \b
    rangecheck run sample_data --out out           the whole job
    rangecheck check scan.ply --unit m             is it fit, and if not, where
    rangecheck COMMAND --help                      everything about one command
    """


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and exit."""
    # threads come from one place, and BLAS's own would wait for each other over small matrices, for a hundred times as long on a machine that is busy
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(exit_status(arguments))


def exit_status(arguments: list[str] | None = None) -> int:
    """Run the command line; errors become one line on stderr and a status."""
    try:
        result: Any = cli.main(args=arguments, prog_name="rangecheck", standalone_mode=False)
        return result if isinstance(result, int) else 0
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.ctx.get_help() if error.ctx else "", file=sys.stderr)  # noqa: T201
        return 2
    except click.ClickException as error:
        asked = error.ctx.command_path if isinstance(error, click.UsageError) and error.ctx else ""
        return _complain(error.format_message(), hint=asked)
    except (KeyboardInterrupt, click.exceptions.Abort):
        kept = _command_of(sys.argv[1:] if arguments is None else arguments) in RESUMED
        return _complain(
            "interrupted" + "; what was finished is kept, and the same command goes on from there" * kept, status=130
        )
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except MemoryError:
        return _complain(OUT_OF_MEMORY)
    except Exception as error:
        from rangecheck.errors import PosesRefused, RangecheckError

        if isinstance(error, RangecheckError):
            return _complain(str(error), status=1 if isinstance(error, PosesRefused) else 2)
        if isinstance(error, OSError):
            where = f"{error.filename}: " if error.filename else ""
            return _complain(f"{where}{error.strerror or error}")
        raise


def _command_of(arguments: list[str]) -> str:
    return next((argument for argument in arguments if argument in COMMANDS), "")


def _complain(message: str, *, status: int = 2, hint: str = "") -> int:
    print(f"rangecheck: {' '.join(message.split())}", file=sys.stderr)  # noqa: T201
    if hint:
        print(f"rangecheck: see {hint} --help", file=sys.stderr)  # noqa: T201
    return status
