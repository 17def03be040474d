"""Split lanelets into tiles."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterCrs,
    QgsProcessingParameterFile,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
    QgsProcessingParameterVectorDestination,
)

from ..base import SITE, WorkerAlgorithm, option
from ..loading import finish_output, load
from ..words import tr

CRS_HELP = "A projected system in metres; without one the UTM zone of the site is taken."
ORIGIN_HELP = (
    "Only for maps whose latitudes and longitudes are empty or false: easting and northing "
    "of the map's local (0, 0), with a comma between them."
)


class SplitLanelets(WorkerAlgorithm):
    """An algorithm that makes a layer of tiles, and one of problems, of a Lanelet2 map."""

    NAME = "splitlanelets"
    TITLE = "Split lanelets into tiles"
    GROUP = SITE
    HELP = (
        "Splits the lanes of a Lanelet2 map into tiles of half a metre, the unit of statistics.\n"
        "The layer 'problems' of the same file lists what was mended or left out of the map.\n"
        "With a scanned road (from 'Mask road from airborne scan') the tiles have a height."
    )
    KEYWORDS = ("hd map", "osm", "lanes")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        self.add(
            QgsProcessingParameterFile(
                "MAP", tr("Lanelet2 map"), fileFilter=tr("Lanelet2 maps") + " (*.osm *.xml)"
            ),
            about="The HD map as an OSM file.",
        )
        self.add(
            QgsProcessingParameterFile(
                "ROAD", tr("Scanned road"), optional=True,
                fileFilter=tr("Point clouds") + " (*.laz *.las)",
            ),
            about="Gives the tiles' heights; needed to filter by height over the road.",
        )  # fmt: skip
        self.add(
            QgsProcessingParameterNumber(
                "LENGTH", tr("Length of a tile, m"), QgsProcessingParameterNumber.Type.Double,
                0.5, minValue=0.05, maxValue=100.0,
            ),
            advanced=True,
        )  # fmt: skip
        self.add(
            QgsProcessingParameterCrs("CRS", tr("Coordinate system"), optional=True),
            about=CRS_HELP, advanced=True,
        )  # fmt: skip
        self.add(
            QgsProcessingParameterString("SUBTYPE", tr("Lanelets of subtype"), optional=True),
            about="Such as road,highway; without it all but those for pedestrians and bicycles.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterString("ORIGIN", tr("Origin of the map"), optional=True),
            about=ORIGIN_HELP, advanced=True,
        )  # fmt: skip
        self.add(
            QgsProcessingParameterVectorDestination("OUTPUT", tr("Tiles")),
            about="GeoPackage with the layers 'tiles' and 'problems'.",
        )

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsOutputLayer(parameters, "OUTPUT", context)
        crs = self.parameterAsCrs(parameters, "CRS", context)
        words = [
            "tiles", self.parameterAsFile(parameters, "MAP", context), "-o", dest,
            "--length", str(self.parameterAsDouble(parameters, "LENGTH", context)),
            *option("--crs", crs_words(crs)),
            *option("--road", self.parameterAsFile(parameters, "ROAD", context)),
            *option("--subtype", self.parameterAsString(parameters, "SUBTYPE", context)),
            *option("--origin", self.parameterAsString(parameters, "ORIGIN", context)),
        ]  # fmt: skip
        answer = self.work(words, [dest], feedback)
        mended = answer.summary.get("repaired", 0) + answer.summary.get("left_out", 0)
        if finish_output(context, dest) and mended:
            load(context, f"{dest}|layername=problems", tr("Problems of the map"), visible=False)
        return {"OUTPUT": dest, "TILES": answer.summary.get("tiles", 0)}


def crs_words(crs: Any) -> str:
    """Return a coordinate system as the worker reads it, empty where there is none."""
    if not crs.isValid():
        return ""
    return str(crs.authid() or crs.toWkt())
