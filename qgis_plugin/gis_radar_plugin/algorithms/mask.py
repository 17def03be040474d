"""Mask the road out of an airborne scan."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterFeatureSource,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterMultipleLayers,
)

from ..base import SITE, WorkerAlgorithm, option
from ..inputs import layer_file
from ..parameters import (
    add_choice,
    add_crs,
    add_map,
    add_origin,
    add_scan_crs,
    crs_words,
    given_words,
)
from ..words import tr


class MaskRoad(WorkerAlgorithm):
    """An algorithm that cuts the road's surface out of an airborne scan."""

    NAME = "maskroad"
    TITLE = "Mask road from airborne scan"
    GROUP = SITE
    HELP = (
        "Keeps the road of an airborne laser scan (LAS, LAZ, COPC): one point each half metre, at "
        "the height of its surface.\n"
        "What is road is given by a Lanelet2 map, or by a layer of polygons, which may be "
        "filtered, selected or in memory.\n"
        "The result is a LAZ file, which the other algorithms read."
    )
    KEYWORDS = ("lidar", "laz", "point cloud")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        self.add(
            QgsProcessingParameterMultipleLayers(
                "SCANS", tr("Airborne scans"), QgsProcessing.SourceType.TypeFile
            ),
            about="One or more LAS or LAZ files of the site.",
        )
        add_map(self, about="The HD map; or choose road polygons below.", optional=True)
        self.add(
            QgsProcessingParameterFeatureSource(
                "ROADS", tr("Road polygons"), [QgsProcessing.SourceType.TypeVectorPolygon],
                optional=True,
            ),
            about="A layer of polygons, in place of the map.",
        )  # fmt: skip
        add_scan_crs(self)
        add_crs(self)
        add_origin(self)
        add_choice(
            self, "ENGINE", "Who reads the scans", ("auto", "pdal", "laspy"),
            "auto takes PDAL where there is one.",
        )  # fmt: skip
        self.add(
            QgsProcessingParameterFileDestination(
                "OUTPUT", tr("Road"), tr("Point clouds") + " (*.laz)"
            ),
            about="The road's surface as LAZ.",
        )

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsFileOutput(parameters, "OUTPUT", context)
        crs = crs_words(self, parameters, "CRS", context)
        words = [
            "mask", *self.files(parameters, "SCANS", context), "-o", dest,
            *self._roads(parameters, context, reprojected=bool(crs)),
            *given_words(self, parameters, context, ("ENGINE",)),
            *crs, *crs_words(self, parameters, "SCAN_CRS", context),
            *option("--origin", self.parameterAsString(parameters, "ORIGIN", context)),
        ]  # fmt: skip
        self.work(words, [dest], feedback)
        return {"OUTPUT": dest}

    def _roads(
        self, parameters: dict[str, Any], context: QgsProcessingContext, *, reprojected: bool
    ) -> list[str]:
        """Return the words that name the map or the layer: one of them, not both."""
        lanelets = self.parameterAsFile(parameters, "MAP", context)
        polygons = parameters.get("ROADS") not in (None, "")
        if bool(lanelets) == polygons:
            raise QgsProcessingException(
                tr("Choose either a Lanelet2 map or a layer of road polygons.")
            )
        if lanelets:
            return ["--map", lanelets]
        path, layer = layer_file(
            self, parameters, "ROADS", context, layer_name="roads", metric=not reprojected
        )
        return ["--map", path, "--layer", layer]
