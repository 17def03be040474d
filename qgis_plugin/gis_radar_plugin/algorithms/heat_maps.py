"""Algorithms of heat maps: of times and intervals, and of a month."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingOutputFile,
    QgsProcessingOutputRasterLayer,
    QgsProcessingOutputVectorLayer,
)

from ..base import TRAFFIC, WorkerAlgorithm
from ..loading import INTERVALS, as_ground, dress, dress_only, heatmap_titles, load, shows_occupancy
from ..parameters import Folder, Given, OutputFolder, Result, Text
from ..runner import Answer
from ..words import tr
from . import shared


class MakeHeatMap(WorkerAlgorithm):
    """An algorithm that makes layers of the share of time with a vehicle on each tile."""

    NAME = "heatmap"
    COMMAND = "heatmap"
    TITLE = "Heat map"
    GROUP = TRAFFIC
    HELP = (
        "Makes maps of occupancy: the estimated share of time that a vehicle is on a tile, moving "
        "or waiting. A dataset without vehicles gives maps of the hit share: the share of the "
        "observed time in which radar hit a tile, which is several times lower. What was never "
        "observed is left out, not 0; occupancy that is uncertain is hatched.\n"
        "The result is a GeoPackage (the whole time, and by interval), a GeoTIFF with a band an "
        "interval, a GeoParquet and a picture. Colours are the same on every map, so that maps "
        "compare.\n"
        "The layer 'by interval' is animated by the temporal controller as it is loaded. The data "
        "are in UTC; the picture and the clock on the map show the local time."
    )
    KEYWORDS = ("hits", "occupancy", "raster", "animation")
    PARAMETERS = (
        shared.DATASET,
        replace(
            shared.INTERVAL,
            about="Length of the intervals: 20s, 15min, 1h; empty for the whole time only.",
        ),
        replace(
            shared.TIMEZONE,
            about="Whose hours and days the intervals follow, such as Europe/Berlin; by "
            "default the dataset's.",
        ),
        shared.BEGIN,
        shared.END,
        shared.LANGUAGE,
        shared.MAP_TITLE,
        replace(shared.SOURCE, about="Where the data come from, to stand under the picture."),
        Text(
            "AT", "One moment only", "The map of one step of 50 ms, in UTC: 2025-06-12T07:30:10Z.",
        ),
        shared.LOAD,
        OutputFolder("OUTPUT", "Heat map", "A folder."),
        Result("HEATMAP", "Heat map, whole time", kind=QgsProcessingOutputVectorLayer),
        Result("INTERVALS", "Heat map by interval", kind=QgsProcessingOutputVectorLayer),
        Result("RASTER", "Heat map, raster", kind=QgsProcessingOutputRasterLayer),
        Result("PICTURE", "Picture", kind=QgsProcessingOutputFile),
    )  # fmt: skip

    def finish(self, given: Given, answer: Answer) -> dict[str, Any]:
        del answer
        folder = Path(given.outputs["OUTPUT"])
        if given.is_on("LOAD"):
            load_heatmap(given.context, folder, folder.name)
        self.made = [
            (tr("Open the picture"), folder / "heatmap.png"), (tr("Show the folder"), folder)
        ]  # fmt: skip
        return layers_of(folder)


def layers_of(folder: Path) -> dict[str, str]:
    """Return what is in a heat map's folder, by output."""
    package = folder / "heatmap.gpkg"
    return {
        "HEATMAP": f"{package}|layername=heatmap",
        "INTERVALS": f"{package}|layername={INTERVALS}",
        "RASTER": str(folder / ("heatmap.tif" if shows_occupancy(folder) else "hits.tif")),
        "PICTURE": str(folder / "heatmap.png"),
    }


def load_heatmap(
    context: QgsProcessingContext,
    folder: Path,
    group: str,
    *,
    sets_time: bool = True,
) -> None:
    """Have QGIS load a heat map as a group, the layer by interval on top and switched on.

    The project steps by its intervals, unless `sets_time` is false.
    """
    layers, titles = layers_of(folder), heatmap_titles(folder)
    finish = dress if sets_time else dress_only
    load(context, layers["INTERVALS"], titles[INTERVALS], group=group, order=3, finish=finish)
    load(context, layers["HEATMAP"], titles["heatmap"], group=group, order=2, visible=False)
    load(context, layers["RASTER"], titles["raster"], group=group, order=1, visible=False)
    # In other words, as Processing loads a source once.
    source = f"{layers['HEATMAP']}|geometrytype=Polygon"
    load(context, source, tr("Road, not observed"), group=group, order=0, finish=as_ground)


class MapMonth(WorkerAlgorithm):
    """An algorithm that asks a dataset, or all sites of a city, for the map of a month."""

    NAME = "monthmap"
    COMMAND = "heatmap"
    TITLE = "Map of a month"
    GROUP = TRAFFIC
    HELP = (
        "Makes the map of occupancy over a month, of a dataset or of all sites of a city: the "
        "folder with a dataset for each site (site=...), as 'gis-radar run CITY.toml' makes it. It "
        "comes from the sums that are kept of each month, in seconds, also where older exact "
        "tables were deleted.\n"
        "Colours are the same on every map, so that months and places compare."
    )
    KEYWORDS = ("city", "occupancy", "heat map")
    PARAMETERS = (
        Folder("DATASET", "Dataset or city", "A dataset, or a folder with one for each site.", ""),
        Text(
            "MONTH", "Month", "By the clocks of the sites: 2026-10.", advanced=False,
            optional=False,
        ),
        shared.LOAD,
        OutputFolder("OUTPUT", "Heat map", "A folder."),
        Result("HEATMAP", "Map of the month", kind=QgsProcessingOutputVectorLayer),
    )  # fmt: skip

    def finish(self, given: Given, answer: Answer) -> dict[str, Any]:
        del answer
        folder = Path(given.outputs["OUTPUT"])
        layer = layers_of(folder)["HEATMAP"]
        if given.is_on("LOAD"):
            load(given.context, layer, f"{tr('Occupancy')} {given.text('MONTH')}")
        self.made = [(tr("Show the folder"), folder)]
        return {"HEATMAP": layer}
