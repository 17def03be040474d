"""What a dataset holds; recordings that moved or are withdrawn."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingOutputFolder,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterFile,
)

from ..base import TRAFFIC, WorkerAlgorithm
from ..parameters import add_dataset, add_file, given_words
from ..words import tr


class KeepDataset(WorkerAlgorithm):
    """An algorithm that says what a dataset holds, and changes its recordings."""

    NAME = "dataset"
    TITLE = "What a dataset holds"
    GROUP = TRAFFIC
    HELP = (
        "Shows what a dataset holds: sensors, hours, tracks, passages.\n"
        "It finds recordings again that were moved, and withdraws one that does not belong there; "
        "the hours that this touches are made again."
    )
    KEYWORDS = ("withdraw", "relink", "check")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        add_dataset(self)
        folder = QgsProcessingParameterFile.Behavior.Folder
        self.add(
            QgsProcessingParameterFile("RELINK", tr("Folder of moved recordings"), folder,
                                       optional=True),
            about="Recordings that are not where they were are looked for in it.",
        )  # fmt: skip
        add_file(
            self, "WITHDRAW", "Recording to withdraw", "Recordings (*.parquet *.csv)",
            "The dataset is then as if it had never been measured.",
        )  # fmt: skip
        self.add(
            QgsProcessingParameterBoolean("CHECK", tr("Check all files"), False),
            about="Whether each file is as it was written.", advanced=True,
        )  # fmt: skip
        self.addOutput(QgsProcessingOutputFolder("OUTPUT", tr("Dataset")))

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dataset = self.parameterAsFile(parameters, "DATASET", context)
        more = given_words(self, parameters, context, ("RELINK", "WITHDRAW", "CHECK"))
        self.work(["dataset", dataset, *more], [dataset], feedback)
        return {"OUTPUT": dataset}
