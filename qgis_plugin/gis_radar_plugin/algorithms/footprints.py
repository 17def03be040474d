"""Single vehicles as a layer that moves with the time."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterVectorDestination,
)

from ..base import TRAFFIC, WorkerAlgorithm
from ..loading import finish_output
from ..parameters import add_dataset
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
        add_dataset(self)
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
        dataset = self.parameterAsFile(parameters, "DATASET", context)
        self.work(["footprints", dataset, "-o", dest], [dest], feedback)
        finish_output(context, dest)
        return {"OUTPUT": dest}
