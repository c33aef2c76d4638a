"""rangecheck dataset"""

import click

from .common import common, settings_from
from .completing import shipped


@click.command("dataset", short_help="Many pictures with their truth over sampled parameters, for vision research.")
@click.argument("model", type=click.Path())
@click.option("--count", type=click.IntRange(1), default=1000, show_default=True, help="How many pictures.")
@click.option(
    "--ranges",
    metavar="FILE",
    shell_complete=shipped("datasets"),
    help="What varies, in TOML; without it configs/datasets/default.toml.",
)
@click.option("--scheduler", metavar="ADDRESS", help="Make the pictures on a dask cluster, for example tcp://10.0.0.1:8786.")
@common("dry_run", "out_dir", "unit", "size", "seed", "config", "set", "force")
def command(model, count, ranges, scheduler, out, unit, size, seed, config, assignments, force, dry_run, reporter):
    """Many pictures with their truth over sampled parameters, for vision research.

    DIR gets pictures/, truth/ (an NPZ each: distance, depth, normals, incidence, surface and mirrored IDs, shadows, radiance without noise),
    index.jsonl (a line each: camera, pose, lights, sensor, all parameters), masks.json as COCO has them, and a COLMAP model. Every
    picture is checked against its truth. A job that was stopped goes on, to the same bytes.
    """
    from rangecheck.pipeline import dataset, rehearse_dataset

    settings = settings_from(config, assignments, seed=seed)
    if dry_run:
        return rehearse_dataset(
            model, out, settings=settings, unit=unit, count=count, ranges=ranges, size=size or (128, 128), scheduler=scheduler, force=force,
            reporter=reporter,
        )  # fmt: skip
    return dataset(
        model,
        out,
        settings=settings,
        unit=unit,
        count=count,
        ranges=ranges,
        size=size or (128, 128),
        scheduler=scheduler,
        force=force,
        reporter=reporter,
    )
