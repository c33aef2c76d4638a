"""rangecheck doctor"""

import click

from .common import common


@click.command("doctor", short_help="Say what is installed, what is missing, and the line that mends it.")
@common()
def command(reporter):
    """Say what is installed, what is missing, and the line that mends it."""
    from rangecheck.pipeline import doctor

    return doctor()
