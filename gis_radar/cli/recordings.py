"""The commands about recordings: convert, occupancy, clocks, quality."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import gis_radar as gr
from gis_radar.cli.console import Result, command
from gis_radar.cli.options import (
    DURATION,
    FILE,
    PAIRS,
    csv_locale,
    frame_times,
    lanes,
    numbers,
    occupancies,
    output,
    poses,
    recordings,
    sight,
    tile_file,
    view,
)  # fmt: skip
from gis_radar.files import refuse_inputs
from gis_radar.progress import Reporter

ENGINES = {"grid": "TileGrid", "rtree": "TileTree"}


@command(example="gis-radar convert capture.pcap -o R1.parquet")
@click.argument("inputs", metavar="IN...", nargs=-1, required=True)
@output
@click.option("--sensor", help="Only this one, where there are several: 10.13.1.113, /radar/front.")
@click.option("--columns", type=PAIRS, help="Fields of a table or cloud: x=X,range_rate=-doppler.")
@click.option(
    "--time-unit", type=click.Choice(["s", "ms", "us", "ns"]), default="s", show_default=True,
    help="Of the times in a table, since 1970.",
)  # fmt: skip
@click.option(
    "--clock", type=click.Choice(["auto", "sensor", "recorder"]), default="auto", show_default=True,
    help="Whose times count; auto takes the sensor's where they are right.",
)  # fmt: skip
@click.option(
    "--duration", "duration_s", type=DURATION, help="How long to listen to an address: 30s, 10min."
)
def convert(*, inputs: tuple[str, ...], output: Path, reporter: Reporter, **options: Any) -> Result:
    """Make recordings of captures, ROS bags, PCD folders, tables, or udp://224.0.2.2:42102."""
    made = gr.convert(inputs, output, reporter=reporter, **options)
    return Result(outputs=made.outputs, summary=made.figures())


@command(
    example="gis-radar occupancy R1.parquet R2.parquet --pose R1.json --pose R2.json "
    "--tiles tiles.gpkg -o occupancy/",
)
@recordings
@poses
@tile_file
@output
@view
@click.option("--min-speed", type=float, help="Least absolute range rate, m/s; off by default.")
@click.option("--min-rcs", type=float, help="Least radar cross section, dBm2; off by default.")
@click.option("--clearance", type=numbers("LOW,HIGH"), help="Heights over the road that count, m.")
@click.option(
    "--elevation-error", "elevation_error_deg", type=float, default=0.5, show_default=True,
    help="The radar's elevation error, deg (1 sigma): widens the clearance with range.",
)  # fmt: skip
@frame_times
@sight
@click.option("--engine", type=click.Choice(sorted(ENGINES)), default="grid", show_default=True)
@click.option("--pairs", is_flag=True, help="Also write hits.parquet: each pair of step and tile.")
def occupancy(
    *,
    recordings: tuple[Path, ...],
    poses: tuple[Path, ...],
    tiles_path: Path,
    output: Path,
    clocks: str | None,
    engine: str,
    pairs: bool,
    cycles: dict[str, float] | None,
    scans: tuple[Path, ...],
    scan_crs: str | None,
    sight: Path | None,
    reporter: Reporter,
    **options: Any,
) -> Result:
    """Join recordings to tiles: which tile was hit in which 50 ms step."""
    from gis_radar.site.recipes import join_recordings  # noqa: PLC0415 - --help needs no NumPy

    refuse_inputs(output, *recordings, *poses, tiles_path, *scans, *_files(clocks, sight))
    tracks = _tracks(poses, options, reporter)
    result = join_recordings(
        recordings, tracks, tiles_path, output, filters=options, clocks=clocks, cycles=cycles,
        engine=getattr(gr, ENGINES[engine]), pairs=pairs, scans=scans, scan_crs=scan_crs,
        sight=sight, reporter=reporter,
    )  # fmt: skip
    for line in gr.measure_quality(result).warnings():
        reporter.log(line, "warning")
    return Result(outputs=[output], summary=result.figures())


def _files(clocks: str | None, sight: Path | None) -> list[Path]:
    """Return the files among these options."""
    return [Path(each) for each in (clocks, sight) if each not in {None, "auto"}]


