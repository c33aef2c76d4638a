"""rangecheck sample"""

import click

from .common import common


@click.command("sample", short_help="Make the sample scans again, byte for byte.")
@common("out_dir", "force")
def command(out, force, reporter):
    """Make the sample scans again, byte for byte."""
    from rangecheck.pipeline import sample

    return sample(out, force=force, reporter=reporter)
