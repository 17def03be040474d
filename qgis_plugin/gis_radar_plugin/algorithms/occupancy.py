"""Occupancy from recordings of several sensors."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingFeedback,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterNumber,
    QgsProcessingParameterRange,
)

from ..base import TRAFFIC, WorkerAlgorithm, option
from ..parameters import (
    add_hiding_scans,
    add_recordings,
    add_scan_crs,
    add_tiles,
    recording_words,
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
        self.add(
            QgsProcessingParameterFile(
                "SIGHT", tr("Sight"), optional=True, fileFilter=tr("GeoPackages") + " (*.gpkg)"
            ),
            about="What sensors see, from gis-radar sight, in place of the scans.", advanced=True,
        )  # fmt: skip
        add_scan_crs(self)
        self.add(
            QgsProcessingParameterRange(
                "CLEARANCE", tr("Height over the road that counts, m"),
                QgsProcessingParameterNumber.Type.Double, optional=True,
            ),
            about="-0.5 to 4.5 keeps vehicles, without the tree crowns over the kerb. "
            "The tiles need heights for it.",
        )  # fmt: skip
        self.add(_number("MIN_SPEED", tr("Least speed, m/s")), advanced=True,
                 about="Least absolute range rate; without it what stands counts too.")  # fmt: skip
        self.add(_number("MIN_RCS", tr("Least radar cross section, dBm2")), advanced=True)
        self.add(_number("MAX_RANGE", tr("Range of poses without a view, m")), advanced=True)
        self.add(_number("AZIMUTH", tr("Azimuth of poses without a view, deg")), advanced=True)
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
        words = [
            "occupancy", "-o", dest, *recording_words(self, parameters, context, feedback),
            *option("--sight", self.parameterAsFile(parameters, "SIGHT", context)),
            *option("--clearance", self._clearance(parameters, context)),
        ]  # fmt: skip
        for flag, name in (
            ("--min-speed", "MIN_SPEED"), ("--min-rcs", "MIN_RCS"),
            ("--max-range", "MAX_RANGE"), ("--azimuth", "AZIMUTH"),
        ):  # fmt: skip
            if parameters.get(name) is not None:
                words += option(flag, self.parameterAsDouble(parameters, name, context))
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


def _number(name: str, title: str) -> QgsProcessingParameterNumber:
    kind = QgsProcessingParameterNumber.Type.Double
    return QgsProcessingParameterNumber(name, title, kind, None, optional=True)