def _tracks(
    poses: tuple[Path, ...], options: dict[str, Any], reporter: Reporter
) -> list[gr.PoseTrack]:
    """Read poses; take the view of those without one out of the options."""
    known = {name: options.pop(name) for name in ("azimuth_deg", "elevation_deg", "max_range_m")}
    return [_seeing(gr.read_track(pose), known, reporter) for pose in poses]


def _seeing(
    track: gr.PoseTrack, options: dict[str, float | None], reporter: Reporter
) -> gr.PoseTrack:
    """Give poses without a view the one of the options."""
    given = {name: value for name, value in options.items() if value is not None}
    try:
        view = gr.View(**given)
    except gr.InputError as error:
        raise gr.UsageError(error.message) from error
    own = [pose.view for pose in track.poses if pose.view is not None]
    if any(getattr(each, name) != value for each in own for name, value in given.items()):
        reporter.log(f"the pose of {track.sensor} has a view, which counts", "warning")
    return track.with_view(view)


@command(
    example="gis-radar vehicles R1.parquet R2.parquet --pose R1.json --pose R2.json "
    "--tiles tiles.gpkg --map MAP.osm --scan SCAN.laz -o vehicles/",
)
@recordings
@poses
@tile_file
@lanes
@output
@view
@frame_times
@sight
def vehicles(
    *,
    recordings: tuple[Path, ...],
    poses: tuple[Path, ...],
    tiles_path: Path,
    map_path: Path,
    output: Path,
    clocks: str | None,
    reporter: Reporter,
    scans: tuple[Path, ...],
    sight: Path | None,
    **options: Any,
) -> Result:
    """Follow the vehicles in recordings: which tiles they covered, and for how long."""
    from gis_radar.site.recipes import follow_vehicles  # noqa: PLC0415 - --help needs no NumPy

    files = _files(clocks, sight)
    refuse_inputs(output, *recordings, *poses, tiles_path, map_path, *scans, *files)
    tracks = _tracks(poses, options, reporter)
    found = follow_vehicles(
        recordings, tracks, tiles_path, map_path, output, clocks=clocks, scans=scans, sight=sight,
        reporter=reporter, **options,
    )  # fmt: skip
    return Result(outputs=[output], summary=found.figures())


@command(
    example="gis-radar clocks R1.parquet R2.parquet --pose R1.json --pose R2.json "
    "--tiles tiles.gpkg -o clocks.json",
)
@recordings
@poses
@tile_file
@click.option("-o", "--output", type=FILE, help="A file for gis-radar occupancy --clocks (JSON).")
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
    if output is not None:
        refuse_inputs(output, *recordings, *poses, tiles_path)
    found = gr.measure_clocks(
        recordings,
        [gr.read_track(pose) for pose in poses],
        gr.read_tiles(tiles_path),
        reference=reference,
        reporter=reporter,
    )
    outputs = [] if output is None else [found.write(output)]
    return Result(outputs=outputs, summary=found.figures())


@command(example="gis-radar quality occupancy/ --timezone Europe/Berlin -o quality.csv")
@occupancies
@click.option("--timezone", default="UTC", show_default=True, help="Whose hours: Europe/Berlin.")
@click.option(
    "-o", "--output", type=FILE, help="The table, a row a sensor and hour (CSV, Parquet)."
)
@csv_locale
def quality(
    *, folders: tuple[Path, ...], timezone: str, output: Path | None, csv_locale: str,
    reporter: Reporter,
) -> Result:  # fmt: skip
    """Show what an occupancy rests on: frames, detections, clocks, poses, and a verdict."""
    if output is not None:
        from gis_radar.quality.quality import require_table_name  # noqa: PLC0415 - late as above

        require_table_name(output)
        inside = [file for folder in folders if folder.is_dir() for file in folder.iterdir()]
        refuse_inputs(output, *folders, *(file for file in inside if file.stem != "quality"))
    merged = gr.merge_occupancies([gr.read_occupancy(each, reporter=reporter) for each in folders])
    found = gr.measure_quality(merged, timezone=timezone, reporter=reporter)
    outputs = [] if output is None else [found.write(output, csv_locale=csv_locale)]
    return Result(outputs=outputs, summary=found.figures(), timezone=timezone)
