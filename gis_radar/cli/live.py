"""The commands of the live system, which run until they are stopped: edge, live."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

import gis_radar as gr
from gis_radar import live as live_room
from gis_radar.base import stopped_by_signals
from gis_radar.cli.console import Console, Result, command
from gis_radar.cli.options import FILE, template


@contextmanager
def _logged_in_english(reporter: Console) -> Iterator[None]:
    """Log in English, as few words of the log have a translation; an error stays the user's."""
    users = reporter.language
    reporter.language = "en"
    try:
        yield
    except BaseException:
        reporter.language = users
        raise


@command(example="gis-radar edge R1.toml")
@click.argument("sensor", metavar="SENSOR.toml", type=FILE)
@template(
    lambda: live_room.edge_template(),  # noqa: PLW0108 - the room loads when it is asked
    "Print a sensor's file to fill in, and do nothing else.",
)
def edge(*, sensor: Path, reporter: Console) -> Result:
    """Run a sensor's side of the live system: detections near the road go to fusion.

    It ends with Ctrl-C, or when a recording is over and fusion has stored all of it.
    """
    with _logged_in_english(reporter), stopped_by_signals() as stop:
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
    *, site: Path, broker_files: Path | None, webhook: str | None, reporter: Console
) -> Result:
    """Run the centre of the live system, fusion: the map of now, recordings, a dataset by hours.

    It ends with Ctrl-C; hours that are over are then measured.
    """
    if broker_files is not None:
        return Result(outputs=live_room.write_broker_files(site, broker_files, webhook=webhook))
    with _logged_in_english(reporter), stopped_by_signals() as stop:
        done = gr.run_fusion(site, webhook=webhook, stop=stop, reporter=reporter)
    return Result(outputs=done.outputs, summary=done.figures())
