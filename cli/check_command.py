"""rangecheck check"""

import click

from .common import common, settings_from
from .completing import among, profiles, shipped


@click.command("check", short_help="Check range scans or mesh files; verdict, findings with places, numbers.")
@click.argument("files", nargs=-1, required=True, type=click.Path())
@click.option("--opinions", is_flag=True, help="Ask trimesh, MeshLab and manifold3d too.")
@click.option(
    "--printer",
    metavar="NAME",
    shell_complete=shipped("printers"),
    help="Judge for printing by a profile of configs/printers, or a profile file.",
)
@click.option(
    "--profile",
    metavar="NAME",
    shell_complete=among(profiles),
    help="What scans are judged for: bust-75, bust-150 or bust-300.",
)
@common("explain", "register", "filter", "unit", "config", "set")
def command(files, opinions, printer, profile, register, filters, unit, config, assignments, reporter):
    """Check range scans or mesh files; verdict, findings with places, numbers.

    Exit status 0: fit; 1: not fit; 2: not readable.
    """
    from rangecheck.pipeline import check

    settings = settings_from(
        config, assignments, scan__registration=register, scan__filters=filters or None, scan__profile=profile
    )
    return check(files, settings=settings, unit=unit, opinions=opinions, printer=printer, reporter=reporter)
