"""Vehicles in the recordings of several sensors."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterFolderDestination,
)

from ..base import TRAFFIC, WorkerAlgorithm
from ..parameters import (
    FRAME_TIMES,
    VIEWS,
    add_frame_times,
    add_hiding_scans,
    add_map,
    add_recordings,
    add_scan_crs,
    add_sight,
    add_tiles,
    add_views,
    given_words,
    recording_words,
    scan_words,
)
from ..words import tr


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
        add_recordings(self, about="Of one or more sensors (Parquet or CSV), with range rates.")
        add_tiles(self, about="From 'Split lanelets into tiles', all of them.")
        add_map(self, about="The map that the tiles were made from.")
        add_hiding_scans(self)
        add_sight(self)
        add_scan_crs(self)
        add_views(self)
        add_frame_times(self)
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
        words = [
            "vehicles", "-o", dest, *recording_words(self, parameters, context, feedback),
            "--map", self.parameterAsFile(parameters, "MAP", context),
            *scan_words(self, parameters, context),
            *given_words(self, parameters, context, ("SIGHT", *VIEWS, *FRAME_TIMES)),
        ]  # fmt: skip
        self.work(words, [dest], feedback)
        return {"OUTPUT": dest}
