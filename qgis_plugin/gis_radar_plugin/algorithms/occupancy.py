"""Occupancy from recordings of several sensors."""

from __future__ import annotations

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
    add_number,
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


class MeasureOccupancy(WorkerAlgorithm):
    """An algorithm that measures occupancy from recordings and poses of several sensors."""

    NAME = "occupancy"
    TITLE = "Occupancy from recordings"
    GROUP = TRAFFIC
    HELP = (
        "Finds which tile was hit in which step of 50 ms, by one or more radars; what several "
        "radars see at once counts once.\n"
        "Each recording belongs to a pose file: they are paired by name (R1.parquet and R1.json, "
        "or the sensor's name in the pose), and where no name fits by their order.\n"
        "The layer of tiles may be filtered or selected: then only these tiles count, and the heat "
        "map must be made with the same ones."
    )
    KEYWORDS = ("fusion", "sensors")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        add_recordings(self, about="One a sensor (Parquet or CSV).")
        add_tiles(self, about="From 'Split lanelets into tiles'.")
        add_hiding_scans(self)
        add_sight(self)
        add_scan_crs(self)
        self.add(
            QgsProcessingParameterRange(
                "CLEARANCE", tr("Height over the road that counts, m"),
                QgsProcessingParameterNumber.Type.Double, optional=True,
            ),
            about="-0.5 to 4.5 keeps vehicles, without the tree crowns over the kerb. "
            "The tiles need heights for it.",
        )  # fmt: skip
        add_number(
            self, "MIN_SPEED", "Least speed, m/s",
            "Least absolute range rate; without it what stands counts too.",
        )  # fmt: skip
        add_number(self, "MIN_RCS", "Least radar cross section, dBm2")
        add_number(
            self, "ELEVATION_ERROR", "Elevation error of the radars, deg",
            "One standard deviation, 0.5 without it: widens the heights that count with range.",
        )  # fmt: skip
        add_views(self)
        add_frame_times(self)
        self.add(
            QgsProcessingParameterBoolean("PAIRS", tr("Also write each hit"), False),
            about="hits.parquet: each pair of step and tile, for programs of your own.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterFolderDestination("OUTPUT", tr("Occupancy")),
            about="A folder; folders of any times and sensors go together into a heat map.",
        )

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsString(parameters, "OUTPUT", context)
        filters = ("MIN_SPEED", "MIN_RCS", "ELEVATION_ERROR", "PAIRS", "SIGHT")
        words = [
            "occupancy", "-o", dest, *recording_words(self, parameters, context, feedback),
            *scan_words(self, parameters, context),
            *given_words(self, parameters, context, (*filters, *VIEWS, *FRAME_TIMES)),
            *option("--clearance", self._clearance(parameters, context)),
        ]  # fmt: skip
        self.work(words, [dest], feedback)
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
