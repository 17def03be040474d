"""The commands about poses: localize, track, sensors, sight."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import gis_radar as gr
from gis_radar import calibration, site
from gis_radar import poses as pose_room
from gis_radar import scans as scan_room
from gis_radar.base import (
    OutputError,
    Reporter,
    Text,
    UsageError,
    in_language,
    refuse_inputs,
    require_folder,
    users_language,
)
from gis_radar.cli.console import Result, command
from gis_radar.cli.options import (
    BEARING,
    FILE,
    GIVEN_POSITION,
    lanes,
    origin,
    output,
    recordings,
    road,
    scan_crs,
    sight_scans,
    tile_file,
)


@command(
    example="gis-radar localize R1.parquet --map junction.osm --road road.laz "
    "--guess 690356,5336183 -o R1.json",
    refuses=False,
)
@recordings
@lanes
@road
@click.option(
    "--guess", "guesses", type=GIVEN_POSITION, multiple=True, required=True,
    help="Where the sensor stands, within 15 m, in the road's CRS.",
)  # fmt: skip
@click.option("--guess-crs", help="CRS of the guess, where it is not the road's: EPSG:3857.")
@click.option(
    "--heading", "headings", type=float, multiple=True,
    help="Where it looks, within 25 deg: from grid east, anticlockwise; without it all are tried.",
)  # fmt: skip
@click.option(
    "--compass", "compasses", type=BEARING, multiple=True,
    help="The same as a bearing: 210, north-east, ...",
)  # fmt: skip
@click.option(
    "--together", is_flag=True,
    help="Several sensors, related by the vehicles they share: a RECORDING and --guess each; "
    "-o is a folder of SENSOR.json.",
)  # fmt: skip
@origin
@click.option(
    "--method", type=click.Choice(["lane", "icp"]), default="lane", show_default=True,
    help="Lanes and Doppler, or the paper's ICP.",
)  # fmt: skip
@click.option(
    "--scan", "scans", metavar="SCAN.laz", type=FILE, multiple=True,
    help="Airborne scan, whole: what stands in it measures and checks each pose. May be repeated.",
)  # fmt: skip
@scan_crs
@click.option("--figure", type=FILE, help="Draw the traces over lanes and scan (PNG).")
@output
def localize(
    *,
    recordings: tuple[Path, ...],
    map_path: Path,
    road: Path,
    guesses: tuple[tuple[float, ...], ...],
    headings: tuple[float, ...],
    compasses: tuple[float, ...],
    together: bool,
    scans: tuple[Path, ...],
    figure: Path | None,
    output: Path,
    reporter: Reporter,
    **options: Any,
) -> Result:
    """Find a sensor's pose from its recording and a rough guess (JSON).

    With --together those of several sensors that recorded at the same time.
    """
    if headings and compasses:
        raise UsageError("both --heading and --compass are given", hint="give one of them")
    if together:
        if figure or options.pop("method") != "lane":
            raise UsageError("--figure and {} icp are for one sensor", "--method")
        _check_folder(output, recordings, map_path, road, *scans)
        several = calibration.localize_together(
            recordings, map_path, road, guesses=guesses, headings=headings or None,
            compasses=compasses or None, scans=scans, reporter=reporter, **options,
        )  # fmt: skip
        made = several.write(output)
        return Result(outputs=made, summary=several.figures(), failure=several.failure)
    given = {"RECORDING": recordings, "--guess": guesses, "--heading": headings,
             "--compass": compasses}  # fmt: skip
    for name, values in given.items():
        if len(values) > 1:
            raise UsageError(
                "{} times {}",
                len(values),
                name,
                hint=Text("{} takes several sensors", "--together"),
            )
    _check_outputs(output, figure, *recordings, map_path, road, *scans)
    with in_language(users_language()):  # of the figure
        found = gr.localize(
            recordings[0], map_path, road, guess=guesses[0], heading=next(iter(headings), None),
            compass=next(iter(compasses), None), scans=scans, figure=figure, reporter=reporter,
            **options,
        )  # fmt: skip
    found.pose.write(output)
    outputs = [output] if figure is None else [output, figure]
    return Result(outputs=outputs, summary=found.figures())


@command(
    example="gis-radar track R1.parquet --map junction.osm --road road.laz --pose R1.json "
    "-o track.csv",
)
@click.argument("recording", metavar="RECORDING", type=FILE)
@lanes
@road
@click.option(
    "--pose", type=FILE, required=True, help="Where it stands at the beginning: JSON, or a track."
)
@origin
@click.option("--figure", type=FILE, help="Draw the pose over time, with its error (PNG).")
@output
def track(
    *,
    recording: Path,
    map_path: Path,
    road: Path,
    pose: Path,
    origin: tuple[float, float] | None,
    figure: Path | None,
    output: Path,
    reporter: Reporter,
) -> Result:
    """Follow a sensor's pose through a recording: a corrected pose every 5 s (CSV)."""
    if output.suffix.lower() != ".csv":
        raise UsageError("{}: a pose track is a CSV file", output, hint="name it track.csv")
    _check_outputs(output, figure)
    start = gr.read_track(pose)
    roads = gr.read_map(map_path, crs=scan_room.road_crs(road), origin=origin, reporter=reporter)
    points = gr.read_road(road, roads.crs)
    followed = gr.track(recording, roads, points, start, reporter=reporter)
    outputs = [output]
    if figure is not None:
        with in_language(users_language()):
            followed.draw(figure)
        outputs.append(figure)
    followed.poses.write(output)
    return Result(outputs=outputs, summary=followed.figures())


