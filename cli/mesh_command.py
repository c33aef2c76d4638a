"""rangecheck mesh"""

import click

from .common import common, settings_from


@click.command("mesh", short_help="Turn scans into one surface and say by which method and why.")
@click.argument("scans", nargs=-1, required=True, type=click.Path())
@click.option("--method", type=click.Choice(["auto", "grid", "fuse", "poisson", "pivot"]), help="How scans become triangles.")
@click.option("--closing", type=click.Choice(["open", "half", "closed"]), help="What becomes of what nobody measured.")
@click.option("--largest-hole-mm", type=float, help="half: extent of the largest hole that is closed.")
@common("out_file", "register", "filter", "refine", "unit", "config", "set", "force")
def command(scans, method, closing, largest_hole_mm, out, register, filters, refine, unit, config, assignments, force, reporter):
    """Turn scans into one surface and say by which method and why.

    SCANS are files, a folder, a manifest, a .conf with poses, or a folder of structured-light pictures. FILE is a .ply, .obj, .glb or, if it is closed, .stl file."""
    from rangecheck.pipeline import mesh

    settings = settings_from(
        config,
        assignments,
        meshing__method=method,
        meshing__closing=closing,
        meshing__largest_hole_mm=largest_hole_mm,
        scan__registration=register,
        scan__filters=filters or None,
        scan__refine=refine or None,
    )
    return mesh(scans, out, settings=settings, unit=unit, force=force, reporter=reporter)
