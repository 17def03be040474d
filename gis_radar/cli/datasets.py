"""The commands about a dataset: traffic, query, dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import gis_radar as gr
from gis_radar.base import Reporter, Text, refuse_inputs
from gis_radar.cli.console import Result, command
from gis_radar.cli.options import DURATION, FILE, csv_locale, output
from gis_radar.cli.options import dataset as dataset_argument

TOO_SHORT = Text(
    "no interval was visible for a fifth of its length, which a volume needs: "
    "take a shorter --interval"
)


@command(example="gis-radar traffic dataset/ --interval 15min -o traffic/")
@dataset_argument
@output
@click.option(
    "--interval", default="15min", show_default=True,
    help="Length of the intervals: 1min, 5min, 15min, 1h, 24h; they follow the site's clocks.",
)  # fmt: skip
@click.option("--begin", help="Only from this time on: '2025-06-12 07:30'.")
@click.option("--end", help="Only before this time.")
@click.option(
    "--language", type=click.Choice(["en", "de"]), default="en", show_default=True,
    help="Of the lanes' names and the titles.",
)  # fmt: skip
@csv_locale
def traffic(
    *, folder: Path, output: Path, language: str, csv_locale: str, reporter: Reporter,
    **options: Any,
) -> Result:  # fmt: skip
    """Count traffic by lane and turn: volumes, speeds, queues (CSV, xlsx, GeoPackage, SUMO)."""
    from gis_radar.base import csv_for  # noqa: PLC0415 - --help needs no NumPy

    refuse_inputs(output, folder)
    measured = gr.open_dataset(folder, reporter=reporter)
    made = gr.make_traffic(measured, language=language, **options)
    with csv_for(csv_locale):
        outputs = made.write(output, language=language, reporter=reporter)
    figures = made.figures()
    advice = "" if figures["rows_with_volume"] else TOO_SHORT
    return Result(outputs=outputs, summary=figures, advice=advice, timezone=measured.timezone)


@command(
    example='gis-radar query results/dataset "SELECT tile_id, sum(hit_steps) AS hits '
    'FROM tile_counts GROUP BY tile_id ORDER BY hits DESC LIMIT 10"'
)
@click.argument("folder", metavar="DATASET", type=FILE)
@click.argument("sql", metavar="SELECT")
@click.option("-o", "--output", type=FILE, help="Write the whole answer: .csv or .parquet.")
@click.option(
    "--limit", type=click.IntRange(min=1), default=1000, show_default=True,
    help="How many rows are shown.",
)  # fmt: skip
@click.option(
    "--timeout", "timeout_s", type=DURATION, default="60s", show_default=True,
    help="After how long the question is given up.",
)  # fmt: skip
@click.option(
    "--memory", default="2GB", show_default=True, help="How much memory the question may take."
)
def query(
    *, folder: Path, sql: str, output: Path | None, limit: int, reporter: Reporter, **options: Any
) -> Result:  # fmt: skip
    """Ask a dataset in SQL (DuckDB): one SELECT over its tables; no files, no network."""
    dataset = gr.open_dataset(folder, reporter=reporter)
    if output is None:
        rows, total = dataset.first_rows(sql, limit, **options)
        return Result(outputs=[], summary={"total": total}, rows=rows)
    refuse_inputs(output, folder)
    return Result(outputs=[output], summary={"total": dataset.write_answer(sql, output, **options)})


@command(example="gis-radar dataset results/dataset")
@click.argument("folder", metavar="DATASET", type=FILE)
@click.option("--check", is_flag=True, help="Compare all bytes with the digests of their hours.")
@click.option(
    "--withdraw", metavar="RECORDING", multiple=True,
    help="Take a recording out, and make its hours again without it; repeatable.",
)  # fmt: skip
@click.option(
    "--relink", metavar="FOLDER", type=FILE, help="Find recordings that were moved, by content."
)
def dataset(
    *, folder: Path, check: bool, withdraw: tuple[str, ...], relink: Path | None,
    reporter: Reporter,
) -> Result:  # fmt: skip
    """Say what a dataset holds: recordings, hours, rows by table."""
    moved = {}
    if relink is not None:
        moved = {"recordings_found": gr.relink(folder, relink, reporter=reporter)}
    if withdraw:
        gr.withdraw(folder, withdraw, reporter=reporter)
    found = gr.open_dataset(folder, reporter=reporter)
    if check:
        found.check(reporter)
    return Result(outputs=[], summary=moved | found.figures(), timezone=found.manifest.timezone)
