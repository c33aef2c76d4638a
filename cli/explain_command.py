"""rangecheck explain"""

import click

from .common import common


def _codes(ctx, param, incomplete):
    from rangecheck.files import presets_folder, read_toml

    return sorted(code for code in read_toml(presets_folder() / "findings.toml") if code.startswith(incomplete))


@click.command("explain", short_help="Say what a finding means, why it matters and what mends it.")
@click.argument("code", required=False, shell_complete=_codes)
@common()
def command(code, reporter):
    """Say what a finding means, why it matters and what mends it. Without CODE, list all codes."""
    from rangecheck.pipeline import explain

    return explain(code)
