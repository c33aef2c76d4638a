"""rangecheck mesh"""

import click

from .common import common, settings_from


@click.command("mesh", short_help="Turn scans into one surface and say by which method and why.")
@click.argument("scans", nargs=-1, required=True, type=click.Path())
@click.option("--method", type=click.Choice(["auto", "grid", "fuse", "poisson", "pivot"]), help="How scans become triangles.")
@common("out_file", "unit", "config", "set", "force")
def command(scans, method, out, unit, config, assignments, force, reporter):
    """Turn scans into one surface and say by which method and why. MESH is a .ply, .obj, .glb or, if it is closed, .stl file."""
    from rangecheck.pipeline import mesh

    return mesh(
        scans, out, settings=settings_from(config, assignments, meshing__method=method), unit=unit, force=force, reporter=reporter
    )
