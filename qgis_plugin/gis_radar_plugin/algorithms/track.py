"""Follow a pose through a recording."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterFile,
    QgsProcessingParameterFileDestination,
)

from ..base import SITE, WorkerAlgorithm, option
from ..parameters import add_map, add_origin, add_road
from ..words import tr


class FollowPose(WorkerAlgorithm):
    """An algorithm that corrects a sensor's pose every 5 s, and notices when it was moved."""

    NAME = "trackpose"
    TITLE = "Follow a pose"
    GROUP = SITE
    HELP = (
        "Follows where a radar stands and looks through a recording: a corrected pose every 5 s, "
        "and a remark where it was knocked or moved.\n"
        "The result is a pose track (CSV), which the other algorithms take wherever they take a "
        "pose."
    )
    KEYWORDS = ("pose", "drift", "alignment")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        recordings, poses = tr("Recordings") + " (*.parquet *.csv)", tr("Poses") + " (*.json *.csv)"
        self.add(QgsProcessingParameterFile("RECORDING", tr("Recording"), fileFilter=recordings))
        self.add(
            QgsProcessingParameterFile("POSE", tr("Pose"), fileFilter=poses),
            about="Where it stands at the beginning.",
        )
        add_map(self)
        add_road(self, about="From 'Mask road from airborne scan'.")
        add_origin(self)
        self.add(
            QgsProcessingParameterFileDestination(
                "OUTPUT", tr("Pose track"), tr("Pose tracks") + " (*.csv)"
            )
        )
        self.add(
            QgsProcessingParameterFileDestination(
                "FIGURE", tr("Figure"), tr("Pictures") + " (*.png)", optional=True,
                createByDefault=False,
            ),
            about="The pose over time, with its error.",
        )  # fmt: skip

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsFileOutput(parameters, "OUTPUT", context)
        figure = self.parameterAsFileOutput(parameters, "FIGURE", context)
        words = [
            "track", self.parameterAsFile(parameters, "RECORDING", context),
            "--map", self.parameterAsFile(parameters, "MAP", context),
            "--road", self.parameterAsFile(parameters, "ROAD", context),
            "--pose", self.parameterAsFile(parameters, "POSE", context), "-o", dest,
            *option("--origin", self.parameterAsString(parameters, "ORIGIN", context)),
            *option("--figure", figure),
        ]  # fmt: skip
        self.work(words, [dest, *([figure] if figure else [])], feedback)
        return {"OUTPUT": dest, "FIGURE": figure}
