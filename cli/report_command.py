"""rangecheck report"""

import click

from .common import common


@click.command("report", short_help="Make the report of a finished job again, with the charts of studies.")
@click.argument("job", metavar="DIR", type=click.Path())
@click.option(
    "--study", "studies", multiple=True, type=click.Path(), metavar="DIR", help="A folder that `study` wrote: its charts."
)
@click.option("--pdf", is_flag=True, help="Print it to report.pdf as well; Chromium does that.")
@common()
def command(job, studies, pdf, reporter):
    """Make the report of a finished job again, with the charts of studies.

    DIR is the folder that `run` wrote; its report.html (and report.pdf) is replaced, nothing else is touched."""
    from rangecheck.pipeline import report

    return report(job, studies=studies, pdf=pdf, reporter=reporter)
