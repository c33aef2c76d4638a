"""rangecheck simulate"""

import click

from .common import common


@click.command("simulate", short_help="Make the scans that a range finder would have measured of a mesh.")
@click.argument("mesh", type=click.Path())
@click.option("--views", type=click.IntRange(1, 360), default=8, show_default=True, help="Views on a ring around the object.")
@click.option(
    "--noise-mm", type=click.FloatRange(0), default=0.2, show_default=True, help="Standard deviation of range, head on."
)
@click.option(
    "--kind",
    type=click.Choice(["stripe", "gray-code", "time-of-flight"]),
    default="stripe",
    show_default=True,
    help="How it measures.",
)
@click.option(
    "--ambient", type=click.FloatRange(0), default=0.0, show_default=True, help="Constant light, relative to the source's."
)
@common("out_dir", "unit", "size", "seed", "force")
def command(mesh, views, noise_mm, kind, ambient, out, unit, size, seed, force, reporter):
    """Make the scans that a range finder would have measured of a mesh: noise, dropout, occlusion, quantisation."""
    from rangecheck.pipeline import simulate

    return simulate(
        mesh,
        out,
        unit=unit,
        views=views,
        noise_mm=noise_mm,
        kind=kind,
        ambient=ambient,
        size=size or (640, 480),
        seed=seed or 0,
        force=force,
        reporter=reporter,
    )
