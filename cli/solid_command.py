"""rangecheck solid"""

import click

from .common import common, settings_from


@click.command("solid", short_help="Close, repair and base a mesh so that it can be built; export STL.")
@click.argument("mesh", type=click.Path())
@click.option("--height-mm", type=float, help="Scale the finished part to this height.")
@click.option("--relief-depth-mm", type=float, help="How far behind its deepest point a relief gets its back plane.")
@common("out_file", "unit", "config", "set", "force")
def command(mesh, height_mm, relief_depth_mm, out, unit, config, assignments, force, reporter):
    """Close, repair and base a mesh so that it can be built; export STL.

    The file is read back as a slicer would read it, and checked again; what is not solid is not written.
    """
    from rangecheck.pipeline import solid

    settings = settings_from(config, assignments, solid__height_mm=height_mm, solid__relief_depth_mm=relief_depth_mm)
    return solid(mesh, out, settings=settings, unit=unit, force=force, reporter=reporter)
