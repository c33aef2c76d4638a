"""rangecheck draw"""

import click

from .common import Point, common, settings_from


@click.command("draw", short_help="Line drawing of a modelled scene, hidden lines removed.")
@click.argument("model", type=click.Path())
@click.option("--camera", type=Point(), metavar="X,Y,Z", help="Where the camera stands, mm; it looks at the middle of the scene.")
@click.option("--hidden", is_flag=True, help="Hidden lines too, dashed.")
@common("out_file", "size", "config", "set", "force")
def command(model, camera, hidden, out, size, config, assignments, force, reporter):
    """Line drawing of a modelled scene, hidden lines removed. MODEL is a scene's .toml file, FILE an .svg."""
    from rangecheck.pipeline import draw

    settings = settings_from(config, assignments, picture__width=size and size[0], picture__height=size and size[1])
    return draw(model, out, settings=settings, camera_mm=camera, hidden=hidden, force=force, reporter=reporter)
