"""rangecheck explain"""

import click

from .common import common
from .completing import among, codes


@click.command("explain", short_help="Say what a finding means, why it matters and what mends it.")
@click.argument("code", required=False, shell_complete=among(codes))
@common()
def command(code, reporter):
    """Say what a finding means, why it matters and what mends it. Without CODE, list all codes."""
    from rangecheck.pipeline import explain

    return explain(code)
