"""rangecheck schema"""

import click

from .common import common
from .completing import among, schemas


@click.command("schema", short_help="Print the JSON Schema of a document, or of the settings.")
@click.argument("name", required=False, shell_complete=among(schemas))
@common()
def command(name, reporter):
    """Print the JSON Schema of a document, or of the settings. Without NAME, list what there is.

    Every JSON document says its schema as rangecheck/NAME/1; `configuration` is that of settings files, as editors take it.
    """
    from rangecheck.pipeline import schema

    return schema(name)
