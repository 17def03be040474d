"""Split lanelets into tiles."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterFeatureSource,
    QgsProcessingParameterField,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
    QgsProcessingParameterVectorDestination,
)

from ..base import SITE, WorkerAlgorithm, option
from ..inputs import layer_file
from ..loading import finish_output, load
from ..parameters import add_crs, add_map, add_origin, add_road, crs_words
from ..words import tr


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
        add_map(self, about="The HD map as an OSM file.")
        add_road(
            self, about="Gives the tiles' heights; needed to filter by height over the road.",
            optional=True,
        )  # fmt: skip
        self.add(
            QgsProcessingParameterNumber(
                "LENGTH", tr("Length of a tile, m"), QgsProcessingParameterNumber.Type.Double,
                0.5, minValue=0.05, maxValue=100.0,
            ),
            advanced=True,
        )  # fmt: skip
        add_crs(self)
        self.add(
            QgsProcessingParameterString("SUBTYPE", tr("Lanelets of subtype"), optional=True),
            about="Such as road,highway; without it all but those for pedestrians and bicycles.",
            advanced=True,
        )
        add_origin(self)
        lines = [QgsProcessing.SourceType.TypeVectorLine]
        self.add(
            QgsProcessingParameterFeatureSource("STREETS", tr("Streets"), lines, optional=True),
            about="Lines with names, for lanes that the map does not name.", advanced=True,
        )  # fmt: skip
        self.add(
            QgsProcessingParameterField(
                "STREET_FIELD", tr("Field with their names"), parentLayerParameterName="STREETS",
                optional=True,
            ),
            advanced=True,
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
        words = [
            "tiles", self.parameterAsFile(parameters, "MAP", context), "-o", dest,
            "--length", str(self.parameterAsDouble(parameters, "LENGTH", context)),
            *crs_words(self, parameters, "CRS", context),
            *option("--road", self.parameterAsFile(parameters, "ROAD", context)),
            *option("--subtype", self.parameterAsString(parameters, "SUBTYPE", context)),
            *option("--origin", self.parameterAsString(parameters, "ORIGIN", context)),
        ]  # fmt: skip
        if parameters.get("STREETS") not in (None, ""):
            streets, _ = layer_file(
                self, parameters, "STREETS", context, layer_name="streets", metric=False
            )
            names = self.parameterAsStrings(parameters, "STREET_FIELD", context)
            words += ["--streets", streets, *option("--street-field", "".join(names[:1]))]
        answer = self.work(words, [dest], feedback)
        mended = answer.summary.get("repaired", 0) + answer.summary.get("left_out", 0)
        if finish_output(context, dest) and mended:
            load(context, f"{dest}|layername=problems", tr("Problems of the map"), visible=False)
        return {"OUTPUT": dest, "TILES": answer.summary.get("tiles", 0)}
