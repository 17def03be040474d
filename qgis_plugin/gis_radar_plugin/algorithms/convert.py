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
from ..parameters import add_choice, add_text, given_words
from ..words import tr

OPTIONS = ("SENSOR", "COLUMNS", "TIME_UNIT", "CLOCK")


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
        add_text(
            self, "SENSOR", "Only this sensor",
            "Where the files have several: its address or topic, such as 10.13.1.113.",
        )  # fmt: skip
        add_text(
            self, "COLUMNS", "Columns of a table",
            "Ours and those of the table: x=X,range_rate=-doppler; a minus turns the sign.",
        )  # fmt: skip
        add_choice(self, "TIME_UNIT", "Unit of the times in a table", ("s", "ms", "us", "ns"))
        add_choice(
            self, "CLOCK", "Whose clock counts", ("auto", "sensor", "recorder"),
            "auto takes the sensor's where it is right.",
        )  # fmt: skip
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
        words = ["convert", *files, "-o", dest, *given_words(self, parameters, context, OPTIONS)]
        self.work(words, [dest], feedback)
        return {"OUTPUT": dest}
