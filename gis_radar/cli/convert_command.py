"""The command that makes recordings of what radars and their users write."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

import gis_radar as gr
from gis_radar.cli.commands import group, output
from gis_radar.cli.console import Result
from gis_radar.cli.door import command
from gis_radar.cli.options import Duration, Pairs
from gis_radar.progress import Reporter


@command(group, example="gis-radar convert capture.pcap -o R1.parquet")
@click.argument("inputs", metavar="IN...", nargs=-1, required=True)
@output
@click.option("--sensor", help="Only this one, where there are several: 10.13.1.113, /radar/front.")
@click.option(
    "--columns", type=Pairs(), help="Fields of a table or cloud: x=X,range_rate=-doppler."
)
@click.option(
    "--time-unit", type=click.Choice(["s", "ms", "us", "ns"]), default="s", show_default=True,
    help="Of the times in a table, since 1970.",
)  # fmt: skip
@click.option(
    "--clock", type=click.Choice(["auto", "sensor", "recorder"]), default="auto", show_default=True,
    help="Whose times count; auto takes the sensor's where they are right.",
)  # fmt: skip
@click.option("--duration", type=Duration(), help="How long to listen to an address: 30s, 10min.")
def convert(
    *,
    inputs: tuple[str, ...],
    output: Path,
    sensor: str | None,
    columns: dict[str, str] | None,
    time_unit: str,
    clock: Literal["auto", "sensor", "recorder"],
    duration: float | None,
    reporter: Reporter,
) -> Result:
    """Make recordings of captures, ROS bags, PCD folders, tables, or udp://224.0.2.2:42102."""
    made = gr.convert(
        inputs,
        output,
        sensor=sensor,
        columns=columns,
        time_unit=time_unit,
        clock=clock,
        duration_s=duration,
        reporter=reporter,
    )
    return Result(outputs=made.outputs, summary=made.figures())
