"""rangecheck materials"""

import click

from .common import common
from .completing import shipped


@click.command("materials", short_help="List materials, plot their lobes, print their energy table.")
@click.argument("names", nargs=-1, shell_complete=shipped("materials"))
@click.option("-o", "--output", "out", type=click.Path(), metavar="DIR", help="Write a polar plot of each material's reflection.")
@common("force")
def command(names, out, force, reporter):
    """List materials, plot their lobes, print their energy table. Without NAMES, all that are shipped."""
    from rangecheck.pipeline import materials

    return materials(names, out, force=force, reporter=reporter)
