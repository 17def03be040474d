"""Algorithms from the results of a run: the report for people without QGIS, a QGIS project."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from qgis.core import QgsProcessingOutputFile

from ..base import RESULTS, WorkerAlgorithm
from ..parameters import (
    File,
    Folder,
    Given,
    Output,
    OutputFolder,
    Result,
    Switch,
)
from ..runner import Answer
from ..words import tr
from . import shared

PACKAGE = File("", "", optional=True, advanced=True, kinds="GeoPackages (*.gpkg)")


class WriteReport(WorkerAlgorithm):
    """An algorithm that writes the report of a run for people without QGIS."""

    NAME = "sitereport"
    COMMAND = "report"
    TITLE = "Report for people without QGIS"
    GROUP = RESULTS
    HELP = (
        "Writes a report of a site's run or of a heat map: a page for the browser (HTML), the same "
        "as PDF, and tables (CSV)."
    )
    KEYWORDS = ("html", "pdf", "csv")
    PARAMETERS = (
        Folder("RESULTS", "Results", "The folder of a site's run, or of a heat map.", ""),
        replace(shared.MAP_TITLE, about="The site's, without it."),
        replace(
            shared.TIMEZONE,
            about="Whose clocks its times follow, such as Europe/Berlin; the site's without.",
        ),
        shared.LANGUAGE,
        shared.CSV_LOCALE,
        replace(
            shared.DATASET, flag="--dataset", optional=True,
            about="What the heat map was made of, where it is not in the folder.",
        ),
        Switch(
            "NO_WAYS", "Without ways of vehicles",
            "Its diagrams of queues then show the queues alone.",
        ),
        OutputFolder(
            "OUTPUT", "Report",
            "A folder; without one the report goes into the folder of the results.", optional=True,
        ),
        Result("PAGE", "Report", kind=QgsProcessingOutputFile),
    )  # fmt: skip

    def finish(self, given: Given, answer: Answer) -> dict[str, Any]:
        page = next((path for path in answer.outputs if path.endswith(".html")), "")
        given.feedback.pushInfo(page)
        self.made = [
            (tr("Open the report"), Path(page)),
            (tr("Open the report as PDF"), Path(page).with_suffix(".pdf")),
            (tr("Show the folder"), Path(page).parent),
        ]
        return {"OUTPUT": given.outputs["OUTPUT"] or given.text("RESULTS"), "PAGE": page}


class WriteProject(WorkerAlgorithm):
    """An algorithm that writes a project which shows a heat map ready to present."""

    NAME = "qgisproject"
    COMMAND = "qgis"
    TITLE = "QGIS project of a heat map"
    GROUP = RESULTS
    HELP = (
        "Writes a QGIS project that shows a heat map ready to present: groups, styles, time and a "
        "print layout. A site's run makes one by itself.\n"
        "Its paths are relative: the folder with all of it can be moved."
    )
    KEYWORDS = ("qgz", "present", "layout")
    PARAMETERS = (
        Folder("HEATMAP", "Heat map", "A folder from 'Heat map'.", ""),
        replace(PACKAGE, name="SENSORS", title="Sensors", about="From 'Localize a radar'."),
        replace(PACKAGE, name="SIGHT", title="Sight", about="From 'What sensors see'."),
        replace(
            PACKAGE, name="LANES", title="Lanes", about="The tiles, which hold the lanes, too."
        ),
        replace(
            PACKAGE,
            name="FOOTPRINTS",
            title="Footprints",
            about="From 'Vehicles that move on the map'.",
        ),
        shared.MAP_TITLE,
        shared.SOURCE,
        replace(
            shared.TIMEZONE,
            about="Such as Europe/Berlin; without one that of the heat map.",
        ),
        shared.LANGUAGE,
        Output("OUTPUT", "QGIS project", kinds="QGIS projects (*.qgz)"),
    )  # fmt: skip

    def finish(self, given: Given, answer: Answer) -> dict[str, Any]:
        del answer
        self.made = [(tr("Open the project"), Path(given.outputs["OUTPUT"]))]
        return {}
