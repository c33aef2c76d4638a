"""rangecheck solid"""

import click

from .common import common, settings_from
from .completing import shipped


class Plane(click.ParamType):
    """nx,ny,nz,d."""

    name = "NX,NY,NZ,D"

    def __init__(self, count: int = 4) -> None:
        self.count = count

    def convert(self, value, param, ctx):
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != self.count:
            self.fail(
                f"{value!r} is not {self.count} numbers with commas between, for example {','.join('0100'[: self.count])}",
                param,
                ctx,
            )
        return numbers


class Simplify(click.ParamType):
    """A length in mm, or auto."""

    name = "MM|auto"

    def convert(self, value, param, ctx):
        if value == "auto" or isinstance(value, float):
            return value
        try:
            return float(value)
        except ValueError:
            self.fail(f"{value!r} is neither a length in mm nor auto", param, ctx)


@click.command("solid", short_help="Close, repair, base, hollow and simplify a mesh so that it can be built; export it.")
@click.argument("mesh", type=click.Path())
@click.option(
    "--close", type=click.Choice(["auto", "repair", "relief"]), help="How an open surface is closed; auto says which and why."
)
@click.option("--max-move-mm", type=float, help="How far repair may move any point; what needs more is refused.")
@click.option("--relief-depth-mm", type=float, help="How far behind its deepest point a relief gets its back plane.")
@click.option("--relief-back", type=click.Choice(["plane", "hollow"]), help="hollow: open behind, with a wall of --wall-mm.")
@click.option("--cut", type=Plane(), help="Cut by a plane, with a cap; what lies beyond D along the normal is kept.")
@click.option(
    "--base", type=click.Choice(["auto", "none", "socle"]), help="auto cuts it flat to stand; socle puts a plinth under it."
)
@click.option("--base-height-mm", type=float, help="Cut the base this far above the lowest point.")
@click.option("--nameplate", metavar="TEXT", help="A text on a plate at the front of the socle.")
@click.option("--height-mm", type=float, help="Scale the finished part to this height.")
@click.option(
    "--simplify-mm", type=Simplify(), help="Fewer triangles, nowhere farther off than this; auto: what the printer cannot show."
)
@click.option("--wall-mm", type=float, help="Hollow it to a wall of this thickness, with drains and their plugs.")
@click.option("--drain-mm", type=float, help="Diameter of drains; 0 drills none.")
@click.option(
    "--print-up", type=Plane(3), metavar="X,Y,Z", help="Away from the build plate: the tilt for which it is proved to drain."
)
@click.option(
    "--file-up", type=click.Choice(["z", "scan"]), help="z: STL and 3MF stand as slicers take them; scan: y up, as scanned."
)
@click.option(
    "--printer",
    metavar="NAME",
    shell_complete=shipped("printers"),
    help="Judge it for printing by a profile of configs/printers, or a profile file.",
)
@click.option("--orient", is_flag=True, help="Advise which way up to print: islands, overhang, largest layer, height.")
@click.option("--ascii", is_flag=True, help="STL as text.")
@click.option("--force-open", is_flag=True, help="Write STL even of what is no solid.")
@common("explain", "out_file", "unit", "config", "set", "force")
def command(mesh, out, unit, config, assignments, force, orient, ascii, force_open, reporter, **wanted):
    """Close, repair, base, hollow and simplify a mesh so that it can be built; export it.

    The ending of FILE says as what: STL, 3MF, PLY, GLB, OBJ or OFF.

    The file is read back as a slicer would read it, and checked again; what is not solid is not written. FILE.json beside it says what it
    was made of, and how.
    """
    from rangecheck.pipeline import solid

    settings = settings_from(config, assignments, **{f"solid__{name}": value for name, value in wanted.items()})
    return solid(
        mesh, out, settings=settings, unit=unit, force=force, reporter=reporter, ascii=ascii, force_open=force_open, orient=orient
    )
