"""Heat map of coverage and occupancy."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingOutputFile,
    QgsProcessingOutputRasterLayer,
    QgsProcessingOutputVectorLayer,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterString,
)

from ..base import TRAFFIC, WorkerAlgorithm, option
from ..loading import INTERVALS, as_ground, dress, dress_only, heatmap_titles, load
from ..parameters import add_language, add_text, add_tiles, add_timezone, given_words, tile_file
from ..words import tr

OPTIONS = ("TIMEZONE", "LANGUAGE", "TITLE", "SOURCE", "AT")
INTERVAL = re.compile(r"\d+(\.\d+)?\s*(ms|s|min|h|d)")


class MakeHeatMap(WorkerAlgorithm):
    """An algorithm that makes layers of shares of time which compare over places and times."""

    NAME = "heatmap"
    TITLE = "Heat map"
    GROUP = TRAFFIC
    HELP = (
        "Makes maps of coverage: the estimated share of time that a vehicle is on a tile, moving "
        "or waiting. That needs the vehicles; without them the map shows occupancy: the share of "
        "the observed time in which radar hit a tile, which is several times lower. What was never "
        "observed is left out, not 0; coverage that is uncertain is hatched.\n"
        "The result is a GeoPackage (the whole time, and by interval), a GeoTIFF with a band an "
        "interval, a GeoParquet and a picture. Colours are the same on every map, so that maps "
        "compare.\n"
        "The layer 'by interval' is animated by the temporal controller as it is loaded. Times are "
        "UTC in the data and in the picture; the clock on the map shows the local time."
    )
    KEYWORDS = ("occupancy", "coverage", "raster", "animation")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        self.add(
            QgsProcessingParameterFile(
                "OCCUPANCY", tr("Occupancy"), QgsProcessingParameterFile.Behavior.Folder
            ),
            about="A folder from 'Occupancy from recordings', or the one of all sensors of a site.",
        )
        add_tiles(self, about="The tiles that the occupancy was made with.")
        self.add(
            QgsProcessingParameterFile(
                "VEHICLES", tr("Vehicles"), QgsProcessingParameterFile.Behavior.Folder,
                optional=True,
            ),
            about="A folder from 'Vehicles from recordings', made with the same recordings, poses, "
            "tiles and scans: the maps then show coverage.",
        )  # fmt: skip
        self.add(
            QgsProcessingParameterString("INTERVAL", tr("Interval"), "15min", optional=True),
            about="Length of the intervals: 20s, 15min, 1h; empty for the whole time only.",
        )
        add_timezone(
            self, "Whose hours and days the intervals follow, such as Europe/Berlin; UTC without."
        )
        add_language(self)
        add_text(self, "TITLE", "Title")
        add_text(self, "SOURCE", "Source", "Where the data come from, to stand under the picture.")
        add_text(
            self, "AT", "One moment only",
            "The map of one step of 50 ms, in UTC: 2025-06-12T07:30:10Z.",
        )  # fmt: skip
        self.add(
            QgsProcessingParameterMultipleLayers(
                "MORE", tr("Further occupancy"), QgsProcessing.SourceType.TypeFile, optional=True
            ),
            about="The files manifest.json of more folders, which are merged.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterBoolean("LOAD", tr("Load the layers"), True),
            about="Switch it off in a model that continues with the files.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterFolderDestination("OUTPUT", tr("Heat map")), about="A folder."
        )
        self.addOutput(QgsProcessingOutputVectorLayer("HEATMAP", tr("Heat map, whole time")))
        self.addOutput(QgsProcessingOutputVectorLayer("INTERVALS", tr("Heat map by interval")))
        self.addOutput(QgsProcessingOutputRasterLayer("RASTER", tr("Heat map, raster")))
        self.addOutput(QgsProcessingOutputFile("PICTURE", tr("Picture")))

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsString(parameters, "OUTPUT", context)
        manifests = self.files(parameters, "MORE", context)
        folders = [
            *occupancies_in(self.parameterAsFile(parameters, "OCCUPANCY", context)),
            *[str(Path(manifest).parent) for manifest in manifests],
        ]
        tiles = tile_file(self, parameters, context)
        interval = self.parameterAsString(parameters, "INTERVAL", context).strip()
        vehicles = self.parameterAsFile(parameters, "VEHICLES", context)
        words = ["heatmap", *folders, "--tiles", tiles, "-o", dest]
        words += [*option("--interval", interval), *option("--vehicles", vehicles)]
        words += given_words(self, parameters, context, OPTIONS)
        self.work(words, [dest], feedback)
        if self.parameterAsBoolean(parameters, "LOAD", context):
            load_heatmap(context, Path(dest), Path(dest).name)
        self.made = [
            (tr("Open the picture"), Path(dest) / "heatmap.png"),
            (tr("Show the folder"), Path(dest)),
        ]
        return {"OUTPUT": dest, **layers_of(Path(dest))}


def occupancies_in(folder: str) -> list[str]:
    """Return a folder of occupancy, or those that are in it, as a site's run leaves them."""
    inside = sorted(Path(folder).glob("*/manifest.json"))
    if (Path(folder) / "manifest.json").is_file() or not inside:
        return [folder]
    return [str(manifest.parent) for manifest in inside]


def layers_of(folder: Path) -> dict[str, str]:
    """Return what is in a heat map's folder, by output."""
    package = folder / "heatmap.gpkg"
    return {
        "HEATMAP": f"{package}|layername=heatmap",
        "INTERVALS": f"{package}|layername={INTERVALS}",
        "RASTER": str(folder / "heatmap.tif"),
        "PICTURE": str(folder / "heatmap.png"),
    }


def load_heatmap(
    context: QgsProcessingContext, folder: Path, group: str, *, sets_time: bool = True
) -> None:
    """Have QGIS load a heat map as a group, the layer by interval on top and switched on.

    The project steps by its intervals, unless `sets_time` is false.
    """
    layers, titles = layers_of(folder), heatmap_titles(folder)
    finish = dress if sets_time else dress_only
    load(context, layers["INTERVALS"], titles[INTERVALS], group=group, order=3, finish=finish)
    load(context, layers["HEATMAP"], titles["heatmap"], group=group, order=2, visible=False)
    load(context, layers["RASTER"], titles["raster"], group=group, order=1, visible=False)
    ground = tr("Road, not observed")
    # In other words, as Processing loads a source once.
    source = f"{layers['HEATMAP']}|geometrytype=Polygon"
    load(context, source, ground, group=group, order=0, finish=as_ground)
