"""Single vehicles as a layer that moves with the time."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterFile,
    QgsProcessingParameterVectorDestination,
)

from ..base import TRAFFIC, WorkerAlgorithm
from ..loading import finish_output
from ..words import tr


class ShowVehicles(WorkerAlgorithm):
    """An algorithm that makes a layer of the footprints of vehicles, half second by half second."""

    NAME = "footprints"
    TITLE = "Vehicles that move on the map"
    GROUP = TRAFFIC
    HELP = (
        "Makes a layer of single vehicles as rectangles of their length and width, which the "
        "temporal controller moves half second by half second: blue are light ones, green heavy "
        "ones, hollow are those that stand, pale those whose place is inferred.\n"
        "It shows tracks of single vehicles: a working file for checks, not to be published. "
        "Measures over minutes leave it."
    )
    KEYWORDS = ("tracks", "animation", "temporal")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        self.add(
            QgsProcessingParameterFile(
                "VEHICLES", tr("Vehicles"), QgsProcessingParameterFile.Behavior.Folder
            ),
            about="A folder from 'Vehicles from recordings'.",
        )
        self.add(
            QgsProcessingParameterVectorDestination("OUTPUT", tr("Footprints")),
            about="GeoPackage, a row a vehicle and half second.",
        )

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsOutputLayer(parameters, "OUTPUT", context)
        vehicles = self.parameterAsFile(parameters, "VEHICLES", context)
        self.work(["footprints", vehicles, "-o", dest], [dest], feedback)
        finish_output(context, dest)
        return {"OUTPUT": dest}
