"""rangecheck decode"""

import click

from .common import common


@click.command("decode", short_help="Turn structured-light pictures into a range scan.")
@click.argument("folder", type=click.Path())
@click.option(
    "--pictures", is_flag=True, help="Also where and why pixels hold no distance, and contours, in FILE's folder NAME_pictures."
)
@click.option(
    "--against", type=click.Path(), metavar="CLOUD", help="Compare with another program's points in the same frame (with --unit)."
)
@click.option(
    "--min-contrast",
    type=click.FloatRange(0, 1),
    default=0.03,
    show_default=True,
    help="White minus black, share of full scale, below which a pixel is in shadow.",
)
@click.option(
    "--max-residual-px",
    type=click.FloatRange(0, min_open=True),
    default=3.0,
    show_default=True,
    help="Epipolar residual above which a pixel is refused.",
)
@common("out_file", "unit", "force")
def command(folder, pictures, against, min_contrast, max_residual_px, out, unit, force, reporter):
    """Turn structured-light pictures into a range scan.

    FOLDER holds Gray-code (and phase-shift) pictures of two calibrated cameras, or of a camera and a projector; capture.json says
    which is which. FILE is an .npz on the left camera's grid, with brightness.
    """
    from rangecheck.pipeline import decode

    return decode(
        folder, out, pictures=pictures, force=force, reporter=reporter, against=against, unit=unit, min_contrast=min_contrast,
        max_residual_px=max_residual_px,
    )  # fmt: skip
