"""The commands of the live system, which run until they are stopped: edge, live."""

from __future__ import annotations

from pathlib import Path

import click

import gis_radar as gr
from gis_radar import live as live_room
from gis_radar.base import Reporter, stopped_by_signals
from gis_radar.cli.console import Result, command
from gis_radar.cli.options import FILE, template


@command(example="gis-radar edge R1.toml")
@click.argument("sensor", metavar="SENSOR.toml", type=FILE)
@template(
    lambda: live_room.edge_template(),  # noqa: PLW0108 - the room loads when it is asked
    "Print a sensor's file to fill in, and do nothing else.",
)
def edge(*, sensor: Path, reporter: Reporter) -> Result:
    """Run a sensor's side of the live system: detections near the road go to fusion.

    It ends with Ctrl-C, or when a recording is over and fusion has stored all of it.
    """
    with stopped_by_signals() as stop:
        done = gr.run_edge(sensor, stop=stop, reporter=reporter)
    return Result(outputs=[], summary=done.figures())


@command(example="gis-radar live SITE.toml")
@click.argument("site", metavar="SITE.toml", type=FILE)
@click.option(
    "--broker-files", type=FILE, metavar="DIR",
    help="Write files for Mosquitto and systemd units, and do nothing else.",
)  # fmt: skip
@click.option(
    "--webhook", metavar="URL",
    help="Post alerts of sensors there as JSON: https, or http on this machine.",
)  # fmt: skip
def live(
    *, site: Path, broker_files: Path | None, webhook: str | None, reporter: Reporter
) -> Result:
    """Run the centre of the live system, fusion: the map of now, recordings, a dataset by hours.

    It ends with Ctrl-C; hours that are over are then measured.
    """
    if broker_files is not None:
        return Result(outputs=live_room.write_broker_files(site, broker_files, webhook=webhook))
    with stopped_by_signals() as stop:
        done = gr.run_fusion(site, webhook=webhook, stop=stop, reporter=reporter)
    return Result(outputs=done.outputs, summary=done.figures())
