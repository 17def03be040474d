"""The sample site: files to try everything on."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterFolderDestination,
)

from ..base import SET_UP, WorkerAlgorithm
from ..words import tr


class SampleSite(WorkerAlgorithm):
    """An algorithm that copies the sample junction to a folder."""

    NAME = "samplesite"
    TITLE = "Get the sample site"
    GROUP = SET_UP
    HELP = (
        "Copies the files of a made-up junction to a folder, to try everything on: a Lanelet2 map, "
        "an airborne scan, recordings and poses of two radars."
    )
    KEYWORDS = ("example", "demo", "tutorial")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        self.add(QgsProcessingParameterFolderDestination("OUTPUT", tr("Sample site")))

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsString(parameters, "OUTPUT", context)
        self.work(["sample", "-o", dest], [dest], feedback)
        return {"OUTPUT": dest}
