"""Convert recordings."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterMultipleLayers,
)

from ..base import TRAFFIC, WorkerAlgorithm
from ..words import tr


class ConvertRecordings(WorkerAlgorithm):
    """An algorithm that makes a recording of what a radar's driver wrote."""

    NAME = "convertrecordings"
    TITLE = "Convert recordings"
    GROUP = TRAFFIC
    HELP = (
        "Turns what a radar's driver wrote, in any known format, into one recording (Parquet) that "
        "the other algorithms read.\n"
        "Several files of the same sensor are joined in the order of their times."
    )
    KEYWORDS = ("pcap", "rosbag", "parquet", "import")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        self.add(
            QgsProcessingParameterMultipleLayers(
                "INPUT", tr("Files of one radar"), QgsProcessing.SourceType.TypeFile
            ),
            about="What the radar's driver wrote.",
        )
        self.add(
            QgsProcessingParameterFileDestination(
                "OUTPUT", tr("Recording"), tr("Recordings") + " (*.parquet)"
            ),
        )

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsFileOutput(parameters, "OUTPUT", context)
        files = self.files(parameters, "INPUT", context)
        self.work(["convert", *files, "-o", dest], [dest], feedback)
        return {"OUTPUT": dest}
