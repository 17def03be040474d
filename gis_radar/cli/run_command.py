"""The command that runs a whole site."""

from __future__ import annotations

from pathlib import Path

import click

import gis_radar as gr
from gis_radar.cli.commands import FILE, group, output
from gis_radar.cli.console import Result
from gis_radar.cli.door import command
from gis_radar.progress import Reporter


def _print_template(context: click.Context, _option: click.Parameter, wanted: object) -> None:
    if wanted:
        click.echo(gr.site_template(), nl=False)
        context.exit()


@command(group, example="gis-radar run SITE.toml -o results")
@click.argument("site", metavar="SITE.toml", type=FILE)
@output
@click.option("--jobs", type=int, help="Stages at once; by default as cores and memory allow.")
@click.option("--fresh", is_flag=True, help="Do all again, also what an earlier run has done.")
@click.option(
    "--template", is_flag=True, is_eager=True, expose_value=False, callback=_print_template,
    help="Print a site file to fill in, and do nothing else.",
)  # fmt: skip
def run(*, site: Path, output: Path, jobs: int | None, fresh: bool, reporter: Reporter) -> Result:
    """Go the whole way for all sensors of a site; go on where an earlier run ended.

    Exit code 4 tells that a sensor has no trustworthy pose, 3 that its data are bad; the heat maps
    show the others.
    """
    done = gr.run_site(site, output, jobs=jobs, fresh=fresh, reporter=reporter)
    return Result(outputs=done.outputs, summary=done.figures(), failure=done.failure)
