"""The command that writes a report."""

from __future__ import annotations

from pathlib import Path

import click

import gis_radar as gr
from gis_radar.cli.commands import FILE, group
from gis_radar.cli.console import Result
from gis_radar.cli.door import command
from gis_radar.progress import Reporter


@command(group, example="gis-radar report results --timezone Europe/Berlin")
@click.argument("folder", metavar="DIR", type=FILE)
@click.option("-o", "--output", type=FILE, help="Where the report goes; by default into DIR.")
@click.option("--title", help="What it is about; by default the site's title or DIR.")
@click.option(
    "--timezone",
    help="Whose clocks its times follow: Europe/Berlin; by default the site's, or UTC.",
)
@click.option(
    "--occupancy", "occupancies", type=FILE, multiple=True,
    help="What the heat map was made of, where it is not in DIR.",
)  # fmt: skip
def report(
    *,
    folder: Path,
    output: Path | None,
    title: str | None,
    timezone: str | None,
    occupancies: tuple[Path, ...],
    reporter: Reporter,
) -> Result:
    """Write a report for people without QGIS: HTML, PDF, and tables (CSV).

    DIR holds the results of gis-radar run or demo, or a heat map.
    """
    made = gr.write_report(
        folder,
        output=output,
        title=title,
        timezone=timezone,
        occupancies=occupancies,
        reporter=reporter,
    )
    return Result(outputs=list(made.outputs), summary=made.summary)
