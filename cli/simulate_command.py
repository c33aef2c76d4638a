"""rangecheck simulate"""

import click

from .common import Point, common


@click.command("simulate", short_help="Make the scans that a range finder would have measured of a mesh.")
@click.argument("mesh", type=click.Path())
@click.option("--views", type=click.IntRange(1, 360), default=8, show_default=True, help="Views on a ring around the object.")
@click.option(
    "--kind",
    type=click.Choice(["stripe", "gray-code", "time-of-flight"]),
    default="stripe",
    show_default=True,
    help="How it measures.",
)
@click.option(
    "--noise",
    "noise_model",
    type=click.Choice(["quadratic", "speckle", "photon", "kinect"]),
    default="quadratic",
    show_default=True,
    help="Law of its noise; time of flight has photon's.",
)
@click.option(
    "--noise-mm", type=click.FloatRange(0), default=0.2, show_default=True, help="Standard deviation of range, head on."
)
@click.option(
    "--ambient", type=click.FloatRange(0), default=0.0, show_default=True, help="Constant light, relative to the source's."
)
@click.option(
    "--drift",
    type=Point("a velocity; write X,Y,Z in mm/s, for example 0,0,2"),
    metavar="X,Y,Z",
    help="How fast the object drifts meanwhile, mm/s.",
)
@click.option("--turn", type=float, default=0.0, metavar="DEG", help="How fast it turns meanwhile, degrees/s about y.")
@click.option(
    "--finder", multiple=True, metavar="KEY=VALUE", help="Another number of the instrument, for example lost_share=0.1."
)
@click.option("--brightness", is_flag=True, help="Keep the camera's picture with each scan.")
@click.option("--pictures", is_flag=True, help="gray-code: the pictures of the patterns, for `decode`, a folder for each view.")
@click.option("--cameras", type=click.IntRange(1, 2), default=1, show_default=True, help="Cameras that take the pictures.")
@common("material", "out_dir", "unit", "size", "seed", "force")
def command(
    mesh, views, kind, noise_model, noise_mm, ambient, drift, turn, finder, brightness, pictures, cameras, material, out, unit, size, seed,
    force, reporter,
):  # fmt: skip
    """Make the scans that a range finder would have measured of a mesh: noise, dropout, occlusion, quantisation, motion.

    Beside each scan its truth, and why each cell holds no distance. With --material, light comes back as from that material: what shines
    elsewhere than into the camera is lost. Without --unit the mesh file must say its own."""
    from rangecheck.pipeline import simulate
    from rangecheck.pipeline.simulating import Instrument

    instrument = Instrument(
        kind, noise_model, noise_mm, ambient, material, drift or (0.0, 0.0, 0.0), turn, finder, brightness, pictures, cameras
    )
    return simulate(
        mesh,
        out,
        unit=unit,
        views=views,
        instrument=instrument,
        size=size or (640, 480),
        seed=seed or 0,
        force=force,
        reporter=reporter,
    )
