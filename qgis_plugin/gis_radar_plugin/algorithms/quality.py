"""Data quality of occupancies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessing,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterFile,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterMultipleLayers,
)

from ..base import TRAFFIC, WorkerAlgorithm
from ..parameters import add_csv_locale, add_timezone, given_words
from ..words import tr
from .heatmap import occupancies_in


class CheckQuality(WorkerAlgorithm):
    """An algorithm that lists what an occupancy rests on, by sensor and hour."""

    NAME = "quality"
    TITLE = "Data quality"
    GROUP = TRAFFIC
    HELP = (
        "Lists what an occupancy rests on, a row a sensor and hour: frames, detections, clocks, "
        "poses, and a verdict.\n"
        "What is odd is said in the log, too."
    )
    KEYWORDS = ("health", "gaps", "check")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        self.add(
            QgsProcessingParameterFile(
                "OCCUPANCY", tr("Occupancy"), QgsProcessingParameterFile.Behavior.Folder
            ),
            about="A folder from 'Occupancy from recordings', or the one of all sensors of a site.",
        )
        self.add(
            QgsProcessingParameterMultipleLayers(
                "MORE", tr("Further occupancy"), QgsProcessing.SourceType.TypeFile, optional=True
            ),
            about="The files manifest.json of more folders, which are merged.",
            advanced=True,
        )
        add_timezone(self, "Whose hours the rows are, such as Europe/Berlin; UTC without.")
        add_csv_locale(self)
        self.add(
            QgsProcessingParameterFileDestination(
                "OUTPUT", tr("Data quality"), tr("Tables") + " (*.csv *.parquet)"
            )
        )

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsFileOutput(parameters, "OUTPUT", context)
        folders = [
            *occupancies_in(self.parameterAsFile(parameters, "OCCUPANCY", context)),
            *[str(Path(path).parent) for path in self.files(parameters, "MORE", context)],
        ]
        words = ["quality", *folders, "-o", dest]
        words += given_words(self, parameters, context, ("TIMEZONE", "CSV_LOCALE"))
        self.work(words, [dest], feedback)
        return {"OUTPUT": dest}
