"""rangecheck study"""

import click

from .common import common


@click.command("study", short_help="Chart speed against accuracy, and find where methods break.")
@click.argument("what", metavar="NAME")
@click.option("--part", metavar="PART", help="Only this part of the study.")
@click.option("--quick", is_flag=True, help="Fewer points and repeats: a first look.")
@common("out_dir", "force")
def command(what, part, quick, out, force, reporter):
    """Chart speed against accuracy, and find where methods break, on this machine. A NAME or PART that does not exist is answered with
    those that do."""
    from rangecheck.pipeline import study

    return study(what, out, quick=quick, part=part, force=force, reporter=reporter)
