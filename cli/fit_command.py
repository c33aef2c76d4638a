"""rangecheck fit"""

import click

from .common import Point, common, settings_from


@click.command("fit", short_help="Recover material and lamps from photographs of a known shape.")
@click.argument("pictures", nargs=-1, required=True, type=click.Path())
@click.option(
    "--sphere",
    type=Point("a circle; write COLUMN,ROW,RADIUS in pixels, for example 320,240,150"),
    metavar="COLUMN,ROW,RADIUS",
    help="They show a sphere of this outline, pixels, from far away.",
)
@click.option("--on", "model", type=click.Path(), metavar="MESH", help="They show this mesh, scan or modelled scene.")
@click.option(
    "--part",
    metavar="NAME",
    help="Of a scene: the body or face (body/face) whose material is looked for; the others' are known. The scene's file tells camera and "
    "lamps, all in every picture, unless --camera and --lights do.",
)
@click.option("--camera", type=Point(), metavar="X,Y,Z", help="Where the camera stood, mm; it looks at the middle of the object.")
@click.option(
    "--field", type=click.FloatRange(1, 170), help="The camera's horizontal field of view, degrees; else the scene's own, or 30."
)
@click.option(
    "--lights",
    type=click.Path(),
    metavar="FILE",
    help="About where the lamps stand: x y z, one line a picture. studio: those of render, where a scene has none of its own.",
)
@click.option(
    "--calibrate",
    type=click.Choice(["chrome", "matt", "bust"]),
    help="Only find the lamps: on a chrome or matt --sphere (x right, y up, z to the camera), or on the bust itself, --on MESH (its own axes).",
)
@click.option(
    "--response", type=click.Choice(["linear", "srgb"]), default="linear", help="How the pictures' numbers follow light."
)
@click.option("--noise", type=click.FloatRange(1e-6, 1), default=0.01, help="Standard deviation of a pixel, parts of full scale.")
@click.option(
    "--scale",
    type=click.FloatRange(0, min_open=True),
    metavar="MM",
    help="Length over which a scan is held against its brightness.",
)
@click.option(
    "--irradiance",
    type=click.FloatRange(1e-9),
    help="Of the lamps, so that a white surface shows irradiance/pi; 3 if not said. Of a scene's own lamps: of the first, or --set picture.exposure=E as "
    "rendered, or --find exposure.",
)
@click.option(
    "--find",
    multiple=True,
    type=click.Choice(["pose", "exposure", "strength", "distance", "radius", "ambient"]),
    help="Also find these; may be given several times. pose: the camera's, near --camera, by turns of a degree or so and shifts of some per cent of the object's size; exposure: of each picture but "
    "the first, and of that too where a scene's parts of known material tell it; strength: irradiance of each lamp but the first; distance, radius: of each lamp; ambient: light from all around.",
)
@click.option(
    "--lamp-distance", type=click.FloatRange(0, min_open=True), metavar="MM", help="The lamps' distance; far away otherwise."
)
@click.option(
    "--lamp-radius",
    type=click.FloatRange(0, 90, min_open=True, max_open=True),
    help="The lamps' angular radius, degrees; 0.25 if not said.",
)
@click.option("--same-strength", is_flag=True, help="With --calibrate matt or bust: the lamps are known to be of one strength.")
@click.option("--spike", is_flag=True, help="Also fit a mirror's share; its highlight must be seen.")
@click.option(
    "-o",
    "--output",
    "out",
    type=click.Path(),
    metavar="FILE",
    help="Material file (.toml); with --calibrate the list of lights; of a scan, a picture (.png) of what its brightness contradicts.",
)
@common("unit", "config", "set", "force")
def command(
    pictures,
    sphere,
    model,
    part,
    camera,
    field,
    lights,
    calibrate,
    response,
    noise,
    scale,
    irradiance,
    find,
    lamp_distance,
    lamp_radius,
    same_strength,
    spike,
    out,
    unit,
    config,
    assignments,
    force,
    reporter,
):
    """Recover material and lamps from photographs of a known shape, one lamp a picture, with 95 % intervals and a statement of what
    the pictures cannot determine. The material file serves every --material. Pictures that shape, camera and lamps do not explain are said to be such
    (exit status 1).

    Given one scan with brightness instead of pictures: material and lamp on the scan's own surface, and the places where the scan shows a
    shape that its picture does not (exit status 1); FILE is then a picture (.png) of where."""
    from rangecheck.pipeline import fit

    return fit(
        pictures, out, settings=settings_from(config, assignments), unit=unit, sphere=sphere, model=model, part=part, camera_mm=camera,
        field_deg=field, lights=lights, calibrate=calibrate, response=response, noise=noise, spike=spike, irradiance=irradiance, scale_mm=scale,
        find=find, lamp_distance_mm=lamp_distance, lamp_radius_deg=lamp_radius, same_strength=same_strength, force=force, reporter=reporter,
    )  # fmt: skip
