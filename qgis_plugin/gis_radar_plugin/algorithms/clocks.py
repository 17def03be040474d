"""Compare the clocks of several sensors."""

from __future__ import annotations

from typing import Any

from qgis.core import (
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingParameterFileDestination,
)

from ..base import TRAFFIC, WorkerAlgorithm
from ..parameters import add_recordings, add_text, add_tiles, given_words, recording_words
from ..words import tr


class CompareClocks(WorkerAlgorithm):
    """An algorithm that finds how far clocks are apart, by the traffic that sensors share."""

    NAME = "clocks"
    TITLE = "Compare clocks"
    GROUP = TRAFFIC
    HELP = (
        "Finds how far the clocks of several radars are apart, by the vehicles that two of them "
        "see.\n"
        "Give the result to 'Measure traffic', or to a site: times are then corrected."
    )
    KEYWORDS = ("time", "offset", "synchronization")

    def initAlgorithm(self, _configuration: Any = None) -> None:  # noqa: N802
        add_recordings(self, about="Of two or more sensors that see the same traffic.")
        add_tiles(self, about="From 'Split lanelets into tiles', all of them.")
        add_text(self, "REFERENCE", "Whose clock is right", "The name of a sensor.")
        self.add(
            QgsProcessingParameterFileDestination(
                "OUTPUT", tr("Clocks"), tr("Clocks") + " (*.json)"
            )
        )

    def processAlgorithm(  # noqa: N802
        self,
        parameters: dict[str, Any],
        context: QgsProcessingContext,
        feedback: QgsProcessingFeedback,
    ) -> dict[str, Any]:
        dest = self.parameterAsFileOutput(parameters, "OUTPUT", context)
        words = [
            "clocks", *recording_words(self, parameters, context, feedback), "-o", dest,
            *given_words(self, parameters, context, ("REFERENCE",)),
        ]  # fmt: skip
        self.work(words, [dest], feedback)
        return {"OUTPUT": dest}
