"""Detections of a recording as points in the map."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterFile,
    QgsProcessingParameterFileDestination,
)

from ..base import TRAFFIC, WorkerAlgorithm, option
from ..loading import load
from ..parameters import add_map, add_origin
from ..words import tr


class ShowDetections(WorkerAlgorithm):
    """An algorithm that puts the detections of a recording into the map."""

    NAME = "detections"
    TITLE = "Detections on the map"
    GROUP = TRAFFIC
    HELP = (
        "Puts each detection of a recording into the map, as points with their measures: a "
        "GeoPackage for QGIS, a point cloud (LAZ) or a table (Parquet) for other programs.\n"
        "A layer of a long recording is large: an hour has millions of points."
    )
    KEYWORDS = ("points", "hits", "projection")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        recordings, poses = tr("Recordings") + " (*.parquet *.csv)", tr("Poses") + " (*.json *.csv)"
        self.add(QgsProcessingParameterFile("RECORDING", tr("Recording"), fileFilter=recordings))
        self.add(QgsProcessingParameterFile("POSE", tr("Pose"), fileFilter=poses))
        add_map(
            self, optional=True,
            about="Adds the lane of each detection, where on it that lies, and how fast it moves "
            "along it.",
        )  # fmt: skip
        add_origin(self)
        kinds = ";;".join(
            f"{tr(words)} ({ends})" for words, ends in
            (("GeoPackages", "*.gpkg"), ("Point clouds", "*.laz"), ("Tables", "*.parquet"))
        )  # fmt: skip
        self.add(QgsProcessingParameterFileDestination("OUTPUT", tr("Detections"), kinds))

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsFileOutput(parameters, "OUTPUT", context)
        words = [
            "project", self.parameterAsFile(parameters, "RECORDING", context),
            "--pose", self.parameterAsFile(parameters, "POSE", context), "-o", dest,
            *option("--map", self.parameterAsFile(parameters, "MAP", context)),
            *option("--origin", self.parameterAsString(parameters, "ORIGIN", context)),
        ]  # fmt: skip
        self.work(words, [dest], feedback)
        if dest.lower().endswith(".gpkg"):
            load(context, dest, tr("Detections"))
        return {"OUTPUT": dest}
