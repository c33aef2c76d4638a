"""rangecheck maps"""

import click

from .common import Point, common, settings_from


@click.command("maps", short_help="Distance, depth, normals and surface IDs from any focal point.")
@click.argument("scene", type=click.Path())
@click.option("--camera", type=Point(), metavar="X,Y,Z", help="The focal point, mm; it looks at the middle of the object.")
@click.option(
    "--bounces",
    type=click.IntRange(1, 16),
    default=1,
    show_default=True,
    help="Mirror reflections to follow for the secondary IDs.",
)
@click.option(
    "--against", type=click.Path(), metavar="FILE", help="Also how far what is seen lies from this mesh, scan or scene, signed."
)
@common("out_dir", "unit", "size", "config", "set", "force")
def command(scene, camera, bounces, against, out, unit, size, config, assignments, force, reporter):
    """Distance, depth, normals and surface IDs from any focal point.

    DIR gets maps.npz with every map in its unit, coloured pictures with legends, and 16-bit pictures with their scale inside.
    With --against there is a deviation map too: distances from the other surface, positive outside it, where it faces what is seen.
    """
    from rangecheck.pipeline import maps

    settings = settings_from(config, assignments, picture__width=size and size[0], picture__height=size and size[1])
    return maps(
        scene,
        out,
        settings=settings,
        unit=unit,
        camera_mm=camera,
        bounces=bounces,
        against=against,
        force=force,
        reporter=reporter,
    )
