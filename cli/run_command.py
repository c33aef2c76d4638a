"""rangecheck run"""

import click

from .common import common, settings_from


@click.command("run", short_help="Do the whole job: mesh, check, close, render, measure, export STL, report.")
@click.argument("scans", nargs=-1, required=True, type=click.Path())
@click.option("--method", type=click.Choice(["auto", "grid", "fuse", "poisson", "pivot"]), help="How scans become triangles.")
@click.option("--height-mm", type=float, help="Scale the finished bust to this height.")
@click.option("--each", is_flag=True, help="Each of SCANS is a subject of its own, with a folder of its own in DIR.")
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Make the frames, or with --each the subjects, on a dask cluster, for example tcp://10.0.0.1:8786.",
)
@common(
    "dry_run",
    "explain",
    "out",
    "register",
    "filter",
    "refine",
    "unit",
    "size",
    "frames",
    "tolerance",
    "seed",
    "preset",
    "config",
    "set",
    "force",
)
def command(
    scans,
    method,
    height_mm,
    out,
    register,
    filters,
    refine,
    unit,
    size,
    frames,
    tolerance,
    seed,
    preset,
    config,
    assignments,
    force,
    dry_run,
    each,
    scheduler,
    reporter,
):
    """Do the whole job: mesh, check, close, render, measure, export STL, report.

    SCANS are files, a folder, a manifest, a .conf with poses, or a folder of structured-light pictures. DIR gets bust.stl (only of
    what is really solid), plaster.mp4, steel.mp4, maps, report.html and run.json. A run that was stopped goes on where it was.
    """
    from rangecheck.pipeline import rehearse, run, run_each
    from rangecheck.pipeline.presets import with_gain

    settings = settings_from(
        config,
        assignments,
        preset,
        meshing__method=method,
        scan__registration=register,
        scan__filters=filters or None,
        scan__refine=refine or None,
        solid__height_mm=height_mm,
        turntable__frames=frames,
        light__tolerance_percent=tolerance,
        seed=seed,
        picture__width=size and size[0],
        picture__height=size and size[1],
    )
    if dry_run:
        return rehearse(scans, out, settings=settings, unit=unit, force=force, reporter=reporter, scheduler=scheduler, each=each)
    if each:
        return run_each(scans, out, settings=settings, unit=unit, force=force, reporter=reporter, scheduler=scheduler)
    outcome = run(scans, out, settings=settings, unit=unit, force=force, reporter=reporter, scheduler=scheduler)
    return with_gain(outcome, settings)
