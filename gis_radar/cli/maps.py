"""The commands that make maps: tiles, mask, heatmap, footprints, project."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import gis_radar as gr
from gis_radar import products, site
from gis_radar.base import Reporter, UsageError
from gis_radar.cli.console import Result, command
from gis_radar.cli.options import (
    FILE,
    WORDS,
    begin_end,
    dataset,
    folder_output,
    language,
    origin,
    output,
    scan_crs,
)

MASK_ENGINES = ("auto", "pdal", "laspy")


@command(example="gis-radar tiles junction.osm -o tiles.gpkg")
@click.argument("map_path", metavar="MAP.osm", type=FILE)
@output
@click.option("--crs", help="Projected, metric CRS; without it the site's UTM zone.")
@click.option("--length", "length_m", default=0.5, show_default=True, help="Tile length, m.")
@origin
@click.option("--road", type=FILE, help="Scanned road (LAZ) that gives the tiles' heights.")
@click.option(
    "--subtype",
    "subtypes",
    type=WORDS,
    help="Only lanelets of these subtypes: road,bicycle_lane; by default those for vehicles.",
)
@click.option(
    "--streets",
    type=FILE,
    help="Lines of streets with names, for lanes that the map does not name.",
)
@click.option("--street-field", help="Their column of names; by default the first usual one.")
def tiles(*, map_path: Path, output: Path, reporter: Reporter, **options: Any) -> Result:
    """Split the lanelets of a Lanelet2 map into tiles (GeoPackage), and list its lanes."""
    summary = site.split_map(map_path, output, reporter=reporter, **options)
    return Result(outputs=[output], summary=summary)


@command(example="gis-radar mask scan.laz --map junction.osm -o road.laz")
@click.argument("scans", metavar="SCAN.laz...", type=FILE, nargs=-1, required=True)
@click.option(
    "--map", "map_path", type=FILE, required=True,
    help="Lanelet2 map (.osm) or polygons of the roads (.gpkg, .geojson, .csv, ...).",
)  # fmt: skip
@output
@click.option(
    "--engine", type=click.Choice(MASK_ENGINES), default="auto", show_default=True,
    help="Who reads the scans; auto takes PDAL where there is one.",
)  # fmt: skip
@scan_crs
@click.option("--map-crs", help="CRS of a polygon layer that does not state its own.")
@click.option("--crs", help="Projected, metric CRS of the result; by default the map's.")
@origin
@click.option("--layer", help="Which layer of polygons, where the file has several.")
def mask(
    *, scans: tuple[Path, ...], map_path: Path, output: Path, reporter: Reporter, **options: Any
) -> Result:
    """Mask the road out of airborne laser scans: one point each 0.5 m (LAZ)."""
    outputs, summary = site.mask_scans(scans, map_path, output, reporter=reporter, **options)
    return Result(outputs=outputs, summary=summary)


@command(example="gis-radar heatmap dataset/ --interval 15min -o map/")
@dataset
@folder_output
@click.option("--interval", help="Length of the intervals: 20s, 15min, 1h, ...")
@begin_end
@click.option(
    "--month", help="The map of a month, such as 2026-10, from the sums that the dataset keeps."
)
@click.option(
    "--timezone",
    help="Time zone of the intervals and of the picture; by default the dataset's.",
)
@click.option("--title", default="", help="Title of the picture, and of a report of it.")
@language("Of the picture and the report.")
@click.option(
    "--source",
    "sources",
    multiple=True,
    help="Where the data come from, to stand under the picture.",
)
@click.option("--at", help="Map of the one 50 ms step at this time: '2025-06-12 07:30:05'.")
def heatmap(
    *, folder: Path, output: Path, title: str, language: str, sources: tuple[str, ...],
    reporter: Reporter, **options: Any,
) -> Result:  # fmt: skip
    """Make heat maps of occupancy: GeoPackage, GeoTIFF, GeoParquet, picture.

    Of a city, DIR with a dataset a site, --month makes one layer of all sites (GeoPackage).
    """
    if products.is_city(folder):
        others = {**options, "title": title, "language": language if language != "en" else "",
                  "source": sources}  # fmt: skip
        return _map_of_city(folder, output, reporter, **others)
    measured = gr.open_dataset(folder)
    zone = options["timezone"] = options["timezone"] or measured.timezone
    options["labels"] = gr.MapLabels(title=title, timezone=zone, sources=sources, language=language)
    heat = gr.make_heatmap(measured, reporter=reporter, **options)
    outputs = heat.write(output, reporter=reporter)
    return Result(outputs=outputs, summary=heat.figures(), timezone=zone)


def _map_of_city(
    folder: Path, output: Path, reporter: Reporter, *, month: str | None, **others: Any
) -> Result:
    """Write the map of a city's month; refuse options of other maps."""
    if month is None:
        raise UsageError("{} is a city: which month?", folder, hint="name it by --month 2026-10")
    if given := [name for name, value in others.items() if value]:
        raise UsageError("{} is of the map of a dataset, not of a city", f"--{given[0]}")
    city = gr.open_city(folder, reporter=reporter)
    path = city.write_map(month, output)
    return Result(outputs=[path], summary={"sites": len(city.sites), "month": month})


@command(example="gis-radar footprints dataset/ -o footprints.gpkg")
@dataset
@output
def footprints(*, folder: Path, output: Path, reporter: Reporter) -> Result:
    """Write single vehicles as a layer that moves with the time of QGIS (.gpkg).

    A row a vehicle and half second: a working file, not to be published.
    """
    count = gr.open_dataset(folder).write_footprints(output, reporter=reporter)
    return Result(outputs=[output], summary={"rows": count})


@command(example="gis-radar project R1.parquet --pose R1.json -o hits.parquet")
@click.argument("recording", metavar="RECORDING", type=FILE)
@click.option("--pose", type=FILE, required=True, help="Pose (JSON) or pose track (CSV).")
@output
def project(*, recording: Path, pose: Path, output: Path, reporter: Reporter) -> Result:
    """Write the detections of a recording as points in the map (.parquet, .gpkg, .laz).

    A name without an ending becomes GeoParquet, which is the smallest.
    """
    output = output if output.suffix else output.with_suffix(".parquet")
    count = products.write_projection(recording, pose, output, reporter=reporter)
    return Result(outputs=[output], summary={"points": count})
