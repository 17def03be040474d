"""Data quality of a dataset."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterFileDestination,
)

from ..base import TRAFFIC, WorkerAlgorithm
from ..parameters import add_csv_locale, add_dataset, add_timezone, given_words
from ..words import tr


class CheckQuality(WorkerAlgorithm):
    """An algorithm that lists what a dataset rests on, by sensor and hour."""

    NAME = "quality"
    TITLE = "Data quality"
    GROUP = TRAFFIC
    HELP = (
        "Lists what a dataset rests on, a row a sensor and hour: frames, detections, "
        "clocks, poses, and a verdict.\n"
        "What is odd is said in the log, too."
    )
    KEYWORDS = ("health", "gaps", "check")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        add_dataset(self)
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
        words = ["quality", self.parameterAsFile(parameters, "DATASET", context), "-o", dest]
        words += given_words(self, parameters, context, ("TIMEZONE", "CSV_LOCALE"))
        self.work(words, [dest], feedback)
        return {"OUTPUT": dest}
