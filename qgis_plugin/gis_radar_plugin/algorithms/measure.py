"""Measure traffic: recordings of several sensors into a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterNumber,
    QgsProcessingParameterRange,
)

from ..base import TRAFFIC, WorkerAlgorithm, option
from ..parameters import (
    FRAME_TIMES,
    VIEWS,
    add_frame_times,
    add_hiding_scans,
    add_map,
    add_number,
    add_recordings,
    add_scan_crs,
    add_sight,
    add_tiles,
    add_timezone,
    add_views,
    given_words,
    recording_words,
    scan_words,
)
from ..words import tr

OPTIONS = (
    "SIGHT", "HITS_ONLY", "MIN_SPEED", "MIN_RCS", "ELEVATION_ERROR", "TIMEZONE", "JOBS",
)  # fmt: skip


class MeasureTraffic(WorkerAlgorithm):
    """An algorithm that measures hits and vehicles, and adds them to a dataset."""

    NAME = "measure"
    TITLE = "Measure traffic"
    GROUP = TRAFFIC
    HELP = (
        "Follows the vehicles that radars see along the lanes, all radars together, and finds "
        "which tiles they occupied for how long: occupancy. Hits are counted beside it; what "
        "several radars see at once counts once.\n"
        "Each recording belongs to a pose file: they are paired by name (R1.parquet and R1.json, "
        "or the sensor's name in the pose), and where no name fits by their order.\n"
        "The result is a dataset, a folder by the hour, for 'Heat map' and 'Data quality'. Further "
        "recordings of the same site are added to it; the hours that they touch are made again.\n"
        "It holds tracks of single vehicles: a working file. Measures over minutes leave it."
    )
    KEYWORDS = ("fusion", "sensors", "hits", "vehicles", "tracks", "occupancy")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        add_recordings(self, about="Of one or more sensors (Parquet or CSV).")
        add_tiles(self, about="From 'Split lanelets into tiles', all of them.")
        add_map(self, about="The map that the tiles were made from.")
        add_hiding_scans(self)
        add_sight(self)
        add_scan_crs(self)
        self.add(
            QgsProcessingParameterBoolean("HITS_ONLY", tr("Hits only"), False),
            about="Leaves out the vehicles: the maps then show the hit share, not occupancy.",
            advanced=True,
        )
        self._add_filters()
        add_views(self)
        add_frame_times(self)
        add_timezone(self, "The site's, such as Europe/Berlin; UTC without.")
        add_number(self, "JOBS", "Hours at once", "As cores and memory allow, without it.")
        self.add(
            QgsProcessingParameterFolderDestination("OUTPUT", tr("Dataset")),
            about="A folder; one that holds a dataset of the same tiles is added to.",
        )

    def _add_filters(self) -> None:
        """Add which detections count as hits."""
        self.add(
            QgsProcessingParameterRange(
                "CLEARANCE", tr("Height of hits over the road, m"),
                QgsProcessingParameterNumber.Type.Double, optional=True,
            ),
            about="-0.5 to 4.5 keeps vehicles, without the tree crowns over the kerb. "
            "The tiles need heights for it.",
            advanced=True,
        )  # fmt: skip
        add_number(
            self, "MIN_SPEED", "Least speed of hits, m/s",
            "Least absolute range rate; without it what stands counts too.",
        )  # fmt: skip
        add_number(self, "MIN_RCS", "Least radar cross section of hits, dBm2")
        add_number(
            self, "ELEVATION_ERROR", "Elevation error of the radars, deg",
            "One standard deviation, 0.5 without it: widens the heights that count with range.",
        )  # fmt: skip

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsString(parameters, "OUTPUT", context)
        words = [
            "measure", "-o", dest, *recording_words(self, parameters, context, feedback),
            "--map", self.parameterAsFile(parameters, "MAP", context),
            *scan_words(self, parameters, context),
            *given_words(self, parameters, context, (*OPTIONS, *VIEWS, *FRAME_TIMES)),
            *option("--clearance", self._clearance(parameters, context)),
        ]  # fmt: skip
        self.work(words, [dest], feedback)
        self.made = [(tr("Show the folder"), Path(dest))]
        return {"OUTPUT": dest}

    def _clearance(self, parameters: dict[str, Any], context: QgsProcessingContext) -> str:
        if parameters.get("CLEARANCE") in (None, "", "None,None"):
            return ""
        low, high = self.parameterAsRange(parameters, "CLEARANCE", context)
        if not low < high:  # also where QGIS gives NaN for an empty box
            raise QgsProcessingException(
                tr("Height over the road: give both limits, the lower one first.")
            )
        return f"{low},{high}"
