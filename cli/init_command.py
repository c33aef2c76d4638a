"""rangecheck init"""

import click

from .common import common


@click.command("init", short_help="Write a settings file with every setting, its default, range and meaning.")
@click.option("-o", "--output", "out", type=click.Path(), default="rangecheck.toml", show_default=True, metavar="FILE")
@common("force")
def command(out, force, reporter):
    """Write a settings file with every setting, its default, range and meaning.

    Every line is a comment until you change it. Use it with --config FILE; single settings with --set key=value.
    """
    from rangecheck.pipeline import init

    return init(out, force=force)
