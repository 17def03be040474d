"""Algorithms of traffic by lane: volumes of an interval, and what changed between two periods."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from qgis.core import QgsProcessing, QgsProcessingOutputVectorLayer

from ..base import TRAFFIC, WorkerAlgorithm
from ..loading import load
from ..parameters import File, Folder, Given, Layer, OutputFolder, Result, Text
from ..runner import Answer
from ..words import tr
from . import shared


class CountTraffic(WorkerAlgorithm):
    """An algorithm that counts the traffic of lanes and turns by interval."""

    NAME = "traffic"
    COMMAND = "traffic"
    TITLE = "Traffic by lane"
    GROUP = TRAFFIC
    HELP = (
        "Counts the traffic of each lane and turn by interval: volumes with their errors, speeds, "
        "occupancy, delays, queues at stop lines. What was not visible is empty, not 0.\n"
        "Lines that you draw across roads are count sections, with volumes by direction; a count "
        "by hand can stand beside ours.\n"
        "The result is a GeoPackage whose layers the temporal controller animates, tables (CSV and "
        "a workbook), a turning diagram, and files for SUMO."
    )
    KEYWORDS = ("volume", "counts", "speed", "queue", "turns")
    PARAMETERS = (
        shared.DATASET,
        shared.INTERVAL,
        shared.BEGIN,
        shared.END,
        Layer(
            "SECTIONS", "Count sections",
            "Lines across roads, with their names in a field 'name'.",
            optional=True, source=QgsProcessing.SourceType.TypeVectorLine, layer="count_sections",
        ),
        File(
            "COUNTS", "Counts by hand",
            "CSV: section (and direction) or lane, begin, end, volume.",
            optional=True, kinds="Tables (*.csv)",
        ),
        shared.LANGUAGE,
        shared.CSV_LOCALE,
        OutputFolder("OUTPUT", "Traffic", "A folder."),
        Result("LANES", "Traffic of lanes", kind=QgsProcessingOutputVectorLayer),
        Result("TURNS", "Volumes of turns", kind=QgsProcessingOutputVectorLayer),
        Result("SECTION_VOLUMES", "Volumes of sections", kind=QgsProcessingOutputVectorLayer),
    )  # fmt: skip

    def finish(self, given: Given, answer: Answer) -> dict[str, Any]:
        del answer
        folder = Path(given.outputs["OUTPUT"])
        package = folder / "traffic.gpkg"
        layers = {name.upper(): f"{package}|layername={name}" for name in ("lanes", "turns")}
        show = partial(load, given.context, group=folder.name)
        show(layers["LANES"], tr("Traffic of lanes"), order=0)
        show(layers["TURNS"], tr("Volumes of turns"), order=1, legend=False)  # the same classes
        if given.has("SECTIONS"):
            layers["SECTION_VOLUMES"] = f"{package}|layername=sections"
            show(layers["SECTION_VOLUMES"], tr("Volumes of sections"), order=2, legend=False)
        self.made = [
            (tr("Open the workbook"), folder / "traffic.xlsx"), (tr("Show the folder"), folder)
        ]  # fmt: skip
        return layers


class ComparePeriods(WorkerAlgorithm):
    """An algorithm that says what changed by lane between two periods."""

    NAME = "compare"
    COMMAND = "compare"
    TITLE = "Before and after"
    GROUP = TRAFFIC
    HELP = (
        "Compares the traffic of two periods by lane: what got better, what worse, and what cannot "
        "be told. Only what the same sensors saw alike in both is compared.\n"
        "A period is written as 2026-09-07/2026-09-21, days of the week as Mo-Fr or Sa,Su.\n"
        "The result is a page, a table, maps, and a layer that colours lanes by the change of the "
        "volume, grey where none is told."
    )
    KEYWORDS = ("change", "difference", "evaluation")
    PARAMETERS = (
        shared.DATASET,
        Folder(
            "OTHER", "Second dataset", "Of the same tiles; with it, the period after is its.", "",
            optional=True,
        ),
        Text("BEFORE", "Before", "The first period: 2026-09-07/2026-09-21.", advanced=False),
        Text("AFTER", "After", "The second period: 2026-10-05/2026-10-19.", advanced=False),
        Text("DAYS", "Days of the week", "Only these: Mo-Fr or Sa,Su.", advanced=False),
        shared.LANGUAGE,
        shared.CSV_LOCALE,
        OutputFolder("OUTPUT", "Comparison", "A folder."),
        Result("LANES", "What changed by lane", kind=QgsProcessingOutputVectorLayer),
    )  # fmt: skip

    def finish(self, given: Given, answer: Answer) -> dict[str, Any]:
        del answer
        folder = Path(given.outputs["OUTPUT"])
        layer = f"{folder / 'compare.gpkg'}|layername=comparison"
        load(given.context, layer, tr("What changed by lane"), group=folder.name)
        self.made = [(tr("Open the page"), folder / "compare.html")]
        return {"LANES": layer}
