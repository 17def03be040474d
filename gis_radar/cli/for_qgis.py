"""Commands for who works in QGIS: sensors as layers, projects, the sample site."""

from __future__ import annotations

import shutil
from pathlib import Path

import click

import gis_radar as gr
from gis_radar.cli.commands import FILE, group, output
from gis_radar.cli.console import Result
from gis_radar.cli.door import command
from gis_radar.outputs import refuse_inputs, whole_folder
from gis_radar.progress import Reporter

SAMPLE_KINDS = (".osm", ".laz", ".parquet", ".json", ".toml", ".md")


@command(group, example="gis-radar sensors R1.json R2.json -o sensors.gpkg")
@click.argument("poses", metavar="POSE...", type=FILE, nargs=-1, required=True)
@output
def sensors(*, poses: tuple[Path, ...], output: Path, reporter: Reporter) -> Result:
    """Write sensors as layers of a map: points, views, uncertainty (GeoPackage)."""
    refuse_inputs(output, *poses)
    found = [gr.read_track(path).poses[-1] for path in poses]
    gr.write_sensors(found, output)
    reporter.progress("writing sensors", len(found), len(found))
    return Result(outputs=[output], summary={"sensors": [pose.sensor for pose in found]})


@command(group, example="gis-radar qgis map/ --sensors sensors.gpkg -o site.qgz")
@click.argument("heatmap", metavar="HEATMAP", type=FILE)
@click.option("--sensors", type=FILE, help="From gis-radar sensors.")
@click.option("--title", default="", help="Of the project; by default the file's name.")
@click.option("--timezone", default="UTC", show_default=True, help="Of the time on its layout.")
@click.option("--source", default="", help="Where the data come from, as its layout says it.")
@output
def qgis(
    *,
    heatmap: Path,
    sensors: Path | None,
    title: str,
    timezone: str,
    source: str,
    output: Path,
    reporter: Reporter,
) -> Result:
    """Write a QGIS project that shows a heat map ready to present, with a print layout."""
    refuse_inputs(output, heatmap, *[path for path in (sensors,) if path])
    gr.write_qgis_project(
        output, heatmap=heatmap, sensors=sensors, title=title, time_zone=timezone, source=source
    )
    reporter.progress("writing the project", 1, 1)
    return Result(outputs=[output])


@command(group, example="gis-radar sample -o sample")
@output
def sample(*, output: Path, reporter: Reporter) -> Result:
    """Copy the files of the sample junction to a folder, to try everything on."""
    source = gr.sample_folder()
    files = sorted(path for path in source.iterdir() if path.suffix in SAMPLE_KINDS)
    refuse_inputs(output, *files)
    with whole_folder(output, owned=tuple(path.name for path in files)) as fresh:
        for done, path in enumerate(files, start=1):
            shutil.copyfile(path, fresh / path.name)
            reporter.progress("copying the sample", done, len(files))
    return Result(outputs=[output / path.name for path in files])
