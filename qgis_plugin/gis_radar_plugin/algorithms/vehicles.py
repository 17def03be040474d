"""Vehicles in the recordings of several sensors."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterCrs,
    QgsProcessingParameterFeatureSource,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterMultipleLayers,
)

from ..base import TRAFFIC, WorkerAlgorithm, option
from ..inputs import TILE_FIELDS, TILES, layer_file
from ..words import tr
from .occupancy import paired
from .tiles import crs_words


class FollowVehicles(WorkerAlgorithm):
    """An algorithm that follows the vehicles that several sensors see."""

    NAME = "vehicles"
    TITLE = "Vehicles from recordings"
    GROUP = TRAFFIC
    HELP = (
        "Follows the vehicles that radars see along the lanes, all radars together, and finds "
        "which tiles they covered for how long. 'Heat map' makes a map of coverage of it.\n"
        "Give it the same recordings, poses, tiles and scans as 'Occupancy from recordings'; "
        "recordings and poses are paired by name, and where no name fits by their order.\n"
        "The folder holds the tracks of single vehicles, by 50 ms and half a metre: a working "
        "file. Measures over minutes leave it."
    )
    KEYWORDS = ("tracks", "coverage", "sensors")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        files = QgsProcessing.SourceType.TypeFile
        self.add(
            QgsProcessingParameterMultipleLayers("RECORDINGS", tr("Recordings"), files),
            about="Of one or more sensors (Parquet or CSV), with range rates.",
        )
        self.add(
            QgsProcessingParameterMultipleLayers("POSES", tr("Poses"), files),
            about="As many pose files (JSON) or pose tracks (CSV) as recordings.",
        )
        self.add(
            QgsProcessingParameterFeatureSource(
                "TILES", tr("Tiles"), [QgsProcessing.SourceType.TypeVectorPolygon]
            ),
            about="From 'Split lanelets into tiles', all of them.",
        )
        self.add(
            QgsProcessingParameterFile(
                "MAP", tr("Lanelet2 map"), fileFilter=tr("Lanelet2 maps") + " (*.osm *.xml)"
            ),
            about="The map that the tiles were made from.",
        )
        self.add(
            QgsProcessingParameterMultipleLayers(
                "SCANS", tr("Airborne scans"), files, optional=True
            ),
            about="LAS or LAZ, whole and not masked: what stands in them hides tiles, which then "
            "are not observed. Without them all that is within the view counts as seen.",
        )  # fmt: skip
        self.add(
            QgsProcessingParameterCrs("SCAN_CRS", tr("CRS of the scans"), optional=True),
            about="Only for scans without one.", advanced=True,
        )  # fmt: skip
        self.add(
            QgsProcessingParameterFolderDestination("OUTPUT", tr("Vehicles")),
            about="A folder for 'Heat map'.",
        )

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsString(parameters, "OUTPUT", context)
        recordings = self.files(parameters, "RECORDINGS", context)
        poses = paired(recordings, self.files(parameters, "POSES", context))
        tiles, _ = layer_file(
            self, parameters, "TILES", context, layer_name=TILES, fields=TILE_FIELDS
        )
        lanes = self.parameterAsFile(parameters, "MAP", context)
        words = ["vehicles", *recordings, "--tiles", tiles, "--map", lanes, "-o", dest]
        for pose in poses:
            words += ["--pose", pose]
        for scan in self.files(parameters, "SCANS", context):
            words += ["--scan", scan]
        words += option(
            "--scan-crs", crs_words(self.parameterAsCrs(parameters, "SCAN_CRS", context))
        )
        self.work(words, [dest], feedback)
        return {"OUTPUT": dest}
