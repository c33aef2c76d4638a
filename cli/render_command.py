"""rangecheck render"""

import click

from .common import Point, common, settings_from


@click.command("render", short_help="Make one picture of a mesh, scan or scene.")
@click.argument("scene", type=click.Path())
@click.option(
    "--camera", type=Point(), metavar="X,Y,Z", help="Where the camera stands, mm; it looks at the middle of the object."
)
@common("out_file", "unit", "size", "material", "tolerance", "seed", "config", "set", "force")
def command(scene, camera, out, unit, size, material, tolerance, seed, config, assignments, force, reporter):
    """Make one picture of a mesh, scan or scene."""
    from rangecheck.pipeline import render

    settings = settings_from(
        config,
        assignments,
        light__materials=(material,) if material else None,
        light__tolerance_percent=tolerance,
        seed=seed,
        picture__width=size and size[0],
        picture__height=size and size[1],
    )
    return render(scene, out, settings=settings, unit=unit, camera_mm=camera, force=force, reporter=reporter)
