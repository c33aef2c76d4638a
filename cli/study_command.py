"""rangecheck study"""

import click

from .common import common


@click.command("study", short_help="Chart speed against accuracy, and find where methods break.")
@click.argument("what", type=click.Choice(["reflectance"]))
@click.option("--quick", is_flag=True, help="Fewer points and repeats: a first look.")
@common("out_dir", "force")
def command(what, quick, out, force, reporter):
    """Chart speed against accuracy, and find where methods break, on this machine."""
    from rangecheck.pipeline import study

    return study(what, out, quick=quick, force=force, reporter=reporter)
