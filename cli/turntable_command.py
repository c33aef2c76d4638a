"""rangecheck turntable"""

import click

from .common import common, settings_from
from .completing import shipped


@click.command("turntable", short_help="Frames and video of an orbit; resumes where it was stopped.")
@click.argument("scene", type=click.Path())
@click.option(
    "--material",
    "materials",
    multiple=True,
    metavar="NAME",
    shell_complete=shipped("materials"),
    help="A material; given twice, both are shown side by side.",
)
@click.option(
    "--show",
    type=click.Choice(["picture", "stripes", "distance", "id"]),
    help="Pictures; bands of light in a mirroring surface, which show its slopes; distance maps; surface IDs.",
)
@click.option(
    "--lights",
    type=click.Choice(["model", "room"]),
    help="model: the camera goes round; room: the model turns under lights that stand still.",
)
@click.option("--elevation", type=float, metavar="DEG", help="Height of the camera above the horizon.")
@click.option("--swing", type=float, metavar="DEG", help="The camera rises and falls by this once per turn.")
@click.option("--fps", type=click.IntRange(1, 240), help="Frames per second of the video.")
@click.option("--frame-format", type=click.Choice(["png", "exr"]), help="Frames as pictures, or as linear radiance or distances.")
@click.option("--sheet", type=click.Path(), metavar="FILE", help="Also a contact sheet of all frames, a .png.")
@click.option(
    "--consistency",
    is_flag=True,
    help="Measure what the frames show: slope noise, speckle, jumping highlights, flagged places. Dents are looked for in a mirror by further "
    "pictures of waves of light, nine from each of up to twelve poses; in a matt surface in the frames themselves, with --lights room.",
)
@click.option("--scheduler", metavar="ADDRESS", help="Make the frames on a dask cluster, for example tcp://10.0.0.1:8786.")
@common("dry_run", "out_file", "unit", "size", "frames", "frames_dir", "tolerance", "seed", "config", "set", "force")
def command(
    scene, materials, show, lights, elevation, swing, fps, frame_format, sheet, consistency, scheduler, out, unit, size, frames, frames_dir,
    tolerance, seed, config, assignments, force, dry_run, reporter,
):  # fmt: skip
    """Frames and video of an orbit; resumes where it was stopped. The video's name says what it becomes: .mp4, .webm, .gif or .apng.

    Frames are kept beside the video (or in --frames-dir), keyed by everything that determines them: a stopped run goes on, and
    gives the same bytes as one that was never stopped. Their cameras are beside them, as JSON and as a COLMAP model.
    """
    from rangecheck.pipeline import rehearse_turntable, turntable

    settings = settings_from(
        config,
        assignments,
        light__tolerance_percent=tolerance,
        turntable__frames=frames,
        turntable__show=show,
        turntable__lights=lights,
        turntable__elevation_deg=elevation,
        turntable__swing_deg=swing,
        turntable__fps=fps,
        turntable__frame_format=frame_format,
        seed=seed,
        picture__width=size and size[0],
        picture__height=size and size[1],
    )
    if dry_run:
        return rehearse_turntable(
            scene, out, settings=settings, unit=unit, frames_dir=frames_dir, materials=materials, sheet=sheet, scheduler=scheduler,
            force=force, reporter=reporter,
        )  # fmt: skip
    return turntable(
        scene,
        out,
        settings=settings,
        unit=unit,
        frames_dir=frames_dir,
        materials=materials,
        sheet=sheet,
        consistency=consistency,
        scheduler=scheduler,
        force=force,
        reporter=reporter,
    )
