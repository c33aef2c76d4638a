"""rangecheck check"""

import click

from .common import common, settings_from


@click.command("check", short_help="Check range scans or mesh files; verdict, findings with places, numbers.")
@click.argument("files", nargs=-1, required=True, type=click.Path())
@common("unit", "config", "set")
def command(files, unit, config, assignments, reporter):
    """Check range scans or mesh files; verdict, findings with places, numbers.

    Exit status 0: fit; 1: not fit; 2: not readable.
    """
    from rangecheck.pipeline import check

    return check(files, settings=settings_from(config, assignments), unit=unit, reporter=reporter)
