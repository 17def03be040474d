"""Heat map of occupancy and hit share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingOutputFile,
    QgsProcessingOutputRasterLayer,
    QgsProcessingOutputVectorLayer,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterString,
)

from ..base import TRAFFIC, WorkerAlgorithm, option
from ..loading import INTERVALS, as_ground, dress, dress_only, heatmap_titles, load, shows_occupancy
from ..parameters import add_dataset, add_language, add_text, add_timezone, given_words
from ..words import tr

OPTIONS = ("BEGIN", "END", "TIMEZONE", "LANGUAGE", "TITLE", "SOURCE", "AT")


class MakeHeatMap(WorkerAlgorithm):
    """An algorithm that makes layers of shares of time which compare over places and times."""

    NAME = "heatmap"
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

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        add_dataset(self)
        self.add(
            QgsProcessingParameterString("INTERVAL", tr("Interval"), "15min", optional=True),
            about="Length of the intervals: 20s, 15min, 1h; empty for the whole time only.",
        )
        add_timezone(
            self, "Whose hours and days the intervals follow, such as Europe/Berlin; by default "
            "the dataset's.",
        )  # fmt: skip
        add_text(
            self, "BEGIN", "Begin", "Only from this time on, in the time zone: 2025-06-12 07:30."
        )
        add_text(self, "END", "End", "Only before this time.")
        add_language(self)
        add_text(self, "TITLE", "Title")
        add_text(self, "SOURCE", "Source", "Where the data come from, to stand under the picture.")
        add_text(
            self, "AT", "One moment only",
            "The map of one step of 50 ms, in UTC: 2025-06-12T07:30:10Z.",
        )  # fmt: skip
        add_text(
            self, "MAP_OF", "Maps of further columns",
            "Columns of the table 'tile_counts', with a comma between them: hidden_steps maps the "
            "share of the time in which vehicles hid a tile.",
        )  # fmt: skip
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
        interval = self.parameterAsString(parameters, "INTERVAL", context).strip()
        dataset = self.parameterAsFile(parameters, "DATASET", context)
        words = ["heatmap", dataset, "-o", dest, *option("--interval", interval)]
        words += given_words(self, parameters, context, OPTIONS)
        listed = self.parameterAsString(parameters, "MAP_OF", context).replace(",", " ")
        columns = list(dict.fromkeys(listed.split()))
        for column in columns:
            words += ["--map-of", column]
        self.work(words, [dest], feedback)
        if self.parameterAsBoolean(parameters, "LOAD", context):
            load_heatmap(context, Path(dest), Path(dest).name, further=columns)
        self.made = [
            (tr("Open the picture"), Path(dest) / "heatmap.png"),
            (tr("Show the folder"), Path(dest)),
        ]
        return {"OUTPUT": dest, **layers_of(Path(dest))}


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
    further: Sequence[str] = (),
) -> None:
    """Have QGIS load a heat map as a group, the layer by interval on top and switched on.

    The project steps by its intervals, unless `sets_time` is false. Each of the `further` columns
    has a raster, switched off.
    """
    layers, titles = layers_of(folder), heatmap_titles(folder)
    finish = dress if sets_time else dress_only
    load(context, layers["INTERVALS"], titles[INTERVALS], group=group, order=3, finish=finish)
    load(context, layers["HEATMAP"], titles["heatmap"], group=group, order=2, visible=False)
    for name, source in {
        titles["raster"]: layers["RASTER"],
        **{column: str(folder / f"{column}.tif") for column in further},
    }.items():
        load(context, source, name, group=group, order=1, visible=False)
    ground = tr("Road, not observed")
    # In other words, as Processing loads a source once.
    source = f"{layers['HEATMAP']}|geometrytype=Polygon"
    load(context, source, ground, group=group, order=0, finish=as_ground)
