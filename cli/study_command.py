"""rangecheck study"""

import click

from .common import common
from .completing import among, parts, studies


@click.command("study", short_help="Chart speed against accuracy, and find where methods break.")
@click.argument("what", metavar="NAME", shell_complete=among(studies))
@click.option("--part", metavar="PART", shell_complete=among(parts), help="Only this part of the study.")
@click.option("--quick", is_flag=True, help="Fewer points and repeats: a first look.")
@common("out_dir", "force")
def command(what, part, quick, out, force, reporter):
    """Chart speed against accuracy, and find where methods break, on this machine.

    README's table says what each NAME charts; a NAME or PART that does not exist is answered with those that do.
    """
    from rangecheck.pipeline import study

    return study(what, out, quick=quick, part=part, force=force, reporter=reporter)
