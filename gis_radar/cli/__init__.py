"""The command line: a group of verbs; each parses, calls the library once, and prints."""

from __future__ import annotations

from typing import NoReturn

import click

from gis_radar.cli import datasets, live, maps, poses, recordings, sites
from gis_radar.cli.console import run_group
from gis_radar.processes import go_offline


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="gis_radar")
def group() -> None:
    """Turn roadside 4D radar into traffic maps."""


for verb in (
    *(maps.tiles, maps.mask, maps.heatmap, maps.footprints, maps.trajectories),
    maps.project,
    *(recordings.convert, recordings.measure),
    *(recordings.clocks, recordings.quality),
    *(poses.localize, poses.track, poses.sensors, poses.sight),
    *(datasets.query, datasets.dataset),
    *(live.edge, live.live),
    *(sites.run, sites.check, sites.report, sites.qgis, sites.sample, sites.demo),
):
    group.add_command(verb)


def main() -> NoReturn:
    """Run the command line."""
    go_offline()
    run_group(group)