@command(example="gis-radar sensors R1.json R2.json -o sensors.gpkg")
@click.argument("poses", metavar="POSE...", type=FILE, nargs=-1, required=True)
@output
def sensors(*, poses: tuple[Path, ...], output: Path, reporter: Reporter) -> Result:
    """Write sensors as layers of a map: points, views, uncertainty (GeoPackage)."""
    found = [gr.read_track(path).poses[-1] for path in poses]
    pose_room.write_sensors(found, output)
    reporter.progress("writing sensors", len(found), len(found))
    return Result(outputs=[output], summary={"sensors": [pose.sensor for pose in found]})


@command(
    example="gis-radar sight --pose R1.json --tiles tiles.gpkg --scan scan.laz -o sight.gpkg",
)
@click.option("--pose", "poses", type=FILE, multiple=True, required=True, help="Of each sensor.")
@tile_file
@sight_scans
@scan_crs
@output
def sight(
    *,
    poses: tuple[Path, ...],
    tiles_path: Path,
    scans: tuple[Path, ...],
    output: Path,
    reporter: Reporter,
    **options: Any,
) -> Result:
    """Find which tiles sensors see from their poses, and which something hides (GeoPackage)."""
    if not scans:
        raise UsageError("no scan is given", hint=Text("name one with {}; see --help", "--scan"))
    tracks = [gr.read_track(path) for path in poses]
    figures = site.write_sights_of(
        tracks, tiles_path, output, scans=scans, reporter=reporter, **options
    )
    return Result(outputs=[output], summary={"sensors": figures})


def _check_folder(output: Path, recordings: tuple[Path, ...], *inputs: Path) -> None:
    """Refuse a folder for poses that cannot be written, before any work."""
    require_folder(output)
    if output.is_file():
        raise OutputError("{}: is a file", output, hint="name a folder for the poses")
    for recording in recordings:
        refuse_inputs(output / f"{recording.stem}.json", *recordings, *inputs)


def _check_outputs(output: Path, figure: Path | None, *inputs: Path) -> None:
    """Refuse outputs that cannot be written, before any work."""
    require_folder(output)
    refuse_inputs(output, *inputs)
    if figure is None:
        return
    if figure.suffix.lower() != ".png":
        raise UsageError("{}: a figure is a PNG file", figure, hint="name it figure.png")
    require_folder(figure)
    if figure.resolve() == output.resolve():
        raise UsageError("{}: figure and output are the same file", figure, hint="name two files")
    refuse_inputs(figure, *inputs)
