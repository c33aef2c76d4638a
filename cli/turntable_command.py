"""rangecheck turntable"""

import click

from .common import common, settings_from


@click.command("turntable", short_help="Frames and video of an orbit; resumes where it was stopped.")
@click.argument("scene", type=click.Path())
@click.option("--scheduler", metavar="ADDRESS", help="Make the frames on a dask cluster, for example tcp://10.0.0.1:8786.")
@common("out_file", "unit", "size", "frames", "frames_dir", "material", "tolerance", "seed", "config", "set", "force")
def command(
    scene, scheduler, out, unit, size, frames, frames_dir, material, tolerance, seed, config, assignments, force, reporter
):
    """Frames and video of an orbit; resumes where it was stopped.

    Frames are kept beside the video (or in --frames-dir), keyed by everything that determines them: a stopped run goes on, and
    gives the same bytes as one that was never stopped.
    """
    from rangecheck.pipeline import turntable

    settings = settings_from(
        config,
        assignments,
        light__materials=(material,) if material else None,
        light__tolerance_percent=tolerance,
        turntable__frames=frames,
        seed=seed,
        picture__width=size and size[0],
        picture__height=size and size[1],
    )
    return turntable(
        scene, out, settings=settings, unit=unit, frames_dir=frames_dir, scheduler=scheduler, force=force, reporter=reporter
    )
