"""rangecheck decode"""

import click

from .common import common


@click.command("decode", short_help="Turn structured-light pictures into a range scan.")
@click.argument("folder", type=click.Path())
@click.option("--pictures", is_flag=True, help="Also draw where and why pixels hold no distance, and contours.")
@common("out_file", "force")
def command(folder, pictures, out, force, reporter):
    """Turn structured-light pictures into a range scan.

    FOLDER holds Gray-code (and phase-shift) pictures of two calibrated cameras, or of a camera and a projector; capture.json says
    which is which. FILE is an .npz on the left camera's grid, with brightness.
    """
    from rangecheck.pipeline import decode

    return decode(folder, out, pictures=pictures, force=force, reporter=reporter)
