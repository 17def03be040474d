"""The command line: a group of verbs; each parses, calls the library once, and prints."""

from __future__ import annotations

from typing import NoReturn

import click

from gis_radar.base import go_offline
from gis_radar.cli import datasets, live, maps, poses, recordings, sites
from gis_radar.cli.console import run_group

_LONGEST_SENTENCE = 200  # characters of a command's first sentence, more is cut with dots


class WholeSentences(click.Group):
    """A group whose help wraps the first sentence of each command; click would cut it."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands with the first sentence of each one's help."""
        rows = [
            (name, self.commands[name].get_short_help_str(_LONGEST_SENTENCE))
            for name in self.list_commands(ctx)
        ]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


@click.group(cls=WholeSentences, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="gis_radar")
def group() -> None:
    """Turn roadside 4D radar into traffic maps."""


for verb in (
    *(maps.tiles, maps.mask, maps.heatmap, maps.footprints),
    maps.project,
    *(recordings.convert, recordings.measure),
    *(recordings.clocks, recordings.quality),
    *(poses.localize, poses.track, poses.sensors, poses.sight),
    *(datasets.traffic, datasets.compare, datasets.profile, datasets.query),
    *(datasets.publish, datasets.dataset),
    *(live.edge, live.live),
    *(sites.run, sites.check, sites.report, sites.qgis, sites.sample, sites.demo),
):
    group.add_command(verb)


def main() -> NoReturn:
    """Run the command line."""
    go_offline()
    run_group(group)
