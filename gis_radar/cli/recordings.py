"""The commands about recordings: convert, measure, clocks, quality."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import gis_radar as gr
from gis_radar import products, site
from gis_radar.base import Reporter
from gis_radar.cli.console import Result, command
from gis_radar.cli.options import (  # fmt: skip
    DURATION,
    FILE,
    PAIRS,
    accept,
    csv_locale,
    dataset,
    folder_output,
    frame_times,
    numbers,
    output,
    poses,
    recordings,
    scan_crs,
    sight_scans,
    tile_file,
    view,
)


@command(example="gis-radar convert capture.pcap -o R1.parquet")
@click.argument("inputs", metavar="IN...", nargs=-1, required=True)
@output
@click.option("--sensor", help="Only this one, where there are several: 10.13.1.113, /radar/front.")
@click.option("--columns", type=PAIRS, help="Fields of a table or cloud: x=X,range_rate=-doppler.")
@click.option(
    "--time-unit", type=click.Choice(["s", "ms", "us", "ns"]), default="s", show_default=True,
    help="Unit of the times in a table, since 1970.",
)  # fmt: skip
@click.option(
    "--clock", type=click.Choice(["auto", "sensor", "recorder"]), default="auto", show_default=True,
    help="Whose times count; auto takes the sensor's where they are right.",
)  # fmt: skip
@click.option(
    "--duration", "duration_s", type=DURATION, help="How long to listen to an address: 30s, 10min."
)
def convert(*, inputs: tuple[str, ...], output: Path, reporter: Reporter, **options: Any) -> Result:
    """Make recordings from captures, ROS bags, PCD folders, tables, or udp://224.0.2.2:42102."""
    made = gr.convert(inputs, output, reporter=reporter, **options)
    return Result(outputs=made.outputs, summary=made.figures())


@command(
    example="gis-radar measure R1.parquet R2.parquet --pose R1.json --pose R2.json "
    "--tiles tiles.gpkg --map MAP.osm --scan SCAN.laz -o dataset/",
)
@recordings
@poses
@tile_file
@click.option(
    "--map", "map_path", metavar="MAP.osm", type=FILE, help="The lanes; --hits-only needs none."
)
@folder_output
@view
@accept
@click.option("--hits-only", is_flag=True, help="Leave out the vehicles.")
@click.option("--min-speed", type=float, help="Least absolute range rate of a hit, m/s.")
@click.option("--min-rcs", type=float, help="Least radar cross section of a hit, dBm2.")
@click.option(
    "--clearance",
    type=numbers("LOW,HIGH"),
    help="Heights over the road that count as hits, m: -0.5,4.5.",
)
@click.option(
    "--elevation-error", "elevation_error_deg", type=float, default=0.5, show_default=True,
    help="The radar's elevation error, deg (1 sigma): widens the clearance with range.",
)  # fmt: skip
@frame_times
@sight_scans
@scan_crs
@click.option(
    "--timezone", default="UTC", show_default=True, help="Time zone of the site: Europe/Berlin."
)
@click.option(
    "--jobs", "processes", type=click.IntRange(1), help="Processes at once; by default one a core."
)
def measure(
    *,
    recordings: tuple[Path, ...],
    poses: tuple[Path, ...],
    tiles_path: Path,
    map_path: Path | None,
    output: Path,
    reporter: Reporter,
    **options: Any,
) -> Result:
    """Measure traffic: hits, tracks, passages, occupancy, by the hour, as a dataset.

    A dataset that is there is added to; what did not change is not made again.
    """
    tracks = _tracks(poses, options, reporter)
    names = ("min_speed", "min_rcs", "clearance", "elevation_error_deg")
    found = site.measure_recordings(
        recordings, tracks, tiles_path, map_path, output,
        filters={name: options.pop(name) for name in names}, reporter=reporter, **options,
    )  # fmt: skip
    for line in gr.measure_quality(found).warnings():
        reporter.warn(line)
    return Result(outputs=[output], summary=found.figures(), timezone=found.timezone)


def _tracks(
    poses: tuple[Path, ...], options: dict[str, Any], reporter: Reporter
) -> list[gr.PoseTrack]:
    """Read poses, with views by the options; these options are removed."""
    view = {name: options.pop(name) for name in ("azimuth_deg", "elevation_deg", "max_range_m")}
    return [_with_view(gr.read_track(pose), view, reporter) for pose in poses]


def _with_view(
    track: gr.PoseTrack, options: dict[str, float | None], reporter: Reporter
) -> gr.PoseTrack:
    """Return a track whose poses without a view have the one of the options."""
    given = {name: value for name, value in options.items() if value is not None}
    try:
        view = gr.View(**given)
    except gr.InputError as error:
        raise gr.UsageError(error.message) from error
    if track.has_other_view(given):
        reporter.warn("the pose of {} has another view, which counts", track.sensor)
    return track.with_view(view)


@command(
    example="gis-radar clocks R1.parquet R2.parquet --pose R1.json --pose R2.json "
    "--tiles tiles.gpkg -o clocks.json",
)
@recordings
@poses
@tile_file
@click.option("-o", "--output", type=FILE, help="A file for gis-radar measure --clocks (JSON).")
@click.option("--reference", help="The sensor whose clock counts as right.")
def clocks(
    *,
    recordings: tuple[Path, ...],
    poses: tuple[Path, ...],
    tiles_path: Path,
    output: Path | None,
    reference: str | None,
    reporter: Reporter,
) -> Result:
    """Find how far the clocks of sensors are apart, by the traffic that they share."""
    found = gr.measure_clocks(
        recordings,
        [gr.read_track(pose) for pose in poses],
        gr.read_tiles(tiles_path),
        reference=reference,
        reporter=reporter,
    )
    outputs = [] if output is None else [found.write(output)]
    return Result(outputs=outputs, summary=found.figures())


@command(example="gis-radar quality dataset/ --timezone Europe/Berlin -o quality.csv")
@dataset
@click.option("--timezone", help="Time zone of the hours: Europe/Berlin; by default the dataset's.")
@click.option(
    "-o", "--output", type=FILE, help="The table, a row a sensor and hour (CSV, Parquet)."
)
@csv_locale
def quality(
    *, folder: Path, timezone: str | None, output: Path | None, csv_locale: str, reporter: Reporter
) -> Result:
    """Show what a dataset rests on: frames, detections, clocks, poses, and a verdict."""
    if output is not None:
        products.require_table_name(output)
    measured = gr.open_dataset(folder)
    found = gr.measure_quality(measured, timezone=timezone, reporter=reporter)
    outputs = [] if output is None else [found.write(output, csv_locale=csv_locale)]
    return Result(
        outputs=outputs, summary=found.figures(), timezone=timezone or measured.timezone,
    )  # fmt: skip
