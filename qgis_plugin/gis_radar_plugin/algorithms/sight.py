"""What sensors see past what stands in a scan."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterVectorDestination,
)

from ..base import SITE, WorkerAlgorithm
from ..loading import finish_output
from ..parameters import add_hiding_scans, add_scan_crs, add_tiles, paired, scan_words, tile_file
from ..words import tr


class FindSight(WorkerAlgorithm):
    """An algorithm that finds which tiles sensors see, and which something hides."""

    NAME = "sight"
    TITLE = "What sensors see"
    GROUP = SITE
    HELP = (
        "Finds which tiles radars see from where they stand, and which are hidden by what stands "
        "in an airborne scan: houses, walls, trees.\n"
        "With recordings, tiles are listed where these contradict the scan, such as what was built "
        "or pulled down since, and what they see is corrected. 'Measure traffic' takes "
        "the result in place of the scans."
    )
    KEYWORDS = ("visibility", "line of sight", "viewshed")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        files = QgsProcessing.SourceType.TypeFile
        self.add(
            QgsProcessingParameterMultipleLayers("POSES", tr("Poses"), files),
            about="Of each sensor: pose files (JSON) or pose tracks (CSV).",
        )
        add_tiles(self, about="From 'Split lanelets into tiles', with heights.")
        add_hiding_scans(self)
        self.add(
            QgsProcessingParameterMultipleLayers(
                "RECORDINGS", tr("Recordings"), files, optional=True
            ),
            about="One a pose, to correct what the scan shows.",
        )
        add_scan_crs(self)
        self.add(
            QgsProcessingParameterVectorDestination("OUTPUT", tr("Sight")),
            about="GeoPackage, a row a sensor and tile.",
        )

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsOutputLayer(parameters, "OUTPUT", context)
        poses = self.files(parameters, "POSES", context)
        recordings = self.files(parameters, "RECORDINGS", context)
        if recordings:
            poses = paired(recordings, poses)
        words = ["sight", "-o", dest, "--tiles", tile_file(self, parameters, context)]
        for flag, files in (("--pose", poses), ("--recording", recordings)):
            for file in files:
                words += [flag, file]
        self.work([*words, *scan_words(self, parameters, context)], [dest], feedback)
        finish_output(context, dest)
        return {"OUTPUT": dest}
